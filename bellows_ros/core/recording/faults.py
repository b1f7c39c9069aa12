"""
The table of checks of a recording before a fit, for `info`, `identify`, `replay` and the node.

A check is a function that yields remarks, with a row of the table of checks; the sentence and the
remedy of each remark are in `report/texts/recording.toml`.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from bellows_ros.core.signals.trajectory import PoseStream

from . import pose_faults, prepared_faults
from .alignment import FIT, Remark, REPLAY
from .pose_faults import RecordedPoses
from .recording import Recording


class Check(NamedTuple):
    """
    A check before a fit.

    Parameters
    ----------
    test : callable
        Function of `RecordedPoses`, or of a prepared recording and the cup's length (m), that
        yields remarks.
    prevents : str
        Use that its faults prevent: '' for none, `FIT`, or `REPLAY` and any fit.
    level : int
        Levels that found nothing are presumed by the tests of higher ones.
    needs_length : bool
        Whether the test needs the length of the cup.

    """

    test: Callable[..., Iterable[Remark]]
    prevents: str
    level: int = 0
    needs_length: bool = False


OF_POSES = (
    Check(pose_faults.clock_steps, REPLAY),
    Check(pose_faults.frozen_orientations, REPLAY),
    Check(pose_faults.swapped_bodies, REPLAY),
    Check(pose_faults.fixed_packages, REPLAY),
    Check(pose_faults.wrong_conventions, REPLAY, level=1),
    Check(pose_faults.exchanged_topics, REPLAY, level=2),
    Check(pose_faults.tool_z, REPLAY, level=3),
    Check(pose_faults.resting_tools, FIT, level=3),
    Check(pose_faults.wrong_twists, FIT, level=3),
    Check(pose_faults.impossible_packages, FIT, level=3))
"""Checks of recorded poses and of the given package."""

OF_RECORDING = (
    Check(prepared_faults.misplaced, REPLAY),
    Check(prepared_faults.clocks_apart, FIT, level=1),
    Check(prepared_faults.low_pass, FIT, level=1),
    Check(prepared_faults.jumps, FIT, level=1),
    Check(prepared_faults.wrong_sensors, '', level=1),
    Check(prepared_faults.wrong_length, FIT, level=2, needs_length=True))
"""Checks of a prepared recording, in one world and on one clock."""


def pose_remarks(poses: RecordedPoses) -> tuple[Remark, ...]:
    """Return the remarks of the checks on recorded poses."""
    return _remarks(OF_POSES, (poses.tool, poses.package), poses)


def recording_remarks(
    recording: Recording, length: float | None = None
) -> tuple[Remark, ...]:
    """Return the remarks of the checks on a prepared recording of a cup with a length (m)."""
    checks = [check for check in OF_RECORDING if length is not None or not check.needs_length]
    return _remarks(checks, (recording.tool_pose, recording.package_pose), recording, length)


def _remarks(
    checks: Sequence[Check], streams: tuple[PoseStream, PoseStream], *case: Any
) -> tuple[Remark, ...]:
    """Return the remarks of checks on a case, with the names of the topics in question."""
    named, found = {'tool': streams[:1], 'package': streams[1:]}, list[tuple[int, Remark]]()
    for check in checks:
        if all(check.level == level for level, remark in found if remark.prevents):
            found += [(check.level, remark._replace(prevents=check.prevents, numbers={
                'topic': "' and '".join(s.name for s in named.get(remark.body, streams)),
                **remark.numbers})) for remark in check.test(*case)]
    return tuple(remark for _, remark in found)
