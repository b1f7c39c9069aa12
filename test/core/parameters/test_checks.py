"""The parameter table, nested settings, and the refusal of wrong values."""

from array import array
import pickle
import re

from bellows_ros.core.model.structure import inertia_matrix
from bellows_ros.core.parameters import checks
from bellows_ros.core.parameters.checks import resolve, Settings
from bellows_ros.core.parameters.table import lookup, PARAMETERS, SUCCESSORS
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError, NotSetError
from bellows_ros.files.safe_yaml import load
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_array_equal
import pytest

PACKAGE = {
    'package.mass': 2.17, 'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03]}
PYTHON = {
    'bool': bool, 'integer': int, 'double': float, 'string': str, 'double_array': tuple,
    'string_array': tuple}
IDENTITY = np.eye(6)


def changed(values, index, value):
    """Return 36 numbers with one changed."""
    items = list(np.ravel(values))
    items[index] = value
    return items


@pytest.mark.parametrize('parameter', PARAMETERS.values(), ids=lambda p: p.name)
def test_every_parameter_has_a_description(parameter):
    assert parameter.description.endswith('.')
    assert parameter.used_by and set(parameter.used_by) <= {'identifier', 'predictor'}
    assert parameter.constraint
    if parameter.default is None:
        assert parameter.example
    else:
        assert checks.validate(parameter.name, parameter.default) == parameter.default
        assert isinstance(parameter.default, PYTHON[parameter.kind])


def test_resolve_fills_in_defaults_but_not_the_package():
    values = checks.resolve({'gravity.magnitude': 9})
    assert values['gravity.magnitude'] == 9.0
    assert isinstance(values['gravity.magnitude'], float)
    assert not set(checks.RECORDING_PARAMETERS) & set(values)
    known = {**PACKAGE, 'recording.package_frame': 'lip'}
    assert set(checks.resolve(known, checks.RECORDING_PARAMETERS)) == set(PARAMETERS)


def test_missing_required_parameters_are_shown_as_they_are_to_be_set():
    with pytest.raises(BellowsError) as error:
        checks.resolve({'package.com': [0, 0, 0]}, checks.PACKAGE_PARAMETERS)
    message = str(error.value)
    assert 'package.mass: 2.17  # kg' in message
    assert 'package.inertia: [' in message
    assert 'package.com' not in message


@pytest.mark.parametrize('name, suggested', [
    ('package.mas', "'package.mass'"), ('mass', "'package.mass'"),
    ('gravity.direktion', "'gravity.direction'"),
    ('package.xyzzy', 'package.mass, package.inertia, package.com'),
    ('package', 'package.mass, package.inertia, package.com'), ('zzzzzzzzzz', r'topics\.\*'),
    *((name.replace('*', 'any'), re.escape(successor)) for name, successor in SUCCESSORS.items())])
def test_an_unknown_name_is_refused_with_the_nearest_or_those_of_its_group(name, suggested):
    with pytest.raises(BellowsError, match=f"'{name}'.*{suggested}"):
        lookup(name)


def test_successors_are_parameters_of_today_and_old_names_are_not():
    groups = {name.partition('.')[0] for name in PARAMETERS}
    for name, successor in SUCCESSORS.items():
        assert name not in PARAMETERS
        named = re.findall(r'[a-z_]+\.[a-z_]+', successor)
        assert {each for each in named if each.partition('.')[0] in groups} <= {*PARAMETERS}


def test_an_unknown_name_is_shown_shortened_and_printable():
    with pytest.raises(BellowsError) as error:
        lookup('q' * 10_000 + '\x1b[2J')
    assert len(str(error.value)) < 2000
    assert '\x1b' not in str(error.value)


@pytest.mark.parametrize('name, value, normal', [
    ('package.mass', 2, 2.0), ('package.mass', np.float32(2.5), 2.5),
    ('package.com', np.array([0.0, 0.1, -0.2]), (0.0, 0.1, -0.2)),
    ('package.com', array('d', [0.0, 0.1, -0.2]), (0.0, 0.1, -0.2)),
    ('wrench.frame', np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0]) / 2.0, '0 0 0 0 0 0 1'),
    ('recording.align_at_rest', True, True),
    ('bags', ['a', 'b'], ('a', 'b')), ('topics.tool_twist', '', ''),
    ('cup.damping', [0] * 36, (0.0,) * 36)])
def test_values_are_brought_to_their_normal_form(name, value, normal):
    result = checks.validate(name, value)
    assert result == normal
    assert type(result) is type(normal)
    if isinstance(normal, tuple):
        assert {type(x) for x in result} <= {float, str}


@pytest.mark.parametrize('name, value, figures', [
    ('package.mass', True, 'bool'), ('package.mass', 0.0, r'\b0 '),
    ('package.mass', 10**400, r'\b10000 \(kg\)'), ('package.com', [0.0, 0.0], r'\b3 .* 2\b'),
    ('package.com', [0.0, 0.0, float('nan')], 'index 2'), ('cup.length', 53.5, r'53.5 .* m\b'),
    ('gravity.magnitude', -9.81, r'\b0 '), ('gravity.direction', [0.0, 0.0, 0.0], ''),
    ('release.mass_range', [2.0, 1.0], '2 to 1 kg'),
    ('recording.align_at_rest', 1, 'true or false'),
    ('recording.world', 'y_up', 'z_up, motive_y_up'), ('topics.tool_pose', '', ''),
    ('topics.tool_pose', 'a\nb', ''), ('bags', ['a', ''], 'index 1'),
    ('cup.stiffness', changed(IDENTITY, 3, 0.25),
     'row 1, column 4 is 0.25, row 4, column 1 is 0'),
    ('cup.stiffness', changed(IDENTITY, 7, 0.0), 'eigenvalue is 0,'),
    ('cup.damping', changed(IDENTITY, 7, -1e-3), 'eigenvalue is -0.001,'),
    *(('vacuum.holding', held, r'\b60000\b') for held in (0.6, 600.0))])
def test_values_are_refused_with_what_they_may_be(name, value, figures):
    with pytest.raises(BellowsError, match=f'{name}.*{figures}') as error:
        checks.validate(name, value)
    assert error.value.exit_code == 2


@given(st.lists(st.tuples(*[st.floats(-1.0, 1.0)] * 3), min_size=4, max_size=8))
def test_inertia_of_any_body_is_taken(points):
    # Point masses: the integral of (r^2 I - r r^T), which is what an inertia is.
    r = np.array(points)
    moments = np.einsum('ni,ni->', r, r) * np.eye(3) - r.T @ r
    if np.linalg.eigvalsh(moments)[0] <= 1e-9:
        return  # all on one line, no body
    xx, xy, xz, yy, yz, zz = moments[np.triu_indices(3)]
    values = [xx, yy, zz, xy, xz, yz]
    assert checks.validate('package.inertia', values) == tuple(values)
    assert_array_equal(inertia_matrix(values), moments)


@pytest.mark.parametrize(('name', 'value'), [
    ('package.inertia', [8.7, 8.7, 17.3, 0.0, 0.0, 0.0]), ('package.com', [0.0, 2.0, -0.03]),
    ('package.mass', 2170.0), ('package.com', [0.0, 0.0, 0.03])])
def test_a_package_in_another_unit_is_questioned(name, value):
    assert not checks.implausible(checks.resolve(PACKAGE))
    doubt, *_ = checks.implausible(checks.resolve({**PACKAGE, name: value}))
    assert doubt.startswith(f'{name} ')


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.binary(max_size=5) | st.dates(),
    lambda inner: st.lists(inner, max_size=36) | st.dictionaries(
        st.text(max_size=2), inner, max_size=2),
    max_leaves=40)


@given(st.sampled_from(sorted(PARAMETERS)), anything)
def test_any_value_is_either_normal_or_refused(name, value):
    try:
        normal = checks.validate(name, value)
    except BellowsError as error:
        assert len(str(error)) < 1000
    else:
        assert checks.validate(name, normal) == normal
        assert isinstance(normal, PYTHON[PARAMETERS[name].kind])


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
    assert settings.vector('vector', 3).tolist() == [1.0, 2.5, -3.0]
    assert settings.block('inner').number('size') == 0.5
    assert [block.number('a') for block in settings.blocks('list')] == [1.0, 2.0]
    empty = Settings(None)
    assert empty.number('rate', 1.5) == 1.5 and empty.block('inner').number('size', 2.0) == 2.0
    empty.done()


@pytest.mark.parametrize(('read', 'named'), [
    (lambda s: s.number('rate', unit='Hz', above=3.0), r"'rate' .* 3 \(Hz\).* 3\."),
    (lambda s: s.number('missing', unit='Hz'), r"'missing' .*\(Hz\)"),
    (lambda s: s.number('huge'), "'huge' .* 1000"),
    (lambda s: s.integer('rate', 0, maximum=2), "'rate' .* 0 .* 2, .* 3"),
    (lambda s: s.flag('rate', True), r"'rate' .* true or false.* 3 "),
    (lambda s: s.choice('kind', ('a', 'c')), r"'kind' .* a, c.* 'b'\."),
    (lambda s: s.vector('vector', 2, unit='m'), r"'vector' .* 2 .*\(m\).* 3 "),
    (lambda s: s.number('far'), r"'far' .* -1e\+15 .* 1e\+15.* -1e\+300\."),
    (lambda s: s.block('rate'), r"'rate' .* 3\."),
    (lambda s: Settings([1]), r'The file .*\[1\]'), (lambda s: Settings({1: 2}), '1: 2'),
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


@pytest.mark.parametrize(('read', 'line'), [
    (lambda s: s.number('rate', above=10.0), 1),
    (lambda s: s.block('inner').number('size'), 3),
    (lambda s: s.block('inner').number('other'), 2),  # missing: the block that lacks it
    (lambda s: [each.number('a', maximum=1.5) for each in s.blocks('list')], 6),
    (lambda s: (s.block('inner').choice('size', ('x',)), s.number('rate'), s.done()), 4),
    (lambda s: s.block('rate'), 1)])
def test_an_error_begins_with_the_file_and_the_line(tmp_path, read, line):
    file = tmp_path / 'limits.yaml'
    file.write_text('rate: 3.0\ninner:\n  size: "x"\nlist:\n  - a: 1.0\n  - a: 2.0\n')
    with pytest.raises(BellowsError) as caught:
        read(Settings(load(file)))
    assert str(caught.value).startswith(f'{file}, line {line}: ')


VALUES = resolve({'package.mass': 1.8})


def test_every_name_is_an_attribute():
    with pytest.raises(NotSetError, match=r"'package\.inertia' is not set"):
        VALUES.package.inertia  # noqa: B018
    for name, value in VALUES.items():
        found = VALUES
        for part in name.split('.'):
            found = getattr(found, part)
        assert found == value
    assert set(VALUES) <= {*PARAMETERS}


def test_values_reach_other_processes():
    copy = pickle.loads(pickle.dumps(VALUES))
    assert copy == VALUES and copy.package.mass == 1.8
    assert isinstance(copy, Values)
