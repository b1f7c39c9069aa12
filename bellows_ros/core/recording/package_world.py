"""
The transform between the worlds of the tool's and the package's poses.

It brings the package's poses into the frame of the tool's before anything else is done with them.
"""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

LOOKED_AT_HZ = 50.0
"""Poses per second used for the start value."""

SLOWEST = 0.5
"""Fraction of the poses used: the slowest, at which the cup yields least."""

LEAST_TURN = 0.02
"""Smallest rotation (rad) between two poses that determines the rotation between the worlds."""


def pose_of(text: str) -> Array:
    """Return the seven numbers (7,) of recording.package_world."""
    return np.array([float(part) for part in text.split()])


def in_tool_world(package: PoseStream, pose: Array, frame_id: str) -> PoseStream:
    """Return the package's poses in the frame of the tool's, by the pose (7,) of their world."""
    R = lie.quaternion_to_rotation(pose[3:])
    return replace(
        package, frame_id=frame_id, position=pose[:3] + lie.apply(R, package.position),
        rotation=R @ package.rotation)


def closed_form(
    tool: Trajectory, package: Trajectory, length: float, origin_to_lip: Array, turned: bool
) -> Array:
    """
    Return a first guess (7,) of the pose of the package's world in the tool's.

    The slowest poses are taken for those of one rigid body (hand and eye). The turn comes from
    those by which both bodies rotate, or from the rotations themselves where the frames of tool
    and package have the same axes; the position from linear equations.

    Parameters
    ----------
    tool, package : Trajectory
        Each in its own frame.
    length : float
        Of the cup, m.
    origin_to_lip : ndarray (3,)
        From the origin of the package's poses to the lip, in axes of S, m.
    turned : bool
        Whether the package's frame may be turned, and moved sideways, against the lip's.

    Raises
    ------
    BellowsError
        If the two have too few poses in common, or nothing turns where that is needed.

    """
    hand, eye = slow_poses(tool, package)
    R_tool, R_package = hand.rotation, eye.rotation
    below = np.array([0.0, 0.0, -length])
    if turned:
        R = turn_of(R_tool, R_package)
        # o_E + R_E (below - origin_to_lip + (dx, dy, 0)) = R o_M + o
        A = np.concatenate([np.tile(np.eye(3), (len(hand), 1, 1)), -R_tool[:, :, :2]], axis=2)
        b = hand.position + lie.apply(R_tool, below - origin_to_lip) - lie.apply(R, eye.position)
        position = np.linalg.lstsq(A.reshape(-1, 5), b.ravel(), rcond=1e-6)[0][:3]
    else:
        R = lie.mean_rotation(R_tool @ np.swapaxes(R_package, 1, 2))
        position = np.mean(hand.position + lie.apply(R_tool, below - origin_to_lip)
                           - lie.apply(R, eye.position), axis=0)
    return np.concatenate([position, lie.rotation_to_quaternion(R)])


def shifted_pose(pose: Array, R_world_recorded: Array, middle: Array, theta: Array) -> Array:
    """
    Return a pose (7,) of a world after a small motion theta (6,) of it.

    The motion is about a point (3,) and in axes of the levelled world, m and rad.
    """
    level = lie.transform(R_world_recorded, np.zeros(3))
    R = lie.exp_so3(theta[3:])
    move = lie.transform(R, middle + theta[:3] - R @ middle)
    T = lie.inverse_transform(level) @ move @ level @ lie.transform(
        lie.quaternion_to_rotation(pose[3:]), pose[:3])
    return np.concatenate([T[:3, 3], lie.rotation_to_quaternion(T[:3, :3])])


def motion_of(pose: Array, middle: Array) -> Array:
    """Return the motion (6,) about a point (3,) that brings a world to its pose (7,), m, rad."""
    R = lie.quaternion_to_rotation(pose[3:])
    return np.concatenate([pose[:3] + R @ middle - middle, lie.log_so3(R)])


def motion_sentence(theta: Array, std: Array | None = None) -> str:
    """Return by how much the worlds differ (6,), m and rad, with standard errors (6,) if known."""
    sizes = []
    for part, scale, unit in ((slice(3, 6), np.rad2deg(1.0), 'degrees'), (slice(0, 3), 1e3, 'mm')):
        size = float(np.linalg.norm(theta[part]))
        error = '' if std is None else (
            f' ± {scale * np.linalg.norm(theta[part] * std[part]) / max(size, 1e-12):.2g}')
        sizes.append(f'{scale * size:.{2 if scale < 1e3 else 1}f}{error} {unit}')
    return (f'The poses of tool and package are in two worlds, turned by {sizes[0]} and apart '
            f'by {sizes[1]}')


def slow_poses(tool: Trajectory, package: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return valid poses of both at common stamps, the slowest ones."""
    first, last = (pick(tool.stamps_ns[end], package.stamps_ns[end])
                   for pick, end in ((max, 0), (min, -1)))
    count = int((last - first) / NS_PER_S * LOOKED_AT_HZ)
    if count < 20:
        raise BellowsError(
            'The poses of tool and package overlap too little to estimate '
            'recording.package_world. Record longer, or give its seven numbers.'
        )
    stamps = first + np.linspace(0, last - first, count).astype(np.int64)  # exact to the ns
    hand, eye = (resample(body, stamps) for body in (tool, package))
    way = np.linalg.norm(np.gradient(hand.position, axis=0), axis=1)
    turn = np.zeros(count)
    turn[1:] = np.linalg.norm(
        lie.log_so3(np.swapaxes(hand.rotation[:-1], 1, 2) @ hand.rotation[1:]), axis=1)
    speed = way / max(float(np.median(way)), 1e-9) + turn / max(float(np.median(turn)), 1e-9)
    slow = (speed <= np.quantile(speed, SLOWEST)) & hand.valid & eye.valid
    return hand.select(slow), eye.select(slow)


def turn_of(R_tool: Array, R_package: Array) -> Array:
    """Return the rotation between the worlds that makes both bodies rotate alike."""
    pairs = [(first, slice(first, None, len(R_tool) // 15 + 1))
             for first in range(0, len(R_tool), len(R_tool) // 15 + 1)]
    a, b = (np.concatenate([lie.log_so3(R[part] @ R[i].T) for i, part in pairs])
            for R in (R_tool, R_package))
    if np.quantile(np.linalg.norm(a, axis=1), 0.9) < LEAST_TURN:
        raise BellowsError(
            'recording.package_world cannot be estimated: the tool hardly turns in this '
            'recording. Tilt and turn it, best with standstills in between, or give the seven '
            'numbers.'
        )
    return lie.nearest_rotation(a.T @ b)
