"""What is said about a recording: roles, axes, rates and flaws, against recordings made for it."""

from bellows_ros.core.geometry.lie import apply, exp_so3, rotation_to_quaternion
from bellows_ros.core.recording.alignment import R_WORLD_MOTIVE
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import as_messages, Encoded, read_streams, write_bag
from bellows_ros.files.messages import BOOL, HEAD
from bellows_ros.report.printed import cell_file
from bellows_ros.workflows.info import info
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
RATE_HZ, SECONDS, REST = 200.0, 6.0, 1.0
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope='module')
def m():
    """Give a tool that rests and then moves and turns, and a package that swings below it."""
    t = np.arange(round(RATE_HZ * SECONDS)) / RATE_HZ
    s = np.maximum(t - REST, 0.0)[:, None]
    way = np.array([0.1, 0.08, 0.05])
    position = np.array([0.4, 0.1, 0.9]) + way * (1.0 - np.cos(3.0 * s))
    velocity = way * 3.0 * np.sin(3.0 * s) * (s > 0)
    rotation = exp_so3(np.array([0.2, 0.1, 1.2]) * (1.0 - np.cos(2.0 * s)))
    swing = rotation @ exp_so3(0.1 * np.sin(9.0 * s) * np.array([1.0, 0.5, 0.0]))
    package = position + apply(swing, np.array([0.0, 0.0, -0.08]))
    return {'t': t, 'o': position, 'v': velocity, 'R': rotation, 'R_p': swing, 'o_p': package}


def poses(topic, t, position, rotation, frame_id='world'):
    """Return poses to record."""
    stamps = START_NS + np.rint(t * 1e9).astype(np.int64)
    return as_messages(
        topic, POSE, stamps, np.hstack([position, rotation_to_quaternion(rotation)]), frame_id)


def twists(topic, t, linear, angular=None):
    """Return twists to record."""
    stamps = START_NS + np.rint(t * 1e9).astype(np.int64)
    return as_messages(topic, TWIST, stamps, np.hstack([
        linear, np.zeros_like(linear) if angular is None else angular]))


def described(folder, *recorded):
    """Record topics, and return what is said of the recording."""
    write_bag(folder / 'bag', recorded, replace=True)
    return info(folder / 'bag')


def test_poses_determine_roles_if_names_do_not(m, tmp_path):
    """Find what hangs below, even where names have been chosen to mislead."""
    found = described(
        tmp_path, poses('/a', m['t'], m['o_p'], m['R_p']), poses('/b', m['t'], m['o'], m['R']),
        poses('/c', m['t'], 0.0 * m['o'] + 5.0, m['R']))
    assert found.tool and found.tool.topic == '/b'
    assert found.package and found.package.topic == '/a'
    assert found.settings['recording.world'] == 'z_up'
    assert found.settings['recording.align_at_rest'] is False


@pytest.mark.parametrize('jump', [0.0, 1.0])
@pytest.mark.parametrize('frame', ['world', 'tool'])
def test_axes_of_the_twist_are_found(m, frame, jump, tmp_path):
    """Tell world from tool axes by integrating the twist, even if the tool's poses jump (m)."""
    inside = apply(np.swapaxes(m['R'], 1, 2), m['v'])
    linear, moved = m['v'] if frame == 'world' else inside, jump * (m['t'] > 3.0)[:, None]
    found = described(
        tmp_path, poses('/tcp/pose', m['t'], m['o'] + moved, m['R']),
        poses('/box/pose', m['t'], m['o_p'] + moved, m['R_p']),
        twists('/other', m['t'], -linear[::-1]), twists('/tcp/twist', m['t'], linear))
    assert found.twist is not None
    assert (found.twist.topic, found.twist.frame) == ('/tcp/twist', frame)
    assert found.settings['tool_twist.frame'] == frame


@pytest.mark.parametrize('unit', ['degrees', 'radians'])
def test_twists_in_degrees_are_said(m, tmp_path, unit):
    """Noise of the poses is no turn."""
    rng = np.random.default_rng(1)
    turn = np.array([0.2, 0.1, 1.2]) * 2.0 * np.sin(2.0 * np.maximum(m['t'] - REST, 0.0))[:, None]
    angular = apply(m['R'], turn)
    found = described(
        tmp_path, poses('/p', m['t'], m['o_p'], m['R_p']),
        poses('/e', m['t'], m['o'], m['R'] @ exp_so3(1e-3 * rng.standard_normal(m['o'].shape))),
        twists('/v', m['t'], m['v'], np.degrees(angular) if unit == 'degrees' else angular))
    assert found.settings['topics.tool_twist'] == '/v'
    said = any('degrees per second' in note for note in found.notes)
    assert said == (unit == 'degrees')


def test_y_up_and_turned_markers_are_noticed(m, tmp_path):
    """Propose Motive's world and the alignment, with a rest that the recording has."""
    turn, up = exp_so3(np.array([0.0, 0.1, 0.8])), R_WORLD_MOTIVE.T
    found = described(
        tmp_path, poses('/arm', m['t'], apply(up, m['o']), up @ m['R']),
        poses('/plate', m['t'], apply(up, m['o_p']), up @ m['R_p'] @ turn))
    assert found.settings['recording.world'] == 'motive_y_up'
    assert found.settings['recording.align_at_rest'] is True
    assert any('align_at_rest' in note for note in found.notes)


def test_gaps_jitter_and_repeats_are_counted(m, tmp_path):
    """Report per topic what would be left out."""
    rng = np.random.default_rng(3)
    jitter = m['t'] + rng.uniform(-1e-3, 1e-3, len(m['t']))
    kept = (m['t'] < 3.0) | (m['t'] > 3.1)
    again = np.sort(np.append(np.flatnonzero(kept), 30))
    found = {topic.name: topic for topic in described(
        tmp_path, poses('/tcp', jitter, m['o'], m['R']),
        poses('/box', m['t'][again], m['o_p'][again], m['R_p'][again])).topics}
    assert found['/tcp'].jitter_s == pytest.approx(8.5e-4, rel=0.3)  # of the steps
    ((start, length),) = found['/box'].gaps
    assert (start, length) == (pytest.approx(2.995, abs=0.006), pytest.approx(0.105, abs=0.006))
    assert found['/box'].refused == {'copy': 1}
    assert found['/box'].rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


def test_the_rate_of_repeated_poses_is_that_of_the_sensor(m, tmp_path):
    """A driver of 100 Hz shows each pose of the robot four times, at rest too."""
    shown = np.arange(len(m['t'])) // 4 * 4
    tool = next(topic for topic in described(
        tmp_path, poses('/tcp', m['t'], m['o'][shown], m['R'][shown]),
        poses('/box', m['t'], m['o_p'], m['R_p'])).topics if topic.name == '/tcp')
    assert tool.rate_hz == pytest.approx(RATE_HZ / 4, rel=1e-6) and not tool.gaps
    assert tool.refused['repeated'] == pytest.approx(0.75 * len(m['t']), abs=1)


def test_one_body_alone_is_reported_as_insufficient(m, tmp_path):
    """Use the name where there is nothing to compare with."""
    several = Encoded('/bodies', 'geometry_msgs/msg/PoseArray', np.array([START_NS]), [b''])
    found = described(tmp_path, poses('/ur/tcp_pose', m['t'], m['o'], m['R']), several)
    assert found.tool and found.tool.topic == '/ur/tcp_pose'
    assert found.package is None
    note, = (each for each in found.notes if 'needed to identify a cup' in each)
    assert '/bodies: A message of several bodies' in note
    with pytest.raises(BellowsError, match='PoseStamped for each body.*bellows convert'):
        read_streams(tmp_path / 'bag', {'package_pose': '/bodies'})


@pytest.mark.parametrize(('frame', 'late_s', 'aside', 'reason'), [
    ('camera', 0.0, 0.0, "frames are 'base' and 'camera'"),
    ('base', 100.0, 0.0, 'earlier than the stamp'), ('base', 0.0, 1.0, 'which changes by'),
    ('base', 0.0, 0.0, ''), ('/base', 0.0, 0.0, '')])
def test_two_worlds_or_clocks_are_all_set_free(m, tmp_path, frame, late_s, aside, reason):
    """Free world, clock and marker where frames, stamps or distances are not of one world."""
    R_world = exp_so3(np.array([0.4, 1.0, -0.7]) * aside)
    found = described(
        tmp_path, poses('/tcp', m['t'], m['o'], m['R'], 'base'),
        poses('/gripper_load', m['t'] + late_s, apply(R_world, m['o_p'] + aside),
              R_world @ m['R_p'], frame))
    free = {name: found.settings.get(name) for name in (
        'recording.package_world', 'fit.free', 'fit.method')}
    assert any(reason in note for note in found.notes) if reason else not free['fit.free']
    assert frame != 'camera' or 'recording.world' not in found.settings
    if reason:
        assert free == {
            'recording.package_world': 'estimate', 'fit.method': 'output_error',
            'fit.free': ('time_offset', 'package_marker')}
        assert '\n# fit.free: time_offset and package_marker: estimated' in cell_file(found)


@pytest.mark.parametrize(('signal', 'topic', 'kind'), [
    ('bool', '/cell/vacuum/held', BOOL),
    ('pressure', '/cell/vacuum/pressure', 'sensor_msgs/msg/FluidPressure')])
def test_a_recorded_vacuum_is_proposed(m, tmp_path, signal, topic, kind):
    stamps = START_NS + np.rint(m['t'][::100] * 1e9).astype(np.int64)
    switch = Encoded(topic, kind, stamps, [HEAD + bytes([True])] * len(stamps))
    found = described(
        tmp_path, poses('/tcp/pose', m['t'], m['o'], m['R']),
        poses('/box/pose', m['t'], m['o_p'], m['R_p']), switch)
    assert found.settings['vacuum.signal'] == signal


@pytest.mark.parametrize(('rotation', 'offset'), [
    (R_WORLD_MOTIVE, '0 0 0 -0.7071 0 0 0.7071'),  # y up, as a body created upright in Motive
    (exp_so3(np.array([0.0, 1.5708, 0.0])), '0 0 0 0 -0.7071 0 0.7071'),
    (exp_so3(np.array([3.1416, 0.0, 0.0])), '0 0 0 1 0 0 0')])
def test_the_vertical_axis_of_the_tool_becomes_its_z_axis(m, tmp_path, rotation, offset):
    """As an own formula has it: the offset turns z of E to the axis that is vertical."""
    found = described(
        tmp_path, poses('/arm', m['t'], m['o'], m['R'] @ rotation),
        poses('/plate', m['t'], m['o_p'], m['R_p'] @ rotation))
    assert found.settings['tool_pose.offset'] == offset
    assert found.settings['recording.align_at_rest'] is True  # for the package
    turn = Rotation.from_quat([float(x) for x in offset.split()[3:]]).as_matrix()
    assert (rotation @ turn)[2, 2] == pytest.approx(1.0, abs=1e-4)
    given = info(tmp_path / 'bag', {'tool_pose.offset': offset})
    assert not any('of the tool' in note and 'vertical' in note for note in given.notes)
