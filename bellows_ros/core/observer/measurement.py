"""Measured poses of the package: which can be used, and what they say of its centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.kernels import State
from bellows_ros.core.lie import hat
from bellows_ros.core.screening import why_no_pose
from bellows_ros.core.tuples import (
    add,
    apply,
    exp_quaternion,
    normalised,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    subtract,
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
        q = quaternion_product(seen.quaternion_xyzw, quaternion_conjugate(self._turn))
        R = rotation_matrix(q)
        arm = subtract(com if self.of_lip else (0.0, 0.0, 0.0), self._offset)
        T: Array = np.zeros((6, 6))
        T[:3, :3] = T[3:, 3:] = np.reshape(R, (3, 3)).T
        T[:3, 3:] = -hat(np.array(arm)) @ T[3:, 3:]
        return add(seen.position, apply(R, arm)), q, T @ seen.noise @ T.T


def lip_shift(position: Vector, q: Quaternion, com: Vector, tool: State, length: float) -> Vector:
    """Return how far (m) the lip of a package at a pose is from where it is without load."""
    lip = subtract(position, apply(rotation_matrix(q), com))
    free = add(tool[0], apply(rotation_matrix(tool[1]), (0.0, 0.0, -length)))
    return subtract(lip, free)
