"""R factors: small triangles with the inner products of many rows of equations, and solutions."""

from collections.abc import Iterable
from typing import NamedTuple

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.identification.equations.identifiable import (
    IN_NULL_SPACE,
    LARGEST_CONDITION,
    NO_EFFECT,
)
from bellows_ros.core.structure import Structure
import numpy as np

QR_ROWS = 512
"""Rows that are reduced to a triangle at a time: they stay in the processor's cache."""


def r_factor(parts: Iterable[Array], columns: int) -> Array:
    """Return R (columns, columns) of the QR factorisation of stacked parts (4.71, 4.72)."""
    R: Array = np.zeros((columns, columns))
    for rows in parts:
        R = r_factor_of(np.vstack([R, rows]))
    return R


def r_factor_of(rows: Array) -> Array:
    """Return R (q, q) of the QR factorisation of rows (N, q), N at least q."""
    whole = len(rows) // QR_ROWS * QR_ROWS
    size = rows.shape[1]
    # Triangles of small parts, then of these: four times faster than at once.
    parts = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, QR_ROWS, size), mode='r'))
    left = np.concatenate([parts.reshape(-1, size), rows[whole:]])
    return np.asarray(np.linalg.qr(left, mode='r'))


class Solution(NamedTuple):
    """
    The least-squares solution of p parameters.

    x (p,): of what is not identifiable the smallest that fits as well as any. Inverse (p, p) of
    R; which of the p are identifiable; the rank; the condition number with columns of unit length.
    """

    x: Array
    inverse: Array
    identifiable: Mask
    rank: int
    condition_number: float


def solution(R: Array, structure: Structure) -> Solution:
    """Solve the equations of an R factor (q, q) of rows [A b] as far as they go (4.74)."""
    unit = column_sizes(R[:-1, :-1], structure)
    U, singular, Vt = np.linalg.svd(R[:-1, :-1] / unit)
    known = singular > singular[0] / LARGEST_CONDITION
    inverse = (Vt[known].T / singular[known]) @ U[:, known].T / unit[:, None]
    return Solution(
        inverse @ R[:-1, -1],
        inverse,
        ~np.any(np.abs(Vt[~known]) > IN_NULL_SPACE, axis=0),
        int(np.count_nonzero(known)),
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
    )


def column_sizes(R: Array, structure: Structure) -> Array:
    """
    Return by what the columns (p,) of equations are divided, infinite where they are rounding.

    Those of K or P of the same units are compared with each other.
    """
    sizes = np.linalg.norm(R, axis=0)
    angular = [(row > 2) + (column > 2) for row, column in structure.leads]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    return np.where(sizes > NO_EFFECT * largest, sizes, np.inf)
