"""The gripper between a force-torque sensor and the cup, from recordings without a package."""

from collections.abc import Iterator, Mapping
import math
from typing import Any

from bellows_ros.core.model.cup_package import gravity_vector
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.preparation import filtered_tool
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.sensors import weighing
from bellows_ros.core.sensors.weighing import Wrenches
from bellows_ros.core.sensors.wrench import inertial_numbers, sizes_of
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.trajectory import Filtered
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, File
from bellows_ros.workflows.recordings import Progress
import numpy as np

MIN_SIGMAS = 3.0
"""Smallest mass of a gripper, standard deviations."""


def with_gripper(values: Values, progress: Progress) -> Values:
    """
    Return parameters with the gripper.* of the recordings in gripper.bags, if any.

    Raises
    ------
    BellowsError
        If a recording is unusable, or the wrenches show no mass.

    """
    found = []
    for bag in values.gripper.bags:
        progress(f'reading {bag}', 0.0)
        found.append(weighing.information_on_gripper(
            *tool_and_readings(bag, values), gravity_vector(values.gravity.magnitude)))
    if not found:
        return values
    return values.replaced(gripper_of(*(
        np.sum(each, axis=0) for each in zip(*found, strict=True))))


def gripper_sentence(values: Values) -> Iterator[str]:
    """Yield a sentence on a gripper estimated from recordings."""
    if values.gripper.bags:
        mass, com, std = values.gripper.mass, values.gripper.com, values.gripper.std
        yield (f'The gripper was estimated from gripper.bags: gripper.mass {mass:.3f} ± '
               f'{std[0] * mass:.2g} kg, gripper.com {", ".join(f"{1e3 * x:.1f}" for x in com)} '
               f'± {1e3 * std[1] * math.hypot(*com):.2g} mm.')


def tool_and_readings(bag: File, values: Values) -> tuple[Filtered, Wrenches]:
    """Return the filtered tool and the wrenches of a recording, which needs no package."""
    topics = {role: values[f'topics.{role}'] for role in ('tool_pose', 'tool_wrench')}
    if not topics['tool_wrench']:
        raise BellowsError('topics.tool_wrench is not set. Name the topic of the wrenches.')
    return prepared_tool(bags.read_streams(bag, topics), values)


def prepared_tool(streams: Mapping[str, Any], values: Values) -> tuple[Filtered, Wrenches]:
    """Return the filtered tool and the wrenches of streams by their roles."""
    settings = PrepareSettings(
        world=values.recording.world, gravity_direction=values['gravity.direction'],
        tool_half_window=values.filter.tool.half_window, tool_order=values.filter.tool.order)
    pose = trajectory.at_tip(streams['tool_pose'], conversion.tip_of(values))
    tool = filtered_tool(pose, settings)
    return tool, Wrenches.of(
        streams['tool_wrench'], tool, pose.frame_id, settings.R_world_recorded, values)


def gripper_of(information: Any, slope: Any) -> dict[str, Any]:
    """
    Return gripper.* of information (10, 10) and slope (10,) on its inertial numbers.

    Raises
    ------
    BellowsError
        For no mass.

    """
    covariance = np.linalg.inv(information + np.diag(weighing.GRIPPER_STD ** -2))
    phi, std = covariance @ slope, np.sqrt(np.diag(covariance))
    if phi[0] < MIN_SIGMAS * std[0]:
        raise BellowsError(
            f'The wrenches of gripper.bags show a gripper of {phi[0]:.3g} kg, with a standard '
            f'deviation of {std[0]:.2g} kg; more than three of them are expected. Tilt the tool '
            'to two sides by 30 degrees, and check wrench.sign and wrench.frame.')
    com = phi[1:4] / phi[0]
    about_com = phi[4:] - np.array(inertial_numbers(phi[0], com, np.zeros(6)))[4:]
    worst = np.array([std[0], std[1:4].max(), std[4:].max()])
    return {'gripper.mass': float(phi[0]), 'gripper.com': tuple(com.tolist()),
            'gripper.inertia': tuple(about_com.tolist()),
            'gripper.std': tuple((worst / np.maximum(sizes_of(phi), 1e-9)).tolist())}
