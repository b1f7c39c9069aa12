"""Everything a user can get wrong has its own message, ends with 2, and touches no output."""

from typing import Any

from bellows_ros.files.bag_writer import Recorded, write_bag
import numpy as np
import pytest
import yaml

from .conftest import contents, diagonal, PACKAGE, STIFFNESS, TOPICS, write_yaml

POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
RATE_HZ = 200.0
START_NS = 1_700_000_000_000_000_000
BEFORE = 'what was there before'

Case = tuple[dict[str, Any], list[str]]


def still(topic, seconds, start_s=0.0, kind=POSE):
    """Return messages of a body that does not move."""
    count = round(seconds * RATE_HZ)
    first_ns = START_NS + round(start_s * 1e9)
    stamps_ns = first_ns + np.round(np.arange(count) * 1e9 / RATE_HZ).astype(np.int64)
    values = np.zeros((count, 7 if kind == POSE else 6))
    if kind == POSE:
        values[:, 6] = 1.0
    return Recorded(topic, kind, stamps_ns, values)


def bag_of(folder, *recorded):
    """Write a recording."""
    write_bag(folder / 'bad', recorded)
    return folder / 'bad'


# ---- recordings ---------------------------------------------------------------------------------

def missing(folder, good):
    """Name a recording that is not there."""
    return folder / 'bad'


def empty_folder(folder, good):
    """Make a folder without anything."""
    (folder / 'bad').mkdir()
    return folder / 'bad'


def empty_bag(folder, good):
    """Make a recording whose metadata knows topics but no message was recorded."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_typestore, Stores

    with Writer(folder / 'bad', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/tool_arm/pose', POSE, typestore=get_typestore(Stores.ROS2_JAZZY))
    return folder / 'bad'


def no_recording(folder, good):
    """Name a file that is something else."""
    (folder / 'bad.mcap').write_text('certainly not a recording')
    return folder / 'bad.mcap'


def other_topics(folder, good):
    """Record under other names."""
    return bag_of(folder, still('/arm/pose', 5.0), still('/box/pose', 5.0))


def other_type(folder, good):
    """Record twists where poses belong."""
    return bag_of(
        folder, still('/tool_arm/pose', 5.0, kind=TWIST),
        still('/tool_arm/twist', 5.0, kind=TWIST), still('/package/pose', 5.0))


def apart_in_time(folder, good):
    """Record the package a minute after the tool."""
    return bag_of(
        folder, still('/tool_arm/pose', 5.0), still('/tool_arm/twist', 5.0, kind=TWIST),
        still('/package/pose', 5.0, start_s=60.0))


BAD_BAGS = {
    'missing': (missing, ['bad', 'not']),
    'empty folder': (empty_folder, ['bad']),
    'empty bag': (empty_bag, ['bad', 'no message']),
    'no recording': (no_recording, ['bad.mcap', 'neither an MCAP nor an SQLite file']),
    'wrong topic': (other_topics, [
        "Topic '/tool_arm/pose' is not in", '/arm/pose', '/box/pose', 'Set topics.tool_pose']),
    'wrong type': (other_type, [
        "Topic '/tool_arm/pose'", TWIST, 'accepted are', POSE, '/package/pose']),
    'apart in time': (apart_in_time, ['/package/pose', '60']),
}


# ---- parameters ---------------------------------------------------------------------------------

BAD_PARAMETERS = {
    'no mass': (
        {'package.mass': None},
        ['package.mass', 'without a default', 'package.mass: 2.17', 'kg']),
    'inertia of no body': (
        {'package.inertia': [0.001, 0.001, 0.010, 0.0, 0.0, 0.0]},
        ['package.inertia', '0.01', 'at most the sum of the other two', 'kg m^2']),
    'negative inertia': (
        {'package.inertia': [-0.001, 0.001, 0.001, 0.0, 0.0, 0.0]},
        ['package.inertia', 'above zero']),
    'K of 35 numbers': (
        {'cup.stiffness': diagonal(STIFFNESS)[:35]},
        ['cup.stiffness must be a list of 36 numbers', 'got 35']),
    'K not definite': (
        {'cup.stiffness': diagonal((*STIFFNESS[:5], -1.0))},
        ['cup.stiffness is not positive definite', '-1']),
    'unknown name': (
        {'package.weight': 1.8},
        ["Unknown parameter 'package.weight'", 'Did you mean', 'parameters.yaml, line']),
    'near name': (
        {'filter.tool.half_windows': 20},
        ["Did you mean 'filter.tool.half_window'?"]),
    'wrong kind': (
        {'package.mass': 'heavy'},
        ['package.mass must be a number', 'kg', 'heavy']),
    'NaN': (
        {'package.mass': float('nan')},
        ['package.mass must be a number', 'nan']),
}


@pytest.fixture
def outputs(tmp_path):
    """Give a folder with outputs of before."""
    folder = tmp_path / 'outputs'
    folder.mkdir()
    for name in ('cup.yaml', 'fit.json', 'replay.json'):
        (folder / name).write_text(BEFORE)
    return folder


def check_refusal(done, outputs, before, words):
    """Check exit code, message and that nothing was touched."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ''
    assert done.stderr.startswith('bellows: ')
    assert 'Traceback' not in done.stderr
    for word in words:
        assert word in done.stderr
    assert contents(outputs) == before


def identify_command(bag, parameters, outputs):
    """Return arguments that write both outputs."""
    return ['identify', bag, '--params', parameters,
            '--out', outputs / 'cup.yaml', '--json', outputs / 'fit.json']


def replay_command(bag, parameters, outputs):
    """Return arguments that write the scores."""
    return ['replay', bag, '--params', parameters, '--json', outputs / 'replay.json']


COMMANDS = {'identify': identify_command, 'replay': replay_command}


@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize('name', BAD_BAGS)
def test_a_bad_recording(name, command, bellows, workshop, outputs, tmp_path):
    """Say what is wrong with a recording."""
    make, words = BAD_BAGS[name]
    bag = make(tmp_path, workshop / 'recording')
    before = contents(outputs)
    done = bellows(*COMMANDS[command](bag, workshop / 'cup.yaml', outputs))
    check_refusal(done, outputs, before, words)


@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize('name', BAD_PARAMETERS)
def test_a_bad_parameter(name, command, bellows, workshop, outputs, tmp_path):
    """Say which parameter is wrong, and what it must be."""
    change, words = BAD_PARAMETERS[name]
    values = {**PACKAGE, **TOPICS, **change}
    values = {key: value for key, value in values.items() if value is not None}
    before = contents(outputs)
    file = write_yaml(tmp_path / 'parameters.yaml', values)
    done = bellows(*COMMANDS[command](workshop / 'recording', file, outputs))
    check_refusal(done, outputs, before, words)


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('package: [1, 2', ['parameters.yaml, line', 'not valid YAML']),
        ('just a sentence', ['parameters.yaml', "Give 'name: value' lines"]),
        ('', ['parameters.yaml', "Give 'name: value' lines"]),
        ('package:\n  mass: 1.0\n  mass: 2.0\n', ['line 3', 'given twice']),
    ],
)
def test_a_bad_parameter_file(text, words, bellows, workshop, outputs, tmp_path):
    """Name file and line."""
    file = tmp_path / 'parameters.yaml'
    file.write_text(text)
    before = contents(outputs)
    done = bellows(*identify_command(workshop / 'recording', file, outputs))
    check_refusal(done, outputs, before, words)


@pytest.mark.parametrize(
    ('override', 'words'),
    [
        ('fit.structure', ["--set takes NAME=VALUE, got 'fit.structure'"]),
        ('fit.structur=full', ['--set fit.structur: Unknown parameter', "'fit.structure'"]),
        ('fit.structure=round',
         ['one of axisymmetric, axisymmetric_coupled, diagonal, full', "'round'"]),
        ('package.mass=-1', ['package.mass must be a number, above 0', '(kg)', 'got -1']),
        ('package.mass=1,8', ['package.mass must be a number', '1,8']),
        ('package.com=[0, 0]', ['package.com must be a list of 3 numbers', 'got 2']),
        ('filter.tool.half_window=2.5', ['filter.tool.half_window', '2.5']),
        ('recording.align_at_rest=perhaps', ['true or false', 'perhaps']),
    ],
)
def test_a_bad_override(override, words, bellows, workshop, outputs):
    """Treat --set like a line of the file."""
    before = contents(outputs)
    command = identify_command(workshop / 'recording', workshop / 'package.yaml', outputs)
    check_refusal(bellows(*command, '--set', override), outputs, before, words)


def test_no_recording_at_all(bellows, workshop, outputs):
    """Ask for one."""
    before = contents(outputs)
    done = bellows('identify', '--params', workshop / 'package.yaml')
    check_refusal(done, outputs, before, ['No recording is given', 'bags'])


@pytest.mark.parametrize('option', ['--out', '--json'])
def test_an_output_that_cannot_be_written_is_found_before_the_work(
    option, bellows, workshop, outputs
):
    """Refuse a folder that is not there, and a folder in the place of the file."""
    before = contents(outputs)
    for bad, words in ((outputs / 'no' / 'file', 'does not exist'), (outputs, 'is a folder')):
        done = bellows('identify', workshop / 'missing', '--params', workshop / 'package.yaml',
                       option, bad)
        check_refusal(done, outputs, before, [words, str(bad)])


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'kind': 'dance'}, ["'kind'", 'multi_sine', 'dance']),
        ({'duraton': 3.0}, ["Unknown setting 'duraton'", "'duration'"]),
        ({'duration': -1.0}, ["'duration'", '-1']),
    ],
)
def test_a_bad_motion(change, words, bellows, workshop, outputs, tmp_path):
    """Name the setting, and make no recording."""
    before = contents(outputs)
    motion = {**yaml.safe_load((workshop / 'motion.yaml').read_text()), **change}
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', '--out', outputs / 'new',
        '--motion', write_yaml(tmp_path / 'motion.yaml', motion))
    check_refusal(done, outputs, before, words)
