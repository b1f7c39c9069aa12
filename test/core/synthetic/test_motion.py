"""Motions of the tool: derivatives by finite differences, smoothness, errors of settings."""

from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic import recipe as sensing
from bellows_ros.core.synthetic.motion import motion_from
from bellows_ros.core.synthetic.recipe import Faults, SimulatedSensor, TwistSensor
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.spatial.transform import Rotation

START = {'position': [0.5, -0.2, 0.8], 'rpy': [0.3, -0.2, 1.1]}
MULTI_SINE = {
    'kind': 'multi_sine',
    'duration': 6.0,
    'rest_duration': 1.0,
    'ramp_duration': 0.7,
    'start': START,
    'multi_sine': {
        'position': {
            'x': {'amplitude': [0.05, 0.01], 'frequency': [0.4, 3.1]},
            'z': {'amplitude': [0.03], 'frequency': [4.3]}},
        'rotation': {
            'x': {'amplitude': [0.6, 0.1], 'frequency': [0.5, 2.0]},
            'y': {'amplitude': [0.4], 'frequency': [0.8]},
            'z': {'amplitude': [1.2], 'frequency': [0.3]}}}}
WAYPOINTS = {
    'kind': 'waypoints',
    'rest_duration': 1.0,
    'start': START,
    'waypoints': {
        'poses': [
            {'position': [0.6, 0.1, 0.7], 'rpy': [0.1, 0.5, -1.0], 'move': 0.8, 'hold': 0.5},
            {'position': [0.4, 0.1, 0.9], 'rpy': [0.0, 0.0, np.pi], 'move': 1.2},
            {'position': [0.5, 0.0, 0.8], 'move': 0.6, 'hold': 0.9}]}}
STATIC = {
    'kind': 'static',
    'rest_duration': 1.0,
    'static': {
        'move': 0.7, 'hold': 1.3, 'poses': [{'rpy': [0.4, 0.0, 0.0]}, {'rpy': [0.0, 0.4, 0.0]}]}}
ALL = pytest.mark.parametrize(
    'content', [MULTI_SINE, WAYPOINTS, STATIC], ids=lambda c: c['kind'])


def motion(content, seed=0):
    settings = Settings(content)
    moving = motion_from(settings, np.random.default_rng(seed))
    settings.done()
    return moving


@ALL
def test_velocities_are_the_derivatives_of_the_poses(content):
    moving = motion(content)
    h = 1e-5
    t = np.linspace(h, moving.duration - h, 4001)
    _, velocity, rotation, body_rate = moving.state(t)
    before, after = moving.state(t - h), moving.state(t + h)
    # Central differences are off by h^2/6 times the third derivative, and by rounding, 1e-16/h.
    assert_allclose(velocity, (after[0] - before[0]) / (2 * h), atol=1e-7)
    R_T = np.swapaxes(rotation, -1, -2)
    turn = log_so3(R_T @ after[2]) - log_so3(R_T @ before[2])
    assert_allclose(body_rate, turn / (2 * h), atol=1e-6)


@ALL
def test_accelerations_are_continuous(content):
    """Halve the step, and the largest jump of the acceleration between samples halves as well."""
    moving = motion(content)
    jumps = []
    for count in (20_000, 40_000):
        t = np.linspace(0.0, moving.duration, count + 1)
        _, velocity, _, body_rate = moving.state(t)
        rates = np.hstack([velocity, body_rate])
        acceleration = np.diff(rates, axis=0) * count / moving.duration
        jumps.append(np.abs(np.diff(acceleration, axis=0)).max())
    assert jumps[1] < 0.6 * jumps[0]


@ALL
def test_the_rest_is_a_rest(content):
    moving = motion(content)
    position, velocity, rotation, body_rate = moving.state(np.linspace(0.0, 1.0, 11))
    assert_array_equal(position, np.broadcast_to(position[0], (11, 3)))
    assert_allclose(rotation, np.broadcast_to(rotation[0], (11, 3, 3)), atol=1e-15)
    assert not velocity.any() and not body_rate.any()
    assert moving.state(np.array([1.3]))[1].any() or content is STATIC


def test_waypoints_are_reached_and_held():
    moving = motion(WAYPOINTS)
    poses = WAYPOINTS['waypoints']['poses']
    assert moving.duration == pytest.approx(1.0 + 0.8 + 0.5 + 1.2 + 0.6 + 0.9)
    position, velocity, rotation, body_rate = moving.state(np.array([1.8, 2.3, 3.5, 4.1, 5.0]))
    for index, pose in zip((0, 1, 2, 3, 4), (0, 0, 1, 2, 2), strict=True):
        assert_allclose(position[index], poses[pose]['position'], atol=1e-12)
    assert_allclose(velocity, 0.0, atol=1e-12)
    assert_allclose(body_rate, 0.0, atol=1e-12)
    expected = [
        Rotation.from_euler('xyz', poses[0]['rpy']).as_matrix(), np.diag([-1.0, -1.0, 1.0]),
        np.eye(3)]
    assert_allclose(rotation[[0, 2, 4]], expected, atol=1e-12)


def test_a_multi_sine_has_the_lines_that_were_asked_for():
    content = {**MULTI_SINE, 'duration': 42.0, 'ramp_duration': 1.0}
    t = 2.0 + np.arange(4000) * 0.01  # 40 s: all lines are whole multiples of 1/40 Hz
    x = motion(content).state(t)[0][:, 0] - 0.5
    lines = 2.0 * np.abs(np.fft.rfft(x)) / len(t)
    assert_allclose(lines[[16, 124]], [0.05, 0.01], rtol=1e-9)
    assert_allclose(np.delete(lines, [16, 124]), 0.0, atol=1e-12)


def changed(content, path, value):
    """Give the content with one setting replaced."""
    name, *rest = path
    if isinstance(content, list):
        return [changed(c, rest, value) if i == name else c for i, c in enumerate(content)]
    inner = changed(content.get(name, {}), rest, value) if rest else value
    return {**content, name: inner}


POSES = ('waypoints', 'poses', 1)
LINE = ('multi_sine', 'rotation', 'x')


@pytest.mark.parametrize(('content', 'path', 'value', 'named'), [
    (MULTI_SINE, ('multi_sine',), {}, "'multi_sine'"),
    (MULTI_SINE, (*LINE, 'amplitude'), [1.0], r'multi_sine\.rotation\.x.* 1 and 2\b'),
    (MULTI_SINE, (*LINE, 'frequency'), [1.0, -1.0], r'frequency.* 100 \(Hz\).* -1\.0'),
    (WAYPOINTS, ('waypoints', 'poses'), [], "'waypoints.poses'"),
    (WAYPOINTS, (*POSES, 'move'), 3600.0, r'\b3600 s\b')])
def test_a_wrong_setting_is_refused_by_name(content, path, value, named):
    with pytest.raises(BellowsError, match=named):
        motion(changed(content, path, value))


EPOCH_NS = 1_700_000_000_000_000_000
DURATION, REST = 20.0, 2.0
Z_UP, MOTIVE = sensing.WORLDS['z_up'], sensing.WORLDS['motive_y_up']
# (4.1) as printed: from Motive's frame M to the world A.
A_R_M = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])


def draw(seed=0):
    return np.random.default_rng(seed)


def plan_of(sensor, seed=0):
    return sensing.schedule(sensor, DURATION, REST, EPOCH_NS, draw(seed))


def tumbling(stamps_ns):
    """Give a motion with large turns, at rest for two seconds."""
    t = np.maximum((stamps_ns - EPOCH_NS) / 1e9 - REST, 0.0)[:, None]
    position = np.array([0.5, -0.2, 0.8]) + 0.1 * np.sin(t * [1.0, 2.0, 3.0])
    rotation = exp_so3(0.8 * np.sin(t * [0.7, 1.1, 1.3]))
    twist = np.hstack([np.cos(t), np.sin(t), t, -t, 2.0 + t, 0.0 * t])
    return Trajectory(stamps_ns, position, rotation, twist)


def measured(sensor, world=Z_UP, seed=0):
    """Return plan, truth and what is recorded of it."""
    plan = plan_of(sensor, seed)
    truth = tumbling(plan.sampled_ns)
    return plan, truth, sensing.measure_poses(truth, sensor, plan, world, draw(seed + 100))


def turned(R, other):
    """Return the rotation vectors from R to the other rotation, in axes of R."""
    return log_so3(np.swapaxes(R, -1, -2) @ other)


def test_noise_has_the_standard_deviation_that_was_asked_for():
    sensor = SimulatedSensor('tool', 500.0, position_noise=1e-4, rotation_noise=5e-4)
    _, truth, poses = measured(sensor)
    noise = np.hstack([(poses.position - truth.position) / 1e-4,
                       turned(truth.rotation, poses.rotation) / 5e-4])
    count = len(noise)
    assert count == 10_001
    # Five standard errors of mean, deviation, correlation with each other and with the past.
    assert_allclose(noise.mean(0), 0.0, atol=5.0 / np.sqrt(count))
    assert_allclose(noise.std(0), 1.0, atol=5.0 / np.sqrt(2.0 * count))
    assert_allclose(np.corrcoef(noise.T), np.eye(6), atol=5.0 / np.sqrt(count))
    assert_allclose((noise[1:] * noise[:-1]).mean(0), 0.0, atol=5.0 / np.sqrt(count))


def test_marker_frame_and_origin_are_fixed_to_the_body():
    marker, origin = np.array([0.04, -0.07, 0.9]), np.array([0.0008, -0.0006, 0.03])
    _, truth, poses = measured(SimulatedSensor('package', 100.0, origin=origin, marker=marker))
    assert_allclose(poses.position, truth.position + apply(truth.rotation, origin), atol=1e-15)
    assert_allclose(turned(truth.rotation, poses.rotation), np.tile(marker, (2001, 1)), atol=1e-12)


def test_motive_world_is_undone_by_the_printed_matrix():
    _, truth, poses = measured(SimulatedSensor('tool', 100.0), MOTIVE)
    assert_allclose(poses.position @ A_R_M.T, truth.position, atol=1e-15)
    assert_allclose(A_R_M @ poses.rotation, truth.rotation, atol=1e-15)
    # y is up: the second coordinate is the height.
    assert_allclose(poses.position[:, 1], truth.position[:, 2], atol=1e-15)


@pytest.mark.parametrize('seed', range(2))
def test_jumps_and_gaps_are_as_many_as_asked_for_and_apart(seed):
    sensor = SimulatedSensor(
        'tool', 200.0, jumps=Faults(6, 0.02, 0.03, 0.3), dropouts=Faults(4, 0.1))
    plan, truth, poses = measured(sensor, seed=seed)

    rest = int(REST * 200)
    jumping = plan.jump >= 0
    faulty = jumping | ~plan.sent
    assert jumping.sum() == 6 * 4 and (~plan.sent).sum() == 4 * 20
    assert not np.any(jumping & ~plan.sent)
    assert np.sum(np.diff(faulty.astype(int)) == 1) == 10  # no two of them touch
    assert not faulty[: rest + 1].any() and not faulty[-1]

    assert len(poses.stamps_ns) == len(truth) - 80
    off = poses.position - truth.position[plan.sent]
    turn = turned(truth.rotation[plan.sent], poses.rotation)
    size = np.where(jumping[plan.sent], 1.0, 0.0)
    assert_allclose(np.linalg.norm(off, axis=1), 0.03 * size, atol=1e-12)
    assert_allclose(np.linalg.norm(turn, axis=1), 0.3 * size, atol=1e-7)
    # While one lasts, it is the same.
    for number in range(6):
        during = off[plan.jump[plan.sent] == number]
        assert_allclose(during, np.tile(during[0], (4, 1)), atol=1e-12)


def test_faults_that_fit_exactly_are_placed_and_one_more_is_refused():
    def sensor(count):
        return SimulatedSensor('package', 10.0, dropouts=Faults(count, 0.5))

    # 201 samples, 21 of them in the rest: 180 hold 29 gaps of 5 and the samples around them.
    assert np.sum(~plan_of(sensor(29)).sent) == 29 * 5
    with pytest.raises(BellowsError, match=r"'package'.*\b181\b"):
        plan_of(sensor(30))


def test_jitter_moves_stamps_and_keeps_their_order():
    plan = plan_of(SimulatedSensor('tool', 500.0, jitter=1e-4))
    off = (plan.stamps_ns - plan.sampled_ns) * 1e-9
    assert off.std() == pytest.approx(1e-4, rel=5.0 / np.sqrt(2.0 * len(off)))
    wild = plan_of(SimulatedSensor('tool', 500.0, jitter=1.0))
    assert np.all(np.diff(wild.stamps_ns) > 0)
    assert_array_equal(plan_of(SimulatedSensor('tool', 500.0)).stamps_ns, plan.sampled_ns)


@pytest.mark.parametrize('world', ['z_up', 'motive_y_up'])
def test_twists_are_in_the_axes_that_were_asked_for(world):
    marker = np.array([0.1, -0.4, 0.9])
    sensor = SimulatedSensor('tool', 100.0, marker=marker)
    plan, truth, poses = measured(sensor, sensing.WORLDS[world])
    for frame in ('world', 'tool'):
        twists = sensing.measure_twists(
            truth, TwistSensor(frame), marker, plan, sensing.WORLDS[world], draw())
        # Whatever the world, turned by the recorded pose both are the velocities in marker axes.
        R_T = np.swapaxes(poses.rotation, -1, -2) if frame == 'world' else np.eye(3)
        seen = exp_so3(marker).T
        assert_allclose(apply(R_T, twists[:, :3]), truth.twist[:, :3] @ seen.T, atol=1e-13)
        assert_allclose(apply(R_T, twists[:, 3:]), truth.twist[:, 3:] @ seen.T, atol=1e-13)
