"""
Set-up of a force-torque sensor: sign, axes, reference point and zero, by a held package at rest.

Each wrong set-up shows another linear function of the true load. The mass, the centre of mass and
the zero of the sensor may be off within `ALLOWED`; a set-up explains the readings if the rest of
their deviations is small.
"""

from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.sensors.wrench import SAMPLE_NOISE, WrenchSensor
import numpy as np
from scipy.spatial.transform import Rotation

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


class Fault(NamedTuple):
    """What contradicts the stated set-up."""

    name: str
    """The only set-up that the readings fit, of the reasons `wrench_*`; otherwise unknown."""
    rotation: str = ''
    """Of turned axes, the rotation of wrench.frame that readings fit, 'qx qy qz qw'."""


def fault_of(still: Still, sensor: WrenchSensor, weight: float) -> Fault | None:
    """Return what contradicts the stated set-up, or None."""
    size, bias_std = weight * np.repeat([1.0, ARM], 3), np.repeat(sensor.bias_std, 3)
    noise = np.hypot(NOISE * size, np.repeat(SAMPLE_NOISE, 3) / 5.0)
    (stated,), _ = _misfits(still, np.eye(6)[None, None], noise, bias_std)
    if stated < CLEAR:
        return None
    faults, T, unit = _set_ups(still, sensor)
    chi2, _ = _misfits(still, T, unit * noise, bias_std)
    (holding,), zero = _misfits(still, np.eye(6)[None, None], noise, 3.0 * size)
    if not HOLDING[0] < np.linalg.norm(zero[0, :3]) / weight < HOLDING[1]:
        holding = np.inf
    chi2, faults = np.r_[chi2, holding], [*faults, Fault('zeroed_holding')]
    if stated < min(MISFIT, chi2.min() + CLEAR):
        return None
    surprise = chi2 + 2.0 * TILTS * np.r_[np.log(unit).sum(axis=1), 0.0]
    first, second = np.argsort(surprise)[:2]
    down = still.R_world_sensor[:, 2]
    is_clear = (down @ down[0]).min() < COS_MIN_TILT and chi2[first] < MISFIT and (
        surprise[second] - surprise[first] > CLEAR)
    return faults[first] if is_clear else Fault('unknown')


def _set_ups(still: Still, sensor: WrenchSensor) -> tuple[list[Fault], Array, Array]:
    """Return wrong set-ups, their readings (S, n, 6, 6) of a load, and their units (S, 6)."""
    (position, axes, _), R = sensor.mount, still.R_world_sensor
    R_tool_sensor, group = np.reshape(axes, (3, 3)), Rotation.create_group('O')
    turns = group.as_matrix()
    others = np.abs(turns - np.eye(3)).max(axis=(1, 2)) > 0.5
    about_z = turns[turns[:, 2, 2] > 0.5]
    turned = np.concatenate([
        np.broadcast_to(turns[others, None], (others.sum(), len(R), 3, 3)), about_z[:, None] @ R])
    T = np.zeros((5 + len(turned), len(R), 6, 6))
    unit = np.ones((len(T), 6))
    T[0], T[1] = -np.eye(6), np.eye(6)
    T[1, :, 3:, :3] = lie.hat(R_tool_sensor.T @ position)
    unit[2], unit[3], unit[4, 3:] = 0.1, 1.0 / 9.80665, 1e3
    T[3:5] = np.einsum('si,ij->sij', unit[3:5], np.eye(6))[:, None]
    T[5:, :, :3, :3] = T[5:, :, 3:, 3:] = turned
    of_frame = (Rotation.from_matrix(R_tool_sensor) * group.inv()).as_quat()[others]
    return [*map(Fault, ('sign', 'tcp', 'compensated', 'kgf', 'newton_mm')),
            *(Fault('axes', ' '.join(f'{part:.4g}' for part in q)) for q in of_frame),
            *[Fault('world_axes')] * len(about_z)], T, unit


def _misfits(still: Still, T: Array, noise: Array, bias_std: Array) -> tuple[Array, Array]:
    """
    Return chi^2 (S,) of readings T load, with mass, centre of mass and zero free, and the zeros.

    Readings have T (S, 6, 6) or (S, n, 6, 6), standard deviations (6,) or (S, 6), and a zero (S,
    6) of standard deviations (6,).
    """
    shown, load, _ = still
    columns = np.zeros((len(load), 6, 5))  # the load, and its derivatives by the package
    columns[:, :, 0] = columns[:, :, 1] = load
    columns[:, 3:, 2:] = -lie.hat(load[:, :3])
    columns = T @ columns
    A = np.concatenate([columns[..., 1:] * ALLOWED, np.broadcast_to(
        np.diag(bias_std), (*columns.shape[:2], 6, 6))], axis=3)
    weight = np.sqrt(TILTS / len(load)) / np.broadcast_to(noise, (len(T), 6))[:, None]
    A = (weight[..., None] * A).reshape(len(T), load.size, -1)
    r = (weight * (shown - columns[..., 0])).reshape(len(T), -1, 1)
    At = np.swapaxes(A, 1, 2)
    x = np.linalg.solve(At @ A + np.eye(A.shape[2]), At @ r)
    return np.sum(r * (r - A @ x), axis=(1, 2)), bias_std * x[:, 4:, 0]
