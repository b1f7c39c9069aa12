"""The filter against a dense one of its own making, by differences."""

import itertools

from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import largest_step, pose_error, static_equilibrium
from bellows_ros.core.model.kernels import tool_at, tool_segment
from bellows_ros.core.observer.filter import (
    changed,
    driving,
    Estimate,
    NOT_FOLLOWED,
    swept,
    with_payload,
)
from bellows_ros.core.observer.measurement import compared, corrected
import numpy as np
import pytest

from .cases import CUP, later, NOISE, PACKAGE, tool_motion, with_noise

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


def carried(model, known, start, end, stamp_ns, longest, driven):
    """Give an estimate carried along one motion of the tool."""
    rows = [np.array([[*o, *q, *v, *w]] * 2) for o, q, v, w in (start, end, end)]
    P = known.covariance.copy()
    tool, body = swept(
        with_payload(model, known.theta), known.theta, start, known.body, P, NOT_FOLLOWED,
        np.array([known.stamp_ns, stamp_ns]), *rows, False, 1, known.stamp_ns, stamp_ns, longest,
        driven)
    assert tool == end
    return known._replace(stamp_ns=stamp_ns, tool=tool, body=body, covariance=P)


def taken_in(known, position, q, noise, H):
    """Give an estimate with a measurement taken in, and the squared distance of that."""
    y, _, distance, gain = compared(known.body, known.covariance, position, q, noise, H)
    body, theta, P = corrected(known.body, known.theta, known.covariance, y, H, gain, noise)
    return known._replace(body=body, theta=theta, covariance=P), distance


@pytest.mark.parametrize('theta', [np.zeros(10), np.array(
    [0.04, 0.002, -0.001, 0.003, 0.1, -0.08, 0.12, 0.002, 0.001, -0.001])])
def test_filter_equals_a_dense_one_by_differences(theta):
    """
    Carry and correct an estimate for some samples with F by differences, and compare.

    In steps of 1 ms, as the error of the filter's covariance is of second order in them.
    """
    rng = np.random.default_rng(1)
    stamps, tool = tool_motion(rng, 0.5)
    model = model_tuple(CUP, PACKAGE, 9.81)
    body = changed(static_equilibrium(model, tool[60]), rng.normal(size=12) * 0.001)
    P = np.diag(STD**2)
    driven = driving(model, tool[60], body, np.repeat([1e-4, 5e-4], 3),
                     np.r_[np.zeros(16), np.arange(6.0) * 1e-4])
    own = Estimate(int(stamps[60]), tool[60], body, theta, P)
    h, noise, H = 1e-3, np.diag(NOISE**2), np.eye(6, 22)
    H[:3, 13:16] = -np.eye(3)
    half = h / 2 * np.diag(driven[1])  # before and after each step
    half[:12, :12] += h * h / 2 * driven[0]
    for k in range(61, 66):
        segment = tool_segment(tool[k - 1], tool[k], 4 * h)
        tools = [tool_at(segment, part) for part in (0.0, 0.25, 0.5, 0.75, 1.0)]
        for start, end in itertools.pairwise(tools):
            own = carried(
                model, own, start, end, own.stamp_ns + 1_000_000, largest_step(model), driven)
            F = by_differences(body, theta, start, end, h)
            body = later(body, theta, start, end, h)
            P = F @ (P + half) @ F.T + half
        np.testing.assert_allclose(difference(own.body, body) / STD[:12], 0.0, atol=3e-4)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(own.covariance / scale, P / scale, atol=3e-4)
        z = with_noise(rng, body, NOISE)
        own, distance = taken_in(own, *z[:2], noise, H)
        y = difference(body, (*z[:2], body[2], body[3]))[:6]
        S = H @ P @ H.T + noise
        error = P @ H.T @ np.linalg.solve(S, y)
        P = P - P @ H.T @ np.linalg.solve(S, H @ P)
        body, theta = changed(body, error[:12]), theta + error[12:]
        assert distance == pytest.approx(y @ np.linalg.solve(S, y), rel=1e-3)
        np.testing.assert_allclose((own.theta - theta) / STD[12:], 0.0, atol=3e-4)
        scale = np.sqrt(np.outer(np.diag(P), np.diag(P)))
        np.testing.assert_allclose(own.covariance / scale, P / scale, atol=3e-4)


@pytest.mark.parametrize('updates', [
    10_000, pytest.param(1_000_000, marks=[pytest.mark.stress, pytest.mark.timeout(900)])])
def test_covariance_stays_positive_definite_after_very_many_updates(updates):
    """Take in measurements without noise to speak of and ones with, turn and turn about."""
    rng = np.random.default_rng(2)
    model = model_tuple(CUP, PACKAGE, 9.81)
    tool = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    body = static_equilibrium(model, tool)
    driven = np.zeros((12, 12)), np.r_[np.zeros(16), np.full(6, 1e-12)]
    own, H = Estimate(0, tool, body, np.zeros(10), np.diag(STD**2)), np.eye(6, 22)
    seen = [(noise, *with_noise(rng, body, NOISE * np.sqrt(noise))[:2])
            for noise in (1e-8, 1.0, 1e-4, 1.0, 1e-6) for _ in range(20)]
    for k in range(updates):
        if k % 5 == 0:
            own = carried(model, own, tool, tool, own.stamp_ns + 1_000_000, 1.0, driven)
        scale, position, q = seen[37 * k % len(seen)]
        noise = np.diag(NOISE**2) * scale
        own, _ = taken_in(own, position, q, noise, H)
    scale = np.sqrt(np.diag(own.covariance))
    assert np.linalg.eigvalsh(own.covariance / np.outer(scale, scale))[0] > 0.0
    np.testing.assert_array_equal(own.covariance, own.covariance.T)
    np.testing.assert_allclose(difference(own.body, body)[:6], 0.0, atol=1e-4)
