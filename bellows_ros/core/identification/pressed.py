"""
K of a cup at rest on a fixed plate, from poses of the tool and wrenches of a force-torque sensor.

The tool moves and strains the cup; no package is recorded. At rest the sensor measures the spring
force and the weight of the gripper. The unknowns are K, the pose of the lip in the world, the zero
of the sensor and, within given standard deviations, the gains of the sensor and the gripper. The
residuals of force and moment give the noise.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import gravity_vector, regressor
from bellows_ros.core.model.simulation import tool_rows
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.sensors.wrench import gripper_regressors, INERTIAL_NUMBERS, WrenchSensor
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import UndeterminedError, UnexplainedError
import numpy as np
from scipy.optimize import least_squares

LIP_STD = np.repeat([0.02, 0.2], 3)
"""Standard deviations of the pose of the lip about the least loaded standstill, m and rad."""

SPRING_STD = 3.0
"""Standard deviation of K, in units of a usual cup."""

MAX_ERROR = 0.5
"""Largest relative standard error of an entry of K."""

MIN_STANDSTILLS = 8
"""Smallest number of standstills for K with the other unknowns."""


class PressedCup(NamedTuple):
    """
    K (6, 6) with its standard errors, of a number of standstills.

    Residuals (2,) are of force and moment, RMS, N and N m.
    """

    stiffness: Array
    stiffness_std: Array
    standstills: int
    residuals: Array


def pressed_cup(
    tool: Trajectory, wrenches: Array, sensor: WrenchSensor, structure: Structure,
    usual: Array, length: float, gravity: float,
) -> PressedCup:
    """
    Return K from standstills of a tool above a fixed lip.

    Parameters
    ----------
    tool : Trajectory
        N poses at rest.
    wrenches : ndarray (N, 6)
        Mean wrenches in axes of the sensor, N and N m.
    sensor : WrenchSensor
        The sensor with its gripper.
    structure, usual, length : Structure, ndarray (6, 6), float
        Structure of K, a usual K, and the length of the cup, m.
    gravity : float
        m/s^2.

    Raises
    ------
    UndeterminedError
        If there are too few standstills, or the standstills do not determine K.
    UnexplainedError
        If K is not positive definite.

    """
    size, count = structure.size, len(tool)
    if count < MIN_STANDSTILLS:
        raise UndeterminedError(
            f'{count} standstills of the tool do not determine K; at least {MIN_STANDSTILLS} are '
            'expected. Hold more poses, with shifts along x, y, z and tilts to all sides.')
    units = structure.parameters(usual, usual)[:size]
    units = np.where(units > 0.0, units, np.sqrt(np.prod([
        np.diag(usual)[list(pair)] for pair in structure.leads], axis=1)))
    at_rest = Trajectory(tool.stamps_ns, tool.position, tool.rotation, np.zeros((count, 6)))
    Y = gripper_regressors(
        tool_rows(at_rest), np.zeros((count, 6)), gravity_vector(gravity), sensor.mount)
    shown = wrenches - Y @ sensor.gripper
    least = int(np.argmin(np.linalg.norm(shown[:, :3], axis=1)))
    T_E = lie.transform(tool.rotation, tool.position)
    first = T_E[least] @ lie.transform(np.eye(3), np.array([0.0, 0.0, -length]))
    T_E_F = lie.transform(np.reshape(sensor.mount[1], (3, 3)), np.array(sensor.mount[0]))
    prior = np.concatenate([np.full(size, SPRING_STD), LIP_STD, np.repeat(sensor.bias_std, 3),
                            np.full(6, sensor.gain_std), np.maximum(sensor.gripper_std, 1e-9)])
    start = np.zeros(len(prior))
    start[:size] = structure.parameters(usual, usual)[:size] / units

    def residual(x: Array, noise: Array) -> Array:
        spring, lip, bias, gain, phi = np.split(x, size + 6 * np.arange(4))
        T = lie.inverse_transform(T_E) @ first @ lie.transform(lie.exp_so3(lip[3:]), lip[:3])
        L = regressor(length, structure.basis, T[:, :3, 3], T[:, :3, :3], np.zeros((count, 6)))
        to_sensor = np.swapaxes(lie.adjoint(lie.inverse_transform(T) @ T_E_F), 1, 2)
        load = -sensor.mount[2] * to_sensor @ (L[:, :, :size] @ (units * spring))[:, :, None]
        off = shown - (1.0 + gain) * load[:, :, 0] - bias - Y @ phi
        return np.append(off / noise, (x - start) / prior)

    x, covariance, rms = _weighted(residual, start, prior, sensor, count)
    std = np.sqrt(np.diag(covariance)[:size])
    _require_determined(structure, x[:size], std)
    K, _ = structure.matrices(np.tile(units * x[:size], 2))
    if (smallest := float(np.linalg.eigvalsh(K)[0])) <= 0.0:
        raise UnexplainedError(
            f'K of these wrenches is not positive definite, its smallest eigenvalue is '
            f'{smallest:.3g}. Check wrench.sign and wrench.frame.')
    return PressedCup(K, structure.spread(np.tile(units * std, 2))[0], count, rms)


def _weighted(
    residual: Callable[[Array, Array], Array], start: Array, prior: Array, sensor: WrenchSensor,
    count: int
) -> tuple[Array, Array, Array]:
    """Return unknowns (m,), covariance (m, m) and RMS residuals (N, N m) of standstills."""
    x, noise = start, np.repeat(sensor.noise, 3)
    for _ in range(3):  # weights follow the residuals
        found = least_squares(residual, x, x_scale=prior, args=(noise,))
        x, off = found.x, found.fun[:6 * count].reshape(count, 2, 3)
        freedom = max(1.0 - (len(x) - INERTIAL_NUMBERS) / (6.0 * count), 0.1)
        rms = np.sqrt(np.mean(off**2, axis=(0, 2)) / freedom) * noise[[0, 3]]
        noise = np.repeat(rms, 3)
    jacobian: Any = found.jac
    return x, np.linalg.inv(jacobian.T @ jacobian), rms


def _require_determined(structure: Structure, x: Array, std: Array) -> None:
    """Require small standard errors, relative to the entries (s,), of the axes of K."""
    is_axis = [row == column for row, column in structure.leads]
    excess = np.where(is_axis, std - MAX_ERROR * np.abs(x), -np.inf)
    if np.any(excess > 0.0):
        worst = structure.labels[int(np.argmax(excess))]
        raise UndeterminedError(
            f'The standstills do not determine {worst}. Hold '
            'poses shifted along x, y and z by some millimetres, and tilted and turned by some '
            'degrees.')
