"""
Set-up of a force-torque sensor: sign, axes, reference point and zero, by a held package at rest.

Each wrong set-up shows another linear function of the true load. The mass, the centre of mass and
the zero of the sensor may be off within `ALLOWED`; a set-up explains the readings if the rest of
their deviations is small.
"""

from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.sensors.wrench import WrenchSensor
import numpy as np

ARM = 0.05
"""Lever by which moments are compared with forces, m."""

ALLOWED = np.repeat([0.15, 0.015], [1, 3])
"""Standard deviations of a package: relative of the mass, and of its centre of mass, m."""

NOISE = 0.03
"""Standard deviation by gains, hysteresis and gripper, relative to the weight; it persists."""

TILTS = 2.0
"""Number of independent readings, as deviations persist in each tilt."""

MISFIT = 30.0
"""Chi^2 of the readings above which they contradict a set-up."""

CLEAR = 15.0
"""Smallest difference of chi^2 that distinguishes two set-ups: odds of 1800."""

COS_MIN_TILT = np.cos(np.radians(5.0))
"""Cosine of the smallest angle between two tilts."""

HOLDING = 0.7, 1.3
"""Offset of a sensor that was zeroed while holding the package, weights."""


class Still(NamedTuple):
    """Mean readings (n, 6) at rest, predicted loads (n, 6), and axes (n, 3, 3) in the world."""

    shown: Array
    load: Array
    R_world_sensor: Array


def fault_of(still: Still, sensor: WrenchSensor, weight: float) -> tuple[bool, str]:
    """
    Return whether readings contradict the stated set-up, and the only set-up that they fit.

    It is 'sign', 'world_axes', 'tcp', 'zeroed_holding', 'compensated' or 'unknown', or '' without
    a contradiction or without two tilts.
    """
    size, bias_std = weight * np.repeat([1.0, ARM], 3), np.repeat(sensor.bias_std, 3)
    noise = np.hypot(NOISE * size, np.repeat(sensor.noise, 3) / 5.0)
    misfits = {'': _misfit(still, np.eye(6), noise, bias_std)[0]}
    if misfits[''] < CLEAR:
        return False, ''
    down, (position, axes, _) = still.R_world_sensor[:, 2], sensor.mount
    to_tip, in_world = np.eye(6), np.zeros((len(down), 6, 6))
    to_tip[3:, :3] = lie.hat(np.reshape(axes, (3, 3)).T @ position)
    in_world[:, :3, :3] = in_world[:, 3:, 3:] = still.R_world_sensor
    misfits |= {name: _misfit(still, T, noise, bias_std)[0] for name, T in (
        ('sign', -np.eye(6)), ('world_axes', in_world), ('tcp', to_tip),
        ('compensated', np.zeros((6, 6))))}
    holding, offset = _misfit(still, np.eye(6), noise, 3.0 * size)
    if HOLDING[0] < np.linalg.norm(offset[:3]) / weight < HOLDING[1]:
        misfits['zeroed_holding'] = holding
    first, second, *_ = sorted(misfits, key=misfits.__getitem__)
    if misfits[''] < min(MISFIT, misfits[first] + CLEAR):
        return False, ''
    if (down @ down[0]).min() > COS_MIN_TILT:
        return True, ''
    is_clear = misfits[first] < min(MISFIT, misfits[second] - CLEAR)
    return True, first if is_clear else 'unknown'


def _misfit(still: Still, T: Array, noise: Array, bias_std: Array) -> tuple[float, Array]:
    """Return chi^2 of readings T load, with mass, centre of mass and zero free, and the zero."""
    shown, load, _ = still
    columns = np.zeros((len(load), 6, 5))  # the load, and its derivatives by the package
    columns[:, :, 0] = columns[:, :, 1] = load
    columns[:, 3:, 2:] = -lie.hat(load[:, :3])
    columns = T @ columns
    A = np.dstack([columns[:, :, 1:] * ALLOWED, np.tile(np.diag(bias_std), (len(load), 1, 1))])
    A, r = A / noise[:, None], (shown - columns[:, :, 0]) / noise
    A, r = (np.sqrt(TILTS / len(load)) * each.reshape(load.size, -1) for each in (A, r))
    x = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ r)
    return float(np.sum(r * (r - A @ x))), bias_std * x[4:, 0]
