"""Which way is down: gravity as a vector of the world, and the turn to a world whose z is up."""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.lie import exp_so3
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

DOWN = np.array([0.0, 0.0, -1.0])
"""Where gravity points in a world whose z is up."""

PARALLEL = 1e-12
"""Sine of an angle that is none, or half a turn."""


def require_direction(direction: ArrayLike) -> None:
    """Raise BellowsError for a vector (3,) without a direction."""
    if not np.linalg.norm(direction) > 1e-6:
        raise BellowsError(
            'gravity.direction is zero, so that nothing is down. Give the direction in which '
            'things fall, in axes of the world: [0.0, 0.0, -1.0] where z is up.'
        )


def gravity_of(values: Mapping[str, Any]) -> Array:
    """Return the acceleration (3,) of gravity in the world, m/s^2, of parameter values."""
    direction = np.asarray(values['gravity.direction'], dtype=np.float64)
    return np.asarray(values['gravity.magnitude'] * (direction / np.linalg.norm(direction)))


def levelling(direction: ArrayLike) -> Array:
    """
    Return the smallest rotation (3, 3) that turns a direction to -z.

    Poses of a world in which gravity has that direction become those of one whose z is up; where
    it points to z, the half turn is about x.
    """
    down = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    axis = np.cross(down, DOWN)
    sine, cosine = float(np.linalg.norm(axis)), float(down @ DOWN)
    if sine < PARALLEL:
        return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(exp_so3(axis / sine * np.arctan2(sine, cosine)))
