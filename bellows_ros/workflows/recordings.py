"""Reading of a recording, and its preparation by its parameters."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import math
import os
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Mask, Stamps
from bellows_ros.core.identification.registration import (
    registered_recording,
    RegistrationSettings,
    Streams,
)
from bellows_ros.core.identification.segments import AnyRecording
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment as frames
from bellows_ros.core.recording import recording as prepared
from bellows_ros.core.recording.faults import pose_remarks, recording_remarks
from bellows_ros.core.recording.pose_faults import RecordedPoses
from bellows_ros.core.recording.prepared_faults import detected_tags
from bellows_ros.core.recording.recording import PrepareSettings, Recording, TimeOffset
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, same_frame
from bellows_ros.errors import BellowsError, NoTopicError, UnexplainedError
from bellows_ros.files import detections, File, parameter_files, results
from bellows_ros.report.findings import prevents, text
import numpy as np

FULL_RANGE = {'recording.start': 0.0, 'recording.end': 0.0}
"""Settings for reading whole recordings: plans and standstills."""

AT_REST = 'tool_at_rest'
"""Code of the fault of a tool at rest, which a fit with the motion of another recording allows."""

MIN_POSES = 20
"""Smallest number of poses of each body for a search for their faults."""


class Failed(NamedTuple):
    """An unusable recording, and the reason."""

    bag: str
    reason: str


def load(
    path: File, values: Values, name: str = '', held: bool = False, accepted: str = '',
) -> Recording:
    """
    Read a recording and prepare it.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    values : mapping
        Parameters by name, as `core.parameters.checks.resolve` returns them.
    name : str
        Name of the recording by the user; default: the path.
    held : bool
        Whether it is for a fit: only the holds are used, if vacuum.signal is set.
    accepted : str
        Code of a fault that is accepted.

    Raises
    ------
    BellowsError
        If the recording cannot be read, or is unusable for the identification of a cup.

    """
    settings, name = prepare_settings(values), name or os.fspath(path)  # before reading
    roles = 'tool_pose', 'package_pose', 'tool_twist'
    topics = {role: values[f'topics.{role}'] for role in roles}
    if values.measured.type == 'tf':
        topics['package_pose'] = detections.TF_TOPIC
    contents = detections.read_contents(path, topics, tag_sought(values))
    for problem in contents.problems.values():
        if isinstance(problem, NoTopicError) and values.bags[1:] and name in map(str, values.bags):
            problem = NoTopicError(f'{problem} If the topics of recordings differ, give each a '
                                   'file in package.files.')
        raise problem
    streams = within_interval(contents.streams, values)
    if held and values.vacuum.signal != 'none':
        from bellows_ros.workflows.holds import masks_held  # with the live predictor

        streams = _selected(streams, masks_held(path, streams, values))
    recording = prepare_streams(streams, settings, values, accepted)
    files = tuple(results.digests(path))
    return replace(recording, name=name, files=files, digest=results.recording_digest(files))


def tag_sought(values: Values) -> detections.TagSought:
    """Return the tag on the package of which corners are read."""
    given = values.measured
    return detections.TagSought(given.tag_size, given.child_frame, given.rectified)


def interval_masks(all_stamps: Sequence[Stamps], values: Mapping[str, Any]) -> list[Mask]:
    """
    Return masks of the stamps from recording.start to recording.end.

    Parameters
    ----------
    all_stamps : sequence of int arrays
        Stamps in any order, ns; the parameters count from the first of all.
    values : mapping
        Parameters of the interval, s; an end of 0, or none, is the recording's end.

    Raises
    ------
    BellowsError
        If the end is not after the start, or there are no stamps.

    """
    start, end = (values.get(name, 0.0) for name in FULL_RANGE)
    if not (start or end):
        return [np.ones(len(stamps), bool) for stamps in all_stamps]
    first = min((int(stamps.min()) for stamps in all_stamps if len(stamps)), default=0)
    last = max((int(stamps.max()) for stamps in all_stamps if len(stamps)), default=0)
    begins = first + round(start * NS_PER_S)
    ends = first + round(end * NS_PER_S) if end else last
    if end and end <= start:
        raise BellowsError(
            f'The interval from recording.start, {start:g} s, to recording.end, {end:g} s, is '
            'empty. Give an end (--to) after the start (--from).')
    chosen = [(stamps >= begins) & (stamps <= ends) for stamps in all_stamps]
    if ends <= begins or not any(mask.any() for mask in chosen):
        raise BellowsError(
            f'There are no messages from recording.start, {start:g} s, to '
            + (f'recording.end, {end:g} s' if end else 'the end')
            + f'; the recording lasts {(last - first) / NS_PER_S:.1f} s.')
    return chosen


def within_interval(streams: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return streams by role from recording.start to recording.end; see `interval_masks`."""
    if not any(values.get(name) for name in FULL_RANGE):
        return dict(streams)
    return _selected(
        streams, interval_masks([stream.stamps_ns for stream in streams.values()], values))


def _selected(streams: Mapping[str, Any], masks: Sequence[Mask]) -> dict[str, Any]:
    """Return streams by role with the selected messages, and the steps of clocks among them."""
    return {role: replace(stream, **{
        name: each[mask] for name, each in vars(stream).items() if isinstance(each, np.ndarray)
    }, **_steps_within(stream, mask)) for (role, stream), mask in zip(
        streams.items(), masks, strict=True)}


def _steps_within(stream: Any, mask: Mask) -> dict[str, Any]:
    """Return the steps of the clock of a stream of poses within selected ones."""
    chosen = stream.stamps_ns[mask]
    return {'clock_steps': tuple(step for step in stream.clock_steps if len(chosen) and (
        chosen[0] <= step[0] < chosen[-1]))} if isinstance(stream, PoseStream) else {}


def prepare_streams(
    streams: Mapping[str, Any], settings: PrepareSettings, values: Values, accepted: str = '',
) -> Recording:
    """
    Return prepared streams, in one world and on one clock.

    Streams are poses of tool and package, and twists of the tool, if any, by the names of their
    topics.
    """
    recording = _prepared(streams, settings, values, accepted)
    return recording if values.fit.method == 'least_squares' else _with_remarks(recording, [
        each for each in recording.report.remarks if each.code != 'low_rate'])


def checked(recording: Recording) -> Recording:
    """
    Return a recording with the remarks of all checks before a fit.

    Raises
    ------
    BellowsError
        If a fault prevents a replay and any fit.

    """
    remarks = (*recording.report.remarks, *recording_remarks(recording))
    require_none(remarks, 'replay')
    return _with_remarks(recording, remarks)


def _with_remarks(recording: Recording, remarks: Iterable[Finding]) -> Recording:
    """Return a recording with other remarks in its report."""
    return replace(recording, report=replace(recording.report, remarks=tuple(remarks)))


def is_at_rest(part: AnyRecording) -> bool:
    """Return whether the tool of a recording rests throughout."""
    return any(remark.code == AT_REST for remark in part.remarks)


def without_rest(part: AnyRecording) -> AnyRecording:
    """Return a recording without the fault of a tool at rest, for a fit with a motion."""
    kept = tuple(remark for remark in part.remarks if remark.code != AT_REST)
    if isinstance(part, Recording):
        return _with_remarks(part, kept)
    return part._replace(remarks=kept)


def require_none(remarks: Iterable[Finding], use: str, more: str = '') -> None:
    """Raise for all faults, if some prevent a use of a recording, 'fit' or 'replay'."""
    wrong = [remark for remark in remarks if remark.level == Level.ERROR]
    if any(prevents(remark, use) for remark in wrong):
        error = BellowsError if any(prevents(each, 'replay') for each in wrong) else (
            UnexplainedError)
        sentences = [*map(text, wrong), 'More may be wrong: correct this, and run it again.']
        if more:
            sentences.append(more)
        raise error(' '.join(sentences))


def _prepared(
    streams: Mapping[str, Any], settings: PrepareSettings, values: Values, accepted: str
) -> Recording:
    """Return prepared streams, in one world and on one clock."""
    for stream in streams.values():
        if not len(stream):
            raise BellowsError(
                f"Topic '{stream.name}' has no messages from recording.start to recording.end.")
    tool, twist = streams['tool_pose'], streams.get('tool_twist')
    if values.get('tool_pose.offset'):
        tool, twist = trajectory.streams_at_tip(
            tool, twist, conversion.tip_of(values), values.tool_twist.frame == 'world')
    if 'package_pose' not in streams:
        raise BellowsError(
            "topics.package_pose is ''. Name the topic with the package's poses.")
    package = streams['package_pose']
    if values.recording.package_world == '':
        prepared.require_one_frame(tool, package)
    world = values.recording.package_world
    registers = world == checks.ESTIMATE or bool(
        {'time_offset', 'package_marker'} & set(values.fit.free))
    package = as_measured(in_camera(package, tool.frame_id, values), values)
    found = pose_remarks(RecordedPoses(
        tool, package, settings.R_world_recorded, settings.payload, settings.align_at_rest, twist,
        settings.tool_twist_frame)) if (
            min(len(tool), len(package)) >= MIN_POSES) else ()
    found = tuple(remark for remark in found if remark.code != accepted)
    require_none([remark for remark in found if remark.code != AT_REST],  # keeps its stamps
                 'fit' if registers else 'replay')
    if registers:
        recording = registered_recording(
            Streams(tool, package, twist), settings, RegistrationSettings.of(values))
    else:
        recording = Streams(tool, package, twist).prepared(
            settings, frames.pose_of(world) if world else None, marker_alignment(values))
    return _with_remarks(recording, (*recording.report.remarks, *found))


def in_camera(package: PoseStream, world: str, values: Values) -> PoseStream:
    """
    Return the poses of a tag in the frame of its camera, also of poses in the world of the tool.

    Raises
    ------
    BellowsError
        If the poses are in the tool's world, and the pose of the camera in this world is not
        given.

    """
    if not values.measured.tag_size or package.corners is not None or not same_frame(
            package.frame_id, world):
        return package
    if values.recording.package_world in ('', checks.ESTIMATE):
        raise BellowsError(
            f"The poses of '{package.name}' are in '{world}', the frame of the tool's poses. The "
            "corners of a tag need its poses in the camera's own frame: record those, or set "
            'recording.package_world to the pose of the camera, seven numbers (x y z qx qy qz '
            'qw).')
    pose = frames.pose_of(values.recording.package_world)
    T = lie.inverse_transform(lie.transform(lie.quaternion_to_rotation(pose[3:]), pose[:3]))
    return replace(package, frame_id='camera', position=T[:3, 3] + lie.apply(
        T[:3, :3], package.position), rotation=T[:3, :3] @ package.rotation)


def as_measured(package: PoseStream, values: Values) -> PoseStream:
    """Return recorded poses of the package corrected by the stated latency and scale."""
    if not checks.is_measured(values):
        return package
    return replace(trajectory.earlier(package, values.measured.latency[0]),
                   position=values.measured.scale * package.position)


def marker_alignment(values: Values) -> frames.Alignment | None:
    """Return the alignment by measured.offset, None without an offset."""
    offset = np.array(values.measured.offset)
    if not (checks.is_measured(values) and offset.any()):
        return None
    T = lie.inverse_transform(lie.transform(lie.exp_so3(offset[3:]), offset[:3]))
    return frames.Alignment(np.eye(3), T[:3, :3], T[:3, :3].T @ T[:3, 3], np.zeros(3))


def sensor_findings(stream: PoseStream, is_tag: bool) -> tuple[Finding, ...]:
    """Return the finding on poses that seem to be of a tag, and are not stated as of one."""
    return () if is_tag else tuple(
        remark._replace(topic=stream.name) for remark in detected_tags(stream))


def estimate_finding(topic: str, value: Any, std: Any, unit: str = '1') -> Finding:
    """Return the finding on an estimate, a number, several or their text, with its errors."""
    numbers = value.split() if isinstance(value, str) else np.ravel(value)
    return Finding('estimated', Level.OK, {
        'values': ', '.join(f'{float(x):.5g}' for x in numbers),
        'errors': ', '.join(f'{x:.2g}' if x < np.inf else '-' for x in np.ravel(std)),
        'unit': '' if unit == '1' else f' {unit}'}, topic)


def offset_findings(offsets: Iterable[tuple[str, TimeOffset | None]]) -> list[Finding]:
    """Return findings on the corrected time offsets of recordings by name, unless unknown."""
    return [estimate_finding(
        f'{bag}: the delay of stamps of the tool against those of the package', offset.value,
        offset.std, 's') for bag, offset in offsets if offset and math.isfinite(offset.std)]


def duplicates(recordings: Iterable[tuple[str, str]]) -> Iterator[tuple[int, str]]:
    """
    Yield recordings that are given twice, under any name, each with a sentence.

    Parameters
    ----------
    recordings : iterable of (str, str)
        Name and digest of each.

    Yields
    ------
    (int, str)
        Index of a repeated recording, and a sentence about it.

    """
    names: dict[str, str] = {}
    for number, (name, digest) in enumerate(recordings):
        if digest in names:
            yield number, (
                f"'{name}' and '{names[digest]}' are the same recording and would count twice. "
                'Give it once.')
        names.setdefault(digest, name)


def values_of_each(values: Values) -> list[Values]:
    """
    Return the parameters for each recording in bags, with its package.

    Raises
    ------
    BellowsError
        If the numbers of files and recordings differ, or a parameter is missing for a recording.

    """
    bags, files = values.bags, values.package.files
    if files and len(files) != len(bags):
        raise BellowsError(
            f'package.files has {len(files)} files for {len(bags)} recordings. Name one for each '
            'recording in bags, or none.')
    each = [values for _ in bags]
    if files:
        each = [values.replaced(_of_recording(file)) for file in files]
    for bag, parameters in zip(bags, each, strict=True):
        missing = [name for name in checks.RECORDING_PARAMETERS if name not in parameters]
        if missing:
            raise BellowsError(
                f"For '{bag}' these are not set: {', '.join(missing)}. Set them, or name a "
                'parameter file for each recording in package.files.')
    return each


def _of_recording(file: File) -> dict[str, Any]:
    """Return the parameters of a recording and its package in a file of package.files."""
    return {name: value for name, value in parameter_files.read_parameters(file).items()
            if name in checks.PACKAGE_PARAMETERS or name.startswith(
                ('topics.', 'recording.', 'tool_twist.', 'gravity.direction'))}


def prepare_settings(values: Values) -> PrepareSettings:
    """Return the settings of the preparation, from parameters."""
    checks.require(values, checks.RECORDING_PARAMETERS)
    return PrepareSettings(
        world=values.recording.world,
        gravity_direction=values['gravity.direction'],
        package_frame=values.recording.package_frame,
        align_at_rest=values.recording.align_at_rest,
        payload=conversion.package_of(values),
        gravity=values.gravity.magnitude,
        tool_twist_frame=values.tool_twist.frame,
        tag=conversion.tag_of(values))
