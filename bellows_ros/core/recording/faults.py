"""
The table of checks of a recording before a fit, for `info`, `identify`, `replay` and the node.

A check is a function that yields findings on the 'tool', the 'package' or 'both', with a row of
the table of checks; errors prevent a fit, and some a replay.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.signals.trajectory import PoseStream

from . import pose_faults, prepared_faults
from .pose_faults import RecordedPoses
from .recording import Recording


class Check(NamedTuple):
    """
    A check before a fit.

    Parameters
    ----------
    test : callable
        Function of `RecordedPoses`, or of a prepared recording and the cup's length (m), that
        yields findings.
    stage : int
        Stages that found no error are presumed by the tests of higher ones.
    needs_length : bool
        Whether the test needs the length of the cup.

    """

    test: Callable[..., Iterable[Finding]]
    stage: int = 0
    needs_length: bool = False


OF_POSES = (
    Check(pose_faults.clock_steps),
    Check(pose_faults.frozen_orientations),
    Check(pose_faults.swapped_bodies),
    Check(pose_faults.fixed_packages),
    Check(pose_faults.wrong_conventions, stage=1),
    Check(pose_faults.exchanged_topics, stage=2),
    Check(pose_faults.tool_z, stage=3),
    Check(pose_faults.resting_tools, stage=3),
    Check(pose_faults.wrong_twists, stage=3),
    Check(pose_faults.impossible_packages, stage=3))
"""Checks of recorded poses and of the given package."""

OF_RECORDING = (
    Check(prepared_faults.misplaced),
    Check(prepared_faults.clocks_apart, stage=1),
    Check(prepared_faults.low_pass, stage=1),
    Check(prepared_faults.jumps, stage=1),
    Check(prepared_faults.wrong_sensors, stage=1),
    Check(prepared_faults.wrong_length, stage=2, needs_length=True))
"""Checks of a prepared recording, in one world and on one clock."""


def pose_remarks(poses: RecordedPoses) -> tuple[Finding, ...]:
    """Return the findings of the checks on recorded poses."""
    return _remarks(OF_POSES, (poses.tool, poses.package), poses)


def recording_remarks(
    recording: Recording, length: float | None = None
) -> tuple[Finding, ...]:
    """Return the findings of the checks on a prepared recording of a cup with a length (m)."""
    checks = [check for check in OF_RECORDING if length is not None or not check.needs_length]
    return _remarks(checks, (recording.tool_pose, recording.package_pose), recording, length)


def _remarks(
    checks: Sequence[Check], streams: tuple[PoseStream, PoseStream], *case: Any
) -> tuple[Finding, ...]:
    """Return the findings of checks on a case, with the names of the topics in question."""
    tool, package = (stream.name for stream in streams)
    names = {'tool': tool, 'package': package, 'both': f"{tool}' and '{package}"}
    found = list[tuple[int, Finding]]()
    for check in checks:
        if all(check.stage == stage for stage, own in found if own.level == Level.ERROR):
            found += [(check.stage, own._replace(topic=names.get(own.topic, own.topic)))
                      for own in check.test(*case)]
    return tuple(own for _, own in found)
