"""One-step prediction errors: white at the truth, and the observer against SciPy's."""

from bellows_ros.core.equilibrium import static_equilibrium, system_matrix
from bellows_ros.core.identification import innovations as module
from bellows_ros.core.identification import segments as segments_module
from bellows_ros.core.identification.innovations import innovations, observer
from bellows_ros.core.identification.segments import measured_segments
from bellows_ros.core.jit import COMPILED
from bellows_ros.core.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.model import Cup, model_tuple
from bellows_ros.core.recording.recording import Noise, noise_of
from bellows_ros.core.resampling import resample
from bellows_ros.core.simulation import state_row, tool_rows
from bellows_ros.core.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm, solve_discrete_are

from .recordings import noisy, PLATE, segments, Shake

MODEL = model_tuple(Cup.thesis(), PLATE, 9.81)
LEVEL = state_row((0, 0, 0), (0, 0, 0, 1), np.zeros(6))
REST = static_equilibrium(MODEL, LEVEL)


def noises_of(recording):
    """Return the noise of a segment's tool and package."""
    return [Noise(np.mean(own.ripple[:3]), np.mean(own.ripple[3:]))
            for own in (recording.tool_noise, recording.package_noise)]


def errors(recording, filtering, valid=None, model=MODEL):
    """Return the innovations of a segment from its first measured pose on."""
    package = recording.package
    poses = np.hstack([package.position, rotation_to_quaternion(package.rotation)])
    durations = np.diff(package.stamps_ns) * 1e-9
    start = state_row(poses[0, :3], poses[0, 3:], np.zeros(6))
    valid = package.valid if valid is None else valid
    rows = tool_rows(resample(recording.tool, package.stamps_ns))
    return innovations(
        model, start, rows, poses, valid, durations, np.ones(len(durations), dtype=np.int64),
        filtering)


@pytest.mark.parametrize('tool_noise', [(0.0, 0.0), (1e-4, 5e-4)])
def test_white_and_of_the_expected_covariance_at_the_truth(tool_noise):
    (recording,) = segments(11, 20.0, tool_noise=tool_noise)
    filtering = observer(
        MODEL, LEVEL, REST, 0.004, 0.004, *noises_of(recording))
    e = errors(recording, filtering)[500:]
    white = np.linalg.solve(np.linalg.cholesky(filtering.covariance), e.T).T
    # of N samples a variance is known to sqrt(2 / N), a correlation to 1 / sqrt(N)
    within = 4.5 / np.sqrt(len(white))
    assert_allclose(np.mean(white**2, axis=0), 1.0, atol=1.5 * within)
    for lag in (1, 2, 5, 20, 60):
        assert np.all(np.abs(np.mean(white[lag:] * white[:-lag], axis=0)) < within)


def test_without_tool_noise_it_is_the_free_simulation():
    filtering = observer(MODEL, LEVEL, REST, 0.004, 0.004, Noise(0.0, 0.0), Noise(1e-4, 5e-4))
    assert_allclose(filtering.gain, 0.0, atol=1e-12)
    assert_allclose(np.diag(filtering.covariance), [1e-8] * 3 + [25e-8] * 3, rtol=1e-9)


def test_transition_is_that_of_the_linear_system():
    F, inputs = module._one_step(MODEL, LEVEL, REST, 0.004)
    # gravity turns the moment of a hanging package a little: compare without it
    weightless = model_tuple(Cup.thesis(), PLATE, 0.0)
    free, _ = module._one_step(
        weightless, LEVEL, static_equilibrium(weightless, LEVEL), 0.004)
    assert_allclose(free, expm(0.004 * system_matrix(weightless)), atol=2e-4)
    # a tool moved as a whole carries the resting package with it in the end
    moved = np.linalg.solve(np.eye(12) - F, np.sum(inputs, axis=0))
    assert_allclose(moved[:3, :3], np.eye(3), atol=1e-6)
    # rounding of differences, 1e-10, is made larger by what (1 - F)^-1 is for slow modes
    assert_allclose(moved[6:], 0.0, atol=1e-3)


def test_stationary_covariance_is_that_of_the_riccati_equation():
    rng = np.random.default_rng(2)
    for _ in range(5):
        F = rng.standard_normal((12, 12))
        F *= 0.98 / np.abs(np.linalg.eigvals(F)).max()
        Q = rng.standard_normal((12, 12))
        Q = 1e-3 * Q @ Q.T
        H = np.eye(6, 12)
        X = module._stationary_covariance(F, H.T @ H, Q)
        assert_allclose(X, solve_discrete_are(F.T, H.T, Q, np.eye(6)), rtol=1e-9, atol=1e-12)


def test_the_gains_are_those_of_a_kalman_filter_that_knows_every_noise():
    """Compare with the textbook's recursion on a state that holds all noises one by one."""
    rng = np.random.default_rng(3)
    F = rng.standard_normal((12, 12))
    F *= 0.9 / np.abs(np.linalg.eigvals(F)).max()
    inputs = [0.3 * rng.standard_normal((12, 6)) for _ in range(module.LAGS + 1)]
    A, drive = module._with_tool_noise(F, inputs)
    H = np.eye(6, len(A))
    steps = 200
    n, m = rng.standard_normal((steps + module.LAGS + 1, 6)), rng.standard_normal((steps, 6))
    seen, x = np.zeros((steps, 6)), np.zeros(12)
    for k in range(steps):
        seen[k] = x[:6] + m[k]
        x = F @ x + sum(B @ n[k + j] for j, B in enumerate(inputs))
    X, z, expected = np.eye(len(A)), np.zeros(len(A)), np.zeros((steps, 6))
    for _ in range(400):  # to the stationary covariance
        S = X[:6, :6] + np.eye(6)
        X = A @ (X - X[:, :6] @ np.linalg.solve(S, X[:6])) @ A.T + drive @ drive.T
    kalman = X[:, :6] @ np.linalg.inv(X[:6, :6] + np.eye(6))
    for k in range(steps):
        expected[k] = seen[k] - H @ z
        z = A @ (z + kalman @ expected[k])
    gain = module._lagged(A[:12], kalman)
    x, e = np.zeros(12), np.zeros((steps, 6))
    for k in range(steps):
        e[k] = seen[k] - x[:6]
        x = F @ x + sum(gain[lag] @ e[k - lag] for lag in range(min(module.LAGS, k + 1)))
    assert_allclose(e, expected, atol=1e-9)
    found = module._stationary_covariance(A, H.T @ H, drive @ drive.T)
    assert_allclose(found[:12, :12], X[:12, :12], rtol=1e-8, atol=1e-10)


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: this takes minutes interpreted')
def test_at_rest_no_damping_makes_the_errors_smaller(monkeypatch):
    """The squares of white noise say nothing of K and P: what prefers one is a bias."""
    noise = Noise(1e-4, 5e-4)
    count = 200_000
    stamps = np.arange(count) * 4_000_000
    still = Trajectory(stamps, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)))
    position, rotation = np.array(REST[0]), quaternion_to_rotation(np.array(REST[1]))
    hanging = Trajectory(
        stamps, np.tile(position, (count, 1)), np.tile(rotation, (count, 1, 1)))
    rng = np.random.default_rng(4)
    monkeypatch.setattr(segments_module, 'MOST_POSES', 2 * count)
    (recording,) = measured_segments(
        noisy(still, *noise, rng), noisy(hanging, *noise, rng), PLATE, 9.81)
    thesis, squares = Cup.thesis(), []
    for factor in (0.5, 1.0, 2.0):
        cup = Cup(thesis.stiffness, factor * thesis.damping, thesis.length)
        model = model_tuple(cup, PLATE, 9.81)
        filtering = observer(model, LEVEL, REST, 0.004, 0.004, noise, noise)
        e = errors(recording, filtering, model=model)[500:]
        white = np.linalg.solve(np.linalg.cholesky(filtering.covariance), e.T)
        squares.append(np.mean(white**2, axis=1))
    # an observer that forgets that one pose's noise acts in several steps is off by 0.02
    assert_allclose(squares, np.ones((3, 6)), atol=4.5 * np.sqrt(2 / count))
    # of such differences, 12 seeds of an eighth of this length say a spread of 0.0006
    assert_allclose(squares[0], squares[1], atol=2.7e-3)
    assert_allclose(squares[2], squares[1], atol=2.7e-3)


def test_an_outlier_steers_no_more_than_its_limit():
    (recording,) = segments(12, 6.0, tool_noise=(1e-4, 5e-4))
    filtering = observer(
        MODEL, LEVEL, REST, 0.004, 0.004, *noises_of(recording))
    usual = errors(recording, filtering)
    position = recording.package.position.copy()
    position[700] += 10.0
    package = type(recording.package)(
        recording.package.stamps_ns, position, recording.package.rotation)
    hit = errors(type(recording)(
        recording.tool, package, *list(vars(recording).values())[2:]), filtering)
    assert np.abs(hit[700]).max() > 5.0
    assert np.abs(hit[701:] - usual[701:]).max() < 5e-4


def test_nothing_is_made_of_invalid_poses():
    (recording,) = segments(13, 4.0, tool_noise=(1e-4, 5e-4))
    filtering = observer(
        MODEL, LEVEL, REST, 0.004, 0.004, *noises_of(recording))
    valid = recording.package.valid.copy()
    valid[300:350] = False
    e = errors(recording, filtering, valid)
    assert_allclose(e[300:350], 0.0, atol=0)
    assert np.all(np.any(e[350:360] != 0.0, axis=1))


@pytest.mark.parametrize(('position', 'rotation'), [(1e-4, 5e-4), (1e-3, 1e-3), (0.0, 0.0)])
def test_noise_is_found_in_spite_of_motion_and_outliers(position, rotation):
    poses = noisy(Shake(1).trajectory(10.0, 360.0), position, rotation, np.random.default_rng(0))
    jumps = poses.position.copy()
    jumps[100:1000:97] += 0.03
    found = noise_of(type(poses)(poses.stamps_ns, jumps, poses.rotation))
    assert_allclose(found.position, position, rtol=0.05, atol=1e-8)
    assert_allclose(found.rotation, rotation, rtol=0.05, atol=1e-7)
