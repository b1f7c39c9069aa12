"""
Matrices of parameter values, and what a cup or a body physically can have.

A 6x6 matrix is 36 numbers, row-major; an inertia is [ixx, iyy, izz, ixy, ixz, iyz]; units are SI.
"""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

MOMENTS_WITHIN = 1e-3
"""How far (relative) the largest principal moment may be above the sum of the other two.

The rounded figures of a thin plate's data sheet may be so.
"""

SYMMETRIC_WITHIN = 1e-9
"""Relative difference of a matrix and its transpose that counts as rounding."""

SOFTEST = 1e-6
"""Smallest eigenvalue (N/m, N m/rad) of a stiffness: a million times softer than any cup."""


def matrix(values: ArrayLike) -> Array:
    """Return 36 numbers, row-major, as a 6x6 matrix."""
    return np.array(values, dtype=np.float64).reshape(6, 6)


def inertia_matrix(values: ArrayLike) -> Array:
    """Return [ixx, iyy, izz, ixy, ixz, iyz] as a symmetric 3x3 matrix."""
    xx, yy, zz, xy, xz, yz = np.array(values, dtype=np.float64)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def require_stiffness(stiffness: Array, name: str = 'cup.stiffness') -> None:
    """
    Refuse a 6x6 matrix that is not symmetric positive definite, or softer than any cup.

    Raises
    ------
    BellowsError
        With the smallest eigenvalue.

    """
    smallest, rounding = _smallest_eigenvalue(name, stiffness)
    if smallest <= rounding or smallest < SOFTEST:
        what = 'not positive definite' if smallest <= rounding else 'too soft to hold a package'
        raise BellowsError(
            f'{name} is {what}: its smallest eigenvalue is {smallest:.6g}, expected at least '
            f'{SOFTEST:g}. Check signs, rows and units (N/m, N and N m/rad), or identify it '
            'again.')


def require_damping(damping: Array, name: str = 'cup.damping') -> None:
    """
    Refuse a 6x6 matrix that is not symmetric positive semidefinite.

    Raises
    ------
    BellowsError
        With the smallest eigenvalue.

    """
    smallest, rounding = _smallest_eigenvalue(name, damping)
    if smallest < -rounding:
        raise BellowsError(
            f'{name} is not positive semidefinite: its smallest eigenvalue is {smallest:.6g}, '
            'but a negative one would let the cup create energy. Check signs and rows, or '
            'identify it again.'
        )


def require_symmetric(values: Array, name: str) -> None:
    """Raise BellowsError, with the entries that differ most, for a matrix that is asymmetric."""
    asymmetry = np.abs(values - values.T)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(asymmetry)), values.shape))
    if asymmetry[row, column] > SYMMETRIC_WITHIN * float(np.max(np.abs(values))):
        raise BellowsError(
            f'{name} is not symmetric: row {row + 1}, column {column + 1} is '
            f'{values[row, column]:.9g}, row {column + 1}, column {row + 1} is '
            f'{values[column, row]:.9g}. Give the same number to both, row by row.'
        )


def _smallest_eigenvalue(name: str, values: Array) -> tuple[float, float]:
    """Return the smallest eigenvalue of a symmetric matrix and the size of its rounding error."""
    require_symmetric(values, name)
    rounding = len(values) * float(np.finfo(np.float64).eps * np.max(np.abs(values)))
    return float(np.linalg.eigvalsh(values)[0]), rounding


def check_inertia(inertia: Array) -> None:
    """
    Raise BellowsError unless a rigid body can have this inertia tensor (3, 3), kg m^2.

    It must be symmetric and positive definite, and no principal moment above the sum of the
    other two.
    """
    require_symmetric(inertia, 'package.inertia')
    moments = np.linalg.eigvalsh(inertia)
    shown = ', '.join(f'{moment:.6g}' for moment in moments)
    if moments[0] <= 0.0 or (
            moments[2] > (moments[0] + moments[1]) * (1.0 + MOMENTS_WITHIN)):
        raise BellowsError(
            f'No body has this package.inertia: its principal moments are {shown} kg m^2; '
            'expected all above zero, and the largest at most the sum of the other two. Check '
            'units (kg m^2), signs and the order ixx, iyy, izz, ixy, ixz, iyz.')
