"""The configuration files that are shipped: read by us, taken by ROS, units on every line."""

import runpy

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.table import parameters_for
from bellows_ros.files.parameter_files import read_parameters
import pytest

NAMES = ('predictor', 'identifier', 'cup_thesis')


@pytest.mark.parametrize('name', (*NAMES, 'ur'))
def test_every_value_has_its_unit(name, root):
    """Find a comment on every line that holds a value, and read the file."""
    file = root / 'config' / f'{name}.yaml'
    assert read_parameters(file)
    for line in file.read_text().splitlines():
        text, _, comment = line.partition('#')
        is_heading = text.strip().endswith(':')
        assert comment.strip() or is_heading or not text.strip(), line


@pytest.mark.parametrize('name', NAMES)
def test_our_reader_takes_it(name, root):
    """Read every file with the checks of the table, and show what holds without the file."""
    values = read_parameters(root / 'config' / f'{name}.yaml')
    if name == 'cup_thesis':
        cup = Cup.thesis()
        assert values['cup.stiffness'] == tuple(cup.stiffness.ravel())
        assert values['cup.damping'] == tuple(cup.damping.ravel())
        assert values['cup.length'] == cup.length
    elif name == 'predictor':
        assert {f'package.{own}' for own in ('mass', 'inertia', 'com')} == set(values)
    else:
        ours = {p.name for p in parameters_for(name)}
        of_the_cup = ('cup.stiffness', 'cup.damping', 'cup.length', 'cup.relaxation',
                      'cup.stretch', 'cup.valid_', 'cup.layout', 'cup.open')
        # ROS has no empty list to show.
        of_many = ('package.files', 'static.bags', 'validation.bags', 'fit.free')
        shown = set(values) | {n for n in ours if n.startswith((*of_the_cup, *of_many))}
        assert ours - shown == set(), 'not in the file'
    chosen = {'bags', 'cup.length', 'output.parameters', 'output.json'}  # of the recording, names
    for parameter in (p for user in ('predictor', 'identifier') for p in parameters_for(user)):
        if parameter.default is not None and parameter.name in set(values) - chosen:
            assert values[parameter.name] == parameter.default, parameter.name


def test_launch_file_gives_the_package_after_the_cup(root):
    """Let the package of the user prevail there, too, and do without a cup."""
    launched = runpy.run_path(str(root / 'launch' / 'predictor.launch.py'))
    usual = {name: default for name, (default, _) in launched['ARGUMENTS'].items()}
    switches = {'autostart': True, 'use_sim_time': False}

    for cup, files in (('c.yaml', ['c.yaml', 'p.yaml']), ('', ['p.yaml'])):
        node = launched['node_arguments']({**usual, 'params_file': 'p.yaml', 'cup_file': cup})
        assert node['parameters'] == [*files, switches] and node['remappings'] == []


def test_launch_file_remaps_every_topic(root, make_predictor):
    """Give each topic of a running node an argument; pass simulated time on."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    launched = runpy.run_path(str(root / 'launch' / 'predictor.launch.py'))
    value = {name: default for name, (default, _) in launched['ARGUMENTS'].items()}
    value |= {'params_file': 'p.yaml', 'use_sim_time': 'True'}
    value |= {name: f'/cell/{name}' for name in launched['TOPICS']}
    arguments = launched['node_arguments'](value)
    assert arguments['parameters'][-1] == {'autostart': True, 'use_sim_time': True}
    remaps = [word for pair in arguments['remappings'] for word in ('-r', ':='.join(pair))]
    node = make_predictor(cli_args=['--ros-args', *remaps])
    own = {end.topic_name for end in (*node.subscriptions, *node.publishers)}
    others = {name for name in own if not name.startswith('/cell/')}
    assert others <= {'/parameter_events', '/rosout', '/predictor/transition_event'}
    assert len(own - others) > 20


def test_predictor_starts_with_its_files(root, make_predictor):
    """Give the real node both files, as a user would."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    files = [root / 'config' / f'{name}.yaml' for name in ('cup_thesis', 'predictor')]
    node = make_predictor({}, cli_args=[
        '--ros-args', *(part for file in files for part in ('--params-file', str(file)))])

    expected = {name: value for file in files for name, value in read_parameters(file).items()}
    for name, value in expected.items():
        shown = node.get_parameter(name).value
        assert (tuple(shown) if isinstance(value, tuple) else shown) == value
    assert node.overridden == set(expected)
