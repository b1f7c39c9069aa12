"""
Plans as messages: MultiDOFJointTrajectory and Path as CDR, all points at once, JointTrajectory.

Points lie in memory with one spacing, as doubles are aligned to 8: NumPy reads and writes a plan
of 2,000 points in the time in which Python objects of 20 are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
import struct
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import apply, rotation_to_quaternion
from bellows_ros.core.parameters.table import short
from bellows_ros.core.planning.points import require_count
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.messages import HEAD, Reader, with_number, with_text
import numpy as np

MULTI_DOF = 'trajectory_msgs/msg/MultiDOFJointTrajectory'
PATH = 'nav_msgs/msg/Path'


@dataclass(frozen=True, eq=False)
class PlanMessage:
    """
    A plan as messages have it.

    Parameters
    ----------
    stamp_ns : int
        Of the header, ns; 0 where the plan starts when the tool starts.
    frame_id : str
    names : tuple of str
        Of the joint, that is of what moves.
    times_ns : int array (N,)
        From the start, ns.
    poses : array (N, 7)
        Position (m) and quaternion xyzw.
    twists, accelerations : array (N, 6) or None

    """

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    times_ns: Stamps
    poses: Array
    twists: Array | None = None
    accelerations: Array | None = None

    def __post_init__(self) -> None:
        """Refuse several names for the one transform of each point."""
        if len(self.names) > 1:
            raise BellowsError(
                f"The plan has the joint names {', '.join(self.names)}, but points with 1 "
                'transform; expected 1 name. Send a plan of the tool alone.')


def decode_multi_dof(data: bytes) -> PlanMessage:
    """
    Decode a MultiDOFJointTrajectory of one joint.

    Raises
    ------
    BellowsError
        If it is damaged, has several joints or names, or points that differ in what they have.

    """
    reader = Reader(data)
    stamp_ns = reader.number('i') * NS_PER_S + reader.number()
    frame_id = reader.text()
    names = tuple(reader.text() for _ in range(min(reader.number(), 100)))
    count = reader.number()
    require_count(count, 'The plan')
    first = reader.at
    parts = tuple(reader.skip_list(doubles) for doubles in (7, 6, 6))
    if parts[0] != 1 or max(parts) > 1:
        raise BellowsError(
            f'The plan has points with {parts[0]} transforms, {parts[1]} velocities and '
            f'{parts[2]} accelerations; expected 1 transform, and 0 or 1 of the others: a plan is '
            'of one thing, the tool.')
    reader.at = first
    # The first point may be padded differently.
    rows = [_points(reader, parts, 1), _points(reader, parts, count - 1)]
    times = [each['sec'].astype(np.int64) * NS_PER_S + each['nanosec'] for each in rows]
    poses, twists, accelerations = (
        np.concatenate([each[name] for each in rows]).astype(float) if size else None
        for name, size in zip('abc', parts, strict=True))
    assert poses is not None  # parts[0] is 1
    return PlanMessage(
        stamp_ns, frame_id, names, np.concatenate(times), poses, twists, accelerations)


def _points(reader: Reader, parts: tuple[int, ...], count: int) -> np.ndarray:
    """Return points with equal layout; their parts are called a, b and c."""
    rows = reader.rows(_point(reader.order, reader.at % 8, parts), count)
    for name, size in zip('abc', parts, strict=True):
        if (rows[f'n{name}'] != size).any():
            raise BellowsError(
                'The plan has points that differ in what they have; expected the same of all: '
                'velocities and accelerations of every point, or of none.')
    reader.at += rows.nbytes
    return rows


@cache
def _point(order: str, offset: int, parts: tuple[int, ...]) -> np.dtype[np.void]:
    """Return the layout of a point that begins 0 or 4 bytes behind a multiple of 8."""
    names, formats, offsets, at = [], [], [], offset
    for name, size, doubles in zip('abc', parts, (7, 6, 6), strict=True):
        names.append(f'n{name}')
        formats.append(f'{order}u4')
        offsets.append(at - offset)
        at += 4
        if size:
            at += -at % 8
            names.append(name)
            formats.append(f'({doubles},){order}f8')
            offsets.append(at - offset)
            at += 8 * doubles
    names += ['sec', 'nanosec']
    formats += [f'{order}i4', f'{order}u4']
    offsets += [at - offset, at + 4 - offset]
    return np.dtype({
        'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': at + 8 - offset})


def encode_multi_dof(plan: PlanMessage) -> bytes:
    """Encode a MultiDOFJointTrajectory of one joint, little-endian."""
    head = _header(plan.stamp_ns, plan.frame_id)
    head = with_number(head, len(plan.names))
    for name in plan.names:
        head = with_text(head, name)
    head = with_number(head, len(plan.times_ns))
    parts = (1, int(plan.twists is not None), int(plan.accelerations is not None))
    values = (plan.poses, plan.twists, plan.accelerations)
    pieces, at = [head], len(head)
    for part in (slice(0, 1), slice(1, None)):
        dtype = _point('<', at % 8, parts)
        rows = np.zeros(len(plan.times_ns[part]), dtype)
        rows['sec'], rows['nanosec'] = np.divmod(plan.times_ns[part], NS_PER_S)
        for name, size, value in zip('abc', parts, values, strict=True):
            rows[f'n{name}'] = size
            if value is not None:
                rows[name] = value[part]
        pieces.append(rows.tobytes())
        at += len(pieces[-1])
    return HEAD + b''.join(pieces)


def encode_path(stamp_ns: int, frame_id: str, times_ns: Stamps, poses: Array) -> bytes:
    """Encode a Path, little-endian: poses (N, 7) at times (ns) from the stamp."""
    head = with_number(_header(stamp_ns, frame_id), len(times_ns))
    text = frame_id.encode() + b'\0'
    pieces, at = [head], len(head)
    for part in (slice(0, 1), slice(1, None)):
        offset = at % 8
        pose = offset + 12 + len(text)
        pose += -pose % 8 - offset
        dtype = np.dtype({
            'names': ['sec', 'nanosec', 'size', 'text', 'pose'],
            'formats': ['<i4', '<u4', '<u4', f'S{len(text)}', '(7,)<f8'],
            'offsets': [0, 4, 8, 12, pose], 'itemsize': pose + 56})
        rows = np.zeros(len(times_ns[part]), dtype)
        rows['sec'], rows['nanosec'] = np.divmod(stamp_ns + times_ns[part], NS_PER_S)
        rows['size'], rows['text'], rows['pose'] = len(text), text, poses[part]
        pieces.append(rows.tobytes())
        at += len(pieces[-1])
    return HEAD + b''.join(pieces)


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """Return a header."""
    return with_text(struct.pack('<iI', *divmod(stamp_ns, NS_PER_S)), frame_id)


def require_frame(frame_id: str, values: Mapping[str, Any]) -> None:
    """
    Refuse a plan in a frame other than plan.frame, or one that moves with the tool.

    Raises
    ------
    BellowsError
        If plan.frame names another one, or the frame is that of the tool, the lip or the package.

    """
    wanted = values['plan.frame']
    if frame_id in (values['frames.tool'], values['frames.lip'], values['frames.package']):
        raise BellowsError(
            f"The plan is in frame '{short(frame_id)}', which moves; expected one in which "
            "gravity keeps its direction, such as the arm's base. Transform the plan.")
    if wanted and frame_id not in ('', wanted):
        raise BellowsError(
            f"The plan is in frame '{short(frame_id)}'; expected plan.frame, '{wanted}'. "
            'Transform the plan, or set plan.frame.')


def plan_message(
    motion: Trajectory, stamp_ns: int, frame_id: str, name: str, axes: str
) -> PlanMessage:
    """Return a motion as the plan of a body, with twists in axes of the 'world' or its own."""
    twist = np.asarray(motion.twist)
    if axes == 'world':
        twist = apply(motion.rotation[:, None], twist.reshape(-1, 2, 3)).reshape(-1, 6)
    return PlanMessage(
        stamp_ns, frame_id, (name,), motion.stamps_ns - motion.stamps_ns[0],
        np.hstack([motion.position, rotation_to_quaternion(motion.rotation)]), twist)


class JointPlan(NamedTuple):
    """Positions of an arm's joints over time, rad and m, with rates if given."""

    frame_id: str
    stamp_ns: int
    names: tuple[str, ...]
    times_ns: Stamps
    position: Array
    velocity: Array | None
    acceleration: Array | None


def joint_plan(message: Any) -> JointPlan:
    """Return the points of a JointTrajectory."""
    points, names = message.points, tuple(message.joint_names)
    require_count(len(points), 'The plan')
    position, velocity, acceleration = (
        None if lists is None else np.array(lists, dtype=float) for lists in (
            lists_of(points, part, len(names))
            for part in ('positions', 'velocities', 'accelerations')))
    if position is None:
        raise BellowsError('The plan has points without positions; expected one of each joint.')
    return JointPlan(
        message.header.frame_id, ns_of(message.header.stamp), names, durations_of(points),
        position, velocity, acceleration)


def lists_of(points: Sequence[Any], part: str, count: int) -> list[Any] | None:
    """Return what all points have of a part, or None if no point has any; refuse other numbers."""
    lists = [getattr(point, part, ()) for point in points]
    if not any(len(each) for each in lists):
        return None
    wrong = [i for i, each in enumerate(lists) if len(each) != count]
    if wrong:
        raise BellowsError(
            f'The plan: point {wrong[0]} (the first is 0) has {len(lists[wrong[0]])} {part}; '
            f'expected {count} in every point, one per joint or for the tool, or none at all.')
    return lists


def ns_of(stamp: Any) -> int:
    """Return a stamp or duration in ns, of integers as large as ROS has them."""
    for count, lowest, highest in ((stamp.sec, -2**31, 2**31), (stamp.nanosec, 0, 2**32)):
        if not isinstance(count, int | np.integer) or not lowest <= count < highest:
            raise ValueError(f'{count} as seconds or nanoseconds')
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def durations_of(points: Sequence[Any]) -> Stamps:
    """Return the times of points from the start, ns."""
    return np.array([ns_of(point.time_from_start) for point in points], dtype=np.int64)
