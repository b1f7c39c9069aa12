"""
Vectors, matrices and rotations as tuples of floats, for the kernels.

A vector is ``(x, y, z)``, a 3x3 matrix its nine entries row by row. A rotation is stored as a unit
quaternion ``(x, y, z, w)`` and applied as a 3x3 matrix.

With numba, products of small arrays are compiled loops; without numba they are numpy's products.
"""

import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import COMPILED, kernel
import numpy as np

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Quaternion = tuple[float, float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)

SMALL_ANGLE_SQUARED = 0.25
"""
Squared angle below which sine and cosine ratios are computed by series (to 1e-17), rad^2.

The series consist of products only, because an integration step with divisions takes 20 % longer.
"""

SMALL_SINE_SQUARED = 1e-3
"""Squared sine of half an angle below which the angle is computed by a series."""


@kernel
def add(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def subtract(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(factor: float, a: Vector) -> Vector:
    """Return factor * a."""
    return (factor * a[0], factor * a[1], factor * a[2])


@kernel
def add_scaled(a: Vector, factor: float, b: Vector) -> Vector:
    """Return a + factor * b."""
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Return the inner product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def unit(axis: int, size: float) -> Vector:
    """Return a vector of a given length along axis 0, 1 or 2; zero for other axes."""
    return (size if axis == 0 else 0.0, size if axis == 1 else 0.0, size if axis == 2 else 0.0)


@kernel
def norm(a: Vector) -> float:
    """Return the length of a vector."""
    return math.sqrt(dot(a, a))


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0])


@kernel
def apply(A: Matrix, v: Vector) -> Vector:
    """Return A v."""
    return (
        A[0] * v[0] + A[1] * v[1] + A[2] * v[2],
        A[3] * v[0] + A[4] * v[1] + A[5] * v[2],
        A[6] * v[0] + A[7] * v[1] + A[8] * v[2])


@kernel
def apply_transposed(A: Matrix, v: Vector) -> Vector:
    """Return A^T v; for a rotation, its inverse applied."""
    return (
        A[0] * v[0] + A[3] * v[1] + A[6] * v[2],
        A[1] * v[0] + A[4] * v[1] + A[7] * v[2],
        A[2] * v[0] + A[5] * v[1] + A[8] * v[2])


@kernel
def multiply_transposed(A: Matrix, B: Matrix) -> Matrix:
    """Return A^T B; for rotations ``R_a_c = R_b_a^T R_b_c``."""
    return multiply(transposed(A), B)


@kernel
def multiply(A: Matrix, B: Matrix) -> Matrix:
    """Return A B."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8])


@kernel
def transposed(A: Matrix) -> Matrix:
    """Return A^T."""
    return (A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8])


@kernel
def add_scaled_matrix(A: Matrix, factor: float, B: Matrix) -> Matrix:
    """Return A + factor * B."""
    return (
        A[0] + factor * B[0], A[1] + factor * B[1], A[2] + factor * B[2],
        A[3] + factor * B[3], A[4] + factor * B[4], A[5] + factor * B[5],
        A[6] + factor * B[6], A[7] + factor * B[7], A[8] + factor * B[8])


@kernel
def scale_matrix(factor: float, A: Matrix) -> Matrix:
    """Return factor * A."""
    return (
        factor * A[0], factor * A[1], factor * A[2],
        factor * A[3], factor * A[4], factor * A[5],
        factor * A[6], factor * A[7], factor * A[8])


@kernel
def inverse(A: Matrix) -> Matrix:
    """Return the inverse of a 3x3 matrix."""
    a = cross((A[3], A[4], A[5]), (A[6], A[7], A[8]))
    b = cross((A[6], A[7], A[8]), (A[0], A[1], A[2]))
    c = cross((A[0], A[1], A[2]), (A[3], A[4], A[5]))
    k = 1.0 / (A[0] * a[0] + A[1] * a[1] + A[2] * a[2])
    return (
        k * a[0], k * b[0], k * c[0], k * a[1], k * b[1], k * c[1], k * a[2], k * b[2], k * c[2])


@kernel
def hat(a: Vector) -> Matrix:
    """Return the matrix a^ of the cross product: a^ b = a x b."""
    return (0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0)


@kernel
def quaternion_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product p q, the rotation q followed by p."""
    return (
        p[3] * q[0] + p[0] * q[3] + p[1] * q[2] - p[2] * q[1],
        p[3] * q[1] - p[0] * q[2] + p[1] * q[3] + p[2] * q[0],
        p[3] * q[2] + p[0] * q[1] - p[1] * q[0] + p[2] * q[3],
        p[3] * q[3] - p[0] * q[0] - p[1] * q[1] - p[2] * q[2])


@kernel
def quaternion_conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation of a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


@kernel
def normalised(q: Quaternion) -> Quaternion:
    """Return q / |q|; q must not be zero."""
    factor = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (factor * q[0], factor * q[1], factor * q[2], factor * q[3])


@kernel
def rotation_matrix(q: Quaternion) -> Matrix:
    """Return the rotation matrix of a unit quaternion."""
    x, y, z, w = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


@kernel
def exp_quaternion(phi: Vector) -> Quaternion:
    """Return the unit quaternion of the rotation vector phi (rad), exp on SO(3) (G.74)."""
    squared = dot(phi, phi)
    if squared < SMALL_ANGLE_SQUARED:
        x = 0.25 * squared  # of the half angle
        ratio = 0.5 - x * (1 / 12 - x * (1 / 240 - x * (
            1 / 10080 - x * (1 / 725760 - x * (1 / 79833600)))))
        cosine = 1 - x * (1 / 2 - x * (1 / 24 - x * (1 / 720 - x * (
            1 / 40320 - x * (1 / 3628800 - x * (1 / 479001600))))))
    else:
        angle = math.sqrt(squared)
        ratio = math.sin(0.5 * angle) / angle
        cosine = math.cos(0.5 * angle)
    return (ratio * phi[0], ratio * phi[1], ratio * phi[2], cosine)


@kernel
def log_quaternion(q: Quaternion) -> Vector:
    """Return the rotation vector (rad, at most pi long) of a unit quaternion, log on SO(3)."""
    x, y, z, w = q
    if w < 0.0:  # q and -q are the same rotation: take the shorter one
        x, y, z, w = -x, -y, -z, -w
    squared = x * x + y * y + z * z  # of the half angle's sine
    if squared < SMALL_SINE_SQUARED:  # asin(s) / s, the next term is below 3e-17
        factor = 2.0 + squared * (1 / 3 + squared * (3 / 20 + squared * (
            5 / 56 + squared * (35 / 576))))
    else:
        sine = math.sqrt(squared)
        factor = 2.0 * math.atan2(sine, w) / sine
    return (factor * x, factor * y, factor * z)


@kernel
def rotation_between(p: Quaternion, q: Quaternion) -> Vector:
    """Return the rotation vector (rad) from one orientation to another, in axes of the first."""
    return log_quaternion(quaternion_product(quaternion_conjugate(p), q))


@kernel
def body_rate(phi: Vector, phi_dot: Vector) -> Vector:
    """
    Return the body angular velocity of R0 exp(phi(t)): dexp(-phi) phi_dot (G.65).

    G.65 as corrected: the last term is divided by the square of the norm.
    """
    squared = dot(phi, phi)
    if squared < SMALL_ANGLE_SQUARED:
        x = squared
        first = 1 / 2 - x * (1 / 24 - x * (1 / 720 - x * (
            1 / 40320 - x * (1 / 3628800 - x * (1 / 479001600 - x / 87178291200)))))
        second = 1 / 6 - x * (1 / 120 - x * (1 / 5040 - x * (
            1 / 362880 - x * (1 / 39916800 - x * (1 / 6227020800 - x / 1307674368000)))))
    else:
        angle = math.sqrt(squared)
        first = (1.0 - math.cos(angle)) / squared
        second = (angle - math.sin(angle)) / (squared * angle)
    once = cross(phi, phi_dot)
    return add_scaled(add_scaled(phi_dot, -first, once), second, cross(phi, once))


@kernel
def rotation_vector_rate(phi: Vector, omega: Vector) -> Vector:
    """Return phi_dot of R0 exp(phi(t)) for its body rate omega: the inverse of dexp(-phi)."""
    squared = dot(phi, phi)
    if squared < SMALL_ANGLE_SQUARED:
        x = squared  # 1/x - cot(sqrt(x)/2) / (2 sqrt(x)), its Bernoulli series
        tail = 1 / 47900160 + x * (691 / 1307674368000 + x * (1 / 74724249600))
        factor = 1 / 12 + x * (1 / 720 + x * (1 / 30240 + x * (1 / 1209600 + x * tail)))
    else:
        angle = math.sqrt(squared)
        factor = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / squared
    once = cross(phi, omega)
    return add_scaled(add_scaled(omega, 0.5, once), factor, cross(phi, once))


if COMPILED:
    @kernel
    def add_product(A: Any, B: Any, out: Any) -> Any:
        """Add the product A B, of as many columns of A as rows of B, to the first rows of out."""
        n = min(A.shape[1], B.shape[0])
        whole = n - n % 4  # four rows at once, which needs a quarter of the stores
        for i in range(A.shape[0]):
            row = out[i]
            for k in range(0, whole, 4):
                a, b, c, d = A[i, k], A[i, k + 1], A[i, k + 2], A[i, k + 3]
                for j in range(B.shape[1]):
                    row[j] += (
                        a * B[k, j] + b * B[k + 1, j] + c * B[k + 2, j] + d * B[k + 3, j])
            for k in range(whole, n):
                for j in range(B.shape[1]):
                    row[j] += A[i, k] * B[k, j]
        return out

    @kernel
    def add_array(A: Any, out: Any) -> Any:
        """Add A to the first rows, and return the sum."""
        for i in range(A.shape[0]):
            for j in range(A.shape[1]):
                out[i, j] += A[i, j]
        return out
else:
    def add_product(A: Any, B: Any, out: Any) -> Any:
        """Add A B to the first rows, and return the sum."""
        out[:len(A)] += A[:, :len(B)] @ B
        return out

    def add_array(A: Any, out: Any) -> Any:
        """Add A to the first rows, and return the sum."""
        out[:len(A)] += A
        return out


@kernel
def product(A: Any, B: Any, out: Any) -> Any:
    """Write A B to the first rows and zeros to the others, and return the result."""
    out[:] = 0.0
    return add_product(A, B, out)


@kernel
def transpose(A: Array) -> Array:
    """Return A^T with contiguous rows."""
    return np.ascontiguousarray(A.T)
