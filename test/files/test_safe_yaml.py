"""YAML that cannot do harm, and errors that name the line."""

import time

from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
import pytest

PATIENCE = 20.0  # s, for what takes three


def load(path, text):
    """Load a text as a file."""
    path.write_text(text)
    return safe_yaml.load(path)


@pytest.mark.parametrize('text, value', [
    ('1e-05', 1e-5), ('-2E+3', -2e3), ('1.5e4', 1.5e4), ('6417.0', 6417.0), ('12', 12),
    ('.nan', pytest.approx(float('nan'), nan_ok=True)), ('true', True), ('~', None),
    ('1:30', '1:30'), ('1:30.5', '1:30.5'), ('0x1F', 31), ('-0b11', -3), ('017', 15),
    ('08', '08'), ('1_000', 1000), ('+.5', 0.5), ('-.inf', -float('inf')), ('0', 0),
    ('1.', 1.0), ('0.5e-3', 0.5e-3), ('.', '.'), ('+', '+'), ('1.2.3', '1.2.3'),
    ('2024-05-01', '2024-05-01'), ('e5', 'e5'), ("'1'", '1'), ('[1, a]', [1, 'a'])])
def test_values_are_those_ros_would_take(tmp_path, text, value):
    loaded = load(tmp_path / 'a', f'key: {text}\n')['key']
    assert loaded == value
    assert type(loaded) is type(value) or not isinstance(value, int | float | str)


@pytest.mark.parametrize('text, line, named', [
    ('a: 1\nb: 2\na: 3\n', 3, "'a'"), ('a:\n  b: 1\n  b: 2\n', 3, "'b'"),
    ('a: 1\nb: &x 1\nc: *x\n', 2, '&name'), ('a: 1\nb: *x\n', 2, ''), ('a: &x [*x]\n', 1, '&name'),
    ('a: {c: 1}\nb:\n  <<: {d: 1}\n', 3, '<<'),
    ('a: 1\n? [1, 2]\n: 3\n', 2, ''), ('a: 1\n---\nb: 2\n', 2, ''), ('a: 1\n  b: 2\n', 2, ''),
    ('a: 1\nb: !!python/object/apply:os.system [echo]\n', 2, '!name'),
    ('a: [1,\n', 2, ''), ('a: "x\n', 2, '')])
def test_errors_name_the_line(tmp_path, text, line, named):
    with pytest.raises(BellowsError, match=rf'a, line {line}: .*{named}'):
        load(tmp_path / 'a', text)


@pytest.mark.parametrize('data, figure', [
    (b'[' * 20_000, None), (b'\xff\xff', 'UTF-8'), (b'a: \0', None), (b'x: ' + b'1' * 5000, None),
    (b'- 1\n---\n- 2\n', 'another document')], ids=range(5))
def test_what_is_no_yaml_is_refused(tmp_path, data, figure):
    (tmp_path / 'a').write_bytes(data)
    begin = time.process_time()
    with pytest.raises(BellowsError, match=figure):
        safe_yaml.load(tmp_path / 'a')
    assert time.process_time() - begin < PATIENCE


def test_a_long_message_is_read_at_some_megabytes_a_second(tmp_path):
    """A plan, as it is printed; its length is not bounded."""
    point = '- positions:\n' + '  - 0.12345678901\n' * 6 + (
        '  time_from_start:\n    sec: 1\n    nanosec: 2000000\n')
    count = 2_000_000 // len(point)
    begin = time.process_time()
    loaded = load(tmp_path / 'a', 'points:\n' + point * count + '---\n')
    assert time.process_time() - begin < PATIENCE
    assert len(loaded['points']) == count
    assert loaded['points'][-1] == {
        'positions': [0.12345678901] * 6, 'time_from_start': {'sec': 1, 'nanosec': 2000000}}


def test_a_megabyte_that_looks_like_one_number_is_a_text(tmp_path):
    """Digits with colons are a number to the base of 60 in YAML 1.1, computed for minutes."""
    begin = time.process_time()
    assert load(tmp_path / 'a', 'x: 1' + ':1' * (2**19 - 9))['x'].startswith('1:1')
    assert time.process_time() - begin < PATIENCE


def test_what_is_no_file_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / 'none', '/dev/zero'):
        with pytest.raises(BellowsError, match=f"'{path}'"):
            safe_yaml.load(type(tmp_path)(path))


def test_lines_lead_to_each_key(tmp_path):
    (tmp_path / 'a').write_text('# comment\na:\n  b: 1\n  c: {d: 2}\n"e f": [1]\n')
    content = safe_yaml.load(tmp_path / 'a')
    assert content == {'a': {'b': 1, 'c': {'d': 2}}, 'e f': [1]}
    lines = {('a',): 2, ('a', 'b'): 3, ('a', 'c'): 4, ('a', 'c', 'd'): 4, ('e f',): 5}
    assert all(content.where(keys) == f'{tmp_path / "a"}, line {line}: '
               for keys, line in lines.items())
