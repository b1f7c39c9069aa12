"""Small triangles that hold all that many rows of equations tell, by QR factorisations."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QR_ROWS = 512
"""Rows that are reduced to a triangle at a time: they stay in the processor's cache."""


def triangle(parts: Iterable[Array], columns: int) -> Array:
    """Return R (columns, columns) of the QR factorisation of stacked parts (4.71, 4.72)."""
    R: Array = np.zeros((columns, columns))
    for rows in parts:
        R = triangle_of(np.vstack([R, rows]))
    return R


def triangle_of(rows: Array) -> Array:
    """Return R (q, q) of the QR factorisation of rows (N, q), N at least q."""
    whole = len(rows) // QR_ROWS * QR_ROWS
    size = rows.shape[1]
    # Triangles of small parts, then of these: four times faster than at once.
    parts = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, QR_ROWS, size), mode='r'))
    left = np.concatenate([parts.reshape(-1, size), rows[whole:]])
    return np.asarray(np.linalg.qr(left, mode='r'))
