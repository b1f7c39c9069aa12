"""
Errors of the measured pose of a body or of a detected tag.

The error of a detected tag depends on the direction: depth and rotation across the line of sight
follow from small differences between its corners, the other directions from their mean. Motion
during the exposure blurs the image; errors of a blurred tag grow with the square of its speed
across the line of sight. A flat tag has a second solution, its tilt mirrored at the line of sight,
which a detector may return by mistake (a flip).

The observer and its alarms weigh a measured pose by `pose_noise`; fits and `replay` use
`MeasurementModel.errors`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import entry
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream
import numpy as np

Sizes = tuple[float, float, float, float]
"""Standard deviations of an error: lateral (m), depth (m), rotation across and along the line of
sight (rad)."""

Sensor = tuple[bool, Sizes, Sizes, Vector]
"""A `MeasurementModel` for kernels: is_tag, at_rest, in_motion, camera."""

BODY_AT_REST: Sizes = (2e-3, 2e-3, 1e-2, 1e-2)
"""Default standard deviations of a tracked body, m and rad."""

TAG_AT_REST: Sizes = (5e-4, 5e-3, 1.2e-2, 4e-3)
"""Default standard deviations of a tag at rest, 1 m from the camera, m and rad."""

TAG_IN_MOTION: Sizes = (8e-3, 4e-2, 2e-1, 6e-2)
"""Default growth of a tag's errors per squared speed, 1 m from the camera, s^2/m and s^2
rad/m^2."""

NO_GROWTH: Sizes = (0.0, 0.0, 0.0, 0.0)
"""Growth of a tracked body's errors with its speed."""

LEAST_DISTANCE = 0.05
"""Smallest distance of a tag from the camera, the limit of focus, m."""


@entry
def sizes_of(sensor: Sensor, position: Vector, velocity: Vector) -> Sizes:
    """
    Return the standard deviations of a measured pose from its position and velocity.

    Errors of a tag's corners in the image are constant: the lateral error and the rotations grow
    with the distance from the camera, the depth error with the squared distance, or, if blurred,
    with the distance.
    """
    is_tag, at_rest, in_motion, camera = sensor
    if not is_tag:
        return at_rest
    sight = t3.subtract(position, camera)
    distance = max(t3.norm(sight), LEAST_DISTANCE)
    along = t3.dot(sight, velocity) / distance
    v2 = max(t3.dot(velocity, velocity) - along * along, 0.0)
    return (
        math.hypot(distance * at_rest[0], in_motion[0] * v2),
        math.hypot(distance * distance * at_rest[1], distance * in_motion[1] * v2),
        math.hypot(distance * at_rest[2], in_motion[2] * v2),
        math.hypot(distance * at_rest[3], in_motion[3] * v2))


@entry
def pose_noise(sensor: Sensor, position: Vector, velocity: Vector) -> Array:
    """Return the covariance (6, 6) of a measured pose (m^2, rad^2) about axes of the world."""
    lateral, depth, across, along = sizes_of(sensor, position, velocity)
    sight, out = t3.subtract(position, sensor[3]), np.zeros((6, 6))
    square = max(t3.dot(sight, sight), LEAST_DISTANCE * LEAST_DISTANCE)
    for i in range(3):
        out[i, i], out[3 + i, 3 + i] = lateral * lateral, across * across
        for j in range(3):
            part = sight[i] * sight[j] / square
            out[i, j] += (depth * depth - lateral * lateral) * part
            out[3 + i, 3 + j] += (along * along - across * across) * part
    return out


@entry
def mirrored(camera: Vector, position: Vector, q: Quaternion) -> Quaternion:
    """
    Return the second solution of a flat tag's orientation.

    R becomes S R D with the reflections S along the line of sight and D along the tag's normal, z.
    Their product is a half turn about the line of sight times R times a half turn about z.
    """
    sight = t3.subtract(position, camera)
    x, y, z = t3.scale(1.0 / max(t3.norm(sight), 1e-9), sight)
    return t3.quaternion_product(t3.quaternion_product((x, y, z, 0.0), q), (0.0, 0.0, 1.0, 0.0))


class PoseErrors(NamedTuple):
    """
    Errors of recorded poses at stamps (N,), ns, in axes (N, 3, 3) with z along the line of sight.

    The fields are standard deviations (N, 6), m and rad, of a point (3,) in body axes, m; the
    share of motion in the variances (N, 6); and whether the errors are estimated.
    """

    stamps_ns: Stamps
    axes: Array
    std: Array
    point: Array
    of_motion: Array
    are_known: bool = False

    def at(self, stamps_ns: Stamps) -> PoseErrors:
        """Return the errors of the poses nearest to some stamps."""
        middles = self.stamps_ns[:-1] + np.diff(self.stamps_ns) // 2
        nearest = np.searchsorted(middles, stamps_ns)
        return self._replace(stamps_ns=stamps_ns, axes=self.axes[nearest], std=self.std[nearest],
                             of_motion=self.of_motion[nearest])

    def body_std(self, rotation: Array) -> Array:
        """Return RMS standard deviations (6,) of poses with rotations (N, 3, 3) in body axes."""
        axes = np.swapaxes(rotation, 1, 2) @ self.axes
        lever = lie.hat(self.point) @ axes  # the origin rotates about the point
        shift, turn = np.hsplit(self.std**2, 2)
        squares = lie.apply(axes**2, shift) + lie.apply(lever**2, turn), lie.apply(axes**2, turn)
        return np.asarray(np.sqrt(np.mean(np.hstack(squares), axis=0)))


@dataclass(frozen=True)
class MeasurementModel:
    """
    The errors of measured poses, in the frame of the poses.

    Parameters
    ----------
    kind : {'body', 'tag'}
        A tracked body has equal errors in all directions, a tag those described above.
    at_rest : tuple of 4 floats
        Standard deviations at rest: lateral (m), depth (m), rotation across and along the line of
        sight (rad); of a tag at a distance of 1 m.
    in_motion : tuple of 4 floats
        Growth of the standard deviations with the squared lateral speed (s^2/m, s^2 rad/m^2).
    camera : tuple of 3 floats
        Optical centre of the camera, m.
    scale : float
        Factor of the positions relative to the camera that corrects the size of the tag.
    latency, latency_std : float
        Delay of the stamps and its standard deviation, s.
    are_estimated : bool
        Whether the errors were estimated from these poses.

    """

    kind: str = 'body'
    at_rest: Sizes = BODY_AT_REST
    in_motion: Sizes = NO_GROWTH
    camera: Vector = ZERO
    scale: float = 1.0
    latency: float = 0.0
    latency_std: float = 5e-3
    are_estimated: bool = False

    @property
    def sensor(self) -> Sensor:
        """The model for kernels."""
        return self.kind == 'tag', self.at_rest, self.in_motion, self.camera

    def moved(self, origin: Vector, rotation: Quaternion) -> MeasurementModel:
        """Return the model in a frame in which the frame of the poses has a given pose."""
        camera = t3.add(origin, t3.apply(t3.rotation_matrix(rotation), self.camera))
        return replace(self, camera=camera)

    def scaled(self, position: Vector) -> Vector:
        """Return a measured position (m) with the corrected size of the tag."""
        if self.scale == 1.0:
            return position
        sight = t3.subtract(position, self.camera)
        return t3.add(self.camera, t3.scale(self.scale, sight))

    def scaled_errors(self, at_rest: Array, in_motion: Array) -> MeasurementModel:
        """Return the model with errors multiplied by factors (6,) in the axes of `PoseErrors`."""
        def scaled(sizes: Sizes, factors: Array) -> Sizes:
            lateral, across = (float(np.sqrt(np.mean(factors[part]**2))) for part in (
                slice(2), slice(3, 5)))
            return (sizes[0] * lateral, sizes[1] * float(factors[2]),
                    sizes[2] * across, sizes[3] * float(factors[5]))

        return replace(self, at_rest=scaled(self.at_rest, at_rest),
                       in_motion=scaled(self.in_motion, in_motion), are_estimated=True)

    def errors(self, poses: PoseStream) -> PoseErrors:
        """Return the errors of a recorded tag, with its velocity over three poses."""
        stamps, sight = poses.stamps_ns, poses.position - self.camera
        seconds = (stamps - stamps[0]) / NS_PER_S
        velocity = np.gradient(poses.position, seconds, axis=0)
        sizes, still = (np.array([
            sizes_of(self.sensor, tuple(o), tuple(v))
            for o, v in zip(poses.position.tolist(), each.tolist(), strict=True)
        ])[:, [0, 0, 1, 2, 2, 3]] for each in (velocity, 0.0 * velocity))
        depth = sight / np.linalg.norm(sight, axis=1)[:, None]
        first = np.cross(depth, np.eye(3)[np.argmin(np.abs(depth), axis=1)])
        first /= np.linalg.norm(first, axis=1)[:, None]
        return PoseErrors(
            stamps, np.stack([first, np.cross(depth, first), depth], axis=2),
            sizes, np.zeros(3), 1.0 - (still / sizes) ** 2, self.are_estimated)

    def second_solution(self, position: Array, rotation: Array) -> Array:
        """Return the second solutions (N, 3, 3) of the orientations (N, 3, 3) of a flat tag."""
        q = lie.rotation_to_quaternion(rotation)
        return lie.quaternion_to_rotation(np.array([
            mirrored(self.camera, tuple(o), tuple(each))
            for o, each in zip(position.tolist(), q.tolist(), strict=True)]))


def measurement_model(values: Values) -> MeasurementModel:
    """
    Return the model of the parameters measured.*, in the frame of the measured poses.

    A number 0 in measured.noise or measured.blur stands for the default of measured.model.
    """
    given, kind = values.measured, values.measured.model
    at_rest, in_motion = (TAG_AT_REST, TAG_IN_MOTION) if kind == 'tag' else (
        BODY_AT_REST, NO_GROWTH)
    x, y, z = given.camera
    return MeasurementModel(
        kind, _chosen(given.noise, at_rest), _chosen(given.blur, in_motion), (x, y, z),
        given.scale, given.latency, given.latency_std)


def _chosen(given: Sequence[float], defaults: Sizes) -> Sizes:
    """Return the given numbers, with defaults for zeros."""
    a, b, c, d = (each or default for each, default in zip(given, defaults, strict=True))
    return a, b, c, d
