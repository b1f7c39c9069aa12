"""The filter against polynomials, a slow reference, and the synthetic motions of the thesis."""

from math import factorial

from bellows_ros.core.geometry import lie
from bellows_ros.core.signals import savgol as module
from bellows_ros.core.signals.savgol import (
    bridged,
    correlated,
    longest_bridge,
    savgol,
    weights,
    with_filtered_noise,
)
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

RATE_HZ = 360.0


def trajectory_of(position, rotation, rate_hz=RATE_HZ, valid=True):
    stamps = 1_700_000_000_000_000_000 + np.round(np.arange(len(position)) * 1e9 / rate_hz)
    return Trajectory(stamps.astype(np.int64), position, rotation, valid=np.array(valid))


def noisy_motion(count=120, seed=0):
    """Give a smooth motion with 1 mm and 20 mrad of noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(count)[:, None] / RATE_HZ
    position = np.sin(t * [3.0, 7.0, 11.0]) + 1e-3 * rng.normal(size=(count, 3))
    phi = 2.0 * np.cos(t * [11.0, 5.0, 8.0]) + 0.02 * rng.normal(size=(count, 3))
    return trajectory_of(position, lie.exp_so3(phi))


def slow_reference(trajectory, half_window, order):
    """Fit every window by least squares as printed (4.18-4.21, 4.43-4.45), sample by sample."""
    offsets = range(-half_window, half_window + 1)
    period = 1e-9 * (trajectory.stamps_ns[-1] - trajectory.stamps_ns[0]) / (len(trajectory) - 1)
    A = [[(w * period) ** j / factorial(j) for j in range(order + 1)] for w in offsets]
    rows = []
    for k in range(half_window, len(trajectory) - half_window):
        o = [trajectory.position[k + w] for w in offsets]
        R_k = trajectory.rotation[k]
        turns = [Rotation.from_matrix(trajectory.rotation[k + w] @ R_k.T) for w in offsets]
        o = np.linalg.lstsq(A, o, rcond=None)[0]
        e = np.linalg.lstsq(A, [turn.as_rotvec() for turn in turns], rcond=None)[0]
        R, R_rate, R_rate2 = (M @ R_k for M in exponential_of_a_parabola(*e[:3]))
        rows.append(body_quantities(o[:3], R, R_rate, R_rate2))
    return [np.array(column) for column in zip(*rows, strict=True)]


def exponential_of_a_parabola(e0, e1, e2):
    """Differentiate exp(e0 + e1 t + e2 t^2/2) twice at t = 0, by the exponential of its jet."""
    E0, E1, E2 = (np.cross(np.eye(3), e) for e in (e0, e1, e2))
    zero = np.zeros((3, 3))
    jet = expm(np.block([[E0, E1, E2 / 2], [zero, E0, E1], [zero, zero, E0]]))
    return jet[:3, :3], jet[:3, 3:6], 2 * jet[:3, 6:]


def body_quantities(o, R, R_rate, R_rate2):
    """Return position, rotation, body twist and its derivative from plain derivatives."""
    W = R.T @ R_rate
    dW = R_rate.T @ R_rate + R.T @ R_rate2
    v, dv = R.T @ o[1], R_rate.T @ o[1] + R.T @ o[2]
    twist, acceleration = (
        np.concatenate([linear, [S[2, 1], S[0, 2], S[1, 0]]]) for linear, S in ((v, W), (dv, dW))
    )
    return o[0], R, twist, acceleration


@pytest.mark.parametrize('half_window, order', [(2, 2), (23, 2), (15, 3), (25, 4)])
def test_agrees_with_a_slow_least_squares_fit_per_window(half_window, order):
    trajectory = noisy_motion()
    result = savgol(trajectory, half_window, order)
    position, rotation, twist, acceleration = slow_reference(trajectory, half_window, order)
    assert len(result) == len(trajectory) - 2 * half_window
    assert_array_equal(result.stamps_ns, trajectory.stamps_ns[half_window:-half_window])
    assert_allclose(result.position, position, atol=1e-9)
    assert_allclose(result.rotation, rotation, atol=1e-9)
    assert_allclose(result.twist, twist, atol=1e-9, rtol=1e-9)
    assert_allclose(result.acceleration, acceleration, atol=1e-9, rtol=1e-9)


def test_windows_beyond_the_reach_of_the_logarithm_are_not_valid():
    t = np.arange(400) / 125.0
    angle = 2.0 * t + 20.0 * np.clip(t - 1.6, 0.0, None)  # 0.4 rad and then 4.4 rad in 0.2 s
    R = lie.exp_so3(np.multiply.outer(angle, [0.0, 0.6, 0.8]))
    result = savgol(trajectory_of(np.zeros((400, 3)), R, 125.0), 25, 2)
    assert result.valid[:150].all()
    assert not result.valid[200:].any()
    assert_allclose(np.linalg.norm(result.twist[:150, 3:], axis=1), 2.0, rtol=1e-9)


def test_windows_that_touch_an_invalid_sample_are_not_valid():
    good, n = noisy_motion(), 10
    position, rotation = good.position.copy(), good.rotation.copy()
    valid = np.full(len(good), True)
    position[50], rotation[50], valid[50] = [9.0, 9.0, 9.0], np.diag([-1.0, 1.0, -1.0]), False
    result = savgol(trajectory_of(position, rotation, valid=valid), n, 3)
    expected = np.full(len(good) - 2 * n, True)
    expected[40 - n:40 + n + 1] = False
    assert_array_equal(result.valid, expected)
    # Only those samples differ; they are finite all the same.
    clean = savgol(good, n, 3)
    assert_array_equal(result.twist[expected], clean.twist[expected])
    assert_array_equal(result.acceleration[expected], clean.acceleration[expected])


def test_blocks_leave_no_seams(monkeypatch):
    trajectory = noisy_motion(200)
    whole = savgol(trajectory, 12, 3)
    for block in (1, 7, 176, 177):
        monkeypatch.setattr(module, 'BLOCK', block)
        parts = savgol(trajectory, 12, 3)
        assert_allclose(parts.acceleration, whole.acceleration, atol=1e-12, rtol=1e-12)
        assert_allclose(parts.rotation, whole.rotation, atol=1e-15)


@pytest.mark.parametrize('kept', [(0.0, 0.0), (0.9, 0.0), (0.5, 0.97)])
def test_noise_that_a_filter_lets_through(kept):
    count, noise, rate_hz = 40_000, np.array([2e-3, 5e-3]), 360.0
    still = Trajectory(
        np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64), np.zeros((count, 3)),
        np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 6)))
    W = weights(6, 4, rate_hz)
    noisy = with_filtered_noise(
        still, noise, np.array(kept), W, 1.0 / rate_hz, np.random.default_rng(3))
    lags = np.abs(np.subtract.outer(np.arange(13), np.arange(13)))
    seen = ((noisy.position, noisy.twist[:, :3]),
            (Rotation.from_matrix(noisy.rotation).as_rotvec(), noisy.twist[:, 3:]))
    for std, part, own in zip(noise, kept, seen, strict=True):
        for row, values in zip(W[:2], own, strict=True):
            expected = std * np.sqrt(row @ np.power(part, lags) @ row)
            assert_allclose(np.std(values, axis=0), expected, rtol=0.06)


@pytest.mark.parametrize('half_window, order, figures', [
    (5, 1, r'\b5\b.* 2 .* 10 .* 1\b'), (5, 11, r'\b5\b.* 2 .* 10 .* 11\b'),
    (0, 2, r'\b1 sample\b.* 0\b'), (40, 2, r'\b40\b.* 81 samples.* 80\b')])
def test_impossible_fits_are_refused(half_window, order, figures):
    with pytest.raises(BellowsError, match=figures):
        savgol(noisy_motion(80), half_window, order)


@pytest.mark.parametrize('kept', [0.0, 0.3, 0.999, -0.5])
def test_it_is_the_filter_of_scipy(kept):
    inputs = np.random.default_rng(1).standard_normal((500, 3))
    found = correlated(inputs, kept)
    inputs[1:] *= np.sqrt(1.0 - kept**2)
    assert_allclose(found, lfilter([1.0], [1.0, -kept], inputs, axis=0), atol=1e-9)


@pytest.mark.parametrize(('half_window', 'order'), [(8, 6), (30, 6), (42, 6)])
def test_a_bridge_is_as_certain_as_a_measured_pose(half_window, order):
    """And exact for polynomials, in gaps of any places."""
    rng, count = np.random.default_rng(2), longest_bridge(half_window, order)
    at = np.linspace(-1.0, 1.0, 6 * half_window)
    valid = np.ones(len(at), dtype=bool)
    valid[3 * half_window:3 * half_window + count] = False
    valid[half_window] = False
    curve = np.vander(at, order + 1) @ rng.normal(size=(order + 1, 3))
    turns = lie.exp_so3(0.3 * curve * [0.0, 0.0, 1.0])
    lost = np.where(valid[:, None], curve, 99.0)
    found = bridged(trajectory_of(lost, turns, valid=valid), half_window, order)
    assert found.valid.all()
    assert_allclose(found.position, curve, atol=1e-6)
    errors = np.array([bridged(trajectory_of(
        rng.normal(size=(len(at), 3)), turns, valid=valid), half_window, order).position[~valid]
        for _ in range(300)])
    spread = errors.std(axis=(0, 2))
    assert 0.6 < spread.max() < 1.1


@pytest.mark.parametrize(('half_window', 'order'), [(10, 4), (40, 6)])
def test_tapered_weights_are_those_of_a_weighted_fit_and_stop_what_is_above_their_band(
        half_window, order):
    lags = np.arange(-half_window, half_window + 1)
    roots = np.cos(0.5 * np.pi * lags / (half_window + 1))
    powers = np.array([(lags / RATE_HZ) ** j / factorial(j) for j in range(order + 1)]).T
    expected = np.linalg.pinv(roots[:, None] * powers)[:3] * roots
    tapered, plain = (weights(half_window, order, RATE_HZ, taper) for taper in (True, False))
    assert_allclose(tapered, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    waves = np.exp(2j * np.pi * np.outer(lags, np.linspace(1.5 * order / (
        2 * half_window + 1), 0.5, 50)))
    assert np.mean(np.abs(tapered[0] @ waves)**2) < 0.1 * np.mean(np.abs(plain[0] @ waves)**2)
