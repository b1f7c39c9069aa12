"""What is uncertain of a package, its cup and a camera before the first measured pose."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.structure import composition, places_of, UPPER
from bellows_ros.core.observer.filter import (
    ALL_ROWS,
    CAMERA,
    COM,
    DAMPING,
    INERTIA,
    LATENCY,
    LEAST_ROWS,
    MARKER,
    MASS,
    NOISE,
    STATE,
    STIFFNESS,
    WRENCH,
)
from bellows_ros.core.observer.measurement import FIRST_MEMORY
import numpy as np

START = np.repeat([0.01, 0.1, 0.5, 1.0], 3)
"""Standard deviations at the start: m, rad, m/s, rad/s."""

MASS_SHARE, COM_UNCERTAIN = 0.1, 0.01
"""Default standard deviations of the payload: relative mass, centre of mass (m)."""

UNCALIBRATED = 0.03, 0.05, 0.05
"""Standard deviations of position (m), rotation and latency (s) of a camera to be calibrated."""

BIAS_WALK, WALK_ARM = 0.01, 0.02
"""Random walk of the wrench bias per second: fraction of the weight, and moment by force (m)."""

BIAS_SHARE = 0.1
"""Initial bias, relative to the effect of the default payload uncertainty."""

OF_MOTION = (*range(STATE), *range(WRENCH, STIFFNESS), *range(NOISE, NOISE + 6))
"""Rows that are forgotten at a fresh start with the same package, ..."""

OF_PACKAGE = (*range(MASS, COM + 3), *range(MARKER, MARKER + 6), *range(INERTIA, ALL_ROWS))
"""... and with another one, too."""


def bias_walk(model: ModelTuple) -> Array:
    """Return the variances (6,) that the wrench beside the cup's gains in 1 s."""
    weight = model[1][0] * math.hypot(*model[2])
    walk: Array = np.square(BIAS_WALK * weight * np.repeat([1.0, WALK_ARM], 3))
    return walk


def first_memory(time_constant: float) -> Array:
    """Return the memory (s) of the noise before the first measurement, see `correlations`."""
    seconds, squares = FIRST_MEMORY
    products = squares * math.exp(-seconds / time_constant)
    memory: Array = np.r_[seconds, squares, squares, products, products, np.zeros(6)]
    return memory


def prior_std(values: Mapping[str, Any], model: ModelTuple) -> Array:
    """Return the standard deviations (n,) of the error at the start."""
    (_, _, *blocks), (mass, *_), gravity = (model[0][:4], *model[1:])
    weight = mass * math.hypot(*gravity)
    C = np.square(composition(places_of(values))[UPPER[0] == UPPER[1]])
    K, P = (
        np.minimum(np.sqrt(C @ np.square(np.reshape(values[f'cup.{name}_std'], (6, 6))[UPPER]))
                   / np.maximum(np.r_[matrix[0][::4], matrix[2][::4]], 1e-12), 1.0)
        for name, matrix in zip(('stiffness', 'damping'), blocks, strict=True))
    inertia = np.array(values['package.inertia_std'][:3])
    std: Array = np.zeros(ALL_ROWS if P.any() or inertia.any() else LEAST_ROWS)
    std[:STATE] = START
    mass, com = values['package.mass_std'] / mass, values['package.com_std']
    if values['payload.estimate']:
        mass, com = mass or MASS_SHARE, [each or COM_UNCERTAIN for each in com]
    std[MASS], std[COM:COM + 3] = mass, com
    std[WRENCH:WRENCH + 6] = BIAS_SHARE * weight * np.repeat([MASS_SHARE, COM_UNCERTAIN], 3)
    std[STIFFNESS:STIFFNESS + 6] = K
    offset, latency = values['measured.offset_std'], values['measured.latency_std']
    std[MARKER:MARKER + 6] = np.repeat(offset, 3)
    if values['measured.calibrate']:
        offset, latency = np.maximum(offset, UNCALIBRATED[:2]), max(latency, UNCALIBRATED[2])
    std[CAMERA:CAMERA + 6], std[LATENCY] = np.repeat(offset, 3), latency
    std[NOISE:NOISE + 6] = 1.0
    if len(std) > LEAST_ROWS:
        std[DAMPING:INERTIA], std[INERTIA:] = P, inertia
    return std
