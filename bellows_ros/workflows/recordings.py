"""Reading a recording and preparing it as its parameters say."""

from collections.abc import Mapping
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

from bellows_ros.core.recording.preparation import prepare, PrepareSettings, Recording
from bellows_ros.core.trajectory import PoseStream, TwistStream
from bellows_ros.files.bags import read_streams


@dataclass(frozen=True, eq=False)
class Loaded:
    """A recording's streams as recorded, and what was made of them."""

    path: Path
    tool_pose: PoseStream
    package_pose: PoseStream
    tool_twist: TwistStream | None
    recording: Recording


def load(path: str | os.PathLike[str], values: Mapping[str, Any]) -> Loaded:
    """
    Read a recording and prepare it.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    values : mapping
        Parameters by name, as `core.parameters.resolve` returns them.

    Raises
    ------
    BellowsError
        If it cannot be read, or is not a recording that a cup can be identified from.

    """
    roles = ('tool_pose', 'package_pose', 'tool_twist')
    streams: Mapping[str, Any] = read_streams(
        path, {role: values[f'topics.{role}'] for role in roles}
    )
    tool, package = streams['tool_pose'], streams['package_pose']
    twist = streams.get('tool_twist')
    recording = prepare(tool, package, _settings(values), twist)
    return Loaded(Path(path), tool, package, twist, recording)


def _settings(values: Mapping[str, Any]) -> PrepareSettings:
    """Return the settings of the preparation that parameters stand for."""
    return PrepareSettings(
        world=values['recording.world'],
        package_frame=values['recording.package_frame'],
        align_at_rest=values['recording.align_at_rest'],
        rest_duration=values['recording.rest_duration'],
        com=values['package.com'],
        tool_half_window=values['filter.tool.half_window'],
        tool_order=values['filter.tool.order'],
        package_half_window=values['filter.package.half_window'],
        package_order=values['filter.package.order'],
        tool_twist_frame=values['tool_twist.frame'],
    )
