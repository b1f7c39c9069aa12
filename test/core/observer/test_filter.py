"""The filter against a dense one of its own making, by differences."""

from bellows_ros.core.equilibrium import largest_step, static_equilibrium
from bellows_ros.core.model import model_tuple
from bellows_ros.core.observer.filter import (
    carried,
    changed,
    corrected,
    Driving,
    Estimate,
    innovation,
    pose_error,
)
import numpy as np
import pytest

from .cases import CUP, later, NOISE, PACKAGE, PERIOD_NS, tool_motion, with_noise

STD = np.repeat([0.003, 0.02, 0.05, 0.2, 0.05, 0.004, 0.3, 0.01],
                [3, 3, 3, 3, 1, 3, 3, 3])


def difference(one, other):
    """Give the change (12,) that leads from one state to another."""
    return np.concatenate([
        *pose_error(one, other[0], other[1]),
        np.subtract(other[2], one[2]), np.subtract(other[3], one[3])])


def by_differences(body, theta, *motion, size=1e-5):
    """Give the transition (22, 22) by central differences."""
    F = np.eye(22)
    for k in range(22):
        step = np.zeros(22)
        step[k] = size
        ends = [later(changed(body, sign * step[:12]), theta + sign * step[12:], *motion)
                for sign in (1.0, -1.0)]
        middle = later(body, theta, *motion)
        F[:12, k] = (difference(middle, ends[0]) - difference(middle, ends[1])) / (2 * size)
    return F


@pytest.mark.parametrize(('theta', 'within'), [(np.zeros(10), 3e-5), (np.array(
    [0.04, 0.002, -0.001, 0.003, 0.1, -0.08, 0.12, 0.002, 0.001, -0.001]), 3e-4)])
def test_filter_equals_a_dense_one_by_differences(theta, within):
    """
    Carry and correct an estimate for some samples with F by differences, and compare.

    The filter takes what a bias does in a sample to first order, so that one of 0.2 N shows.
    """
    rng = np.random.default_rng(1)
    stamps, tool = tool_motion(rng, 0.5)
    model = model_tuple(CUP, PACKAGE, 9.81)
    body = changed(static_equilibrium(model, tool[60]), rng.normal(size=12) * 0.01)
    P = np.diag(STD**2)
    driven = Driving(np.diag(np.arange(1.0, 13.0)), np.arange(10.0) * 1e-4)
    own = Estimate(int(stamps[60]), body, theta, P)
    h, noise, H = PERIOD_NS * 1e-9, np.diag(NOISE**2), np.eye(6, 22)
    H[:3, 13:16] = -np.eye(3)
    for k in range(61, 66):
        own, _ = carried(
            model, own, tool[k - 1], tool[k], int(stamps[k]), largest_step(model), driven)
        F = by_differences(body, theta, tool[k - 1], tool[k], h)
        body = later(body, theta, tool[k - 1], tool[k], h)
        P = F @ P @ F.T
        P[:12, :12] += h**2 * driven.noise
        P += np.diag(np.concatenate([np.zeros(12), h * driven.walk]))
        # fewer steps of integration, and the bias to first order: small against what is known
        np.testing.assert_allclose(difference(own.body, body) / STD[:12], 0.0, atol=within)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(own.covariance / scale, P / scale, atol=within)
        z = with_noise(rng, body, NOISE)
        found = innovation(own, z[0], z[1], noise, H)
        own = corrected(own, found, noise)
        y = difference(body, (*z[:2], body[2], body[3]))[:6]
        S = H @ P @ H.T + noise
        error = P @ H.T @ np.linalg.solve(S, y)
        P = P - P @ H.T @ np.linalg.solve(S, H @ P)
        body, theta = changed(body, error[:12]), theta + error[12:]
        assert found.distance == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-3)
        np.testing.assert_allclose((own.theta - theta) / STD[12:], 0.0, atol=within)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(own.covariance / scale, P / scale, atol=within)


def test_covariance_stays_positive_definite_after_very_many_updates():
    """Take in 100,000 measurements without noise to speak of and ones with, of one transition."""
    rng = np.random.default_rng(2)
    model = model_tuple(CUP, PACKAGE, 9.81)
    tool = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    body = static_equilibrium(model, tool)
    walk = np.concatenate([np.zeros(4), np.full(6, 1e-12)])
    driven = Driving(np.zeros((12, 12)), walk)
    own, H = Estimate(0, body, np.zeros(10), np.diag(STD**2)), np.eye(6, 22)
    for k in range(20_000):
        own, _ = carried(model, own, tool, tool, 1_000_000 * (k + 1), 1.0, driven)
        for scale in (1e-8, 1.0, 1e-4, 1.0, 1e-6):
            noise = np.diag(NOISE**2) * scale
            z = with_noise(rng, body, NOISE * np.sqrt(scale))
            own = corrected(own, innovation(own, z[0], z[1], noise, H), noise)
    scale = np.sqrt(np.diag(own.covariance))
    assert np.linalg.eigvalsh(own.covariance / np.outer(scale, scale))[0] > 0.0
    np.testing.assert_array_equal(own.covariance, own.covariance.T)
    np.testing.assert_allclose(difference(own.body, body)[:6], 0.0, atol=1e-4)
