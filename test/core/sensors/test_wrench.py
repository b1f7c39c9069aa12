"""The wrench of a sensor against Newton and Euler on point masses, its slopes by differences."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import model_tuple, Package
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.kernels import advance
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.sensors import body, wrench
from bellows_ros.core.sensors.wrench import WrenchSensor
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import wrench_cell
from ..observer.cases import tool_motion
from ...cell.cup import CUP, PACKAGE

STEP_NS = 1_000_000
T_TOOL_SENSOR = lie.transform(lie.exp_so3([0.3, -0.2, 2.0]), [0.02, -0.01, 0.12])
GRIPPER = wrench_cell.points_of(0.7, np.array([0.01, -0.02, -0.06]), 1e-12 * np.eye(3))


def sensor(sign='load'):
    """Return the sensor of parameters that describe `T_TOOL_SENSOR` and `GRIPPER`."""
    mass, com, _ = wrench_cell.numbers_of(*GRIPPER)
    q = lie.rotation_to_quaternion(T_TOOL_SENSOR[:3, :3])
    return WrenchSensor.of(resolve({
        'wrench.frame': ' '.join(map(repr, [*T_TOOL_SENSOR[:3, 3].tolist(), *q.tolist()])),
        'wrench.sign': sign, 'gripper.mass': float(mass), 'gripper.com': com.tolist()}, ()))


def motion(seconds=1.2):
    """Return states of a tilted tool and of the package, every `STEP_NS`, and the model."""
    rng = np.random.default_rng(3)
    _, tool = tool_motion(rng, seconds, period_ns=STEP_NS)
    tilt = lie.transform(lie.exp_so3([0.3, -0.2, 0.0]), np.zeros(3))
    tool = [moved(tilt, state) for state in tool]
    model = model_tuple(CUP, Package(PACKAGE.mass, PACKAGE.inertia, (4e-3, -2e-3, -0.03)), 9.81)
    body = [static_equilibrium(model, tool[0])]
    for before, now in zip(tool[:-1], tool[1:], strict=True):
        body.append(advance(model, body[-1], before, now, STEP_NS * 1e-9, 2))
    return tool, body, model


def moved(T, state):
    """Return a state in a world that a transform moves."""
    R = T[:3, :3] @ lie.quaternion_to_rotation(np.array(state[1]))
    return (tuple((T[:3, :3] @ state[0] + T[:3, 3]).tolist()),
            tuple(lie.rotation_to_quaternion(R).tolist()), *state[2:])


def poses(states):
    """Return positions (N, 3) and rotations (N, 3, 3)."""
    return (np.array([state[0] for state in states]),
            lie.quaternion_to_rotation(np.array([state[1] for state in states])))


@pytest.mark.parametrize('sign', ['load', 'reaction'])
def test_wrench_is_that_of_newton_and_euler(sign):
    """Package and gripper as point masses: the fifth differences of positions limit the match."""
    tool, body, model = motion()
    package = wrench_cell.points_of(PACKAGE.mass, np.zeros(3), PACKAGE.inertia)
    true = wrench_cell.loads(
        poses(tool), poses(body), package, GRIPPER, T_TOOL_SENSOR, STEP_NS * 1e-9)
    given = sensor(sign)
    twist = np.array([[*state[2], *state[3]] for state in tool])
    rates = np.gradient(twist, STEP_NS * 1e-9, axis=0)
    shown = []
    for k in range(2, len(tool) - 2):
        of_gripper = wrench.load_of_gripper(
            tool[k], (tuple(rates[k, :3]), tuple(rates[k, 3:])), model[2], given.mount,
            given.gripper)
        shown.append(np.ravel(wrench.cup_load(model, tool[k], body[k], given.mount))
                     + np.ravel(of_gripper))
    size = np.repeat([np.abs(true[:, :3]).max(), np.abs(true[:, 3:]).max()], 3)
    factor = 1.0 if sign == 'load' else -1.0
    assert_allclose(factor * np.array(shown) / size, true / size, atol=2e-4)


def test_gripper_without_mass_has_no_inertia():
    with pytest.raises(BellowsError, match=r'gripper\.mass is 0'):
        wrench.gripper_at_sensor(0.0, np.array([0.1, 0, 0]))


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


def residual(values, body_pose):
    """Return what one pose leaves (6,), with values of nuisances."""
    seen, R = body.poses_of(POSES, values, *CONTEXT), body_pose.rotation[0]
    return np.append(R.T @ (seen.position[0] - body_pose.position[0]),
                     lie.log_so3(R.T @ seen.rotation[0]))


@pytest.mark.parametrize('values', [{}, VALUES])
def test_derivatives_are_those_of_differences(values):
    """Also at frames that are turned by 50 degrees."""
    true, step = body.poses_of(POSES, values, *CONTEXT), 1e-6
    origins = body.poses_of(POSES, {name: value for name, value in values.items() if name not in (
        'com', 'package_marker')}, *CONTEXT)
    columns = body.columns_of(true, values, PLACES, ENDS[-1], CONTEXT, replace(
        origins, rotation=true.rotation))[0]
    for name, place in PLACES.items():
        zero = np.zeros(SIZES[name])
        ends = [residual({**values, name: values.get(name, zero) + side * change}, true)
                for change in step * np.eye(SIZES[name]) for side in (1.0, -1.0)]
        by_value = np.transpose(np.subtract(ends[::2], ends[1::2])) / (2.0 * step)
        assert_allclose(-columns[:, place], by_value, atol=1e-6, err_msg=name)
