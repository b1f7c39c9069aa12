"""
The table of checks of a recording before a fit, for `info`, `identify`, `replay` and the node.

A check is a function that yields findings on the 'tool', the 'package' or 'both'. Checks presume
that the checks of earlier rows found no error; errors prevent a fit, and some a replay.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.signals.trajectory import PoseStream

from . import pose_faults, prepared_faults
from .pose_faults import RecordedPoses
from .recording import Recording

Checks = tuple[Callable[[Any], Iterable[Finding]], ...]
"""Functions that yield findings on a case."""

OF_POSES: tuple[Checks, ...] = (
    (pose_faults.clock_steps, pose_faults.frozen_orientations, pose_faults.swapped_bodies,
     pose_faults.fixed_packages),
    (pose_faults.wrong_conventions,),
    (pose_faults.exchanged_topics,),
    (pose_faults.tool_z, pose_faults.resting_tools, pose_faults.wrong_twists,
     pose_faults.impossible_packages))
"""Checks of `RecordedPoses`."""

OF_RECORDING: tuple[Checks, ...] = (
    (prepared_faults.clocks_apart,),
    (prepared_faults.misplaced,),
    (prepared_faults.turned_frames,),
    (prepared_faults.low_pass, prepared_faults.wrong_sensors))
"""Checks of a prepared recording, in one world and on one clock."""


def pose_remarks(poses: RecordedPoses) -> tuple[Finding, ...]:
    """Return the findings of the checks on recorded poses."""
    return tuple(_remarks(OF_POSES, (poses.tool, poses.package), poses))


def recording_remarks(recording: Recording) -> tuple[Finding, ...]:
    """Return the findings of the checks on a prepared recording."""
    return tuple(_remarks(OF_RECORDING, (recording.tool_pose, recording.package_pose), recording))


def _remarks(
    rows: Sequence[Checks], streams: tuple[PoseStream, PoseStream], case: Any
) -> Iterator[Finding]:
    """Yield the findings of checks on a case, with the names of the topics in question."""
    tool, package = (stream.name for stream in streams)
    names = {'tool': tool, 'package': package, 'both': f"{tool}' and '{package}"}
    for row in rows:
        found = [own for check in row for own in check(case)]
        yield from (own._replace(topic=names.get(own.topic, own.topic)) for own in found)
        if any(own.level == Level.ERROR for own in found):
            return
