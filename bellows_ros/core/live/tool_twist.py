"""Causal estimate of the tool's body twist from its last poses, for drivers without twists."""

from __future__ import annotations

from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import as_inputs, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.model.kernels import State
import numpy as np

ZERO = (0.0, 0.0, 0.0)

SMALLEST_DETERMINANT = 1e-4
"""Of the normal matrix in units of the time spanned; three even samples have 0.06."""


class PoseHistory:
    """
    The last poses of the tool, and the slope of a quadratic through them.

    The quadratic is fitted by least squares to the positions and to the rotation vectors seen
    from one of the poses; its slope there is that pose's body twist. Three poses give the exact
    quadratic; more of them average noise.
    """

    def __init__(self, size: int) -> None:
        """Keep the given number of poses, at least two."""
        # stamp (s, from the first), position, quaternion xyzw
        self._rows, = as_inputs(np.zeros((size, 8)))
        self._count = 0
        self._origin_ns = 0

    def clear(self) -> None:
        """Forget all poses."""
        self._count = 0

    def append(self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion) -> None:
        """Add the newest pose, and drop the oldest when full."""
        if self._count == 0:
            self._origin_ns = stamp_ns
        seconds = (stamp_ns - self._origin_ns) * 1e-9
        self._count = keep(self._rows, self._count, seconds, position, quaternion_xyzw)

    def state(self, back: int = 0) -> State:
        """Return the pose that many samples before the newest, with its estimated body twist."""
        return pose_with_slope(self._rows, self._count, self._count - 1 - back)


@kernel
def keep(rows: Any, count: int, seconds: float, o: Vector, q: Quaternion) -> int:
    """Write a pose behind the others, dropping the first when full; return how many there are."""
    if count == len(rows):
        for i in range(count - 1):
            for j in range(8):
                rows[i][j] = rows[i + 1][j]
        count -= 1
    row = rows[count]
    row[0] = seconds
    row[1], row[2], row[3] = o
    row[4], row[5], row[6], row[7] = q
    return count + 1


@kernel
def pose_with_slope(rows: Any, count: int, at: int) -> State:
    """Return the pose in rows[at] with the slope there of a quadratic through rows[:count]."""
    o = (rows[at][1], rows[at][2], rows[at][3])
    q = (rows[at][4], rows[at][5], rows[at][6], rows[at][7])
    if count < 2:
        return o, q, ZERO, ZERO
    span = rows[count - 1][0] - rows[0][0]
    s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0
    d0, d1, d2 = ZERO, ZERO, ZERO  # moments of the displacements
    p0, p1, p2 = ZERO, ZERO, ZERO  # and of the rotation vectors
    for i in range(count):
        s = (rows[i][0] - rows[at][0]) / span
        d = t3.subtract((rows[i][1], rows[i][2], rows[i][3]), o)
        qi = (rows[i][4], rows[i][5], rows[i][6], rows[i][7])
        p = t3.log_quaternion(t3.quaternion_product(t3.quaternion_conjugate(q), qi))
        s1, s2, s3, s4 = s1 + s, s2 + s * s, s3 + s * s * s, s4 + s * s * s * s
        d0, d1, d2 = t3.add(d0, d), t3.add_scaled(d1, s, d), t3.add_scaled(d2, s * s, d)
        p0, p1, p2 = t3.add(p0, p), t3.add_scaled(p1, s, p), t3.add_scaled(p2, s * s, p)
    w0, w1, w2 = slope_weights(float(count), s1, s2, s3, s4)
    velocity = weighted_sum(w0 / span, d0, w1 / span, d1, w2 / span, d2)
    rate = weighted_sum(w0 / span, p0, w1 / span, p1, w2 / span, p2)
    return o, q, t3.apply_transposed(t3.rotation_matrix(q), velocity), rate


@kernel
def weighted_sum(a: float, x: Vector, b: float, y: Vector, c: float, z: Vector) -> Vector:
    """Return a x + b y + c z."""
    return t3.add_scaled(t3.add_scaled(t3.scale(a, x), b, y), c, z)


@kernel
def slope_weights(
    n: float, s1: float, s2: float, s3: float, s4: float
) -> tuple[float, float, float]:
    """
    Return the row of the inverse normal matrix of a quadratic fit that yields its slope at s = 0.

    The matrix is [[n, s1, s2], [s1, s2, s3], [s2, s3, s4]] of the sums of powers of s. Where it is
    nearly singular, as of two samples or of two bursts, the slope is that of the fitted line.
    """
    determinant = (
        n * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s3 * s2) + s2 * (s1 * s3 - s2 * s2)
    )
    if determinant < SMALLEST_DETERMINANT:
        return (-s1 / (n * s2 - s1 * s1), n / (n * s2 - s1 * s1), 0.0)
    return (
        (s3 * s2 - s1 * s4) / determinant,
        (n * s4 - s2 * s2) / determinant,
        (s1 * s2 - n * s3) / determinant,
    )
