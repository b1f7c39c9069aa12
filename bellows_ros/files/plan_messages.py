"""
Plans of points, and their messages MultiDOFJointTrajectory, Path and JointTrajectory as CDR.

Points have a constant spacing in memory, as doubles are aligned to 8: NumPy writes a plan of 2,000
points in the time of 20 Python objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
import struct
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.points import JointPath, require_count
from bellows_ros.core.signals.trajectory import NS_PER_S, pose_rows, Trajectory
from bellows_ros.errors import BellowsError, require_names, shown
from bellows_ros.files.messages import HEAD, LIP_FRAME, PACKAGE_FRAME
import numpy as np

MULTI_DOF = 'trajectory_msgs/msg/MultiDOFJointTrajectory'
PATH = 'nav_msgs/msg/Path'
JOINTS = 'trajectory_msgs/msg/JointTrajectory'


@dataclass(frozen=True, eq=False)
class PlanMessage:
    """
    A plan in the form of messages.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the header, ns; 0 if the plan starts with the motion of the tool.
    frame_id : str
    names : tuple of str
        Name of the joint, the moving frame.
    times_ns : int array (N,)
        Times from the start, ns.
    poses : array (N, 7)
        Position (m) and quaternion xyzw.
    twists : array (N, 6) or None

    """

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    times_ns: Stamps
    poses: Array
    twists: Array | None = None

    def __post_init__(self) -> None:
        """Raise for several names for one transform of each point, and for unusable names."""
        require_names((self.frame_id, *self.names), 'the plan')
        if len(self.names) > 1:
            raise BellowsError(
                f"The plan has the joint names {shown(', '.join(self.names), 200)}, but points "
                'with 1 transform; expected 1 name. Send a plan of the tool alone.')


FieldTypes = tuple[tuple[str, str], ...]
"""Names and formats."""


@cache
def _structure(fields: FieldTypes, offset: int) -> np.dtype[np.void]:
    """Return the memory layout of fields that begin at an offset from a multiple of 8."""
    offsets, end = [], offset
    for _, form in fields:
        dtype = np.dtype(form)
        end += -end % dtype.alignment
        offsets.append(end - offset)
        end += dtype.itemsize
    names, formats = zip(*fields, strict=True)
    return np.dtype({
        'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': end - offset})


def _encode(head: bytes, fields: FieldTypes, columns: Mapping[str, Any]) -> bytes:
    """Return a message of a head and equal structures, whose fields are the columns."""
    message = head
    for part in (slice(0, 1), slice(1, None)):  # the first may have another padding
        rows = np.zeros(len(columns['sec'][part]), _structure(fields, len(message) % 8))
        for name, _ in fields:
            column = columns[name]
            rows[name] = column[part] if isinstance(column, np.ndarray) else column
        message += rows.tobytes()
    return HEAD + message


def encode_multi_dof(plan: PlanMessage) -> bytes:
    """Encode a MultiDOFJointTrajectory of one joint, little-endian."""
    head = _head(plan.stamp_ns, plan.frame_id, plan.names, len(plan.times_ns))
    seconds, nanoseconds = np.divmod(plan.times_ns, NS_PER_S)
    given = plan.twists is not None
    fields = (('na', '<u4'), ('a', '(7,)<f8'), ('nb', '<u4'), *((('b', '(6,)<f8'),) * given),
              ('no_accelerations', '<u4'), ('sec', '<i4'), ('nanosec', '<u4'))
    return _encode(head, fields, {
        'na': 1, 'a': plan.poses, 'nb': int(given), 'b': plan.twists, 'no_accelerations': 0,
        'sec': seconds, 'nanosec': nanoseconds})


def encode_joints(
    stamp_ns: int, frame_id: str, names: Sequence[str], motion: JointPath
) -> bytes:
    """Encode a JointTrajectory with velocities and accelerations, little-endian."""
    head, count = _head(stamp_ns, frame_id, names, len(motion.seconds)), len(names)
    form, times_ns = f'({count},)<f8', np.round(motion.seconds * NS_PER_S).astype(np.int64)
    fields = (('na', '<u4'), ('a', form), ('nb', '<u4'), ('b', form), ('nc', '<u4'), ('c', form),
              ('no_effort', '<u4'), ('sec', '<i4'), ('nanosec', '<u4'))
    return _encode(head, fields, {
        **dict(zip('abc', motion[1:], strict=True)), 'na': count, 'nb': count, 'nc': count,
        'no_effort': 0, 'sec': times_ns // NS_PER_S, 'nanosec': times_ns % NS_PER_S})


def encode_path(stamp_ns: int, frame_id: str, times_ns: Stamps, poses: Array) -> bytes:
    """Encode a Path, little-endian: poses (N, 7) at times (ns) from the stamp."""
    head, text = _head(stamp_ns, frame_id, None, len(times_ns)), frame_id.encode() + b'\0'
    seconds, nanoseconds = np.divmod(stamp_ns + np.asarray(times_ns), NS_PER_S)
    fields = (('sec', '<i4'), ('nanosec', '<u4'), ('size', '<u4'), ('text', f'S{len(text)}'),
              ('pose', '(7,)<f8'))
    return _encode(head, fields, {
        'sec': seconds, 'nanosec': nanoseconds, 'size': len(text), 'text': text, 'pose': poses})


def _head(stamp_ns: int, frame_id: str, names: Sequence[str] | None, points: int) -> bytes:
    """Return the bytes before the points of a trajectory; a Path has no names of joints."""
    head = struct.pack('<iI', *divmod(stamp_ns, NS_PER_S)) + _text(frame_id)
    if names is not None:
        head += struct.pack('<I', len(names)) + b''.join(map(_text, names))
    return head + struct.pack('<I', points)


def _text(text: str) -> bytes:
    """Return a string with its length, padded to a multiple of 4."""
    raw = text.encode() + b'\0'
    return struct.pack('<I', len(raw)) + raw + bytes(-len(raw) % 4)


def require_frame(frame_id: str, values: Values) -> None:
    """
    Raise for a plan in a frame that moves with the tool.

    Raises
    ------
    BellowsError
        If the frame is of the tool, the lip or the package.

    """
    if frame_id in (values.frames.tool, LIP_FRAME, PACKAGE_FRAME):
        raise BellowsError(
            f"The plan is in frame '{shown(frame_id)}', which moves; expected one in which "
            "gravity keeps its direction, such as the arm's base. Transform the plan.")


def plan_message(
    motion: Trajectory, stamp_ns: int, frame_id: str, name: str, axes: str
) -> PlanMessage:
    """Return a motion as the plan of a body, with twists in axes of the 'world' or of the body."""
    twist = np.asarray(motion.twist)
    if axes == 'world':
        twist = apply(motion.rotation[:, None], twist.reshape(-1, 2, 3)).reshape(-1, 6)
    return PlanMessage(
        stamp_ns, frame_id, (name,), motion.stamps_ns - motion.stamps_ns[0],
        pose_rows(motion), twist)


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
    require_names((message.header.frame_id, *names), 'the plan')
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
    """Return a field of all points, None without the field; raise if some points lack it."""
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
    """Return a stamp or duration in ns, from integers of any size in ROS."""
    for count, lowest, highest in ((stamp.sec, -2**31, 2**31), (stamp.nanosec, 0, 2**32)):
        if not isinstance(count, int | np.integer) or not lowest <= count < highest:
            raise ValueError(f'{count} as seconds or nanoseconds')
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def durations_of(points: Sequence[Any]) -> Stamps:
    """Return the times of points from the start, ns."""
    return np.array([ns_of(point.time_from_start) for point in points], dtype=np.int64)


def plans_of(message: Any) -> list[PlanMessage | JointPlan]:
    """Return the plans in a message of rclpy, rosbags or YAML, of one of `plans.PLAN_TYPES`."""
    if hasattr(message, 'poses'):
        return [path_points(message)]
    if hasattr(message, 'trajectory') or hasattr(message, 'joint_trajectory'):
        return [  # RobotTrajectory: of joints, or otherwise of a body
            joint_plan(each.joint_trajectory) if each.joint_trajectory.points
            else multi_dof(each.multi_dof_joint_trajectory)
            for each in getattr(message, 'trajectory', [message])
            if each.joint_trajectory.points or each.multi_dof_joint_trajectory.points]
    require_count(len(message.points or ()), 'The plan')
    is_of_tool = hasattr(message.points[0], 'transforms')
    return [multi_dof(message) if is_of_tool else joint_plan(message)]


def multi_dof(message: Any) -> PlanMessage:
    """Return the points of a MultiDOFJointTrajectory."""
    points = message.points
    transforms, rates = (lists_of(points, part, 1) for part in ('transforms', 'velocities'))
    if transforms is None:
        raise BellowsError('The plan has points without transforms; expected one of each.')
    poses = np.array([pose_of(each.translation, each.rotation) for (each,) in transforms])
    twists = None if rates is None else np.array(
        [(*_vector(each.linear), *_vector(each.angular)) for (each,) in rates])
    return PlanMessage(
        ns_of(message.header.stamp), message.header.frame_id, tuple(message.joint_names),
        durations_of(points), poses, twists)


def path_points(message: Any) -> PlanMessage:
    """Return the points of a Path, with times from the first pose."""
    require_count(len(message.poses), 'The plan')
    frames = {pose.header.frame_id for pose in message.poses} - {message.header.frame_id, ''}
    if frames:
        raise BellowsError(
            f"The plan is in frame '{message.header.frame_id}', but has poses in "
            f"'{sorted(frames)[0]}'; expected one frame. Transform them before.")
    stamps = np.array([ns_of(pose.header.stamp) for pose in message.poses])
    poses = np.array([pose_of(p.pose.position, p.pose.orientation) for p in message.poses])
    return PlanMessage(
        ns_of(message.header.stamp), message.header.frame_id, ('tool',), stamps - stamps[0], poses)


def _vector(vector: Any) -> tuple[float, float, float]:
    """Return the numbers of a vector."""
    return float(vector.x), float(vector.y), float(vector.z)


def pose_of(vector: Any, q: Any) -> tuple[float, ...]:
    """Return position and quaternion xyzw of a pose or transform."""
    return (*_vector(vector), float(q.x), float(q.y), float(q.z), float(q.w))
