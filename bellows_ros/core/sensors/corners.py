"""
A flat tag, measured by the directions of its four corners in the camera.

In the camera's frame a corner has the image (X/Z, Y/Z), the coordinates of an undistorted pinhole
camera of unit focal length. The residual of a view is the difference of its eight measured and
predicted coordinates. The errors of corners are nearly white and equal. The pose computed from the
corners has much larger errors in depth and tilt, and a second solution. The corners can be
computed back from either solution.

Derivatives are by the package's error: shift and rotation in body axes, as of `pose_error`. With
the QR factors J = Q R of the derivatives, the first six numbers of Q^T r have all information on
the pose, with the derivative R; the last two have none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Mask, Places, Stamps
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.equilibrium import moved
from bellows_ros.core.model.kernels import matrix_of, State
from bellows_ros.core.model.simulation import row_state, write_row
from bellows_ros.core.sensors import body as poses
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
import numpy as np

CORNERS = (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)
"""Corners of a tag in its own axes, in units of half its side, in the order of OpenCV and of the
AprilTag library."""

LEAST_DEPTH = 0.05
"""Smallest distance of a corner from the camera along its axis, the limit of focus, m."""

LEAST_SLOPE = 1e-4
"""Smallest derivative of a corner's direction by the pose in a usable view, rad/m or 1."""

MIN_CORNER_STD = 2e-6
"""Smallest noise of a corner, by rounding, rad."""

SAME_IMAGE = 3e-4
"""Largest motion of the corners between two frames of one view, rad; about a third of a pixel."""

SAME_VIEW = 0.8
"""Share of a corner's variance that all frames of one view have in common."""

EXPOSURE_STEP = 1e-3
"""Time (s) before and after an exposure for the acceleration of the corners."""

USUAL_EXPOSURE = 0.3
"""Default exposure, in periods of the camera; the standard deviation is equal to the exposure."""

NEAR = np.repeat([0.05, 0.1], 3)
"""Standard deviations of a tag's pose about its predicted pose, m and rad."""

NEAR_ITERATIONS = 4
"""Number of Gauss-Newton steps from the predicted pose of a tag to its pose."""

Sight = tuple[Vector, Matrix, Vector, Matrix, float]
"""
Position (m) and axes of the camera in the world, position (m) and axes of the tag in axes of B,
and half of the tag's side (m).
"""


@kernel
def corner_at(body: State, sight: Sight, corner: int) -> tuple[Vector, Vector]:
    """Return a corner in axes of the camera, and relative to B in axes of B, m."""
    camera, R_camera, centre, R_tag, half = sight
    x, y = CORNERS[corner]
    arm = t3.add(centre, t3.apply(R_tag, (half * x, half * y, 0.0)))
    place = t3.add(body[0], t3.apply(t3.rotation_matrix(body[1]), arm))
    X, Y, Z = t3.apply_transposed(R_camera, t3.subtract(place, camera))
    return (X, Y, max(Z, LEAST_DEPTH)), arm


@kernel
def write_image(body: State, sight: Sight, out: Any) -> None:
    """Write the image (8,) of the corners."""
    for corner in range(4):
        (X, Y, Z), _ = corner_at(body, sight, corner)
        out[2 * corner], out[2 * corner + 1] = X / Z, Y / Z


@kernel
def write_slopes(body: State, sight: Sight, J: Any) -> None:
    """Write the derivatives (8, 6) of the image by the package's error."""
    axes = t3.multiply(t3.transposed(sight[1]), t3.rotation_matrix(body[1]))
    for corner in range(4):
        (X, Y, Z), arm = corner_at(body, sight, corner)
        for k, along in ((2 * corner, X / Z), (2 * corner + 1, Y / Z)):
            row = 0 if k % 2 == 0 else 3
            a, b, c = ((axes[row] - along * axes[6]) / Z, (axes[row + 1] - along * axes[7]) / Z,
                       (axes[row + 2] - along * axes[8]) / Z)
            J[k, 0], J[k, 1], J[k, 2] = a, b, c
            J[k, 3], J[k, 4], J[k, 5] = t3.cross(arm, (a, b, c))


@kernel
def reduce_view(J: Any, X: Any) -> None:
    """
    Replace J (8, 6) by R, and X (8, m) by Q^T X, with J = Q R, by Householder's reflections.

    The first six rows have all information on the pose.
    """
    for k in range(6):
        size = 0.0
        for i in range(k, 8):
            size += J[i, k] * J[i, k]
        size = size**0.5 if J[k, k] < 0.0 else -(size**0.5)
        first = J[k, k] - size
        square = -size * first
        if square <= 0.0:
            continue
        J[k, k] = first
        for j in range(k + 1, 6):
            _reflect(J, k, square, J, j)
        for j in range(X.shape[1]):
            _reflect(J, k, square, X, j)
        J[k, k] = size
        for i in range(k + 1, 8):
            J[i, k] = 0.0


@kernel
def _reflect(J: Any, k: int, square: float, X: Any, j: int) -> None:
    """Reflect column j of X by the vector in column k of J, whose half square is given."""
    along = 0.0
    for i in range(k, 8):
        along += J[i, k] * X[i, j]
    along /= square
    for i in range(k, 8):
        X[i, j] -= along * J[i, k]


@entry
def _write_views(
    rows: Any, accelerations: Any, sight: Sight, corners: Any, out: Any, maps: Any, speeds: Any
) -> None:
    """Write the results of `views`."""
    J, X, image, before, after = (
        np.empty((8, 6)), np.empty((8, 2)), np.empty(8), np.empty(8), np.empty(8))
    h = EXPOSURE_STEP
    for n in range(len(rows)):
        body, a = row_state(rows[n]), accelerations[n]
        v, w = body[2], body[3]
        second = t3.scale(0.5 * h * h, (a[0], a[1], a[2]))
        turn = t3.scale(0.5 * h * h, (a[3], a[4], a[5]))
        write_image(body, sight, image)
        write_image(moved(body, t3.add_scaled(second, h, v), t3.add_scaled(turn, h, w),
                          t3.ZERO, t3.ZERO), sight, after)
        write_image(moved(body, t3.add_scaled(second, -h, v), t3.add_scaled(turn, -h, w),
                          t3.ZERO, t3.ZERO), sight, before)
        square = 0.0
        for i in range(8):
            X[i, 0] = corners[n][i] - image[i]
            X[i, 1] = (after[i] - 2.0 * image[i] + before[i]) / (h * h)
            square += (after[i] - before[i]) ** 2 / (16.0 * h * h)
        speeds[n] = square**0.5
        write_slopes(body, sight, J)
        reduce_view(J, X)
        for i in range(8):
            out[n, i, 0], out[n, i, 1] = X[i, 0], X[i, 1]
        for i in range(6):
            for j in range(6):
                maps[n, i, j] = J[i, j]


def views(
    rows: Array, accelerations: Array, sight: Sight, corners: Array
) -> tuple[Array, Array, Array]:
    """
    Return residuals of N views, their derivatives by the package's error, and speeds.

    Parameters
    ----------
    rows : ndarray (N, 13)
        The package at the exposures: position, quaternion, body twist.
    accelerations : ndarray (N, 6)
        Derivatives of its velocity and its rate in body axes, m/s^2 and rad/s^2.
    sight : tuple
        Camera and tag.
    corners : ndarray (N, 8)
        Measured corners.

    Returns
    -------
    ndarray (N, 8, 2)
        Q^T times the residual (rad), and Q^T times the acceleration of the image (rad/s^2); the
        mean over an exposure T differs from the middle by T^2/24 of this acceleration. The last
        two rows do not depend on the pose.
    ndarray (N, 6, 6)
        Derivatives R by the package's error.
    ndarray (N,)
        Speed of the corners in the image, RMS, rad/s.

    """
    count = len(rows)
    out, maps, speeds = np.empty((count, 8, 2)), np.empty((count, 6, 6)), np.empty(count)
    _write_views(*as_inputs(rows, accelerations), sight, *as_inputs(corners), out, maps, speeds)
    return out, maps, speeds


def corners_of_poses(position: Array, rotation: Array, side: float) -> Array:
    """Return the corners (N, 8) of tags at poses (N, 3), (N, 3, 3) in the camera, side in m."""
    points = np.pad(0.5 * side * np.array(CORNERS), ((0, 0), (0, 1)))
    places = position[:, None] + np.einsum('nij,cj->nci', rotation, points)
    depth = np.maximum(places[..., 2:], LEAST_DEPTH)
    return np.asarray((places[..., :2] / depth).reshape(-1, 8))


Sensor = tuple[bool, float, float, Vector, Matrix, float, float]
"""
Fields in order: whether a tag is measured instead of a tracked body; standard deviations of a pose
(m, rad), or the numbers of `CornerNoise`; and for a tag the position (m) and axes of the camera in
the world, half the tag's side (m), and the exposure (s).
"""


@kernel
def equivalent_pose(
    body: State, acceleration: tuple[Vector, Vector], sight: Sight, sensor: Sensor, seen: Any
) -> tuple[Array, Array]:
    """
    Return the shift and rotation (6,) from a body to the pose measured in one view.

    The second result is the covariance (6, 6) of shift and rotation. Both are of first order, in
    body axes, and contain all information of the view. The corners have independent errors, and a
    mean error of the same standard deviation: detected tags err by 0.3 to 0.8 mm across the line
    of sight, twice to four times the error by independent corners.
    """
    rows, accelerations = np.empty((1, 13)), np.empty((1, 6))
    write_row(rows[0], (body[0], body[1], body[2], body[3]))
    for i in range(3):
        accelerations[0, i], accelerations[0, 3 + i] = acceleration[0][i], acceleration[1][i]
    out, maps, speed = np.empty((1, 8, 2)), np.empty((1, 6, 6)), np.empty(1)
    _write_views(rows, accelerations, sight, seen, out, maps, speed)
    blur = sensor[6] * sensor[6]
    growth = sensor[2] * blur * speed[0] * speed[0]
    variance = sensor[1] * sensor[1] + growth * growth
    inverse, x = np.zeros((6, 6)), np.zeros(6)
    for i in range(5, -1, -1):
        diagonal = maps[0, i, i]
        if abs(diagonal) < LEAST_SLOPE:
            diagonal = LEAST_SLOPE
        inverse[i, i] = 1.0 / diagonal
        for j in range(i + 1, 6):
            for k in range(i + 1, j + 1):
                inverse[i, j] -= maps[0, i, k] * inverse[k, j] / diagonal
    for i in range(6):
        for j in range(6):
            x[i] += inverse[i, j] * (out[0, j, 0] - blur / 24.0 * out[0, j, 1])
    noise = _times_transposed(inverse, variance)
    # the mean error of the corners shifts the tag across the line of sight
    R = t3.multiply(t3.transposed(sight[1]), t3.rotation_matrix(body[1]))
    centre = t3.add(body[0], t3.apply(t3.rotation_matrix(body[1]), sight[2]))
    depth = t3.apply_transposed(sight[1], t3.subtract(centre, sight[0]))[2]
    for i in range(3):
        for j in range(3):
            noise[i, j] += variance * depth * depth * (R[i] * R[j] + R[3 + i] * R[3 + j])
    return x, noise


@kernel
def _times_transposed(A: Array, factor: float) -> Array:
    """Return the product of a matrix (6, 6), its transpose and a factor."""
    out = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(6):
                out[i, j] += factor * A[i, k] * A[j, k]
    return out


class CornerNoise(NamedTuple):
    """
    Standard deviation of a corner: sigma^2 + (growth smear^2)^2.

    Parameters
    ----------
    sigma : float
        At rest, rad: pixels over the focal length.
    growth : float
        Growth with the square of the smear by motion during the exposure, 1/rad.

    """

    sigma: float = 3e-4
    growth: float = 30.0

    def variance(self, smear: Array, frames: Array) -> Array:
        """Return the variances (N,) of corners, rad^2, from smears (rad) and numbers of frames."""
        return np.asarray((self.sigma**2 + (self.growth * smear**2) ** 2)
                          * ((1.0 - SAME_VIEW) + SAME_VIEW * frames))

    def estimated(self, smear: Array, squares: Array) -> tuple[CornerNoise, float]:
        """
        Return the noise of corners with the squares (N,) of residuals relative to this noise.

        The second result is the RMS change of the standard deviations.
        """
        from scipy.optimize import nnls  # for fits: the node loads no optimizer

        units = np.column_stack([np.ones(len(smear)), smear**4])
        now = units @ np.square(self)
        found = np.square(self)
        for _ in range(4):  # weights follow the noise
            expected = np.maximum(units @ found, 1e-3 * now)
            found = nnls(units / expected[:, None], squares * now / expected)[0]
            found[0] = max(found[0], MIN_CORNER_STD**2)
        return CornerNoise(*np.sqrt(found).tolist()), float(
            np.sqrt(np.mean(np.square(units @ found / now - 1.0))))


def frames_of(corners: Array) -> Array:
    """Return the number (N,) of frames of each view, in which no corner (N, 8) moves."""
    still = np.abs(np.diff(corners, axis=0)).max(axis=1) < SAME_IMAGE
    view = np.append(0, np.cumsum(~still))
    return np.asarray(np.bincount(view)[view], float)


@dataclass(frozen=True, eq=False)
class Tag:
    """
    A detected tag and the camera that sees it.

    Parameters
    ----------
    side : float
        Side of the tag, m.
    noise : CornerNoise
    exposure : float
        Exposure time, s; 0 for `USUAL_EXPOSURE` of the camera's period.
    T_world_camera : ndarray (4, 4)
        Pose of the camera in the world of the tag's poses.

    """

    side: float
    noise: CornerNoise = CornerNoise()
    exposure: float = 0.0
    T_world_camera: Array = field(default_factory=partial(np.eye, 4))

    def moved(self, T: Array) -> Tag:
        """Return the tag in another world, in which the tag's world has a pose (4, 4)."""
        return replace(self, T_world_camera=T @ self.T_world_camera)


USUAL_NOISE = CornerNoise()
"""Noise of the corners of an unknown detector."""


class Seen(NamedTuple):
    """
    Views of a tag about a simulated package.

    Fields in order: residuals (N, 6), rad; their negative derivatives by the unknowns (N, 6, p)
    and by the package's error (N, 6, 6); their variances (N,), rad^2; smears (N,) by motion during
    the exposure, rad; effect (6,) of a residual on the pose, m and rad per rad.
    """

    residuals: Array
    columns: Array
    maps: Array
    variance: Array
    smear: Array
    scale: Array


@dataclass(frozen=True, eq=False)
class TagViews:
    """
    Corners of a tag on a package.

    Parameters
    ----------
    tag : Tag
    stamps_ns : ndarray (N,)
    corners : ndarray (N, 8)
    frames : ndarray (N,)
        Number of frames of each view.
    T_package_tag : ndarray (4, 4)
        Pose of the tag in B.

    """

    tag: Tag
    stamps_ns: Stamps
    corners: Array
    frames: Array
    T_package_tag: Array

    @classmethod
    def of(cls, tag: Tag, stream: PoseStream, T_package_tag: Array) -> TagViews:
        """Return the views of recorded poses, from recorded corners or corners of the poses."""
        corners = stream.corners
        if corners is None:
            R = tag.T_world_camera[:3, :3].T
            corners = corners_of_poses(
                lie.apply(R, stream.position - tag.T_world_camera[:3, 3]), R @ stream.rotation,
                tag.side)
        return cls(tag, stream.stamps_ns, corners, frames_of(corners), T_package_tag)

    def at(self, stamps_ns: Stamps) -> TagViews:
        """Return the views nearest to some stamps."""
        middles = self.stamps_ns[:-1] + np.diff(self.stamps_ns) // 2
        return self.select(np.searchsorted(middles, stamps_ns))

    def select(self, chosen: Places | Mask) -> TagViews:
        """Return chosen views."""
        return replace(self, stamps_ns=self.stamps_ns[chosen], corners=self.corners[chosen],
                       frames=self.frames[chosen])

    @property
    def sight(self) -> Sight:
        """Camera and tag for kernels."""
        (o, R), (c, R_tag) = ((
            (float(T[0, 3]), float(T[1, 3]), float(T[2, 3])), matrix_of(T[:3, :3].ravel().tolist())
        ) for T in (self.tag.T_world_camera, self.T_package_tag))
        return o, R, c, R_tag, 0.5 * self.tag.side

    @property
    def exposure(self) -> float:
        """Exposure time, s."""
        period = float(np.median(np.diff(self.stamps_ns))) / NS_PER_S
        return self.tag.exposure or USUAL_EXPOSURE * period

    def corrected(self, values: poses.Nuisances, moves: Array, middle: Array) -> TagViews:
        """Return the views corrected by values of the nuisances."""
        origin = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.eye(3)[None])
        T = self.tag.T_world_camera
        camera, package = (poses.poses_of(at, {
            name: values[name] for name in names if name in values}, moves, middle)
            for at, names in (
                (replace(origin, position=T[None, :3, 3], rotation=T[None, :3, :3]),
                 ('package_world',)), (origin, ('com', 'package_marker'))))
        T_before_package = lie.transform(package.rotation[0], package.position[0])
        return replace(self, tag=replace(
            self.tag, side=self.tag.side * (1.0 + float(values.get('scale', (0.0,))[0])),
            T_world_camera=lie.transform(camera.rotation[0], camera.position[0])),
            T_package_tag=lie.inverse_transform(T_before_package) @ self.T_package_tag)

    def seen(
        self, motion: Array, noise: CornerNoise, values: poses.Nuisances,
        places: Mapping[str, Places], units: Array, context: poses.Context,
    ) -> Seen:
        """
        Return the residuals of the views about a simulated package.

        Parameters
        ----------
        motion : ndarray (N, 19)
            The package at the views: its state, and derivatives of its velocity and its rate in
            body axes, m/s^2 and rad/s^2.
        noise : CornerNoise
            Noise of the corners.
        values, places, units, context
            Nuisances, as in `body.columns_of`.

        """
        at = self.corrected(values, *context[:2])
        package = Trajectory(
            self.stamps_ns, motion[:, :3], lie.quaternion_to_rotation(motion[:, 3:7]))
        out, maps, speed = views(motion[:, :13], motion[:, 13:], at.sight, self.corners)
        tag = package.position + lie.apply(package.rotation, at.T_package_tag[:3, 3])
        columns = poses.columns_of(
            package, values, places, len(units), context, replace(package, position=tag))
        for name in places.keys() & poses.CLOCKS:
            columns[:, :, places[name]] *= motion[:, 7:13, None]
        columns, exposure = maps @ columns, self.exposure
        change = 1.0 + float(values.get('exposure', (0.0,))[0])
        mean = exposure**2 / 24.0
        columns[:, :, places.get('exposure', [])] = 2.0 * mean * change * out[:, :6, 1:]
        inverse = np.linalg.inv(np.mean(np.swapaxes(maps, 1, 2) @ maps, axis=0))
        return Seen(
            out[:, :6, 0] - mean * change**2 * out[:, :6, 1], columns * units, maps,
            noise.variance(exposure * speed, self.frames), exposure * speed,
            np.sqrt(np.diag(inverse)))

    def errors(self, package: Trajectory) -> tuple[Array, Array]:
        """Return measured minus predicted corners (N, 8) of a package, and variances (N,)."""
        still = np.zeros((len(package), 6))
        twist = still if package.twist is None else package.twist
        rows = np.column_stack([
            package.position, lie.rotation_to_quaternion(package.rotation), twist])
        out, _, speed = views(rows, still, self.sight, self.corners)
        return out[:, :, 0], self.tag.noise.variance(self.exposure * speed, self.frames)

    def poses_near(self, package: Trajectory) -> tuple[Trajectory, Array]:
        """
        Return the poses of B for the corners, near predicted poses, and RMS errors (6,).

        A wide prior about the predicted pose selects one of the two solutions of a flat tag.
        """
        position, rotation, still = package.position, package.rotation, np.zeros((len(package), 6))
        twist = still if package.twist is None else package.twist
        for _ in range(NEAR_ITERATIONS):
            rows = np.column_stack([position, lie.rotation_to_quaternion(rotation), twist])
            out, maps, speed = views(rows, still, self.sight, self.corners)
            variance = self.tag.noise.variance(self.exposure * speed, self.frames)[:, None]
            prior = variance / NEAR**2
            back = np.hstack([
                lie.apply(np.swapaxes(rotation, 1, 2), package.position - position),
                lie.log_so3(np.swapaxes(rotation, 1, 2) @ package.rotation)])
            inverse = np.linalg.inv(
                np.swapaxes(maps, 1, 2) @ maps + prior[:, :, None] * np.eye(6))
            step = lie.apply(inverse, lie.apply(
                np.swapaxes(maps, 1, 2), out[:, :6, 0]) + prior * back)
            position = position + lie.apply(rotation, step[:, :3])
            rotation = rotation @ lie.exp_so3(step[:, 3:])
        std = np.sqrt(np.mean(variance * np.einsum('nii->ni', inverse), axis=0))
        return Trajectory(package.stamps_ns, position, rotation, valid=package.valid), std
