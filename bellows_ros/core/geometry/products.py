"""Products of small matrices for kernels: compiled loops where numba is, else those of numpy."""

from __future__ import annotations

from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import array_kernel, COMPILED, kernel
import numpy as np

if COMPILED:
    @array_kernel
    def add_product(A: Any, B: Any, out: Any) -> Any:
        """
        Add A B to the first rows: 12 columns of A at once, then 6, and none of zeros.

        Only as many columns of A are used as B has rows.
        """
        n = min(A.shape[1], B.shape[0])
        for i in range(A.shape[0]):
            row, m = out[i], 0
            while n - m >= 12:
                C = A[i, m:m + 12]
                if C.any():
                    _add_rows(C, B[m:m + 12], row)
                m += 12
            if n - m >= 6 and A[i, m:m + 6].any():
                a, b, c, d, e, f = (
                    A[i, m], A[i, m + 1], A[i, m + 2], A[i, m + 3], A[i, m + 4], A[i, m + 5])
                for j in range(B.shape[1]):
                    row[j] += (
                        a * B[m, j] + b * B[m + 1, j] + c * B[m + 2, j] + d * B[m + 3, j]
                        + e * B[m + 4, j] + f * B[m + 5, j])
            m += 6 if n - m >= 6 else 0
            for k in range(m, n):
                if A[i, k] != 0.0:
                    for j in range(B.shape[1]):
                        row[j] += A[i, k] * B[k, j]
        return out

    @kernel
    def _add_rows(C: Any, B: Any, row: Any) -> None:
        """Add C B, with C (12,)."""
        a, b, c, d, e, f = C[0], C[1], C[2], C[3], C[4], C[5]
        g, h, p, q, r, s = C[6], C[7], C[8], C[9], C[10], C[11]
        for j in range(B.shape[1]):
            row[j] += (
                a * B[0, j] + b * B[1, j] + c * B[2, j] + d * B[3, j] + e * B[4, j] + f * B[5, j]
                + g * B[6, j] + h * B[7, j] + p * B[8, j] + q * B[9, j] + r * B[10, j]
                + s * B[11, j])

    @array_kernel
    def product(A: Any, B: Any, out: Any) -> Any:
        """Write A B to the first rows, and return it; slices of columns take far longer."""
        if A.shape[1] != 12:
            out[:] = 0.0
            return add_product(A, B, out)
        for i in range(A.shape[0]):
            a, b, c, d, e, f = A[i, 0], A[i, 1], A[i, 2], A[i, 3], A[i, 4], A[i, 5]
            g, h, p, q, r, s = A[i, 6], A[i, 7], A[i, 8], A[i, 9], A[i, 10], A[i, 11]
            for j in range(B.shape[1]):
                out[i, j] = (
                    a * B[0, j] + b * B[1, j] + c * B[2, j] + d * B[3, j] + e * B[4, j]
                    + f * B[5, j] + g * B[6, j] + h * B[7, j] + p * B[8, j] + q * B[9, j]
                    + r * B[10, j] + s * B[11, j])
        out[len(A):] = 0.0
        return out

    @array_kernel
    def subtract_product(Z: Any, B: Any, out: Any) -> None:
        """Subtract Z^T B, of six rows each, from the first rows; Z^T Z stays symmetric."""
        for i in range(Z.shape[1]):
            row = out[i]
            a, b, c, d, e, f = Z[0, i], Z[1, i], Z[2, i], Z[3, i], Z[4, i], Z[5, i]
            for j in range(B.shape[1]):
                row[j] -= (
                    a * B[0, j] + b * B[1, j] + c * B[2, j] + d * B[3, j] + e * B[4, j]
                    + f * B[5, j])
else:
    def add_product(A: Any, B: Any, out: Any) -> Any:
        """Add A B to the first rows, and return the sum."""
        out[:len(A)] += A[:, :len(B)] @ B
        return out

    def product(A: Any, B: Any, out: Any) -> Any:
        """Write A B to the first rows, and return it."""
        out[:] = 0.0
        out[:len(A)] = A[:, :len(B)] @ B
        return out

    def subtract_product(Z: Any, B: Any, out: Any) -> None:
        """Subtract Z^T B from the first rows."""
        out[:Z.shape[1]] -= Z.T @ B


@kernel
def transpose(A: Array) -> Array:
    """Return A^T, its rows one after the other in memory."""
    return np.ascontiguousarray(A.T)
