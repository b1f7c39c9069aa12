"""Nested settings: what is read, and the words in which the rest is refused."""

from bellows_ros.core.parameters.checks import Settings
from bellows_ros.errors import BellowsError
from bellows_ros.files.safe_yaml import load
import pytest

BLOCK = {
    'rate': 3, 'count': 2, 'on': False, 'kind': 'b', 'name': 'x', 'vector': [1, 2.5, -3],
    'inner': {'size': 0.5}, 'list': [{'a': 1}, {'a': 2}], 'huge': 10**400, 'far': -1e300,
    'none': None}


def test_values_are_given_as_asked_for():
    settings = Settings(BLOCK)
    assert settings.number('rate') == 3.0 and isinstance(settings.number('rate'), float)
    assert settings.integer('count', 0) == 2
    assert settings.flag('on', True) is False
    assert settings.choice('kind', ('a', 'b')) == 'b'
    assert settings.text('name') == 'x'
    assert settings.vector('vector', 3).tolist() == [1.0, 2.5, -3.0]
    assert settings.numbers('vector').tolist() == [1.0, 2.5, -3.0]
    assert settings.block('inner').number('size') == 0.5
    assert [block.number('a') for block in settings.blocks('list')] == [1.0, 2.0]


def test_what_is_not_given_has_its_default():
    settings = Settings(None)
    assert settings.number('rate', 1.5) == 1.5
    assert settings.vector('vector', 2, (0.0, 1.0)).tolist() == [0.0, 1.0]
    assert settings.block('inner').number('size', 2.0) == 2.0
    settings.done()


@pytest.mark.parametrize(('read', 'named'), [
    (lambda s: s.number('rate', unit='Hz', above=3.0), r"'rate' .* 3 \(Hz\).* 3\."),
    (lambda s: s.number('missing', unit='Hz'), r"'missing' .*\(Hz\)"),
    (lambda s: s.number('huge'), "'huge' .* 1000"),
    (lambda s: s.integer('rate', 0, maximum=2), "'rate' .* 0 .* 2, .* 3"),
    (lambda s: s.flag('rate', True), r"'rate' .* true or false.* 3\."),
    (lambda s: s.choice('kind', ('a', 'c')), r"'kind' .* a, c.* 'b'\."),
    (lambda s: s.vector('vector', 2, unit='m'), r"'vector' .* 2 .*\(m\).* 3 "),
    (lambda s: s.number('far'), r"'far' .* -1e\+15 .* 1e\+15.* -1e\+300\."),
    (lambda s: s.block('rate'), r"'rate' .* 3\."),
    (lambda s: s.blocks('list')[1].number('b'), r"'list\[1\]\.b'")])
def test_a_wrong_value_is_named_with_what_it_must_be(read, named):
    with pytest.raises(BellowsError, match=named):
        read(Settings(BLOCK))


def test_unknown_names_are_refused_with_the_nearest():
    settings = Settings({'noise': {'postion': 1.0, 'zzz': 2.0}}).block('noise')
    settings.number('position', 0.0)
    settings.number('rotation', 0.0)
    with pytest.raises(BellowsError, match=r"'noise\.postion'.*'noise\.position'"):
        settings.done()
    with pytest.raises(BellowsError, match="'zzz'"):
        Settings({'zzz': 1}).done()


@pytest.mark.parametrize('content', [3, 'text', [1], {1: 2}])
def test_a_file_that_is_no_block_is_refused(content):
    with pytest.raises(BellowsError):
        Settings(content)


@pytest.mark.parametrize(('read', 'line'), [
    (lambda s: s.number('rate', above=10.0), 1),
    (lambda s: s.block('inner').number('size'), 3),
    (lambda s: s.block('inner').number('other'), 2),  # missing: the block that lacks it
    (lambda s: [each.number('a', maximum=1.5) for each in s.blocks('list')], 6),
    (lambda s: (s.block('inner').text('size', 'x'), s.number('rate'), s.done()), 4),
    (lambda s: s.block('rate'), 1)])
def test_an_error_begins_with_the_file_and_the_line(tmp_path, read, line):
    file = tmp_path / 'limits.yaml'
    file.write_text('rate: 3.0\ninner:\n  size: "x"\nlist:\n  - a: 1.0\n  - a: 2.0\n')
    with pytest.raises(BellowsError) as caught:
        read(Settings(load(file)))
    assert str(caught.value).startswith(f'{file}, line {line}: ')
