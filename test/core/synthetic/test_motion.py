"""Motions of the tool: derivatives by finite differences, smoothness, errors of settings."""

from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.synthetic.motion import motion_from
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.signal import chirp
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
CHIRP = {
    'kind': 'chirp', 'duration': 6.0, 'rest_duration': 1.0, 'start': START,
    'chirp': {'from': 0.5, 'to': 5.0, 'position': [0, 0.02, 0.01], 'rotation': [0.1, 0.3, 0.2]}}
WAYPOINTS = {
    'kind': 'waypoints',
    'rest_duration': 1.0,
    'start': START,
    'waypoints': {
        'poses': [
            {'position': [0.6, 0.1, 0.7], 'rpy': [0.1, 0.5, -1.0], 'move': 0.8, 'hold': 0.5},
            {'position': [0.4, 0.1, 0.9], 'quaternion_xyzw': [0, 0, 1, 0], 'move': 1.2},
            {'position': [0.5, 0.0, 0.8], 'move': 0.6, 'hold': 0.9}]}}
STATIC = {
    'kind': 'static',
    'rest_duration': 1.0,
    'static': {
        'move': 0.7, 'hold': 1.3, 'poses': [{'rpy': [0.4, 0.0, 0.0]}, {'rpy': [0.0, 0.4, 0.0]}]}}
ALL = pytest.mark.parametrize(
    'content', [MULTI_SINE, CHIRP, WAYPOINTS, STATIC], ids=lambda c: c['kind'])


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
    assert_array_equal(position, np.broadcast_to(moving.start.position, (11, 3)))
    assert_allclose(rotation, np.broadcast_to(moving.start.rotation, (11, 3, 3)), atol=1e-15)
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


def test_a_chirp_sweeps_linearly():
    moving = motion(CHIRP)
    phase = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 5)[0]  # of y, the first that moves
    tau = np.linspace(1.0, 5.0, 1001)  # after the ramp
    expected = 0.02 * chirp(tau, 0.5, 5.0, 5.0, phi=np.degrees(phase) - 90.0)
    position = moving.state(tau + 1.0)[0] - moving.start.position
    assert_allclose(position[:, 1], expected, atol=1e-12)
    assert_allclose(position[:, 0], 0.0, atol=0.0)


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
    (MULTI_SINE, ('start', 'quaternion_xyzw'), [0, 0, 0, 1], 'start.*quaternion_xyzw'),
    (MULTI_SINE, ('multi_sine',), {}, "'multi_sine'"),
    (MULTI_SINE, (*LINE, 'amplitude'), [1.0], r'multi_sine\.rotation\.x.* 1 and 2\b'),
    (MULTI_SINE, (*LINE, 'frequency'), [1.0, -1.0], r'frequency.* 100 \(Hz\).* -1\.0'),
    (WAYPOINTS, ('waypoints', 'poses'), [], "'waypoints.poses'"),
    (WAYPOINTS, (*POSES, 'quaternion_xyzw'), [0, 0, 0, 2], r'quaternion_xyzw.* 1\b'),
    (WAYPOINTS, (*POSES, 'move'), 3600.0, r'\b3600 s\b')])
def test_a_wrong_setting_is_refused_by_name(content, path, value, named):
    with pytest.raises(BellowsError, match=named):
        motion(changed(content, path, value))
