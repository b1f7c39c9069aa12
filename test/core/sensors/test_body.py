"""Derivatives of a body's views are those of differences, also in axes of the noise."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import displaced
from bellows_ros.core.model.simulation import row_state, state_row
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

MODEL = model_tuple(Cup.thesis(), Package(1.8, np.diag([4.4e-3, 6.5e-3, 9.8e-3]), [0, 0, -0.03]),
                    9.81)
TOOL = state_row(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
SIZES = {'com': 3, 'scale': 1, 'package_world': 6, 'package_marker': 6}


def seen(values, axes):
    """Return the view of one pose with values of nuisances, and its columns, one after another."""
    ends = np.cumsum(list(SIZES.values()))
    places = {name: np.arange(end - size, end) for (name, size), end in zip(
        SIZES.items(), ends, strict=True)}
    turn = lie.exp_so3(np.array([[0.3, -0.2, 0.5]]))
    poses = Trajectory(np.zeros(1, int), np.array([[0.11, 0.19, -0.1]]), turn)
    views = body.views(
        poses, values, places, np.ones(ends[-1]), (np.ones(3), np.array([0.1, 0.0, 0.2, 0.0])),
        poses, 0.01, np.zeros(1), axes, np.array([0.02, 0.01, -0.03]))
    return views, places


def residual(views, state):
    """Return the residual of the view (6,), and its derivative by the package's error."""
    out, M = np.zeros(6), np.zeros((6, 6))
    body.observe(MODEL, TOOL, state, views, 0, M, out)
    return out, M


@pytest.mark.parametrize('axes', [
    np.empty((0, 3, 3)), lie.exp_so3(np.array([[0.4, 0.1, -0.7]]))], ids=['body', 'noise'])
def test_derivatives_are_those_of_differences(axes):
    q = lie.rotation_to_quaternion(lie.exp_so3(np.array([0.3, -0.21, 0.5])))
    state = row_state(np.concatenate([[0.111, 0.19, -0.1], q, np.zeros(6)]))
    step = 1e-6
    views, places = seen({}, axes)
    _, M = residual(views, state)
    by_error = np.transpose([
        (residual(seen({}, axes)[0], displaced(state, tuple(d[:3]), tuple(d[3:])))[0]
         - residual(seen({}, axes)[0], displaced(state, tuple(-d[:3]), tuple(-d[3:])))[0])
        / (2.0 * step) for d in step * np.eye(6)])
    assert_allclose(-M, by_error, atol=0.02)  # the residual is a hundredth of a radian
    for name, place in places.items():
        ends = [residual(seen({name: side * change}, axes)[0], state)[0]
                for change in step * np.eye(SIZES[name]) for side in (1.0, -1.0)]
        by_value = np.transpose(np.subtract(ends[::2], ends[1::2])) / (2.0 * step)
        assert_allclose(-views.columns[0][:, place], by_value, atol=0.02, err_msg=name)
