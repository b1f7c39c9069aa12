"""
Coordinates of mass and inertia whose values always describe a possible rigid body.

A body is possible if its pseudo-inertia is positive definite (Wensing, Kim and Slotine, 2018): the
mass is positive, and the second moments Sigma = tr(I) / 2 - I about the centre of mass are
positive definite. The logarithms of the mass and of the diagonal of the Cholesky factor of Sigma,
and the centre of mass, are any numbers (Rucker and Wensing, 2022). A change d (3,) of these
logarithms stretches the body along its axes: Sigma_ij exp(d_i + d_j).
"""

import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
import numpy as np
from numpy.typing import ArrayLike

MIN_FLATNESS = 1e-4
"""Smallest ratio of two principal second moments, of a plate whose thickness is 1 % of its
side."""


@kernel
def second_moments(inertia: Matrix) -> Vector:
    """Return the second moments (3,) of mass along x, y and z, kg m^2."""
    half = 0.5 * (inertia[0] + inertia[4] + inertia[8])
    return half - inertia[0], half - inertia[4], half - inertia[8]


@kernel
def stretched(inertia: Matrix, d: Vector) -> Matrix:
    """Return the inertia of a body stretched by factors exp(d) along its axes."""
    x, y, z = second_moments(inertia)
    a, b, c = math.exp(d[0]), math.exp(d[1]), math.exp(d[2])
    x, y, z = a * a * x, b * b * y, c * c * z
    xy, xz, yz = a * b * inertia[1], a * c * inertia[2], b * c * inertia[5]
    return y + z, xy, xz, xy, x + z, yz, xz, yz, x + y


def with_moments(inertia: Array, factors: ArrayLike) -> Array:
    """
    Return the inertia (3, 3) of a stretched body, from logarithmic factors (3,) of its moments.

    If no body has these moments, the inertia of the nearest body of least thickness is returned.
    """
    inertia = nearest(inertia)
    moments = np.diag(inertia) * np.exp(factors)
    wanted = 0.5 * moments.sum() - moments
    wanted = np.maximum(wanted, MIN_FLATNESS * wanted.max())
    d = 0.5 * np.log(wanted / second_moments(_tuple(inertia)))
    return np.array(stretched(_tuple(inertia), _tuple(d))).reshape(3, 3)


def flatness(inertia: Array) -> float:
    """Return the ratio of smallest to largest second moment; at most 0 for an impossible body."""
    squares = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return float(squares[0] / squares[2])


def nearest(inertia: Array) -> Array:
    """Return the inertia (3, 3) of the nearest possible body; unchanged for a possible body."""
    if flatness(inertia) >= MIN_FLATNESS:
        return inertia
    squares, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    squares = np.maximum(squares, MIN_FLATNESS * squares[2])
    return np.asarray(np.sum(squares) * np.eye(3) - (axes * squares) @ axes.T)


def _tuple(values: Array) -> Any:
    return tuple(values.ravel().tolist())
