"""Measured poses of the package: which can be used, and what they say of its centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import State
from bellows_ros.core.observer.filter import product, turned_over
from bellows_ros.core.screening import why_no_pose
from bellows_ros.core.tuples import (
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
import numpy as np


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
    What is measured, and how well.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, recording.package_world.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Take the frame that is measured, and the noise where a message has none."""
        self.noise = np.diag(np.repeat(np.square(values['measured.noise']), 3))
        self.of_lip = values['measured.frame'] == 'lip'
        x, y, z, *turn = values['measured.offset']
        self._offset: Vector = x, y, z
        self._turn = exp_quaternion((turn[0], turn[1], turn[2]))
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

    def at_com(self, seen: Measurement, com: Vector) -> tuple[Vector, Quaternion, Array]:
        """Return the pose of B, and its noise (6, 6) in B axes, with B at com (m) from the lip."""
        arm = subtract(com if self.of_lip else (0.0, 0.0, 0.0), self._offset)
        return _at_com(seen.position, seen.quaternion_xyzw, seen.noise, self._turn, arm)


@kernel
def _at_com(
    position: Vector, quaternion_xyzw: Quaternion, noise: Array, turn: Quaternion, arm: Vector
) -> tuple[Vector, Quaternion, Array]:
    """Return the pose of B, `arm` (m) from what was measured, and its noise in B axes."""
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
    """Return how far (m) the lip of a package at a pose is from where it is without load."""
    lip = subtract(position, apply(rotation_matrix(q), com))
    free = add(tool[0], apply(rotation_matrix(tool[1]), (0.0, 0.0, -length)))
    away = subtract(lip, free)
    return math.sqrt(dot(away, away))
