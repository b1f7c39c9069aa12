"""The tool tip E in the frame whose poses are recorded or received: tool_pose.offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply as applied
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory, TwistStream
import numpy as np


def tip_of(values: Mapping[str, Any]) -> Array | None:
    """Return the pose (4, 4) of E in the frame of the tool's poses, None where that is E."""
    text = values.get('tool_pose.offset', '')
    if not text:
        return None
    pose = np.array([float(part) for part in text.split()])
    return lie.transform(lie.quaternion_to_rotation(pose[3:]), pose[:3])


def at_tip(motion: Trajectory, tip: Array | None) -> Trajectory:
    """Return a motion with body twists of the frame at a pose (4, 4) in the one that moves."""
    if tip is None:
        return motion
    twist = motion.twist
    return replace(
        motion, position=motion.position + applied(motion.rotation, tip[:3, 3]),
        rotation=motion.rotation @ tip[:3, :3],
        twist=None if twist is None else twist @ lie.adjoint(lie.inverse_transform(tip)).T)


def from_tip(motion: Trajectory, tip: Array | None) -> Trajectory:
    """Return the motion of the frame in which E, that moves so, has a pose (4, 4)."""
    return at_tip(motion, None if tip is None else lie.inverse_transform(tip))


def streams_at_tip(
    poses: PoseStream, twists: TwistStream | None, tip: Array | None, in_world: bool
) -> tuple[PoseStream, TwistStream | None]:
    """Return recorded poses and twists of E, those of another frame of the tool being given."""
    if tip is None:
        return poses, twists
    moved = replace(
        poses, position=poses.position + applied(poses.rotation, tip[:3, 3]),
        rotation=poses.rotation @ tip[:3, :3])
    if twists is None:
        return moved, None
    R, lever = tip[:3, :3], np.broadcast_to(tip[:3, 3], twists.linear.shape)
    if in_world:  # with the orientation at the nearest pose
        later = np.searchsorted(poses.stamps_ns, twists.stamps_ns).clip(1, len(poses) - 1)
        before = twists.stamps_ns - poses.stamps_ns[later - 1]
        nearest = np.where(before < poses.stamps_ns[later] - twists.stamps_ns, later - 1, later)
        R, lever = np.eye(3), applied(poses.rotation[nearest], tip[:3, 3])
    return moved, replace(
        twists, linear=(twists.linear + np.cross(twists.angular, lever)) @ R,
        angular=twists.angular @ R)
