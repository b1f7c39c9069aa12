"""Parameter files: what is read from them, and that what is written reads back the same."""

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.errors import BellowsError
from bellows_ros.files import parameter_files
from bellows_ros.files.parameter_files import (
    format_parameters,
    read_parameters,
    write_parameters,
)
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


@pytest.mark.parametrize(('name', 'option'), [
    ('bags/transport.yaml', '--motion'), ('config/limits_example.yaml', '--limits')])
def test_another_file_of_ours_is_refused_with_its_option(name, option, root):
    with pytest.raises(BellowsError, match=option):
        parameter_files.read_parameters(root / name)


def test_all_values_come_back(tmp_path):
    values = {
        **resolve(PACKAGE), **LISTS,
        'bags': ('a', "b's: #{}[]", '-', 'true', '1.0', ' x ', 'ü', "/it's", '/\u202eleft\\"',
                 '/\U0001f600\x85two', '/three\u2028lines')}
    write_parameters(tmp_path / 'p.yaml', values, ['A cup'])
    assert read_parameters(tmp_path / 'p.yaml') == values


STIFF = tuple(Cup.thesis().stiffness.ravel().tolist())
SOFT = tuple(0.5 * x for x in STIFF)
NAMED = {
    'cups.soft.stiffness': SOFT, 'cups.hard.length': 0.05, 'cup.name': 'soft',
    'cups.hard.stiffness': STIFF, 'cups.soft.friction': 0.3, 'package.mass': 2.0,
    'cups.soft.damping': tuple(Cup.thesis().damping.ravel().tolist()),
    'cups.hard.stiffness_std': (0.0,) * 36}


def test_named_cups_come_back(tmp_path):
    path = tmp_path / 'p.yaml'
    write_parameters(path, NAMED)
    assert read_parameters(path) == NAMED
    text = path.read_text()
    assert [text.count(f'{name}:') for name in ('cups', 'soft', 'hard')] == [1, 1, 1]
    assert text.count('# ry: N, N m/rad') == 2  # units stand beside the rows of each K
    write_parameters(path, {**resolve({**PACKAGE, **NAMED})})  # ROS has no empty lists
    assert read_parameters(path) == {
        name: value for name, value in resolve({**PACKAGE, **NAMED}).items() if value != ()}


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
        assert reader.load(text)['/**']['ros__parameters']['package']['mass'] == value


def test_a_value_that_is_not_allowed_is_not_written(tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text('old')
    for values in ({'package.mass': float('nan')}, {'unknown': 1}, {'cup.stiffness': [0.0] * 36}):
        with pytest.raises(BellowsError):
            write_parameters(path, values)
    assert path.read_text() == 'old'
