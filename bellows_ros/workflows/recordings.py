"""Reading a recording and preparing it as its parameters say."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
import os
from pathlib import Path
from typing import Any

from bellows_ros.core.identification.advice.time_offset import time_offset
from bellows_ros.core.identification.methods import samples_of
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import Package, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS
from bellows_ros.core.recording.preparation import (
    prepare,
    PrepareSettings,
    Recording,
    TimeOffset,
)
from bellows_ros.core.savgol import savgol
from bellows_ros.core.trajectory import NS_PER_S, PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams
from bellows_ros.files.parameter_files import read_parameters

NOT_TOLD = (
    'This recording does not tell by how much the stamps of the tool are behind those of the '
    'package: it was used as it is stamped. Record a motion that is richer in all directions, '
    'with clocks that differ by less than 50 ms.'
)
"""Said where a time offset is wanted and cannot be found."""

NO_INERTIA = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
"""Stands for the inertia (kg m^2) of what hangs at rest, where it takes no part."""


@dataclass(frozen=True)
class Failed:
    """A recording that cannot be used, its place in `bags`, and why."""

    number: int
    bag: str
    reason: str


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
    loaded = Loaded(Path(path), tool, package, twist, recording)
    return _in_time(loaded, values) if values['fit.time_offset'] else loaded


def _in_time(loaded: Loaded, values: Mapping[str, Any]) -> Loaded:
    """Return a recording with the tool's stamps by the clock of the package, if that is told."""
    found = _time_offset(loaded.recording, values)
    if found is None:
        report = loaded.recording.report
        return _reported(loaded, warnings=(*report.warnings, NOT_TOLD))
    tool, twist = _earlier(loaded.tool_pose, found.value), loaded.tool_twist
    if twist is not None:
        twist = _earlier(twist, found.value)
    recording = prepare(tool, loaded.package_pose, _settings(values), twist)
    moved = replace(loaded, tool_pose=tool, tool_twist=twist, recording=recording)
    return _reported(moved, time_offset=found)


def _time_offset(recording: Recording, values: Mapping[str, Any]) -> TimeOffset | None:
    """Return the time by which the tool's stamps are behind the package's, if that is told."""
    half_window = recording.tool_weights.shape[1] // 2
    tool = savgol(recording.aligned_tool, half_window, values['filter.tool.order'])
    samples = samples_of(recording, package_of(values), values['gravity'])
    structure = structure_named(values['fit.structure'])
    return time_offset(tool, samples, values['cup.length'], structure)


def _earlier(stream: Any, seconds: float) -> Any:
    """Return a stream with earlier stamps."""
    return replace(stream, stamps_ns=stream.stamps_ns - round(seconds * NS_PER_S))


def _reported(loaded: Loaded, **changes: Any) -> Loaded:
    """Return the same with changes of the report."""
    recording = loaded.recording
    report = replace(recording.report, **changes)
    return replace(loaded, recording=replace(recording, report=report))


def offset_sentence(bag: object, offset: TimeOffset | None) -> list[str]:
    """Return a sentence about the clocks of a recording, or none where that is not told."""
    if offset is None or not math.isfinite(offset.std):
        return []
    where = 'behind' if offset.value >= 0.0 else 'ahead of'
    return [
        f'{bag}: the stamps of the tool were {1e3 * abs(offset.value):.3f} ± '
        f'{1e3 * offset.std:.3f} ms {where} those of the package, which was taken out.'
    ]


def repeats(recordings: Iterable[tuple[str, str]]) -> Iterator[tuple[int, str]]:
    """
    Yield what is wrong with recordings that are there twice, under whatever names.

    Parameters
    ----------
    recordings : iterable of (str, str)
        Name and digest of each.

    Yields
    ------
    (int, str)
        Place of a recording that has been there before, and a sentence about it.

    """
    first: dict[str, str] = {}
    for number, (name, digest) in enumerate(recordings):
        if digest in first:
            yield number, (
                f"'{name}' and '{first[digest]}' are the same recording, which would count twice. "
                'Give it once.'
            )
        first.setdefault(digest, name)


def values_of_each(values: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """
    Return the parameters for each of `bags`, with the package that it held.

    Raises
    ------
    BellowsError
        If there are not as many package.files, or one of them lacks something.

    """
    return _each(values, 'bags', 'package.files', PACKAGE_PARAMETERS)


def values_at_rest(values: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """
    Return the parameters for each of `static.bags`, with what hung there.

    Raises
    ------
    BellowsError
        If there are not as many static.files, or a mass or a centre of mass is not known.

    """
    filled = {'package.inertia': NO_INERTIA, **values}
    each = _each(filled, 'static.bags', 'static.files', ('package.mass',))
    missing = [n for n in PACKAGE_PARAMETERS if any(n not in own for own in each)]
    if missing:
        raise BellowsError(f'Not set for the recordings in static.bags: {", ".join(missing)}.')
    return each


def packages_differ(held: Sequence[Package]) -> bool:
    """Tell whether the packages of recordings have different masses."""
    return len({package.mass for package in held}) > 1


def names_of(bags: Sequence[object], held: Sequence[Package]) -> list[str]:
    """Return the names of recordings, with masses where these tell them apart."""
    if not packages_differ(held):
        return [str(bag) for bag in bags]
    return [f'{bag} ({package.mass:.4g} kg)' for bag, package in zip(bags, held, strict=True)]


def _each(
    values: Mapping[str, Any], bags_in: str, files_in: str, needed: Sequence[str]
) -> list[Mapping[str, Any]]:
    """Return the parameters for each recording; every file of a package has what is needed."""
    files, bags = values[files_in], values[bags_in]
    if not files:
        return [values] * len(bags)
    if len(files) != len(bags):
        raise BellowsError(
            f'{files_in} has {len(files)} files for {len(bags)} recordings. Name one for each '
            f'recording in {bags_in}, in the same order, or none.'
        )
    each: list[Mapping[str, Any]] = []
    for file in files:
        own = {n: v for n, v in read_parameters(file).items() if n in PACKAGE_PARAMETERS}
        missing = [name for name in needed if name not in own]
        if missing:
            raise BellowsError(f"Parameter file '{file}' lacks {', '.join(missing)}.")
        each.append({**values, **own})
    return each


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
