"""
The states of the filter: one table that defines all slices.

The rows of the error have the names below: pose and twist of the package in its own axes, as in
`moved`; parameters of the model, which change its motion; and errors of measured poses. All rows
but the first four are the vector theta.

Logarithms s change K, P and the second moments of mass S = tr(I) / 2 - I along each axis, as exp(s
/ 2) M exp(s / 2). K and P then stay positive, and the package stays a possible body (Wensing, Kim
and Slotine 2018). A common scale of K, P, mass, inertia and wrench does not change the motion and
is not observable. In logarithms the direction of this common scale is constant. In other
coordinates the filter would use noise as information on the scale.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.structure import composition, UPPER
from bellows_ros.core.parameters.conversion import places_of, stated_std, stiffness_std
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.sensors.wrench import GAIN_STD
from bellows_ros.errors import BellowsError
import numpy as np

COM_UNCERTAIN = 3e-3, 3e-3, 1.5e-3
"""Default standard deviations of the centre of mass of an estimated payload, m."""

MASS_SHARE = 0.05
"""Default relative standard deviation of the mass of an estimated payload."""

UNSTATED_CUP = 0.05
"""Relative standard deviation of K, if not stated."""

UNSTATED_DAMPING = 0.2
"""Relative standard deviation of P, if not stated."""

UNSTATED_INERTIA = 0.05
"""Relative standard deviation of moments of inertia, if not stated."""

UNSTATED_MASS = 0.02
"""Relative standard deviation of the mass, if not stated."""

UNSTATED_COM = 2e-3
"""Standard deviation of the centre of mass, if not stated, m."""

ZERO_DRIFT = (0.02, 1e-3)
"""Random walk of the zero of a force-torque sensor in 1 s, N and N m: between a laboratory sensor
(0.01, 0.0005) and one in a wrist (0.05, 0.003)."""

BIAS_SHARE = 0.01
"""Initial wrench bias, relative to the effect of the uncertainty of mass and centre of mass."""

BIAS_TIME = 5.0
"""Time in which the wrench bias changes by its initial standard deviation, s."""

CAMERA_WALK_TIME = 300.0
"""Time in which a camera's frame drifts by `measured.camera_std` as its mount warms up, s."""

MOTION = 'motion'
"""Owner of states of the present motion."""

PACKAGE = 'package'
"""Owner of states of the package, which stay over motions."""

CUP = 'cup'
"""Owner of states of the cup, which stay over packages."""

CAMERA_SIDE = 'camera'
"""Owner of states of the camera or the force-torque sensor, which stay over packages."""

NOISE_SIDE = 'noise'
"""Owner of states of the noise."""


class FilterState(NamedTuple):
    """A state, or several equal ones, of the filter."""

    name: str
    size: int
    unit: str
    belongs_to: str
    largest: float
    """Largest physical value, in the unit."""


STATES = (
    FilterState('SHIFT', 3, 'm', MOTION, math.inf),
    FilterState('TURN', 3, 'rad', MOTION, math.inf),
    FilterState('SPEED', 3, 'm/s', MOTION, 50.0),
    FilterState('SPIN', 3, 'rad/s', MOTION, 300.0),
    FilterState('MASS', 1, 'log', PACKAGE, math.log(20.0)),
    FilterState('COM', 3, 'm', PACKAGE, 0.5),
    # additional wrench on the package at the lip, in S axes, at the nominal mass, proportional to
    # the mass; its largest value is in weights, at 1 m for the moment
    FilterState('WRENCH', 6, 'N, N m', MOTION, 100.0),
    FilterState('STIFFNESS', 6, 'log', CUP, math.log(100.0)),
    FilterState('DAMPING', 6, 'log', CUP, math.log(100.0)),
    FilterState('INERTIA', 3, 'log', PACKAGE, math.log(100.0)),
    # the marker in B axes, the camera in the world, the delay of stamps, and the noise with memory
    # of the measured pose in B axes, in its standard deviations
    FilterState('MARKER', 6, 'm, rad', PACKAGE, math.tau),
    FilterState('CAMERA', 6, 'm, rad', CAMERA_SIDE, math.tau),
    FilterState('LATENCY', 1, 's', CAMERA_SIDE, 1.0),
    FilterState('NOISE', 6, '1', NOISE_SIDE, 100.0),
    # bias and gain of a force-torque sensor, present from its first wrenches on
    FilterState('ZERO', 6, 'N, N m', CAMERA_SIDE, 1e4),
    FilterState('GAIN', 1, '1', CAMERA_SIDE, 0.5),
)
"""All states, in the order of the rows: those that change the motion are before `MARKER`."""

FIRST = dict(zip((each.name for each in STATES), np.cumsum(
    [0, *(each.size for each in STATES)]).tolist(), strict=False))
"""First row of each state."""

(SHIFT, TURN, SPEED, SPIN, MASS, COM, WRENCH, STIFFNESS, DAMPING, INERTIA, MARKER, CAMERA,
 LATENCY, NOISE, ZERO, GAIN) = FIRST.values()
ROWS = sum(each.size for each in STATES)
"""Number of rows."""
ROWS_WITHOUT_SENSOR = ZERO
"""Number of rows without a force-torque sensor."""
STATE = MASS
"""Number of rows of the state of motion; theta has the others."""

LARGEST: Array = np.repeat(
    [each.largest for each in STATES], [each.size for each in STATES])
"""Largest physical value of each row."""


def rows_of(*belonging: str) -> tuple[int, ...]:
    """Return the rows of the states that belong to camera, cup or package."""
    return tuple(FIRST[each.name] + i for what in belonging for each in STATES
                 if each.belongs_to == what for i in range(each.size))


CAMERA_ROWS, CUP_ROWS = rows_of(CAMERA_SIDE), rows_of(CUP)
ANOTHER_PACKAGE = rows_of(CAMERA_SIDE, CUP)
"""Rows that are kept for another package."""
SAME_PACKAGE = rows_of(CAMERA_SIDE, CUP, PACKAGE)
"""Rows that are kept over a gap in the tool's poses, with the same package."""
KNOWN_ROWS: Array = np.sort(SAME_PACKAGE)
"""Rows that are estimated over time; the others belong to the motion."""


class Priors(NamedTuple):
    """Stated or usual uncertainty of the states."""

    weight: float
    """Weight of the package, N."""
    std: Array
    """Initial standard deviation of each row (n,)."""
    inertia: Array
    """Initial covariance of the rows of the inertia (3, 3)."""
    walk: Array
    """Standard deviation of the random walk of each row in 1 s (n,)."""


def priors_of(values: Values, model: ModelTuple) -> Priors:
    """
    Return the stated uncertainties, or usual ones.

    Raises
    ------
    BellowsError
        If three standard deviations exceed the physical range of the mass or the centre of mass.

    """
    weight, (stiffness, damping) = model[1][0] * math.hypot(*model[2]), _of_cup(values, model)
    mass, com, inertia = _of_package(values, model)
    marker, camera = (
        np.repeat(values[f'measured.{name}_std'], 3) for name in ('marker', 'camera'))
    prior: dict[str, float | Array] = {
        'SHIFT': 0.01, 'TURN': 0.1, 'SPEED': 0.5, 'SPIN': 1.0, 'MASS': mass, 'COM': com,
        'WRENCH': BIAS_SHARE * weight * np.repeat([mass, com.max()], 3),
        'STIFFNESS': stiffness, 'DAMPING': damping, 'INERTIA': np.sqrt(np.diag(inertia)),
        'MARKER': marker, 'CAMERA': camera, 'LATENCY': values.measured.latency[1], 'NOISE': 1.0,
        'ZERO': np.repeat(values.wrench.bias_std, 3), 'GAIN': GAIN_STD}
    walk: dict[str, float | Array] = {
        'WRENCH': prior['WRENCH'] / math.sqrt(BIAS_TIME),
        'CAMERA': camera / math.sqrt(CAMERA_WALK_TIME), 'ZERO': np.repeat(ZERO_DRIFT, 3)}
    std, of_walk = (np.concatenate([
        np.broadcast_to(sizes.get(each.name, 0.0), each.size) for each in STATES])
        for sizes in (prior, walk))
    return Priors(weight, std, inertia, of_walk)


def _of_cup(values: Values, model: ModelTuple) -> list[Array]:
    """Return the relative standard deviations (6,) of K and P along each axis."""
    C = np.square(composition(places_of(values))[UPPER[0] == UPPER[1]])
    relative = []
    for std_of, unstated, matrix in zip(
            (stiffness_std(values), np.reshape(values.cup.damping_std, (6, 6))),
            (UNSTATED_CUP, UNSTATED_DAMPING), model[0][2:4], strict=True):
        stated = std_of[UPPER]
        share = np.sqrt(C @ np.square(stated)) / np.maximum(
            np.r_[matrix[0][::4], matrix[2][::4]], 1e-12)
        relative.append(np.minimum(share, 1.0) if stated.any() else np.full(6, unstated))
    return relative


def _of_package(values: Values, model: ModelTuple) -> tuple[float, Array, Array]:
    """Return relative std of the mass, std (3,) of com, m, and covariance (3, 3) of INERTIA."""
    mass, _, inertia, _ = model[1]
    is_free = values.payload.estimate
    mass_std, com, moments = (
        stated_std(values, f'package.{name}_std', np.array(usual)) for name, usual in (
            ('mass', [mass * (MASS_SHARE if is_free else UNSTATED_MASS)]),
            ('com', COM_UNCERTAIN if is_free else [UNSTATED_COM] * 3),
            ('inertia', UNSTATED_INERTIA * np.array(inertia)[::4])))
    for name, std, row, unit in (('mass', float(mass_std[0]), MASS, mass),
                                 ('com', float(com.max()), COM, 1.0)):
        most = LARGEST[row] * unit / 3.0
        if std > most:
            raise BellowsError(
                f'package.{name}_std is {std:g}; expected at most {most:.3g}, so that three '
                'standard deviations are possible. Weigh and measure the package, or leave '
                f'package.{name}_std out for the usual uncertainty.')
    return float(mass_std[0]) / mass, com, _of_moments(np.reshape(inertia, (3, 3)), moments)


def _of_moments(inertia: Array, std: Array) -> Array:
    """
    Return the covariance (3, 3) of the logarithms of the second moments of mass.

    The standard deviations (3,) are of the moments of inertia (kg m^2). A logarithm's is at most
    1, as the second moment of a thin plate along its normal is nearly 0.
    """
    half = 0.5 - np.eye(3)
    root = half * std / np.maximum(half @ np.diag(inertia), 1e-12)[:, None]
    root /= np.maximum(np.linalg.norm(root, axis=1), 1.0)[:, None]
    return np.asarray(root @ root.T)
