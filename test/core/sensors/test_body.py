"""Derivatives of a body's views are those of differences."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.equilibrium import displaced
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose

SIZES = {'com': 3, 'scale': 1, 'package_world': 6, 'package_marker': 6}


def seen(values):
    """Return the view of one pose with values of nuisances, and its columns, one after another."""
    ends = np.cumsum(list(SIZES.values()))
    places = {name: np.arange(end - size, end) for (name, size), end in zip(
        SIZES.items(), ends, strict=True)}
    turn = lie.exp_so3(np.array([[0.3, -0.2, 0.5]]))
    poses = Trajectory(np.zeros(1, int), np.array([[0.11, 0.19, -0.1]]), turn)
    views = body.views(
        poses, values, places, np.ones(ends[-1]), (
            np.ones(3), np.array([0.1, 0.0, 0.2, 0.0]), np.array([0.0, 0.5, 1.0])),
        poses, np.zeros(1))
    return views, places


def residual(views, state):
    """Give what a pose leaves, and the derivative by the error of the package."""
    out, M = np.zeros(6), np.zeros((6, 6))
    body.observe(state, views, 0, M, out)
    return out, M


def test_derivatives_are_those_of_differences():
    q = lie.rotation_to_quaternion(lie.exp_so3(np.array([0.3, -0.21, 0.5])))
    state = row_state(np.concatenate([[0.111, 0.19, -0.1], q, np.zeros(6)]))
    step = 1e-6
    views, places = seen({})
    _, M = residual(views, state)
    by_error = np.transpose([
        (residual(seen({})[0], displaced(state, tuple(d[:3]), tuple(d[3:])))[0]
         - residual(seen({})[0], displaced(state, tuple(-d[:3]), tuple(-d[3:])))[0])
        / (2.0 * step) for d in step * np.eye(6)])
    assert_allclose(-M, by_error, atol=0.02)  # the residual is a hundredth of a radian
    for name, place in places.items():
        ends = [residual(seen({name: side * change})[0], state)[0]
                for change in step * np.eye(SIZES[name]) for side in (1.0, -1.0)]
        by_value = np.transpose(np.subtract(ends[::2], ends[1::2])) / (2.0 * step)
        assert_allclose(-views.columns[0][:, place], by_value, atol=0.02, err_msg=name)
