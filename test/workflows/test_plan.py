"""Plans in every form they come in, what is said of them, and bad ones refused."""

import json
import math
import warnings

from bellows_ros.core.geometry.lie import apply, quaternion_to_rotation
from bellows_ros.core.model.simulation import stands
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import as_messages, Encoded, write_bag
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.plans import (
    DESCRIPTION,
    encode,
    JOINTS,
    MULTI_DOF,
    PATH,
    Plan,
    plans_in,
    STATES,
)
from bellows_ros.workflows.plan import plan, plan_with_cup, read_plan, write_prediction
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_convert import write_tum
from ..cell.cup import CUP, VALUES
from ..cell.motion import Move
from ..conftest import ROOT
from ..core.planning.test_arm import URDF
from ..files.recordings import cartesian, header, plan_messages, POSE, serialized, TWIST, write

MOVE = Move([0.3, -0.2, 0.1], [0.2, -0.1, 0.5], 0.6)
VALUES = VALUES.replaced({
    'cup.lip_radius': 0.025, 'vacuum.holding': 6e4, 'package.mass_std': 0.01})
T0 = 1_700_000_000_000_000_000
FIGURES = ('smallest_safety_factor', 'peak_bending', 'peak_force', 'peak_moment', 'swing_left')


def samples(rate_hz=250):
    """Return times, poses (N, 7), and twists (N, 6) in world axes of the move."""
    times, poses, v = MOVE.points(rate_hz)
    R = quaternion_to_rotation(poses[:, 3:])
    return times, poses, np.hstack([apply(R, v[:, :3]), apply(R, v[:, 3:])])


def message(**changes):
    """Return the move as a message."""
    times, poses, twists = samples()
    return Plan(MULTI_DOF, 0, 'base', ('tool',), times, poses, twists)._replace(**changes)


def bag_of(path, kind, data, topic='/plan'):
    """Write a recording of one message."""
    write_bag(path, [Encoded(topic, kind, np.array([T0]), [data])])
    return path


def figures(path, **options):
    """Return what is said of a plan."""
    return plan(path, VALUES.replaced(options.pop('values', {})), **options).as_json()


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Give a recording of the move as a MultiDOFJointTrajectory."""
    return bag_of(tmp_path_factory.mktemp('move') / 'bag', MULTI_DOF, encode(message()))


@pytest.fixture(scope='module')
def truth(bag):
    """Give the figures of the move."""
    return figures(bag)


def test_text_and_yaml_are_the_same_plan(truth, tmp_path):
    times, poses, twists = samples()
    write_tum(tmp_path / 'plan.tum', T0 + times, poses)
    text = json.dumps(cartesian(times, poses, twists))
    (tmp_path / 'plan.yaml').write_text(text + '---\n')  # as ros2 topic echo ends
    for name in ('plan.tum', 'plan.yaml'):
        found = figures(tmp_path / name)
        for figure in FIGURES:
            assert_allclose(found[figure], truth[figure], rtol=2e-3, err_msg=name)


def joints(rate_hz=100):
    """Return times, positions and velocities of the arm in the tests of URDF."""
    times = np.round(np.arange(round(0.6 * rate_hz) + 1) / rate_hz * 1e9).astype(np.int64)
    s = (times / times[-1])[:, None]
    step, rate = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s)**2 / 0.6
    way = np.array([0.4, 0.2, -0.2])
    return times, step * way, rate * way


def joint_message(names=('turn', 'slide', 'spin')):
    """Return a plan of joints."""
    times, position, velocity = joints()
    return header(0, ''), names, [
        (q, v, [], [], (0, int(at))) for at, q, v in zip(times, position, velocity, strict=True)]


def upright(urdf):
    """Return the URDF with a tool whose z points away from the cup at the start."""
    first = read_arm(urdf, 'c').tool(np.zeros((1, 3)))[0][0]
    from scipy.spatial.transform import Rotation

    rpy = Rotation.from_matrix(first[:3, :3].T).as_euler('xyz')
    return urdf.replace('rpy="3.14159265 0 0"', f'rpy="{rpy[0]} {rpy[1]} {rpy[2]}"')


def joint_recording(folder, factor=1.0, offset=0.0):
    """
    Write a recording with a robot description and joint states, and none of the tool.

    The velocities are multiplied by a factor, and have an offset.
    """
    times, position, velocity = joints()
    velocity = factor * velocity + offset
    orders = [0, 1, 2], [1, 0, 2]  # of two drivers
    states = [(header(T0 + at, ''), [('turn', 'slide', 'spin')[k] for k in order], q[order],
               v[order], []) for at, q, v, order in zip(
                   times, position, velocity, [orders[k % 3 > 0] for k in range(len(times))],
                   strict=True)]
    write_bag(folder, [
        Encoded('/robot_description', DESCRIPTION, np.array([T0]),
                [serialized(DESCRIPTION, (upright(URDF),))]),
        Encoded('/joint_states', STATES, T0 + times,
                [serialized(STATES, state) for state in states]),
        as_messages('/package/pose', POSE, T0 + times, np.tile([0, 0, 0, 0, 0, 0, 1.0], (61, 1)))])
    return folder


def test_a_plan_of_joints_is_one_of_the_tool(tmp_path):
    (tmp_path / 'arm.urdf').write_text(upright(URDF))
    bag = bag_of(tmp_path / 'bag', JOINTS, serialized(JOINTS, joint_message()))
    values = {'tool_link': 'tool'}
    found = figures(bag, values=values, urdf=str(tmp_path / 'arm.urdf'))
    assert found['frame_id'] == 'world' and found['duration'] == 0.6
    recorded = figures(joint_recording(tmp_path / 'states'), values=values)
    for name in FIGURES:
        assert_allclose(recorded[name], found[name], rtol=1e-3, err_msg=name)
    with pytest.raises(BellowsError, match='Set tool_link'):
        figures(bag)
    with pytest.raises(BellowsError, match='Give its urdf'):
        figures(bag, values=values)
    other = bag_of(tmp_path / 'o', JOINTS, serialized(JOINTS, joint_message(('a', 'b', 'c'))))
    with pytest.raises(BellowsError, match="'turn'"):
        figures(other, values=values, urdf=str(tmp_path / 'arm.urdf'))


@pytest.mark.parametrize(('factor', 'offset'), [
    (0.0, 0.0), (0.0, 0.3), (-1.0, 0.0), (np.nan, 0.0), (1.0, 1e300)])
def test_positions_decide_where_velocities_of_joint_states_contradict_them(
        factor, offset, tmp_path):
    found = plan(joint_recording(tmp_path / 'bag', factor, offset),
                 VALUES.replaced({'tool_link': 'tool'}))
    assert 'joint_velocities' in [each.code for each in found.findings]
    speed = np.linalg.norm(found.source.tool.twist[:, :3], axis=1).max()
    arm = read_arm(upright(URDF), 'tool')
    _, position, velocity = joints()
    expected = np.linalg.norm(arm.tool(position, velocity)[1][:, :3], axis=1).max()
    assert_allclose(speed, expected, rtol=0.05)


GANTRY = """<robot name="gantry"><link name="base"/><link name="a"/><link name="tool"/>
<joint name="x" type="prismatic"><parent link="base"/><child link="a"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" velocity="3"/></joint>
<joint name="z" type="prismatic"><parent link="a"/><child link="tool"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="3"/></joint></robot>"""


def gantry_plan(folder, times, height, speed=None, urdf=GANTRY):
    """Return the report on heights (N,) of a tool on a gantry at times (N,), s."""
    points = [{
        'positions': [0.0, float(z)],
        'velocities': [] if speed is None else [0.0, float(speed[k])],
        'accelerations': [], 'effort': [], 'time_from_start': dict(zip(
            ('sec', 'nanosec'), divmod(round(1e9 * t), 10**9), strict=True))}
        for k, (t, z) in enumerate(zip(times, height, strict=True))]
    (folder / 'plan.yaml').write_text(json.dumps({
        'trajectory': {'header': {'stamp': {'sec': 0, 'nanosec': 0}, 'frame_id': ''},
                       'joint_names': ['x', 'z'], 'points': points},
        'path_tolerance': [], 'goal_tolerance': [],
        'goal_time_tolerance': {'sec': 0, 'nanosec': 0}}))  # the goal of a FollowJointTrajectory
    (folder / 'arm.urdf').write_text(urdf)
    return plan(folder / 'plan.yaml', VALUES.replaced({'tool_link': 'tool'}),
                str(folder / 'arm.urdf'))


def test_two_points_of_positions_alone_move_at_once_to_full_speed(tmp_path):
    """Upwards by 0.6 m/s: sag and swing of mass, spring and damper after a step of the speed."""
    report = gantry_plan(tmp_path, [0.0, 1.0], [0.0, 0.6])
    m, k, d = VALUES.package.mass, CUP.stiffness[2, 2], CUP.damping[2, 2]
    decay = 0.5 * d / m
    omega = math.sqrt(k / m - decay**2)
    first = math.atan2(omega, decay) / omega
    swing = 0.6 / omega * math.exp(-decay * first) * math.sin(omega * first)
    found = report.as_json()
    assert_allclose(found['peak_deflection'], m * 9.81 / k + swing, rtol=1e-3)
    codes = {each.code: each for each in report.findings}
    assert codes['speed_steps'].numbers['linear'] == pytest.approx(0.6)
    assert 'linearly' in codes['interpolated'].numbers['law'] and 'in_motion' not in codes


def test_the_times_of_a_plan_are_kept(tmp_path):
    """Its first point is at 0.5 s: all times are later, what is before is named, and written."""
    t = np.linspace(0.0, 1.0, 101)
    way = t, 0.6 * t**3 * (10 - 15 * t + 6 * t**2), 18.0 * t**2 * (1 - t)**2
    early = gantry_plan(tmp_path, *way)
    late = gantry_plan(tmp_path, t + 0.5, *way[1:])
    was, found = early.as_json(), late.as_json()
    assert_allclose(found['smallest_safety_time'], was['smallest_safety_time'] + 0.5, atol=1e-9)
    assert_allclose(found['moves'][0]['begin'], was['moves'][0]['begin'] + 0.5, atol=1e-9)
    assert found['smallest_safety_factor'] == was['smallest_safety_factor']
    assert_allclose(late.result.curves[0], early.result.curves[0] + 0.5)
    assert [each.numbers['begin'] for each in late.findings if each.code == 'late_start'] == [0.5]
    assert 'late_start' not in [each.code for each in early.findings]
    write_prediction(tmp_path / 'out', late.source, late.source.tool, late.prediction.states)
    for name, written in plans_in(tmp_path / 'out', ''):
        assert written.times_ns[[0, -1]].tolist() == [500_000_000, 1_500_000_000], name


def test_a_pressed_cup_has_no_smallest_factor_and_no_warning(tmp_path):
    """Upside down nothing peels: the factor is infinite, without a division by zero."""
    upside = GANTRY.replace('<axis xyz="0 0 1"/>', '<origin rpy="3.14159265 0 0" xyz="0 0 0"/>'
                            '<axis xyz="0 0 -1"/>')
    t = np.linspace(0.0, 1.0, 101)
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        report = gantry_plan(tmp_path, t, 0.1 * t**3 * (10 - 15 * t + 6 * t**2),
                             3.0 * t**2 * (1 - t)**2, urdf=upside)
        assert report.result.moves[0].smallest_safety_factor > 1.0


@pytest.mark.parametrize('kind', [
    'moveit_msgs/msg/RobotTrajectory', 'moveit_msgs/msg/DisplayTrajectory'])
def test_plans_of_moveit_are_plans(kind, truth, tmp_path):
    """Of joints or of the tool, with the definition in the recording."""
    values = {'tool_link': 'tool'}
    none = header(0, ''), (), []
    urdf = tmp_path / 'arm.urdf'
    urdf.write_text(URDF)
    expected = figures(bag_of(tmp_path / 'plain', JOINTS, serialized(JOINTS, joint_message())),
                       values=values, urdf=str(urdf))
    times, poses, twists = samples()
    of_tool = (header(0, 'base'), ('tool',), [
        ([(p[:3], p[3:])], [(v[:3], v[3:])], [], divmod(int(t), 10**9))
        for t, p, v in zip(times, poses, twists, strict=True)])
    for number, (trajectory, found) in enumerate(
            (((joint_message(), none), expected), ((none, of_tool), truth))):
        fields = trajectory if kind.endswith('RobotTrajectory') else ('arm', [trajectory])
        bag = write(tmp_path / f'bag{number}', {
            ('/plan', kind): [(T0, serialized(kind, fields))]})
        read = figures(bag, values=values, urdf='' if number else str(urdf))
        for figure in FIGURES:
            assert_allclose(read[figure], found[figure], rtol=1e-6)


def test_recorded_poses_are_a_plan(truth, tmp_path):
    times, poses, twists = samples(500)
    both = [as_messages('/tool_arm/pose', POSE, T0 + times, poses, 'base'),
            as_messages('/tool_arm/twist', TWIST, T0 + times, twists, 'base')]
    write_bag(tmp_path / 'bag', both)
    found = figures(tmp_path / 'bag', values={'topics.tool_twist': '/tool_arm/twist'})
    for name in FIGURES:
        assert_allclose(found[name], truth[name], rtol=1e-4, err_msg=name)
    still = np.pad(poses, ((100, 100), (0, 0)), 'edge')  # half a window is lost at both ends
    stamps = T0 + np.arange(len(still)) * 2_000_000
    write_bag(tmp_path / 'poses', [as_messages('/tool_arm/pose', POSE, stamps, still, 'base')])
    smooth = figures(tmp_path / 'poses')
    assert_allclose(smooth['peak_moment'], truth['peak_moment'], rtol=0.01)


def test_a_part_of_a_plan_is_taken(tmp_path):
    """Count from the first pose recorded, also where the filter needs some before its first."""
    times, poses, _ = samples()
    write_bag(tmp_path / 'poses', [as_messages('/tool_arm/pose', POSE, T0 + times, poses, 'base')])
    plan_bag = bag_of(tmp_path / 'plan', MULTI_DOF, encode(message(stamp_ns=T0)))
    values = resolve(VALUES.replaced({'topics.tool_twist': ''}), ())
    for path in (tmp_path / 'poses', plan_bag):
        whole = read_plan(path, values).tool
        part = read_plan(
            path, values.replaced({'recording.start': 0.1, 'recording.end': 0.3})).tool
        inside = (whole.stamps_ns >= T0 + 10**8) & (whole.stamps_ns <= T0 + 3 * 10**8)
        np.testing.assert_array_equal(part.stamps_ns, whole.stamps_ns[inside])
        assert part.stamps_ns[0] == T0 + 10**8 and part.stamps_ns[-1] == T0 + 3 * 10**8
        np.testing.assert_allclose(part.position, whole.position[inside], rtol=0.0, atol=1e-15)
    with pytest.raises(BellowsError, match=r'1.*recording\.start'):
        read_plan(plan_bag, values.replaced({'recording.start': 0.1, 'recording.end': 0.103}))


def test_fastest_and_curves(bag, tmp_path):
    report = plan(bag, VALUES, seek_fastest=True)
    found = report.as_json()
    assert 0.1 < found['fastest_scale'] < 5.0 and found['fastest_scale_std'] > 0.0
    seconds, _, values, std = report.motions['as planned'].curves
    assert values.shape == std.shape == (len(seconds), 15) and seconds[-1] > 0.6
    assert_allclose(report.motions['as planned'].summary()['smallest_safety_factor'],
                    values[:, 4:6].min(), rtol=1e-9)
    with pytest.raises(BellowsError, match=r'cup\.lip_radius.*vacuum\.holding'):
        plan(bag, VALUES.replaced({'cup.lip_radius': 0.0}), seek_fastest=True)
    half = message(**{name: getattr(message(), name)[:80]
                      for name in ('times_ns', 'points', 'rates')})
    thrown = bag_of(tmp_path / 'half', MULTI_DOF, encode(half))
    found = figures(thrown)
    assert found['swing_left'] is None and 'ends in motion' in ' '.join(found['warnings'])
    with pytest.raises(BellowsError, match='ends in motion'):
        figures(thrown, seek_fastest=True)


def test_each_move_has_its_least_safety_factor(tmp_path):
    """Of ten moves there and back with a pause, the fourth is twice as fast, and is drawn."""
    t = np.arange(0.0, 30.0, 0.004)
    x = np.zeros(len(t))
    for k in range(10):
        s = np.clip((t - 3.0 * k) / (0.5 if k == 3 else 1.0), 0.0, 1.0)
        x += 0.3 * (-1) ** k * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    poses = np.zeros((len(t), 7))
    poses[:, 0], poses[:, 6] = x, 1.0
    twists = np.pad(np.gradient(x, t)[:, None], ((0, 0), (0, 5)))
    times = np.round(1e9 * t).astype(np.int64)
    data = encode(message(times_ns=times, points=poses, rates=twists))
    found = plan(bag_of(tmp_path / 'bag', MULTI_DOF, data), VALUES).result
    assert_allclose([each.begin for each in found.moves], 3.0 * np.arange(10), atol=0.2)
    factors = [each.smallest_safety_factor for each in found.moves]
    assert factors[3] == found.prediction.smallest_safety[0] < 0.8 * min(
        factors[:3] + factors[4:])
    begin, end = found.drawn
    assert begin < 9.0 < 9.5 < end and end - begin == pytest.approx(5.0)
    assert plan(tmp_path / 'bag', VALUES.replaced({'cup.lip_radius': 0.0})).result.moves == ()


def test_lost_grip_and_unknown_grip_are_reported(bag):
    weak = figures(bag, values={'vacuum.holding': 2e4})
    assert weak['findings'][0]['level'] == 'ERROR'
    low = figures(bag, values={'safety.least': 20.0})
    assert 'xpected at least 20' in low['warnings'][0]
    unknown = figures(bag, values={'vacuum.holding': 0.0})
    assert 'Without cup.lip_radius' in unknown['warnings'][0]
    assert unknown['smallest_safety_mode'] is None
    soft = figures(bag, values={
        'cup.stiffness': np.diag([5400.0, 5400.0, 9200.0, 0.3, 0.3, 1.35]).ravel().tolist()})
    assert np.degrees(soft['peak_bending']) > 45.0 and 'may flip' in ' '.join(soft['warnings'])
    assert 'may flip' not in ' '.join(unknown['warnings'])
    seen = {'cup.valid_low': [-1e-3] * 6 + [-0.1] * 6 + [1.8, 0.0],
            'cup.valid_high': [1e-3] * 6 + [0.1] * 6 + [1.8, 0.0]}
    outside = figures(bag, values=seen)['outside_validity']
    assert any('bending about' in phrase for phrase in outside)


def untimed(form):
    """Return a plan as YAML whose points are all at one time."""
    content = plan_messages()[form]
    for each in content.get('points', ()):
        each['time_from_start'] = {'sec': 0, 'nanosec': 0}
    for each in content.get('poses', ()):
        each['header']['stamp'] = {'sec': 0, 'nanosec': 0}
    return content


def test_a_limit_that_cannot_be_checked_is_refused(bag, tmp_path):
    """Of joints, for a plan of the tool."""
    with pytest.raises(BellowsError, match='joint_acceleration cannot be checked'):
        figures(bag, limits={'joint_acceleration': 2.0})
    (tmp_path / 'arm.urdf').write_text(URDF)
    with pytest.raises(BellowsError, match=r'arm\.urdf.* no plan of joints'):
        figures(bag, urdf=str(tmp_path / 'arm.urdf'))


def broken(part, value):
    """Return a plan as YAML in lines, the second of whose points has another part, or lacks it."""
    content = plan_messages()['joints']
    if value is None:
        del content['points'][1][part]
    else:
        content['points'][1][part] = value
    return content


@pytest.mark.parametrize(('content', 'named'), [
    (broken('time_from_start', None), r"no\.yaml, line 29: .* 'time_from_start' is missing"),
    (broken('positions', [0.1, '...']), r'no\.yaml, line \d+: .*cut here.*--full-length'),
    (broken('positions', '...'), r'no\.yaml, line \d+: .*cut here.*--full-length'),
    ({'a': 1}, r"no\.yaml: there is no plan.*'points'"),
    ([1], r"no\.yaml: there is no plan.*'points'"),
    ({**plan_messages()['multi'], 'joint_names': [5]}, r'no\.yaml: there is no plan.*5 as name'),
    *((untimed(form), 'is not timed.*time parameterization')
      for form in ('multi', 'joints', 'path'))])
def test_what_is_no_plan_is_refused(tmp_path, content, named):
    (tmp_path / 'no.yaml').write_text(json.dumps(content, indent=1))
    (tmp_path / 'arm.urdf').write_text(URDF)
    with pytest.raises(BellowsError, match=named):
        figures(tmp_path / 'no.yaml', urdf=tmp_path / 'arm.urdf', values={'tool_link': 'tool'})


def test_a_plan_in_two_frames_or_in_one_that_moves_is_refused(tmp_path):
    times, poses, _ = samples()
    poses_of = encode(message(kind=PATH, stamp_ns=T0, times_ns=times, points=poses))
    elsewhere = poses_of.replace(b'base', b'else')[:24] + poses_of[24:]
    moving = encode(message(frame_id='tool0'))
    for kind, data, named in ((PATH, elsewhere, "'else'.*'base'"), (MULTI_DOF, moving, "'tool0'")):
        with pytest.raises(BellowsError, match=named):
            figures(bag_of(tmp_path / kind[-4:], kind, data))


@pytest.mark.parametrize(('topic', 'begin', 'rests'), [
    ('', 0.0, True), ('/tool_arm/twist', 0.0, True), ('', 5.0, False)])
def test_a_recording_that_begins_at_rest_is_predicted_from_rest(topic, begin, rests):
    """Although its noise makes twists; one that begins in motion is not."""
    values = {**read_parameters(ROOT / 'bags' / 'tossing.yaml'), 'topics.tool_twist': topic,
              'recording.start': begin}
    tool = plan_with_cup(ROOT / 'bags' / 'validation', values).tool
    assert stands(tool.twist[0]) is rests
