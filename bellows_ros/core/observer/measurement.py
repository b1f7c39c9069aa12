"""Measured poses of the package: validity, and conversion to its centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import (
    add,
    apply,
    dot,
    exp_quaternion,
    hat,
    multiply,
    normalised,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    subtract,
    transposed,
    Vector,
)
from bellows_ros.core.model.equilibrium import moved, pose_error
from bellows_ros.core.model.kernels import State
from bellows_ros.core.observer.filter import (
    add_product,
    CENTRE,
    product,
    turned_over,
)
from bellows_ros.core.signals.screening import why_no_pose
import numpy as np

Marker = tuple[Vector, Quaternion, bool]
ZERO = (0.0, 0.0, 0.0)


class Measurement(NamedTuple):
    """A measured pose in the world, with its noise."""

    stamp_ns: int
    position: Vector
    """m."""
    quaternion_xyzw: Quaternion
    noise: Array
    """Covariance (6, 6) of position and rotation (m^2, rad^2) about axes of the world."""


class Sight:
    """
    The measured frame and its noise.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, recording.package_world.

    Attributes
    ----------
    marker : tuple
        Position (m) and orientation of what is measured, in axes of B, from the lip or from B.
    H : ndarray (6, 22)
        Derivative of an innovation by the error.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Set the measured frame, and the noise for messages without covariance."""
        self.noise = np.diag(np.repeat(np.square(values['measured.noise']), 3))
        of_lip = values['measured.frame'] == 'lip'
        x, y, z, *turn = values['measured.offset']
        self.marker: Marker = (x, y, z), exp_quaternion((turn[0], turn[1], turn[2])), of_lip
        self.H: Array = np.eye(6, 22)
        self.H[:3, CENTRE] = -np.eye(3) * of_lip
        world = values['recording.package_world'] or '0 0 0 0 0 0 1'
        self.has_own_world = bool(values['recording.package_world'])
        x, y, z, qx, qy, qz, qw = map(float, world.split())
        self._origin: Vector = x, y, z
        self._world: Quaternion = qx, qy, qz, qw

    def measurement(
        self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion,
        covariance: Array | None = None,
    ) -> Measurement | str:
        """
        Return a measured pose, or why it cannot be used.

        Its covariance (6, 6) is about axes of the world, as in ROS; without one, and with one
        that is all zero, measured.noise counts. What is measured in a world of its own is
        brought into that of the tool.
        """
        reason = why_no_pose(position, quaternion_xyzw) or ('' if stamp_ns > 0 else 'zero_stamp')
        if reason:
            return reason
        noise = self.noise
        if covariance is not None and covariance.any():
            noise = 0.5 * (covariance + covariance.T)
            if not (np.isfinite(noise).all() and np.linalg.eigvalsh(noise)[0] > 0.0):
                return 'covariance'
        q = normalised(quaternion_xyzw)
        if self.has_own_world:
            R = rotation_matrix(self._world)
            position = add(self._origin, apply(R, position))
            q = quaternion_product(self._world, q)
            turn = np.kron(np.eye(2), np.reshape(R, (3, 3)))
            noise = turn @ noise @ turn.T
        return Measurement(stamp_ns, position, q, noise)


@kernel
def at_com(
    position: Vector, quaternion_xyzw: Quaternion, noise: Array, marker: Marker, com: Vector
) -> tuple[Vector, Quaternion, Array]:
    """
    Return the pose of B, and its noise (6, 6) in B axes, as a marker has measured it.

    With B at com (m) from the lip; the rest are those of a `Measurement` and of `Sight`.
    """
    offset, turn, of_lip = marker
    arm = subtract(com if of_lip else ZERO, offset)
    q = quaternion_product(quaternion_xyzw, quaternion_conjugate(turn))
    R = rotation_matrix(q)
    across = multiply(hat(arm), transposed(R))
    T = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            T[i, j] = T[3 + i, 3 + j] = R[3 * j + i]
            T[i, 3 + j] = -across[3 * i + j]
    found = product(product(T, noise, np.empty((6, 6))), turned_over(T), np.empty((6, 6)))
    return add(position, apply(R, arm)), q, found


@kernel
def lip_shift(position: Vector, q: Quaternion, com: Vector, tool: State, length: float) -> float:
    """Return the displacement (m) of the lip from its place without load, for a package pose."""
    lip = subtract(position, apply(rotation_matrix(q), com))
    free = add(tool[0], apply(rotation_matrix(tool[1]), (0.0, 0.0, -length)))
    away = subtract(lip, free)
    return math.sqrt(dot(away, away))


class Innovation(NamedTuple):
    """The difference of a measured pose from an estimate, with its covariance."""

    position: Vector
    quaternion_xyzw: Quaternion
    """Measured pose of B in the world (m)."""
    y: Array
    """Shift (m) and turn (rad) from the estimated to the measured pose, in B axes (6,)."""
    H: Array
    """Its derivative by the error (6, 22)."""
    whitener: Array
    """Triangular (6, 6); makes its covariance the identity."""
    distance: float
    """Its squared Mahalanobis distance."""
    gain: Array
    """(22, 6)."""


@kernel
def whitener(S: Array) -> Array:
    """Return the inverse of the Cholesky factor of a covariance (6, 6)."""
    L, W = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            a = S[i, j]
            for k in range(j):
                a -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(a) if i == j else a / L[j, j]
        for j in range(i + 1):
            a = 1.0 if i == j else 0.0
            for k in range(j, i):
                a -= L[i, k] * W[k, j]
            W[i, j] = a / L[i, i]
    return W


@kernel
def compared(
    body: State, P: Array, position: Vector, q: Quaternion, noise: Array, H: Array
) -> tuple[Array, Array, float, Array]:
    """Return y, whitener, squared distance and gain of an `Innovation`; noise is in B axes."""
    shift, turn = pose_error(body, position, q)
    y = np.array((shift[0], shift[1], shift[2], turn[0], turn[1], turn[2]))
    HP = product(H, P, np.empty((6, 22)))
    S = product(H, turned_over(HP), np.empty((6, 6)))
    for i in range(6):
        for j in range(6):
            S[i, j] += noise[i, j]
    W, distance = whitener(S), 0.0
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += W[i, j] * y[j]
        distance += z * z
    inverse = product(turned_over(W), W, np.empty((6, 6)))
    return y, W, distance, product(turned_over(HP), inverse, np.empty((22, 6)))


@kernel
def corrected(
    body: State, theta: Array, P: Array, y: Array, H: Array, gain: Array, noise: Array
) -> tuple[State, Array, Array]:
    """Return state, theta and covariance after a measurement, in Joseph's form."""
    e, theta = np.zeros(22), theta.copy()
    for i in range(22):
        for j in range(6):
            e[i] += gain[i, j] * y[j]
        if i >= 12:
            theta[i - 12] += e[i]
    body = moved(
        body, (e[0], e[1], e[2]), (e[3], e[4], e[5]), (e[6], e[7], e[8]), (e[9], e[10], e[11]))
    found, less, of_noise = P, -gain, product(gain, noise, np.empty((22, 6)))
    for _ in range(2):
        found = turned_over(found)
        add_product(less, product(H, found, np.empty((6, 22))), found)
    add_product(of_noise, turned_over(gain), found)
    for i in range(22):
        for j in range(i):
            found[i, j] = found[j, i] = 0.5 * (found[i, j] + found[j, i])
    return body, theta, found


USED, OUTSIDE, OUT_OF_REACH = 0, 1, 2


@kernel
def taken(
    tool: State, body: State, theta: Array, P: Array, position: Vector,
    quaternion_xyzw: Quaternion, noise: Array, marker: Marker, H: Array, com: Vector,
    length: float, reach: float, gate: float,
) -> tuple[int, tuple[Vector, Quaternion, Array, Array, Array, float, Array],
           State, Array, Array]:
    """
    Take a measurement in.

    Parameters
    ----------
    tool, body, theta, P
        The estimate at its stamp.
    position, quaternion_xyzw, noise, marker, H
        Of the measurement, and of `Sight`.
    com, length : tuple, float
        Nominal centre of mass, and length of the cup, m.
    reach : float
        How far (m) a lip can be from where it is without load.
    gate : float
        The largest squared Mahalanobis distance.

    Returns
    -------
    int
        `USED`, `OUTSIDE` the gate or `OUT_OF_REACH`, where no lip can be: another package.
    tuple
        `Innovation`.
    State, ndarray (10,), ndarray (22, 22)
        Body, theta and covariance: corrected where it is used, else as they were.

    """
    com = add(com, (theta[1], theta[2], theta[3]))
    position, q, noise = at_com(position, quaternion_xyzw, noise, marker, com)
    y, W, distance, gain = compared(body, P, position, q, noise, H)
    spread = math.sqrt(noise[0, 0] + noise[1, 1] + noise[2, 2])
    verdict = USED
    if lip_shift(position, q, com, tool, length) > reach + 5.0 * spread:
        verdict = OUT_OF_REACH
    elif distance > gate:
        verdict = OUTSIDE
    else:
        body, theta, P = corrected(body, theta, P, y, H, gain, noise)
    return verdict, (position, q, y, H, W, distance, gain), body, theta, P
