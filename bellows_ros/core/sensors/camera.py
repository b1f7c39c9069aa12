"""
Corners of a detected tag: from pixels to directions, and the pose of a tag that shows them.

Directions are coordinates (X/Z, Y/Z) in the camera's frame, as an undistorted camera of unit focal
length shows them. The distortion models follow sensor_msgs/CameraInfo, with the coefficients of
OpenCV: k1, k2, p1, p2, k3 of `plumb_bob`, and also k4, k5, k6 of `rational_polynomial`.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.sensors.corners import CORNERS
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

DISTORTIONS = {'': 0, 'plumb_bob': 5, 'rational_polynomial': 8}
"""Distortion models with their number of coefficients."""

UNDISTORTION_STEPS = 50
"""Largest number of iterations for the direction of a distorted corner."""

UNDISTORTED = 1e-9
"""Largest error of the direction (X/Z, Y/Z) of a distorted corner after the iterations."""
POSE_STEPS = 10
"""Number of Gauss-Newton steps to the pose of a tag; each step reduces the error tenfold."""

LEAST_AREA = 1e-8
"""Smallest area of a tag in the image of unit focal length; about a hundredth of a pixel."""

MAX_DIRECTION = 100.0
"""Largest coordinate X/Z or Y/Z that a camera sees: 89.4 degrees from its axis."""

MAX_KEPT = 8
"""Largest number of cameras, and of tags of one view, that a live input stores."""

MIN_SHARE = 0.02
"""Smallest share of the views of the most frequent tag: a tag in fewer is a false detection."""

RECENT = 100
"""Number of views in which a live input counts tags: one false detection is below `MIN_SHARE`."""


class Camera(NamedTuple):
    """Camera matrix (9), distortion model and coefficients of the image of a detector."""

    matrix: tuple[float, ...]
    model: str
    coefficients: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class CornerViews:
    """
    Views of the four corners of one tag.

    Parameters
    ----------
    name : str
        Topic of the detections.
    frame_id : str
        Frame of the camera, z along its line of sight.
    tag : str
        Family and number of the tag.
    stamps_ns : int array (N,)
        Increasing header stamps, ns.
    corners : array (N, 4, 2)
        Directions (X/Z, Y/Z) of the corners in the order of the detector.
    calibration : str
        Topic of the camera's calibration.
    refused : mapping of str to tuple of int
        Indices of omitted messages by reason.
    focal : float
        Focal length of the camera, pixels.

    """

    name: str
    frame_id: str
    tag: str
    stamps_ns: Stamps
    corners: Array
    calibration: str = ''
    refused: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    focal: float = 0.0

    def poses(self, side: float) -> PoseStream:
        """Return the poses in the camera, with corners, of a tag with a side (m)."""
        position, rotation = poses_of_corners(self.corners, side)
        return PoseStream(self.name, self.frame_id, self.stamps_ns, position, rotation,
                          self.refused, corners=self.corners.reshape(-1, 8),
                          calibration=self.calibration, focal=self.focal)


class TagCamera:
    """
    The poses of a tag in the messages of a camera, one at a time.

    Messages are of sensor_msgs and apriltag_msgs, or objects with the same fields.
    """

    def __init__(self) -> None:
        self._cameras = dict[str, Camera]()
        self._views = deque[Collection[str]](maxlen=RECENT)

    @property
    def tags(self) -> list[str]:
        """The names of the tags in the latest views."""
        return sorted(tags_of(self._views))

    def calibrate(self, info: Any, is_rectified: bool) -> None:
        """Use a CameraInfo for the images of its frame; raise BellowsError if it has no camera."""
        camera = camera_of(info, is_rectified)
        if self._cameras.get(info.header.frame_id) != camera:
            directions(np.zeros((1, 2)), *camera)
            self._cameras[info.header.frame_id] = camera
            if len(self._cameras) > MAX_KEPT:
                del self._cameras[next(iter(self._cameras))]

    def pose(
        self, array: Any, side: float, name: str = ''
    ) -> tuple[Array, Array] | str:
        """
        Return position (3,) and rotation (3, 3) of a tag with a side (m) in the camera.

        Without a pose, the result is the reason as a string, '' if the tag is not visible.
        """
        now = tags_in(array)
        if sought := sorted(tags_of([now], name)):
            self._views.append(sought[:MAX_KEPT])
        tags = tags_of(self._views, name)
        if len(tags) > 1:
            return 'tag_several'
        seen = [corners for tag in tags for corners in now.get(tag, ())]
        if len(seen) != 1:
            return 'tag_twice' if seen else ''
        if (camera := self._cameras.get(array.header.frame_id)) is None:
            return 'tag_no_camera'
        is_shown, position, rotation = tags_shown(directions(np.array(seen), *camera))
        return (side * position[0], rotation[0]) if is_shown[0] else 'tag_no_pose'


def camera_of(info: Any, is_rectified: bool) -> Camera:
    """
    Return the camera of a CameraInfo: K with the distortion, or P of the rectified image.

    P is also used if it alone is given. Both matrices are of the full image: region of interest
    and binning apply as sensor_msgs/CameraInfo defines them.
    """
    is_rectified = is_rectified or not any(info.k)
    matrix = np.array([*info.p[0:3], *info.p[4:7], *info.p[8:11]] if is_rectified else info.k)
    matrix = matrix.reshape(3, 3)
    matrix[:2, 2] -= info.roi.x_offset, info.roi.y_offset
    matrix[:2] /= np.maximum([[info.binning_x], [info.binning_y]], 1)
    lens = ('', ()) if is_rectified else (info.distortion_model, tuple(info.d))
    return Camera(tuple(matrix.ravel().tolist()), *lens)


def tags_in(array: Any) -> dict[str, list[list[tuple[float, float]]]]:
    """
    Return the corners (pixels) of the tags in an AprilTagDetectionArray, by family and number.

    Detections with wrong bits are omitted: most of them show no tag.
    """
    tags = defaultdict(list)
    for each in array.detections:
        if not each.hamming:
            tags[f'{each.family:.40}:{each.id}'].append([(at.x, at.y) for at in each.corners])
    return tags


def tags_of(views: Iterable[Collection[str]], name: str = '') -> dict[str, int]:
    """Return the tags, or one by family and number, with their views; without false ones."""
    counts = Counter(tag for view in views for tag in view if name in ('', tag))
    least = MIN_SHARE * max(counts.values(), default=0)
    return {tag: count for tag, count in counts.items() if count >= least}


def tags_shown(corners: Array) -> tuple[Mask, Array, Array]:
    """
    Return a mask (N,) of directions (N, 4, 2) of a tag before the camera, and M poses.

    Positions are of tags with a side of 1 m; NaN shows no tag.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    after = np.roll(edges, -1, axis=1)
    turns = edges[..., 0] * after[..., 1] - edges[..., 1] * after[..., 0]
    shown = (np.abs(turns).min(axis=1) > LEAST_AREA) & (np.abs(np.sign(turns).sum(axis=1)) == 4)
    position, rotation = poses_of_corners(corners[shown], 1.0)
    before = (position[:, 2] > 0.0) & np.isfinite(rotation).all(axis=(1, 2))
    shown[shown] = before
    return np.asarray(shown), position[before], rotation[before]


def directions(
    pixels: Array, matrix: ArrayLike, model: str, coefficients: ArrayLike
) -> Array:
    """
    Return the coordinates X/Z and Y/Z of pixels, NaN for pixels outside of the lens model.

    Parameters
    ----------
    pixels : array (..., 2)
        Pixels x, y of the raw image.
    matrix : array (3, 3)
        Camera matrix K of the raw image.
    model : str
        One of `DISTORTIONS`.
    coefficients : array (D,)
        Coefficients of the model, fewer if the last ones are 0.

    Raises
    ------
    BellowsError
        For an unknown model, or a matrix of no camera.

    """
    if model not in DISTORTIONS:
        raise BellowsError(
            f"The camera's distortion model is '{model:.40}'; known are plumb_bob and "
            'rational_polynomial. Detect tags in the rectified image, and record its camera_info.')
    K = np.asarray(matrix, float).reshape(3, 3)
    if not (np.isfinite(K).all() and K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise BellowsError(f'The camera is not calibrated: its camera_info has fx {K[0, 0]:g}'
                           f' and fy {K[1, 1]:g}. Calibrate it, and record again.')
    k = np.zeros(8)
    given = np.ravel(coefficients)[:DISTORTIONS[model]]
    k[:len(given)] = given
    with np.errstate(all='ignore'):
        seen = (np.asarray(pixels, float) - K[:2, 2]) / K[[0, 1], [0, 1]]
        seen[..., 0] -= K[0, 1] / K[0, 0] * seen[..., 1]
        found = seen.copy()
        for _ in range(UNDISTORTION_STEPS):
            error = distorted(found, k) - seen
            if not k.any() or np.nanmax(np.abs(error), initial=0.0) < UNDISTORTED:
                break
            found -= error
        wrong = ~((np.abs(distorted(found, k) - seen) < UNDISTORTED)
                  & (np.abs(found) < MAX_DIRECTION)).all(axis=-1)
    found[wrong] = np.nan
    return np.asarray(found)


def distorted(direction: Array, k: Array) -> Array:
    """
    Return directions (..., 2) as a lens with coefficients k (8,) shows them.

    Source: OpenCV, camera calibration: x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 +
    k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and the same formula for y.
    """
    x, y = direction[..., 0], direction[..., 1]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (
        1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    return np.stack([
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y], axis=-1)


def poses_of_corners(corners: Array, side: float) -> tuple[Array, Array]:
    """
    Return the poses of tags in the camera, the least squares of their corners.

    A flat tag has a second pose with nearly the same corners.

    Parameters
    ----------
    corners : array (N, 4, 2)
        Directions of the corners, in the order of `CORNERS`.
    side : float
        Side of the tag, m.

    Returns
    -------
    position : array (N, 3)
        Middle of the tag, m.
    rotation : array (N, 3, 3)
        R_camera_tag.

    """
    plane = 0.5 * side * np.array(CORNERS)
    position, rotation = _from_homography(corners, plane)
    points = np.pad(plane, ((0, 0), (0, 1)))
    for _ in range(POSE_STEPS):
        arms = np.einsum('nij,cj->nci', rotation, points)
        places = position[:, None] + arms
        depth = np.maximum(places[..., 2:], 1e-3)
        seen = places[..., :2] / depth
        by_place = np.concatenate(
            [np.broadcast_to(np.eye(2), (*seen.shape, 2)), -seen[..., None]], -1)
        by_place /= depth[..., None]
        J = np.concatenate([by_place, -by_place @ lie.hat(arms)], -1).reshape(len(seen), 8, 6)
        step = np.linalg.pinv(J, rcond=1e-6) @ (corners - seen).reshape(-1, 8, 1)
        position = position + step[:, :3, 0]
        rotation = lie.exp_so3(step[:, 3:, 0]) @ rotation
    return position, rotation


def _from_homography(corners: Array, plane: Array) -> tuple[Array, Array]:
    """Return poses from the homographies of a plane's corners (4, 2) to directions (N, 4, 2)."""
    x, y = np.broadcast_to(plane, corners.shape)[..., 0], np.broadcast_to(
        plane, corners.shape)[..., 1]
    one, none = np.ones_like(x), np.zeros((*x.shape, 3))
    p, flat = np.stack([x, y, one], -1), corners[..., None]
    rows = np.concatenate([
        np.concatenate([p, none, -flat[..., 0, :] * p], -1),
        np.concatenate([none, p, -flat[..., 1, :] * p], -1)], 1)
    H = np.linalg.svd(rows)[2][:, -1].reshape(-1, 3, 3)
    H = H * np.where(H[:, 2, 2] < 0.0, -1.0, 1.0)[:, None, None]
    H = H / np.sqrt(np.linalg.norm(H[:, :, 0], axis=1) * np.linalg.norm(H[:, :, 1], axis=1)
                    )[:, None, None]
    U, _, V = np.linalg.svd(H[:, :, :2], full_matrices=False)
    first = U @ V
    return H[:, :, 2], np.concatenate(
        [first, np.cross(first[..., 0], first[..., 1])[..., None]], axis=2)
