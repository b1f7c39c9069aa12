"""Parameter files: what is read from them, and that what is written reads back the same."""

import json
import time

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import format_parameters, read_parameters, write_parameters
from hypothesis import given, settings, strategies
import pytest
from ruamel.yaml import YAML

PACKAGE = {
    'package.mass': 2.17, 'package.inertia': (0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0),
    'package.com': (0.0, 0.0, -0.03)}
LISTS = {p.name: p.choices[:2] or ('a', 'b')
         for p in PARAMETERS.values() if p.kind == 'string_array'}


@pytest.fixture
def file(tmp_path):
    """Provide a function that reads a text as a parameter file."""

    def read(text, node=None):
        path = tmp_path / 'p.yaml'
        path.write_text(text)
        return read_parameters(path, node)

    return read


@pytest.mark.parametrize('text', [
    'package.mass: 2\ncup: {length: 0.05}\n',
    'package:\n  mass: 2.0\ncup.length: 0.05\n',
    '/**:\n  ros__parameters:\n    package:\n      mass: 2\n    cup.length: 0.05\n',
    'predictor:\n  ros__parameters: {package.mass: 2, cup.length: 0.05}\n',
    'identifier:\n  ros__parameters: {package: {mass: 2}, cup: {length: 5e-2}}\n',
    '/cell/predictor:\n  ros__parameters: {package.mass: 2, cup.length: 0.05}\n',
    'cell:\n  predictor:\n    ros__parameters: {package.mass: 2, cup.length: 0.05}\n',
    '/**/predictor:\n  ros__parameters: {package.mass: 2, cup.length: 0.05}\n',
    '/*: {ros__parameters: {package.mass: 2}}\n'
    'predictor: {ros__parameters: {cup.length: 0.05}}\n',
    'use_sim_time: true\npackage.mass: 2\ncup.length: 0.05\n'])
def test_every_form_gives_the_same_values(file, text):
    assert file(text) == {'package.mass': 2.0, 'cup.length': 0.05}


BOTH = """
/**:
  ros__parameters:
    package.mass: 1.0
    qos_overrides: {/tool_arm/pose: {subscription: {depth: 5}}}
predictor:
  ros__parameters: {package.mass: 2.0, frames.tool: flange}
/cell/identifier:
  ros__parameters: {package.mass: 3.0}
camera:
  ros__parameters: {exposure: 7}
"""


def test_a_node_is_given_what_ros_would_give_it(file):
    assert file(BOTH, 'predictor') == {'package.mass': 2.0, 'frames.tool': 'flange'}
    assert file(BOTH, 'identifier') == {'package.mass': 3.0}
    with pytest.raises(BellowsError, match=r'7.*package\.mass'):
        file(BOTH)


@pytest.mark.parametrize('text, named', [
    ('package.mas: 1\n', "line 1: .*'package.mas'.*'package.mass'"),
    ('cup:\n  length: 0.05\n  stifness: [1]\n', "line 3: .*'cup.stiffness'"),
    *((text, 'line 2: .*package.mass') for text in (
        'package:\n  mass: two\n', 'package:\n  mass:\n', 'package.mass: 1\npackage.mass: 1\n')),
    ('cup.stiffness: [1.0, 2.0]\n', r'line 1: cup.stiffness .*\b36\b.*\b2\b'),
    ('cup: {length: 0.05}\ncup.length: 0.06\n', 'line 2: .*cup.length'),
    *((f'{name}: 3\n', f"line 1: .*'{name}'") for name in ('package', '1', 'a')),
    ('', ''), ('- 1\n', ''), ('camera: {ros__parameters: {a: 1}}\n', "camera.*'/\\*\\*:'"),
    ('/**: {ros__parameters: 3}\n', "ros__parameters .*'name: value'"),
    ('a: !!python/name:os.system\n', 'line 1: ')])
def test_errors_name_the_line_and_the_remedy(file, text, named):
    with pytest.raises(BellowsError, match=rf'p\.yaml.*{named}'):
        file(text)


def test_all_values_come_back(tmp_path):
    values = {
        **resolve(PACKAGE), **LISTS,
        'bags': ('a', "b's: #{}[]", '-', 'true', '1.0', ' x ', 'ü', "/it's", '/\u202eleft\\"',
                 '/\U0001f600\x85two', '/three\u2028lines')}
    write_parameters(tmp_path / 'p.yaml', values, ['A cup'])
    assert read_parameters(tmp_path / 'p.yaml') == values


@settings(deadline=None)
@given(strategies.floats(1e-300, 1e4, exclude_min=True))
def test_doubles_keep_every_digit_and_their_point(value):
    text = format_parameters({'package.mass': value})
    (line,) = (line for line in text.splitlines() if 'mass:' in line)
    written = line.split()[1]
    assert float(written) == value
    assert '.' in written
    for version in ((1, 1), (1, 2)):
        reader = YAML(typ='safe', pure=True)
        reader.version = version
        assert reader.load(text)['/**']['ros__parameters']['package.mass'] == value


def test_a_value_that_is_not_allowed_is_not_written(tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text('old')
    for values in ({'package.mass': float('nan')}, {'unknown': 1}, {'cup.stiffness': [0.0] * 36}):
        with pytest.raises(BellowsError):
            write_parameters(path, values)
    assert path.read_text() == 'old'


PATIENCE = 20.0  # s, for what takes three


def load(path, text):
    """Load a text as a file."""
    path.write_text(text)
    return safe_yaml.load(path)


@pytest.mark.parametrize('text, value', [
    ('1e-05', 1e-5), ('-2E+3', -2e3), ('1.5e4', 1.5e4), ('6417.0', 6417.0), ('12', 12),
    ('.nan', pytest.approx(float('nan'), nan_ok=True)), ('true', True), ('~', None),
    ('1:30', '1:30'), ('1:30.5', '1:30.5'), ('0x1F', 31), ('-0b11', -3), ('08', 8.0),
    ('1_000', 1000), ('+.5', 0.5), ('-.inf', -float('inf')), ('0', 0),
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
    (b'[' * 20_000, None), (b'\xff\xff', 'UTF-8'), (b'a: \0', None),
    (b'- 1\n---\n- 2\n', 'another document')], ids=range(4))
def test_what_is_no_yaml_is_refused(tmp_path, data, figure):
    (tmp_path / 'a').write_bytes(data)
    begin = time.process_time()
    with pytest.raises(BellowsError, match=figure):
        safe_yaml.load(tmp_path / 'a')
    assert time.process_time() - begin < PATIENCE


@pytest.mark.parametrize('is_json', [False, True])
def test_long_yaml_is_read_fast(is_json, tmp_path):
    """Take much less than a millisecond for a point of a plan, where pure Python takes two."""
    count, joints = 2000, 6
    lines = [f'- positions: {[0.1 * k + joint for joint in range(joints)]}\n  velocities:\n'
             + '  - 0.5\n' * joints + f'  time_from_start: {{sec: {k}, nanosec: 5}}\n'
             for k in range(count)]
    expected = [{'positions': [0.1 * k + joint for joint in range(joints)],
                 'velocities': [0.5] * joints, 'time_from_start': {'sec': k, 'nanosec': 5}}
                for k in range(count)]
    (tmp_path / 'a').write_text(json.dumps(expected) if is_json else ''.join(lines))
    begin = time.process_time()
    assert safe_yaml.load(tmp_path / 'a') == expected
    assert time.process_time() - begin < 1e-3 * count
