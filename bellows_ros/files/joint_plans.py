"""Plans of an arm's joints: the points of JointTrajectory messages, however they were read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.planning.points import require_count
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np


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
