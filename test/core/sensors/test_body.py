"""Derivatives of a body's views are those of differences."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.equilibrium import displaced
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

SIZES = {'com': 3, 'scale': 1, 'package_world': 6, 'package_marker': 6}
VALUES = {
    'com': np.array([0.02, -0.01, 0.03]), 'scale': np.array([0.1]),
    'package_world': np.array([0.1, -0.2, 0.05, 0.5, -0.3, 0.6]),
    'package_marker': np.array([0.02, 0.03, -0.01, -0.6, 0.4, 0.3])}
CONTEXT = np.ones(3), np.array([0.1, 0.0, 0.2, 0.0]), np.array([0.0, 0.5, 1.0])
POSES = Trajectory(
    np.zeros(1, int), np.array([[0.11, 0.19, -0.1]]), lie.exp_so3(np.array([[0.3, -0.2, 0.5]])))
ENDS = np.cumsum(list(SIZES.values()))
PLACES = {name: np.arange(end - size, end) for (name, size), end in zip(
    SIZES.items(), ENDS, strict=True)}


def seen(values, tool):
    """Return the view of one pose with values of nuisances, held parallel to the tool."""
    return body.views(POSES, values, PLACES, np.ones(ENDS[-1]), CONTEXT, tool, np.zeros(1))


def residual(views, state):
    """Give what a pose leaves, and the derivative by the error of the package."""
    out, M = np.zeros(6), np.zeros((6, 6))
    body.observe(state, views, 0, M, out)
    return out, M


@pytest.mark.parametrize('values', [{}, VALUES])
def test_derivatives_are_those_of_differences(values):
    """Also at frames that are turned by 50 degrees."""
    true = body.poses_of(POSES, values, *CONTEXT)
    state = row_state(np.concatenate([
        true.position[0], lie.rotation_to_quaternion(true.rotation)[0], np.zeros(6)]))
    views, step = seen(values, true), 1e-6
    _, M = residual(views, state)
    by_error = np.transpose([
        (residual(views, displaced(state, tuple(d[:3]), tuple(d[3:])))[0]
         - residual(views, displaced(state, tuple(-d[:3]), tuple(-d[3:])))[0])
        / (2.0 * step) for d in step * np.eye(6)])
    assert_allclose(-M, by_error, atol=1e-6)
    for name, place in PLACES.items():
        zero = np.zeros(SIZES[name])
        ends = [residual(seen({**values, name: values.get(name, zero) + side * change}, true),
                         state)[0]
                for change in step * np.eye(SIZES[name]) for side in (1.0, -1.0)]
        by_value = np.transpose(np.subtract(ends[::2], ends[1::2])) / (2.0 * step)
        assert_allclose(-views.columns[0][:, place], by_value, atol=1e-6, err_msg=name)
