"""
Plans and tool motions from files: messages of several types in recordings, or YAML.

The results are points in the form of `plan_messages.PlanMessage`, unchecked and not interpolated.
The transforms on /tf and /tf_static are a tree of frames, whose links have different times and
rates. Results have the stamps of the moving link next to the wanted frame; the other links are
interpolated at these stamps.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.tuples import normalised
from bellows_ros.core.planning.arm import Arm, read_arm
from bellows_ros.core.planning.points import require_count
from bellows_ros.core.signals.screening import PoseSample, why_no_pose
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.core.signals.transforms import Chain
from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import bags, File, plan_messages, read_text, safe_yaml
from bellows_ros.files.bag_folder import Channel
from bellows_ros.files.plan_messages import JointPlan, MULTI_DOF, ns_of, PATH, PlanMessage
import numpy as np

TF = 'tf2_msgs/msg/TFMessage'


class Transform(NamedTuple):
    """A frame in its parent, at a stamp or fixed."""

    child: str
    parent: str
    sample: PoseSample
    is_fixed: bool


def read_transforms(path: File) -> list[Transform]:
    """
    Return the transforms of a recording: the fixed ones, and the others by stamp.

    Raises
    ------
    BellowsError
        If the recording cannot be read.

    """
    transforms = list[Transform]()
    for topic, _, data in bags.messages_of(path, (TF,)):
        is_fixed = topic.name.endswith('/tf_static')  # in any namespace
        for each in bags.decoded(data, TF).transforms:
            child, parent = (name.lstrip('/') for name in (
                each.child_frame_id, each.header.frame_id))
            stamp, o, q = each.header.stamp, each.transform.translation, each.transform.rotation
            transforms.append(Transform(child, parent, PoseSample(
                stamp.sec * NS_PER_S + stamp.nanosec, (o.x, o.y, o.z), (q.x, q.y, q.z, q.w),
            ), is_fixed))
    return sorted(transforms, key=lambda each: (not each.is_fixed, each.sample.stamp_ns))


def moving_frames(transforms: Iterable[Transform]) -> list[str]:
    """Return the frames with several transforms."""
    counts = Counter(each.child for each in transforms if not each.is_fixed)
    return sorted(frame for frame, count in counts.items() if count > 1)


def poses_in(
    transforms: Sequence[Transform], frame: str, world: str, of: str
) -> tuple[Stamps, Array, str, int]:
    """
    Return stamps (N,), poses (N, 7) of a frame in another one, and the other one's name.

    The last result is the number of transforms between them omitted as invalid poses.

    Parameters
    ----------
    transforms : sequence of Transform
        Transforms, as `read_transforms` returns them.
    frame, world : str
        Frame of the body, and frame of its poses; '' for the farthest ancestor.
    of : str
        Name of the body for messages.

    Raises
    ------
    BellowsError
        If a frame is unknown, nothing connects them, or nothing moves between them.

    """
    path, world = _path(transforms, frame.lstrip('/'), world.lstrip('/'), of)
    transforms = [each for each in transforms if each.child in path]
    good = [each for each in transforms if not why_no_pose(*each.sample[1:])]
    firsts = {each.child: each for each in reversed(good)}  # which form the tree
    chain, rows = Chain(world, frame.lstrip('/')), list[PoseSample]()
    for child, parent, sample, is_fixed in (*firsts.values(), *good):
        q = normalised(sample.quaternion_xyzw)
        chain.add(parent, child, sample._replace(quaternion_xyzw=q), is_fixed)
        rows += chain.due()
    if len(rows) < 2:
        raise BellowsError(
            f"There are no poses of '{shown(frame)}' in '{shown(world)}' in {of}: "
            f'{chain.missing or "the transforms have no time in common"}. Record the transforms '
            'between them together, with stamps of one clock.')
    stamps, position, quaternion = map(np.array, zip(*rows, strict=True))
    return stamps, np.hstack([position, quaternion]), world, len(transforms) - len(good)


def interpolation_noise(
    transforms: Sequence[Transform], frame: str, world: str, of: str
) -> list[tuple[str, float, float]]:
    """
    Return the links between two frames that are interpolated, with rate (Hz) and error (m, RMS).

    At steps h, with the acceleration a, the middle of two neighbours deviates by h^2 a / 2, and
    linear interpolation at random times deviates by h^2 a / sqrt(120) (RMS).
    """
    between, _ = _path(transforms, frame.lstrip('/'), world.lstrip('/'), of)
    moving, found = moving_frames(transforms), list[tuple[str, float, float]]()
    for child in [name for name in between if name in moving][1:]:
        own = [each.sample for each in transforms if each.child == child and not (
            each.is_fixed or why_no_pose(*each.sample[1:]))]
        stamps, p = (np.array(part) for part in zip(*(each[:2] for each in own), strict=True))
        middle = p[1:-1] - 0.5 * (p[:-2] + p[2:])
        found.append((child, float(NS_PER_S / np.median(np.diff(stamps))), float(np.sqrt(
            np.mean(np.sum(middle**2, axis=1)) / 30.0)) if len(middle) else 0.0))
    return found


class UnconnectedError(BellowsError):
    """No transforms connect two frames."""


Parents = Mapping[str, Mapping[str, None]]
"""Parents of each frame, in the order of their first transforms."""


def _path(
    transforms: Iterable[Transform], frame: str, world: str, of: str
) -> tuple[list[str], str]:
    """Return the frames whose transforms lead from a frame to a world, and the world's name."""
    parents = defaultdict[str, dict[str, None]](dict)
    for each in transforms:
        parents[each.child][each.parent] = None
    up = _frames_above(parents, frame, of)
    if not world:
        _require_one_parent(parents, up[-1], of)
        return up[:-1], up[-1]
    down = _frames_above(parents, world, of)
    shared = next((name for name in up if name in down), None)
    if shared is not None:
        return [*up[:up.index(shared)], *down[:down.index(shared)]], world
    for top in (up[-1], down[-1]):
        _require_one_parent(parents, top, of)
    raise UnconnectedError(
        f"There are no poses of '{shown(frame)}' in '{shown(world)}' in {of}: no transforms "
        f"connect them, they lead up to '{shown(up[-1])}' and '{shown(down[-1])}'. Record the "
        'transforms between them, or name another frame.')


def connected(transforms: Iterable[Transform], frame: str, world: str) -> bool:
    """Return whether transforms connect a frame with a world."""
    try:
        return bool(_path(transforms, frame.lstrip('/'), world.lstrip('/'), ''))
    except BellowsError:
        return False


def _frames_above(parents: Parents, frame: str, of: str) -> list[str]:
    """Return a frame and its ancestors, up to the root or to a frame with two parents."""
    known = {*parents, *(name for each in parents.values() for name in each)}
    if frame not in known:
        raise BellowsError(
            f"Frame '{shown(frame)}' is not among the transforms of {of}. There are: "
            f"{shown(', '.join(sorted(parents)[:8]), 300) or 'none'}.")
    chain = [frame]
    while len(parents.get(frame, ())) == 1:
        (frame,) = parents[frame]
        if frame in chain:
            loop = ' in '.join(f"'{shown(name, 40)}'" for name in [
                *chain[chain.index(frame):], frame])
            raise BellowsError(
                f'The transforms of {of} form a loop: {loop}. A frame has one parent, which is '
                'not below it; record without the publisher of one of these.')
        chain.append(frame)
    return chain


def _require_one_parent(parents: Parents, frame: str, of: str) -> None:
    """Raise for a frame with two parents, because the path to the root is then not unique."""
    if len(parents.get(frame, ())) > 1:
        first, second, *_ = parents[frame]
        raise BellowsError(
            f"Frame '{shown(frame)}' has two parents in the transforms of {of}, "
            f"'{shown(first)}' and '{shown(second)}'. Record one of them.")


JOINTS = 'trajectory_msgs/msg/JointTrajectory'
STATES = 'sensor_msgs/msg/JointState'
DESCRIPTION = 'std_msgs/msg/String'
PLAN_TYPES = (MULTI_DOF, PATH, JOINTS, bags.ROBOT_TRAJECTORY, bags.DISPLAY_TRAJECTORY)
"""Message types of plans."""


class NoArmError(BellowsError):
    """Joints are given without their arm."""


def plans_in(path: File, topic: str = '') -> list[tuple[str, PlanMessage | JointPlan]]:
    """
    Return the plans in a recording, each with its topic, in the order of the files.

    Raises
    ------
    BellowsError
        If the recording cannot be read, or a plan in it is invalid.

    """
    def plans_of(channel: Channel, data: bytes) -> list[PlanMessage | JointPlan]:
        """Return the plans in a message."""
        if channel.type_name == MULTI_DOF:
            return [plan_messages.decode_multi_dof(data)]
        message = bags.decoded(data, channel.type_name, channel.definition)
        if channel.type_name in (PATH, JOINTS):
            read = path_points if channel.type_name == PATH else plan_messages.joint_plan
            return [read(message)]
        try:
            return of_moveit(getattr(message, 'trajectory', [message]))
        except AttributeError as error:
            raise BellowsError(
                f'The definition of {channel.type_name} in the recording has no field '
                f"'{error.name}'. Record the plan as a JointTrajectory.") from None

    return [(channel.name, plan) for channel, _, data in bags.messages_of(path, PLAN_TYPES, topic)
            for plan in plans_of(channel, data)]


def of_moveit(trajectories: Iterable[Any]) -> list[PlanMessage | JointPlan]:
    """Return the plans in RobotTrajectory messages: of joints, or otherwise of a body."""
    return [
        plan_messages.joint_plan(each.joint_trajectory) if each.joint_trajectory.points
        else multi_dof(each.multi_dof_joint_trajectory) for each in trajectories
        if each.joint_trajectory.points or each.multi_dof_joint_trajectory.points]


def plans_in_yaml(content: Mapping[str, Any], name: str) -> list[PlanMessage | JointPlan]:
    """
    Return the plans in a message as YAML, as `ros2 topic echo --once` prints it.

    Raises
    ------
    BellowsError
        If the text is not a message with a plan.

    """
    try:
        message: Any = json.loads(json.dumps(content), object_hook=lambda x: SimpleNamespace(**x))
        if 'poses' in content:
            read: list[PlanMessage | JointPlan] = [path_points(message)]
        elif 'trajectory' in content or 'joint_trajectory' in content:
            read = of_moveit(getattr(message, 'trajectory', [message]))
            if not read:
                raise ValueError('it has no trajectory')
        else:
            points = message.points or []
            require_count(len(points), 'The plan')
            is_of_tool = hasattr(points[0], 'transforms')
            read = [multi_dof(message) if is_of_tool else plan_messages.joint_plan(message)]
        return read
    except (AttributeError, IndexError, OverflowError, TypeError, ValueError) as error:
        missing = getattr(error, 'name', '')
        why = (f"'{missing}' is missing" if missing else
               f'a part has another form ({shown(str(error))})')
        raise BellowsError(
            f"'{name}' holds no plan: {why}. Expected one of {', '.join(PLAN_TYPES)} as 'ros2 "
            "topic echo --once --full-length' prints it, or a motion of 'bellows simulate'."
        ) from None


def multi_dof(message: Any) -> PlanMessage:
    """Return the points of a MultiDOFJointTrajectory."""
    points = message.points
    transforms, *rates = (plan_messages.lists_of(points, part, 1)
                          for part in ('transforms', 'velocities', 'accelerations'))
    if transforms is None:
        raise BellowsError('The plan has points without transforms; expected one of each.')
    poses = np.array([_pose(each.translation, each.rotation) for (each,) in transforms])
    twists, accelerations = (
        None if lists is None else np.array(
            [(*_vector(each.linear), *_vector(each.angular)) for (each,) in lists])
        for lists in rates)
    return PlanMessage(
        ns_of(message.header.stamp), message.header.frame_id, tuple(message.joint_names),
        plan_messages.durations_of(points), poses, twists, accelerations)


def path_points(message: Any) -> PlanMessage:
    """Return the points of a Path, with times from the first pose."""
    require_count(len(message.poses), 'The plan')
    frames = {pose.header.frame_id for pose in message.poses} - {message.header.frame_id, ''}
    if frames:
        raise BellowsError(
            f"The plan is in frame '{message.header.frame_id}', but has poses in "
            f"'{sorted(frames)[0]}'; expected one frame. Transform them before.")
    stamps = np.array([ns_of(pose.header.stamp) for pose in message.poses])
    poses = np.array([_pose(p.pose.position, p.pose.orientation) for p in message.poses])
    return PlanMessage(
        ns_of(message.header.stamp), message.header.frame_id, ('tool',), stamps - stamps[0], poses)


def recorded_joints(path: File, arm: Arm) -> PlanMessage:
    """
    Return the tool poses of recorded joint states, with twists if they have velocities.

    Raises
    ------
    BellowsError
        If there are no joint states, or they lack a joint of the arm.

    """
    messages = [bags.decoded(data, STATES) for _, _, data in bags.messages_of(path, (STATES,))]
    useful = [m for m in messages if set(arm.moving) <= set(m.name)
              and len(m.position) == len(m.name)]
    if not useful:
        heard = messages[0].name if messages else ()
        arm.columns(heard, f"Joint states in '{path}'")
        raise BellowsError(f"Joint states in '{path}' have no positions. Record them.")
    columns = [arm.columns(m.name, 'A joint state') for m in useful]
    position = np.array([m.position[c] for m, c in zip(useful, columns, strict=True)])
    rates = all(len(m.velocity) == len(m.name) for m in useful)
    velocity = np.array([m.velocity[c] for m, c in zip(useful, columns, strict=True)]) if (
        rates) else None
    T, twist = arm.tool(position, velocity)
    stamps = np.array([ns_of(m.header.stamp) for m in useful])
    poses = np.hstack([T[:, :3, 3], lie.rotation_to_quaternion(T[:, :3, :3])])
    return _recorded(stamps, poses, twist if rates else None, arm.root)


def joints_or_tf(path: File, urdf: File, tool_link: str) -> PlanMessage:
    """
    Return the tool poses of recorded joint states and a URDF, or otherwise of transforms.

    Raises
    ------
    BellowsError
        If a recording has neither joint states nor transforms.

    """
    try:
        arm = arm_of(urdf, tool_link, path)
    except NoArmError as no_arm:
        transforms = read_transforms(path)
        if not transforms:
            raise NoArmError(f"'{path}' has no transforms. {no_arm}") from None
        stamps, poses, root, _ = poses_in(transforms, tool_link, '', f"'{path}'")
        return _recorded(stamps, poses, None, root)
    return recorded_joints(path, arm)


def _recorded(stamps: Stamps, poses: Array, twist: Array | None, frame: str) -> PlanMessage:
    """Return recorded poses (N, 7) in the order of their stamps, without duplicates."""
    stamps, first = np.unique(stamps, return_index=True)
    return PlanMessage(
        int(stamps[0]), frame, ('tool',), stamps - stamps[0], poses[first],
        None if twist is None else twist[first])


def arm_of(urdf: File, tool_link: str, recording: File = '') -> Arm:
    """
    Return the arm of a URDF file, or of the /robot_description in a recording.

    Raises
    ------
    BellowsError
        If there is no URDF, or it does not lead to the link.

    """
    if not tool_link:
        raise NoArmError(
            'The input has joint positions, but not the link of the tool tip. Set tool_link.')
    if urdf:
        return read_arm(read_text(urdf, 2**26, 'URDF'), tool_link)
    if recording:
        for topic, _, data in bags.messages_of(recording, (DESCRIPTION,)):
            if topic.name.endswith('robot_description'):
                return read_arm(bags.decoded(data, DESCRIPTION).data, tool_link)
    raise NoArmError(
        'Joints are given, and the arm is not: there is no /robot_description. Give its urdf.')


def read_yaml(path: File) -> Mapping[str, Any]:
    """Return the content of a YAML file."""
    content = safe_yaml.load(Path(path))
    if not isinstance(content, Mapping):
        raise BellowsError(f"'{path}' holds no names and values, so no plan.")
    return content


def _vector(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _pose(vector: Any, q: Any) -> tuple[float, ...]:
    return (*_vector(vector), float(q.x), float(q.y), float(q.z), float(q.w))
