"""
Plans and tool motions as messages: read from recordings, topics or YAML, and written as CDR.

Messages of rclpy, of rosbags and from YAML have the same attributes. Plans are unchecked and not
interpolated.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter
import struct
from types import SimpleNamespace
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.parameters.conversion import tip_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.arm import Arm, read_arm
from bellows_ros.core.planning.points import (
    contradiction,
    JointPath,
    Joints,
    plan_of,
    plan_of_joints,
    require_count,
)
from bellows_ros.core.signals.screening import repeated
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, pose_rows, Trajectory
from bellows_ros.errors import BellowsError, require_names, shown
from bellows_ros.files import File, read_text
from bellows_ros.files.messages import HEAD, LIP_FRAME, PACKAGE_FRAME
import numpy as np

MULTI_DOF = 'trajectory_msgs/msg/MultiDOFJointTrajectory'
PATH = 'nav_msgs/msg/Path'
JOINTS = 'trajectory_msgs/msg/JointTrajectory'
STATES = 'sensor_msgs/msg/JointState'
DESCRIPTION = 'std_msgs/msg/String'
LAWS = {
    'spline': 'along a cubic spline from rest to rest, for lack of velocities',
    'linear': 'linearly, as ros2_control moves joints that have positions alone',
    'cubic': 'along cubic polynomials, as ros2_control moves joints that have velocities',
    'quintic': 'along quintic polynomials, as ros2_control moves joints that have accelerations'}
"""Motions between the points of a plan."""

PLAN_TYPES = (MULTI_DOF, PATH, JOINTS, 'moveit_msgs/msg/RobotTrajectory',
              'moveit_msgs/msg/DisplayTrajectory')
"""Message types of plans."""


class Plan(NamedTuple):
    """
    A plan in the form of messages.

    Parameters
    ----------
    kind : str
        `MULTI_DOF` or `PATH` for poses of the tool, `JOINTS` for positions of an arm's joints.
    stamp_ns : int
        Stamp of the header, ns; 0 if the plan starts with the motion of the tool.
    frame_id : str
    names : tuple of str
        Names of the joints; one, the moving frame, for poses.
    times_ns : int array (N,)
        Times from the start of the plan, ns; the first may be above 0.
    points : array (N, 7) or (N, K)
        Position (m) and quaternion xyzw, or positions of the joints, rad or m.
    rates, accelerations : array or None
        Twists (N, 6), or the derivatives (N, K) of the joints.

    """

    kind: str
    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    times_ns: Stamps
    points: Array
    rates: Array | None = None
    accelerations: Array | None = None

    @property
    def law(self) -> str:
        """Motion between the points, a key of `LAWS`; '' for a tool with velocities."""
        if self.kind != JOINTS:
            return 'spline' if self.rates is None else ''
        if self.rates is None:
            return 'linear'
        return 'cubic' if self.accelerations is None else 'quintic'

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the motion between the points, and before the first."""
        found = [Finding('interpolated', Level.OK, {'law': LAWS[self.law]})] if self.law else []
        if self.times_ns[0] > 0:
            found.append(Finding(
                'late_start', Level.WARN, {'begin': float(self.times_ns[0]) / NS_PER_S}))
        return tuple(found)


def plan_of_motion(
    motion: Trajectory, stamp_ns: int, frame_id: str, name: str, axes: str, start_ns: int
) -> Plan:
    """
    Return a motion as the plan of a body that starts at a stamp (ns).

    The twists have axes of the 'world' or of the body.
    """
    twist = np.asarray(motion.twist)
    if axes == 'world':
        twist = lie.apply(motion.rotation[:, None], twist.reshape(-1, 2, 3)).reshape(-1, 6)
    return Plan(MULTI_DOF, stamp_ns, frame_id, (name,), motion.stamps_ns - start_ns,
                pose_rows(motion), twist)


def motion_of(
    plan: Plan, values: Values, arm: Arm | None, start_ns: int = 0
) -> tuple[Trajectory, Joints | None]:
    """
    Return the motion of E along a plan of the tool, or of an arm with its joints.

    Raises
    ------
    BellowsError
        If the plan is impossible for an arm.

    """
    tip, stamps = tip_of(values), plan.times_ns + start_ns
    if arm:
        return plan_of_joints(arm.with_tip(tip), plan.names, stamps, *plan[5:])
    tool = plan_of(stamps, plan.points, plan.rates, values.tool_twist.frame).trajectory()
    return at_tip(tool, tip), None


def plan_of_path(
    stamp_ns: int, frame_id: str, names: Sequence[str], path: JointPath, first_ns: int
) -> Plan:
    """Return a motion of joints as a plan whose first point is at a time (ns) from its start."""
    times_ns = first_ns + np.round(path.seconds * NS_PER_S).astype(np.int64)
    return Plan(JOINTS, stamp_ns, frame_id, tuple(names), times_ns, *path[1:])


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


# ---------------------------------------------------------------------------------------- writing


def encode(plan: Plan) -> bytes:
    """
    Encode a plan as CDR, little-endian.

    Points have a constant spacing in memory, as doubles are aligned to 8: NumPy writes a plan of
    2,000 points in the time of 20 Python objects.
    """
    message = struct.pack('<iI', *divmod(plan.stamp_ns, NS_PER_S)) + _text(plan.frame_id)
    fields, time_ns = list[tuple[str, Any]](), np.asarray(plan.times_ns)
    if plan.kind == PATH:
        time_ns, text = time_ns + plan.stamp_ns, plan.frame_id.encode() + b'\0'
        fields += [('<u4', len(text)), (f'S{len(text)}', text), ('(7,)<f8', plan.points)]
    else:
        message += struct.pack('<I', len(plan.names)) + b''.join(map(_text, plan.names))
        of_joints = plan.kind == JOINTS
        for part in (*plan[5:], *[None] * of_joints):  # without efforts
            fields.append(('<u4', 0 if part is None else len(plan.names) if of_joints else 1))
            if part is not None:
                fields.append((f'({part.shape[1]},)<f8', part))
    time = [('<i4', time_ns // NS_PER_S), ('<u4', time_ns % NS_PER_S)]
    fields = time + fields if plan.kind == PATH else fields + time
    message += struct.pack('<I', len(time_ns))
    for rows_of in (slice(0, 1), slice(1, None)):  # the first may have another padding
        offsets, end = [], len(message) % 8
        for dtype in (np.dtype(form) for form, _ in fields):
            end += -end % dtype.alignment
            offsets.append(end - len(message) % 8)
            end += dtype.itemsize
        names = [f'{number}' for number in range(len(fields))]
        rows = np.zeros(len(time_ns[rows_of]), {
            'names': names, 'formats': [form for form, _ in fields], 'offsets': offsets,
            'itemsize': end - len(message) % 8})
        for name, (_, column) in zip(names, fields, strict=True):
            rows[name] = column[rows_of] if isinstance(column, np.ndarray) else column
        message += rows.tobytes()
    return HEAD + message


def _text(text: str) -> bytes:
    """Return a string with its length, padded to a multiple of 4."""
    raw = text.encode() + b'\0'
    return struct.pack('<I', len(raw)) + raw + bytes(-len(raw) % 4)


# ---------------------------------------------------------------------------------------- reading

RowOf = Callable[[Any], tuple[float, ...]]

XYZ, XYZW = ('x', 'y', 'z'), ('x', 'y', 'z', 'w')
TRANSFORM: RowOf = attrgetter(
    *(f'translation.{x}' for x in XYZ), *(f'rotation.{x}' for x in XYZW))
POSE: RowOf = attrgetter(
    *(f'position.{x}' for x in XYZ), *(f'orientation.{x}' for x in XYZW))
TWIST: RowOf = attrgetter(*(f'{part}.{x}' for part in ('linear', 'angular') for x in XYZ))


def plans_of(message: Any) -> list[Plan]:
    """
    Return the plans in a message of one of `PLAN_TYPES`.

    Raises
    ------
    BellowsError
        If the points are too few, uneven or in several frames, or a name is unusable.

    """
    if hasattr(message, 'poses'):
        return [_path(message)]
    trajectory = getattr(message, 'trajectory', message)
    if hasattr(message, 'joint_trajectory'):
        robots = [message]
    elif hasattr(message, 'trajectory') and not hasattr(trajectory, 'points'):
        robots = trajectory
    else:  # alone, or the goal of an action
        return [_points(trajectory)]
    parts = [robot.joint_trajectory if robot.joint_trajectory.points  # of joints, or of a body
             else robot.multi_dof_joint_trajectory for robot in robots]
    return [_points(part) for part in parts if part.points]


def _points(message: Any) -> Plan:
    """Return the points of a trajectory of joints or of a body."""
    points: Sequence[Any] = message.points or ()
    names = tuple(message.joint_names)
    require_count(len(points), 'The plan')
    require_names((message.header.frame_id, *names), 'the plan')
    of_tool = hasattr(points[0], 'transforms')
    if of_tool and len(names) > 1:
        raise BellowsError(
            f"The plan has the joint names {shown(', '.join(names), 200)}, but points "
            'with 1 transform; expected 1 name. Send a plan of the tool alone.')
    count, parts = (1, {'transforms': TRANSFORM, 'velocities': TWIST}) if of_tool else (
        len(names), dict.fromkeys(('positions', 'velocities', 'accelerations')))
    columns = [_column(points, part, count, row) for part, row in parts.items()]
    if columns[0] is None:
        raise BellowsError(f'The plan has points without {next(iter(parts))}; expected them in '
                           'each.')
    times_ns = np.array([ns_of(each.time_from_start) for each in points], np.int64)
    return Plan(MULTI_DOF if of_tool else JOINTS, ns_of(message.header.stamp),
                message.header.frame_id, names, times_ns, columns[0], *columns[1:])


def _column(points: Sequence[Any], part: str, count: int, row: RowOf | None) -> Array | None:
    """Return a field of all points, None without the field; raise if some points lack it."""
    lists: list[Any] = [getattr(point, part, ()) for point in points]
    if not any(map(len, lists)):
        return None
    for number, each in enumerate(lists):
        if len(each) != count:
            raise BellowsError(
                f'The plan: point {number} (the first is 0) has {len(each)} {part}; expected '
                f'{count} in every point, one per joint or for the tool, or none at all.')
    return np.array([row(each[0]) for each in lists] if row else lists, dtype=float)


def _path(message: Any) -> Plan:
    """Return the points of a Path, with times from the first pose."""
    require_count(len(message.poses), 'The plan')
    header = message.header
    require_names((header.frame_id,), 'the plan')
    if frames := {pose.header.frame_id for pose in message.poses} - {header.frame_id, ''}:
        raise BellowsError(
            f"The plan is in frame '{header.frame_id}', but has poses in '{sorted(frames)[0]}'; "
            'expected one frame. Transform them before.')
    stamps = np.array([ns_of(pose.header.stamp) for pose in message.poses])
    return Plan(PATH, ns_of(header.stamp), header.frame_id, ('tool',), stamps - stamps[0],
                np.array([POSE(pose.pose) for pose in message.poses], dtype=float))


def ns_of(stamp: Any) -> int:
    """Return a stamp or duration in ns, from integers of any size in ROS."""
    for count, lowest, highest in ((stamp.sec, -2**31, 2**31), (stamp.nanosec, 0, 2**32)):
        if not isinstance(count, int | np.integer) or not lowest <= count < highest:
            raise ValueError(f'{count} as seconds or nanoseconds')
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def _recorded(path: File, *selection: Any) -> Iterator[tuple[str, int, Any]]:
    """Return decoded messages; see `bags.messages_of`, which nodes do not load."""
    from bellows_ros.files import bags

    return bags.messages_of(path, *selection)


def plans_in(path: File, topic: str = '') -> list[tuple[str, Plan]]:
    """
    Return the plans in a recording, each with its topic, in the order of the files.

    Predictions of the package along a plan (package/plan*) are left out, unless their topic is
    given.

    Raises
    ------
    BellowsError
        If the recording cannot be read, or a plan in it is invalid.

    """
    return [(name, plan) for name, _, message in _recorded(path, PLAN_TYPES, topic)
            if topic or 'package/plan' not in name for plan in plans_of(message)]


def plans_in_yaml(content: Mapping[str, Any], name: str) -> list[Plan]:
    """
    Return the plans in a message as YAML, as `ros2 topic echo --once` prints it.

    Raises
    ------
    BellowsError
        If the text is not a message with a plan.

    """
    where = getattr(content, 'where', lambda keys: f'{name}: ')
    try:
        if read := plans_of(_as_message(content, where)):
            return read
        raise ValueError('it has no trajectory')
    except (AttributeError, IndexError, OverflowError, TypeError, ValueError) as error:
        missing, place = getattr(error, 'name', ''), getattr(
            getattr(error, 'obj', None), 'yaml_keys', ())
        why = (f"'{missing}' is missing" if missing else
               f'a part has another form ({shown(str(error))})')
        raise BellowsError(
            f'{where(place)}there is no plan: {why}. Expected one of '
            f"{', '.join(PLAN_TYPES)} as 'ros2 topic echo --once --full-length' prints it, the "
            "goal of a FollowJointTrajectory, or a motion of 'bellows simulate'.") from None


def _as_message(content: Any, where: Callable[[Sequence[str]], str], *keys: str) -> Any:
    """Return a part of a YAML file as a message, whose parts have their keys; refuse a cut one."""
    if isinstance(content, Mapping):
        return SimpleNamespace(yaml_keys=keys, **{
            name: _as_message(part, where, *keys, name) for name, part in content.items()})
    if isinstance(content, list):
        *parents, last = keys or ('',)
        return [_as_message(part, where, *parents, f'{last}[{number}]')
                for number, part in enumerate(content)]
    if content == '...':
        raise BellowsError(
            f"{where(keys)}the message is cut here ('...'); expected all of its points. Print it "
            "by 'ros2 topic echo --once --full-length'.")
    return content


MAX_POSITION = 1e6
"""Largest position and speed of a joint, rad or m, per second."""


class RecordedJoints(NamedTuple):
    """Tool poses of recorded joint states, and findings on their velocities."""

    plan: Plan
    findings: tuple[Finding, ...]


def recorded_joints(path: File, arm: Arm) -> RecordedJoints:
    """
    Return the tool poses of recorded joint states, with twists if they have velocities.

    States without the position of a joint (NaN, as drivers send it first) are left out, and so are
    velocities that contradict the positions, as zero or constant ones, or are NaN.

    Raises
    ------
    BellowsError
        If there are no joint states, or they lack a joint of the arm.

    """
    messages, where = [m for _, _, m in _recorded(path, (STATES,))], f"Joint states in '{path}'"
    whole = [m for m in messages if set(arm.moving) <= set(m.name)]
    arm.columns((whole or messages)[0].name if messages else (), where)
    states = {ns_of(m.header.stamp): m for m in reversed(whole)  # the first of equal stamps
              if len(m.position) == len(m.name)}
    if not states:
        raise BellowsError(f"Joint states in '{path}' have no positions. Record them.")
    stamps = np.array(sorted(states))
    useful = [states[stamp] for stamp in stamps.tolist()]
    columns = [arm.columns(m.name, where) for m in useful]
    position = np.array([m.position[own] for m, own in zip(useful, columns, strict=True)])
    velocity, findings = None, list[Finding]()
    if all(len(m.velocity) == len(m.name) for m in useful):
        velocity = np.array([m.velocity[own] for m, own in zip(useful, columns, strict=True)])
    known = np.flatnonzero((np.abs(position) < MAX_POSITION).all(axis=1))
    if not len(known):
        raise BellowsError(f'{where} have no positions below {MAX_POSITION:g}. Record them again.')
    fresh = known[~repeated(np.linalg.norm(np.diff(position[known], axis=0), axis=1))]
    stamps, position = stamps[fresh], position[fresh]
    if velocity is not None:
        velocity = velocity[fresh]
        durations, steps = np.diff(stamps) / NS_PER_S, np.diff(position, axis=0)
        if not (np.abs(velocity) < MAX_POSITION).all() or (
                len(stamps) > 1 and contradiction(durations, steps, velocity) is not None):
            velocity = None
            findings.append(Finding('joint_velocities', Level.OK))
    T, twist = arm.tool(position, velocity)
    poses = np.hstack([T[:, :3, 3], lie.rotation_to_quaternion(T[:, :3, :3])])
    plan = Plan(MULTI_DOF, int(stamps[0]), arm.root, ('tool',), stamps - stamps[0], poses,
                None if velocity is None else twist)
    return RecordedJoints(plan, tuple(findings))


def arm_of(urdf: File, tool_link: str, recording: File = '') -> Arm:
    """
    Return the arm of a URDF file, or of the /robot_description in a recording.

    Raises
    ------
    BellowsError
        If there is no URDF, or it does not lead to the link.

    """
    if not tool_link:
        raise BellowsError(
            'The input has joint positions, but not the link of the tool tip. Set tool_link.')
    if urdf:
        return read_arm(read_text(urdf, 2**26, 'URDF'), tool_link)
    for topic, _, message in _recorded(recording, (DESCRIPTION,)) if recording else ():
        if topic.endswith('robot_description'):
            return read_arm(message.data, tool_link)
    raise BellowsError(
        'Joints are given, and the arm is not: there is no /robot_description. Give its urdf.')
