"""
Plans and tool motions from files: messages of several types in recordings, or YAML.

The results are points in the form of `plan_messages.PlanMessage`, unchecked and not interpolated.
"""

from collections.abc import Mapping
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.planning.arm import Arm, read_arm
from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import bags, File, read_text, safe_yaml
from bellows_ros.files.plan_messages import (
    JointPlan,
    JOINTS,
    MULTI_DOF,
    ns_of,
    PATH,
    PlanMessage,
    plans_of,
)
import numpy as np

STATES = 'sensor_msgs/msg/JointState'
DESCRIPTION = 'std_msgs/msg/String'
PLAN_TYPES = (MULTI_DOF, PATH, JOINTS, 'moveit_msgs/msg/RobotTrajectory',
              'moveit_msgs/msg/DisplayTrajectory')
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
    return [(name, plan) for name, _, message in bags.messages_of(path, PLAN_TYPES, topic)
            for plan in plans_of(message)]


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
        if read := plans_of(message):
            return read
        raise ValueError('it has no trajectory')
    except (AttributeError, IndexError, OverflowError, TypeError, ValueError) as error:
        missing = getattr(error, 'name', '')
        why = (f"'{missing}' is missing" if missing else
               f'a part has another form ({shown(str(error))})')
        raise BellowsError(
            f"'{name}' holds no plan: {why}. Expected one of {', '.join(PLAN_TYPES)} as 'ros2 "
            "topic echo --once --full-length' prints it, or a motion of 'bellows simulate'."
        ) from None


def recorded_joints(path: File, arm: Arm) -> PlanMessage:
    """
    Return the tool poses of recorded joint states, with twists if they have velocities.

    Raises
    ------
    BellowsError
        If there are no joint states, or they lack a joint of the arm.

    """
    messages = [message for _, _, message in bags.messages_of(path, (STATES,))]
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
    poses = np.hstack([T[:, :3, 3], lie.rotation_to_quaternion(T[:, :3, :3])])
    stamps, first = np.unique([ns_of(m.header.stamp) for m in useful], return_index=True)
    return PlanMessage(
        int(stamps[0]), arm.root, ('tool',), stamps - stamps[0], poses[first],
        twist[first] if rates else None)


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
        for topic, _, message in bags.messages_of(recording, (DESCRIPTION,)):
            if topic.endswith('robot_description'):
                return read_arm(message.data, tool_link)
    raise NoArmError(
        'Joints are given, and the arm is not: there is no /robot_description. Give its urdf.')


def read_yaml(path: File) -> Mapping[str, Any]:
    """Return the content of a YAML file."""
    content = safe_yaml.load(Path(path))
    if not isinstance(content, Mapping):
        raise BellowsError(f"'{path}' holds no names and values, so no plan.")
    return content
