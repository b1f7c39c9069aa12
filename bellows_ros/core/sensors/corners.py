"""
A flat tag, measured by the directions of its four corners in the camera.

In the camera's frame a corner has the image (X/Z, Y/Z), the coordinates of an undistorted pinhole
camera of unit focal length. The residual of a view is the difference of its eight measured and
predicted coordinates. Errors of corners are nearly white and equal, while a pose made from them
errs in depth and tilt many times more, and has a second solution. Every pose of a tag can be
turned back into its corners, with either solution.

Derivatives are by the package's error: shift and rotation in body axes, as of `pose_error`. With
their QR factors J = Q R, the six numbers Q^T r with the derivative R have all information on the
pose; the other two directions of a view have none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.equilibrium import moved
from bellows_ros.core.model.kernels import matrix_of, State
from bellows_ros.core.model.simulation import row_state
import numpy as np

CORNERS = (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)
"""Corners of a tag in its own axes, in units of half its side, in the order of OpenCV and of the
AprilTag library."""

LEAST_DEPTH = 0.05
"""Smallest distance of a corner from the camera along its axis, the limit of focus, m."""

SAME_IMAGE = 3e-4
"""Largest motion of the corners between two frames of one view, rad: a third of a pixel."""

SAME_VIEW = 0.8
"""Share of a corner's variance that all frames of one view have in common."""

EXPOSURE_STEP = 1e-3
"""Time (s) before and after an exposure for the acceleration of the corners."""

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
    """Reflect column j of X by the vector in column k of J, with half of its square."""
    along = 0.0
    for i in range(k, 8):
        along += J[i, k] * X[i, j]
    along /= square
    for i in range(k, 8):
        X[i, j] -= along * J[i, k]


@entry
def _write_views(
    rows: Any, accelerations: Any, sight: Sight, corners: Any, out: Any, maps: Any, smears: Any
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
        smears[n] = 0.0
        for i in range(8):
            X[i, 0] = corners[n][i] - image[i]
            X[i, 1] = (after[i] - 2.0 * image[i] + before[i]) / (h * h)
            smears[n] += (after[i] - before[i]) ** 2 / (16.0 * h * h)
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
        The package at the exposures, see `row_state`.
    accelerations : ndarray (N, 6)
        Derivatives of its velocity and its rate in body axes, m/s^2 and rad/s^2.
    sight : tuple
        Camera and tag.
    corners : ndarray (N, 8)
        Measured corners.

    Returns
    -------
    ndarray (N, 8, 2)
        Q^T times the residual (rad) and the acceleration of the image (rad/s^2), by which a mean
        over an exposure T differs by T^2/24. The last two rows do not depend on the pose.
    ndarray (N, 6, 6)
        Derivatives R by the package's error.
    ndarray (N,)
        Speed of the corners in the image, RMS, rad/s.

    """
    count = len(rows)
    out, maps, squares = np.empty((count, 8, 2)), np.empty((count, 6, 6)), np.empty(count)
    _write_views(*as_inputs(rows, accelerations), sight, *as_inputs(corners), out, maps, squares)
    return out, maps, np.sqrt(squares)


def corners_of_poses(position: Array, rotation: Array, side: float) -> Array:
    """Return the corners (N, 8) of tags at poses (N, 3), (N, 3, 3) in the camera, side in m."""
    points = np.pad(0.5 * side * np.array(CORNERS), ((0, 0), (0, 1)))
    places = position[:, None] + np.einsum('nij,cj->nci', rotation, points)
    depth = np.maximum(places[..., 2:], LEAST_DEPTH)
    return np.asarray((places[..., :2] / depth).reshape(-1, 8))


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
        """Return the variances (N,) of corners, rad^2, with smears (rad) and frames a view."""
        return np.asarray((self.sigma**2 + (self.growth * smear**2) ** 2)
                          * ((1.0 - SAME_VIEW) + SAME_VIEW * frames))


def frames_of(corners: Array) -> Array:
    """Return the number (N,) of frames of each view, in which no corner (N, 8) moves."""
    still = np.abs(np.diff(corners, axis=0)).max(axis=1) < SAME_IMAGE
    view = np.append(0, np.cumsum(~still))
    return np.asarray(np.bincount(view)[view], float)


def sight_of(T_world_camera: Array, T_package_tag: Array, side: float) -> Sight:
    """Return the sight of a camera (4, 4) and a tag (4, 4) of a side, m."""
    def parts(T: Array) -> tuple[Vector, Matrix]:
        x, y, z = T[:3, 3].tolist()
        return (x, y, z), matrix_of(T[:3, :3].ravel().tolist())

    return *parts(T_world_camera), *parts(T_package_tag), 0.5 * side


def pose_in_camera(T_world_camera: Array, position: Array, rotation: Array) -> tuple[
        Array, Array]:
    """Return poses (N, 3), (N, 3, 3) in a world as poses in the camera (4, 4)."""
    R = T_world_camera[:3, :3].T
    return lie.apply(R, position - T_world_camera[:3, 3]), R @ rotation
