"""Central differences against motions with known derivatives."""

from bellows_ros.core import lie
from bellows_ros.core.differences import central_differences
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest


def motion(count, rate_hz):
    """Give poses, body twists and their derivatives of R = Rz(a(t)) Ry(b(t)) and a curve."""
    stamps = np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
    t, zero = stamps / 1e9, np.zeros(count)
    a, a1, a2 = 3.0 * np.sin(t), 3.0 * np.cos(t), -3.0 * np.sin(t)
    b, b1, b2 = np.cos(2.0 * t), -2.0 * np.sin(2.0 * t), -4.0 * np.cos(2.0 * t)
    spin = lie.exp_so3(np.stack([zero, zero, a], axis=1))
    R = spin @ lie.exp_so3(np.stack([zero, b, zero], axis=1))
    s, c = np.sin(b), np.cos(b)
    rate = np.stack([-a1 * s, b1, a1 * c], axis=1)
    rate2 = np.stack([-a2 * s - a1 * b1 * c, b2, a2 * c - a1 * b1 * s], axis=1)
    o = np.stack([np.sin(t), np.cos(3.0 * t), t**2], axis=1)
    o1 = np.stack([np.cos(t), -3.0 * np.sin(3.0 * t), 2.0 * t], axis=1)
    o2 = np.stack([-np.sin(t), -9.0 * np.cos(3.0 * t), 2.0 + zero], axis=1)
    R_inverse = np.swapaxes(R, -1, -2)
    v = lie.apply(R_inverse, o1)
    v1 = lie.apply(R_inverse, o2) - np.cross(rate, v)
    twist, acceleration = np.hstack([v, rate]), np.hstack([v1, rate2])
    return Trajectory(stamps, o, R), twist, acceleration


def errors(rate_hz):
    trajectory, twist, acceleration = motion(int(4 * rate_hz), rate_hz)
    result = central_differences(trajectory)
    inner = slice(2, -2)
    assert_array_equal(result.position, trajectory.position[inner])
    assert_array_equal(result.rotation, trajectory.rotation[inner])
    return np.array(
        [
            np.abs(result.twist - twist[inner]).max(axis=0),
            np.abs(result.acceleration - acceleration[inner]).max(axis=0),
        ]
    )


def test_second_order_accurate():
    coarse, fine = errors(50.0), errors(100.0)
    assert_allclose(np.log2(coarse / fine), 2.0, atol=0.1)
    assert np.all(fine < 0.05)


def test_standstill_gives_zeros():
    R = lie.exp_so3([0.3, -0.8, 2.0])
    still = Trajectory(np.arange(9) * 10**7, np.ones((9, 3)), np.tile(R, (9, 1, 1)))
    result = central_differences(still)
    # R R^T is the identity but for rounding, times the rate (1e2, and its square).
    assert_allclose(result.twist, 0.0, atol=1e-13)
    assert_allclose(result.acceleration, 0.0, atol=1e-11)


def test_weights_are_those_of_the_positions():
    trajectory, _, _ = motion(40, 20.0)
    upright = Trajectory(
        trajectory.stamps_ns, trajectory.position, np.tile(np.eye(3), (40, 1, 1))
    )
    result = central_differences(upright)
    windows = np.lib.stride_tricks.sliding_window_view(trajectory.position, 5, axis=0)
    _, first, second = result.weights
    assert_allclose(result.twist[:, :3], windows @ first, atol=1e-12)
    assert_allclose(result.acceleration[:, :3], windows @ second, atol=1e-10)


def test_samples_beside_an_invalid_one_are_not_valid():
    trajectory, _, _ = motion(20, 20.0)
    valid = np.arange(20) != 10
    marked = Trajectory(
        trajectory.stamps_ns, trajectory.position, trajectory.rotation, valid=valid
    )
    expected = np.abs(np.arange(2, 18) - 10) > 2
    assert_array_equal(central_differences(marked).valid, expected)


def test_too_short_or_not_uniform_is_refused():
    trajectory, _, _ = motion(20, 20.0)
    with pytest.raises(BellowsError, match='at least 5'):
        central_differences(trajectory.select(slice(0, 4)))
    with pytest.raises(BellowsError, match='uniform'):
        central_differences(trajectory.select(np.delete(np.arange(20), 7)))
