"""Measured poses of the package: validity, world, marker and noise."""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.model.kernels import ORIGIN
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.sensors.corners import CornerNoise, Sensor, USUAL_EXPOSURE
from bellows_ros.core.signals.screening import MAX_PLACE, why_no_pose
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

Marker = tuple[Vector, Quaternion, bool, Sensor]
"""
Position (m) and orientation of the measured frame, in axes of B; whether its position is measured
from the lip instead of B; and the errors of its poses.
"""

BODY_NOISE = 2e-3, 1e-2
"""Default standard deviations of a tracked body, m and rad."""

USUAL_PERIOD = 1.0 / 30.0
"""Period of a usual camera, s."""

MAX_VARIANCE = 1e12
"""Largest variance or covariance in a message, m^2 or rad^2: (1000 km)^2, whose square is
finite."""


class Measurement(NamedTuple):
    """A measured pose in the world, with its noise."""

    stamp_ns: int
    position: Vector
    """m."""
    quaternion_xyzw: Quaternion
    noise: Array
    """Covariance (6, 6) about axes of the world (m^2, rad^2); zero for the covariance of the
    model; empty without a pose, for the end of a block of wrenches."""
    meets_support: bool = False
    """Whether this entry is a stop of the tool on its way down, without a pose."""

    @property
    def is_pose(self) -> bool:
        """Whether there is a pose."""
        return self.noise.size > 0 and not self.meets_support


NO_MEASUREMENT = Measurement(0, *ORIGIN[:2], np.zeros((6, 6)))


class PoseSensor:
    """
    The measured frame and the errors of its poses.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, recording.package_world.

    Attributes
    ----------
    marker : tuple
        The measured frame, see `Marker`.
    has_own_world : bool
        Whether the poses have their own world with a pose in the tool's world.

    """

    def __init__(self, values: Values) -> None:
        x, y, z, *rotation = values.measured.offset
        world = values.recording.package_world or '0 0 0 0 0 0 1'
        self.has_own_world = bool(values.recording.package_world)
        a, b, c, qx, qy, qz, qw = map(float, world.split())
        self._origin: Vector = a, b, c
        self._world: Quaternion = qx, qy, qz, qw
        self._scale, self._late_ns = values.measured.scale, round(
            NS_PER_S * values.measured.latency[0])
        self.marker: Marker = (
            (x, y, z), t3.exp_quaternion((rotation[0], rotation[1], rotation[2])),
            values.measured.frame == 'lip', sensor_of(values, self._origin, self._world))
        self._last: tuple[Any, ...] = ()

    def measurement(
        self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion,
        covariance: Array | None = None,
    ) -> Measurement | str:
        """
        Return a measured pose, or the reason of its rejection.

        Its covariance (6, 6) is about axes of the world, as in ROS; measured.noise replaces it if
        missing or zero, or of a tag. A pose in a world of its own is transformed to the world of
        the tool.
        """
        reason = why_no_pose(position, quaternion_xyzw) or ('' if stamp_ns > 0 else 'zero_stamp')
        if reason or t3.norm(position) > MAX_PLACE:
            return reason or 'millimetres'
        before, noise = self._last, np.zeros((6, 6))
        if covariance is not None and covariance.any() and not self.marker[3][0]:
            if not np.abs(covariance).max() <= MAX_VARIANCE:
                return 'covariance'
            noise = 0.5 * (covariance + covariance.T)
            if not np.linalg.eigvalsh(noise)[0] > 0.0:
                return 'covariance'
        self._last = position, quaternion_xyzw
        if before == self._last:
            return 'repeated'
        position, q = t3.scale(self._scale, position), t3.normalised(quaternion_xyzw)
        if self.has_own_world:
            R = t3.rotation_matrix(self._world)
            position = t3.add(self._origin, t3.apply(R, position))
            q = t3.quaternion_product(self._world, q)
            rotation = np.kron(np.eye(2), np.reshape(R, (3, 3)))
            noise = rotation @ noise @ rotation.T
        return Measurement(stamp_ns - self._late_ns, position, q, noise)


def sensor_of(values: Values, origin: Vector, world: Quaternion) -> Sensor:
    """Return the sensor of measured.*, with the pose of the frame of its poses in the world."""
    given = values.measured
    usual = CornerNoise() if given.tag_size else BODY_NOISE
    first, second = (each or default for each, default in zip(given.noise, usual, strict=True))
    return (given.tag_size > 0.0, first, second, origin, t3.rotation_matrix(world),
            0.5 * given.scale * given.tag_size,
            given.exposure or USUAL_EXPOSURE * USUAL_PERIOD)
