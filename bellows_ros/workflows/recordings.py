"""Reading of a recording, and its preparation by its parameters."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import math
import os
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.estimate import Solution
from bellows_ros.core.identification.least_squares import likely_delay
from bellows_ros.core.identification.unknowns import KINDS, weak_prior
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment as frames
from bellows_ros.core.recording import recording as prepared
from bellows_ros.core.recording.faults import pose_remarks, recording_remarks
from bellows_ros.core.recording.pose_faults import NO_INERTIA, RecordedPoses
from bellows_ros.core.recording.preparation import prepare, with_tool_earlier
from bellows_ros.core.recording.prepared_faults import detected_tags
from bellows_ros.core.recording.recording import PrepareSettings, Recording, TimeOffset
from bellows_ros.core.sensors.body import middle_of
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.residuals import DISPLAY_FACTORS
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, same_frame, TwistStream
from bellows_ros.errors import BellowsError, NoTopicError, UndeterminedError, UnexplainedError
from bellows_ros.files import detections, File, parameter_files, results
from bellows_ros.report.findings import prevents, text
import numpy as np

Progress = Callable[..., None]
"""Callback with the current step and its completed fraction (0 to 1)."""


def no_progress(what: str, part: float = 0.0) -> None:
    """Ignore the progress."""


FULL_RANGE = {'recording.start': 0.0, 'recording.end': 0.0}
"""Settings for reading whole recordings: plans and standstills."""

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


def require_none(remarks: Iterable[Finding], use: str, more: str = '') -> None:
    """Raise for all faults, if some prevent a use of a recording, 'fit' or 'replay'."""
    wrong = [remark for remark in remarks if remark.level == Level.ERROR]
    if any(prevents(remark, use) for remark in wrong):
        error = BellowsError if any(prevents(each, 'replay') for each in wrong) else (
            UnexplainedError)
        raise error(' '.join([
            *map(text, wrong),
            'More may be wrong: correct this, and run it again.', *[more] * bool(more)]))


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
    require_none([remark for remark in found if remark.code != 'tool_at_rest'],  # keeps its stamps
                 'fit' if registers else 'replay')
    if registers:
        recording = registered_recording(tool, package, twist, settings, values)
    else:
        if world:
            pose = frames.pose_of(world)
            package = frames.in_tool_world(package, pose, tool.frame_id)
            settings = settings.in_world(pose)
        recording = prepare(tool, package, settings, twist, marker_alignment(values))
    return _with_remarks(recording, (*recording.report.remarks, *found))


def is_measured(values: Values) -> bool:
    """Return whether measured.* describes the recorded package: a tag, its own world, a marker."""
    return values.measured.tag_size > 0.0 or (
        values.recording.package_world not in ('', checks.ESTIMATE)) or (
        any(values.measured.offset) and values.get('recording.package_frame') == 'com')


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
    if not is_measured(values):
        return package
    return replace(trajectory.earlier(package, values.measured.latency[0]),
                   position=values.measured.scale * package.position)


def marker_alignment(values: Values) -> frames.Alignment | None:
    """Return the alignment by measured.offset, None without an offset."""
    offset = np.array(values.measured.offset)
    if not (is_measured(values) and offset.any()):
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
        'unit': f' {unit}' * (unit != '1')}, topic)


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


def values_of_each(values: Values, at_rest: bool = False) -> list[Values]:
    """
    Return the parameters for each recording in bags, or in static.bags, with its package.

    Raises
    ------
    BellowsError
        If the numbers of files and recordings differ, or a parameter is missing for a recording.

    """
    files, count = values.package.files, len(values.bags)
    bags = (*values.bags, *values.static.bags)
    if files and len(files) != len(bags):
        raise BellowsError(
            f'package.files has {len(files)} files for {len(bags)} recordings. Name one for each '
            'recording in bags, then for each in static.bags, or none.')
    chosen = slice(count, None) if at_rest else slice(count)
    if at_rest:
        values = Values({'package.inertia': NO_INERTIA, **values})
    each: list[Values] = [
        values.replaced({
            name: value for name, value in parameter_files.read_parameters(file).items()
            if name in checks.PACKAGE_PARAMETERS or name.startswith(
                ('topics.', 'recording.', 'tool_twist.', 'gravity.direction'))})
        for file in files[chosen]] or [values for _ in bags[chosen]]
    for bag, parameters in zip(bags[chosen], each, strict=True):
        missing = [name for name in checks.RECORDING_PARAMETERS if name not in parameters]
        if missing:
            raise BellowsError(
                f"For '{bag}' these are not set: {', '.join(missing)}. Set them, or name a "
                'parameter file for each recording in package.files.')
    return each


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


# ----------------------------------- registration: estimates of world, marker and clock


def registered_recording(
    tool: PoseStream, package: PoseStream, twist: TwistStream | None, settings: PrepareSettings,
    values: Values,
) -> Recording:
    """Return prepared streams, in the world of the tool and on its clock."""
    failures, is_late = [], 'time_offset' in values.fit.free
    for rough_s in frames.rough_offsets(
            tool.trajectory(), package.trajectory()) if is_late else (0.0,):
        try:
            return _registered(
                trajectory.earlier(tool, rough_s), package,
                twist and trajectory.earlier(twist, rough_s), settings, values, rough_s)
        except UndeterminedError as error:
            failures.append(error)
    raise failures[0]


def _registered(
    tool: PoseStream, package: PoseStream, twist: TwistStream | None, settings: PrepareSettings,
    values: Values, rough_s: float,
) -> Recording:
    """Return prepared streams with clocks that differ by about rough_s, s."""
    pose, alignment = _first_guess(tool, package, settings, values)

    def filtered(alignment: frames.Alignment | None) -> Recording:
        if pose is None:
            return prepare(tool, package, settings, twist, alignment)
        moved = frames.in_tool_world(package, pose, tool.frame_id)
        return prepare(tool, moved, settings.in_world(pose), twist, alignment)

    recording = filtered(alignment)
    is_late = 'time_offset' in values.fit.free
    late_s = likely_delay(recording) if is_late else None
    if late_s:
        tool, twist = trajectory.earlier(tool, late_s), twist and trajectory.earlier(twist, late_s)
        rough_s, recording = rough_s + late_s, filtered(alignment)
    tells_clock = is_late and (late_s is not None or len(
        frames.rotation_correlation(tool.trajectory(), package.trajectory())[0]) > 0)
    found = _estimated(recording, values, tells_clock)
    changes, estimates = dict[str, Any](), {
        name: found.estimate(name) for name in found.problem.places} if found else {}
    world, world_std = estimates.get('package_world', (None, np.zeros(6)))
    _require_world(values.fit.method, world_std)
    (scale,), _ = estimates.get('scale', (np.zeros(1), None))
    if scale and pose is not None:
        package, pose, settings = _scaled(package, pose, settings, 1.0 + scale)
        changes['scale'] = float(1.0 + scale) * values.measured.scale
    if world is not None and pose is not None:
        pose = frames.shifted_pose(pose, settings.R_world_recorded, middle_of(
            recording.tracked_package)[:3], world)
        changes['package_world'] = prepared.PackageWorld(pose, world_std)
    marker, _ = estimates.get('package_marker', (np.zeros(6), None))
    recording = filtered(_realigned(recording.alignment, marker))
    if is_late:
        recording, more = _on_one_clock(recording, rough_s, *estimates.get(
            'time_offset', (np.zeros(1), np.array([np.inf]))))
        changes |= more
    return replace(recording, report=replace(recording.report, **changes))


def _on_one_clock(
    recording: Recording, rough_s: float, offset: Array, std: Array
) -> tuple[Recording, dict[str, Any]]:
    """Return a recording without the estimated offset (1,) of its clocks, s, and the report."""
    if std[0] < KINDS['time_offset'].max_std:
        return with_tool_earlier(recording, float(offset[0])), {
            'time_offset': TimeOffset(rough_s + float(offset[0]), float(std[0]))}
    return recording, {'remarks': (*recording.report.remarks, Finding('not_identifiable', numbers={
        'label': 'The time offset', 'why': 'the recorded stamps are used unchanged',
        'how': 'Record a motion that is richer in all directions'}))}


def _is_marked(settings: PrepareSettings, values: Values) -> bool:
    """Return whether the marker is free: at rest none can be aligned with an unknown world."""
    return 'package_marker' in values.fit.free or settings.align_at_rest and (
        values.recording.package_world == checks.ESTIMATE)


def _estimated(recording: Recording, values: Values, tells_clock: bool) -> Solution | None:
    """Return the fit of K and P with the free ones of clock, world, marker and scale, if any."""
    names = [name for name, free in (
        ('time_offset', tells_clock),
        ('package_world', values.recording.package_world == checks.ESTIMATE),
        ('package_marker', _is_marked(recording.settings, values)),
        ('scale', 'scale' in values.fit.free)) if free]
    return fitting.registered(
        recording, conversion.given_structure(values), conversion.one_cup_of(values),
        weak_prior(names)) if names else None


def _scaled(
    package: PoseStream, pose: Array, settings: PrepareSettings, scale: float
) -> tuple[PoseStream, Array, PrepareSettings]:
    """Return poses, camera pose (6,) and settings with lengths scaled about the camera."""
    tag = settings.tag and replace(settings.tag, side=scale * settings.tag.side)
    origin = pose[:3] if tag else scale * pose[:3]
    return (replace(package, position=scale * package.position), np.append(origin, pose[3:]),
            replace(settings, tag=tag))


def _realigned(alignment: frames.Alignment, marker: Array) -> frames.Alignment:
    """Return the alignment with the estimated error (6,) of the marker's frame."""
    R = lie.exp_so3(marker[3:])  # origin_to_com is in lip axes, rotated by R
    return replace(
        alignment, R_package_markers_lip=alignment.R_package_markers_lip @ R,
        origin_to_com=R.T @ (alignment.origin_to_com + marker[:3]))


def _require_world(method: str, std: Array) -> None:
    """Raise if the world is unidentifiable, for least squares, which take it as exact."""
    if method == 'least_squares' and np.any(std > KINDS['package_world'].max_std):
        each = [f'{x:.2g}' for x in DISPLAY_FACTORS * std]
        raise UndeterminedError(
            'recording.package_world is not identifiable from this recording: the standard '
            f'errors are {", ".join(each[:3])} mm and {", ".join(each[3:])} degrees. Tilt '
            'and turn the tool more, best with three standstills tilted to different sides, '
            'or set its seven numbers.')


def _first_guess(
    tool: PoseStream, package: PoseStream, settings: PrepareSettings, values: Values,
) -> tuple[Array | None, frames.Alignment | None]:
    """Return the pose (7,) of the package's world, and the alignment of a marker, or None."""
    world, com = values.recording.package_world, settings.payload.com
    marked = _is_marked(settings, values)
    estimate = world == checks.ESTIMATE
    pose = None if estimate or not world else frames.pose_of(world)
    if not (marked or estimate):
        return pose, None
    to_lip = None if marked else np.zeros(3) if settings.package_frame == 'lip' else -com
    guess, grip = frames.hand_eye(
        tool.trajectory(), package.trajectory(), values.cup.length, com, to_lip)
    return guess if estimate else pose, grip
