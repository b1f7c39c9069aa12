"""
Preparation of recorded streams for identification and validation.

Each stream is transformed into the world's axes (4.1), cleaned of tracking errors (appendix H),
resampled to a uniform rate, aligned at rest (4.2-4.13) and filtered (4.15-4.63); the tool is then
interpolated at the package's stamps. The report lists all omitted data.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.signals import resampling, trajectory
from bellows_ros.core.signals.savgol import weights_for
from bellows_ros.core.signals.trajectory import (
    NS_PER_S,
    PoseStream,
    Trajectory,
    TwistStream,
)
from bellows_ros.errors import BellowsError
import numpy as np

from .alignment import aligned_at_rest, Alignment, in_world, rest_of, standstill
from .outliers import find_outliers, increments_of, LastingStep, Outliers
from .recording import (
    Filter,
    LOW_RATE_HZ,
    PrepareSettings,
    Recording,
    RecordingReport,
    StreamReport,
)

AUTOMATIC_HALF_WINDOW = 1 / 12
"""Default half window of the filter, s. With order 6 the filter reduces K and P of a cup shaken at
3 Hz by less than 0.1 %, with the most averaging of noise at that error."""

MAX_REPEATED = 0.05
"""Largest ratio of poses with repeated stamps to others that adds no noise in motion."""

MAX_LATERAL_OFFSET = 5e-3
"""Largest lateral offset of the lip at rest without a warning, m: a tenth of a cup's length."""

MAX_LATERAL_COM = 1e-6
"""Largest lateral centre of mass that counts as none, m."""


def prepare(
    tool: PoseStream, package: PoseStream, settings: PrepareSettings,
    tool_twist: TwistStream | None = None, alignment: Alignment | None = None
) -> Recording:
    """
    Clean and align recorded streams, choose their filters, and join them to a recording.

    Parameters
    ----------
    tool, package : PoseStream
        Recorded poses, in one frame and stamped by one clock.
    settings : PrepareSettings
        Settings of the preparation.
    tool_twist : TwistStream, optional
        Recorded twist of the tool tip, used in `measured_tool` alone. Least squares needs filtered
        twists of both bodies: the filter attenuates them equally, and the attenuation cancels in
        the relative twist.
    alignment : Alignment, optional
        Alignment of another recording with the current markers and grasp, instead of a standstill
        of this recording.

    Raises
    ------
    BellowsError
        If the streams overlap by less than the windows of the filters, are too short for them, or
        do not begin at rest although required, or no valid sample remains.

    """
    is_tag = settings.tag is not None
    clean_tool = _clean(tool, settings.R_world_recorded)
    clean_package = _clean(package, settings.R_world_recorded, is_tag)
    if tool_twist is not None and clean_tool.report.arrival_jitter:
        tool_twist = replace(tool_twist, stamps_ns=_shifted_alike(
            tool_twist.stamps_ns, tool.stamps_ns, clean_tool.report.recorded.stamps_ns))
    tool, package = clean_tool.report.recorded, clean_package.report.recorded
    tool_poses, package_poses = clean_tool.uniform, clean_package.uniform
    _common(tool_poses.stamps_ns, package_poses.stamps_ns, (tool, package))
    as_they_are = not settings.align_at_rest and alignment is None
    alignment = alignment or _alignment(tool_poses, package_poses, settings)
    aligned_tool = alignment.tool(tool_poses)
    aligned_package = alignment.package(package_poses)
    of_tool = _filter(
        aligned_tool, settings.tool_half_window, settings.tool_order, tool.name)
    of_package = _filter(
        aligned_package, settings.package_half_window, settings.package_order, package.name)
    tool_report = _with_filter(clean_tool.report, of_tool, aligned_tool)
    package_report = _with_filter(clean_package.report, of_package, aligned_package)
    remarks = [*remarks_on(tool_report), *remarks_on(package_report)]
    if as_they_are:
        remarks += rest_of(tool_poses, package_poses).remarks
    remarks += _alignment_remarks(alignment, settings)
    tracked = aligned_package
    if is_tag or not package_report.timing.uniform:
        tracked = alignment.package(clean_package.marked)
    return _joined(Recording(
        settings, tool, package, tool_twist, (of_tool, of_package), aligned_tool, aligned_package,
        tracked, alignment, RecordingReport(tool_report, package_report, tuple(remarks))))


def with_tool_earlier(recording: Recording, seconds: float) -> Recording:
    """Return a recording with the stamps of the tool earlier by some seconds."""
    twist, (of_tool, of_package) = recording.tool_twist, recording.filters
    return _joined(replace(
        recording, tool_pose=trajectory.earlier(recording.tool_pose, seconds),
        tool_twist=twist and trajectory.earlier(twist, seconds),
        filters=(replace(of_tool, poses=trajectory.earlier(of_tool.poses, seconds)), of_package)))


def _joined(recording: Recording) -> Recording:
    """Return a recording with its measured poses at the stamps of the package."""
    (of_tool, of_package), twist = recording.filters, recording.tool_twist
    report, streams = recording.report, (recording.tool_pose, recording.package_pose)
    common = _common(of_tool.stamps_ns, of_package.stamps_ns, streams)
    tool = resampling.resample(of_tool.poses, common, report.tool.timing.longest_step_ns)
    if twist is not None:
        tool = _with_twist(tool, twist, recording.alignment, recording.settings)
    recording = replace(recording, measured_tool=tool,
                        measured_package=of_package.poses.between(*common[[0, -1]]))
    if not recording.whole.any():
        both = report.tool, report.package
        none_left = f'None of the {len(common)} common samples is left'
        if any(_in_bursts(report) for report in both):
            raise BellowsError(
                'The poses come in bursts, as if stamped on arrival: stamp them when they are '
                f'measured. {none_left} between the gaps of such stamps.')
        faults = '; '.join(
            f"'{r.recorded.name}': {r.marked} of {len(r.recorded)} poses are outliers, "
            f'{len(r.timing.gaps)} gaps, {r.overlapping_gap} filtered samples touch one of these'
            for r in both)
        raise BellowsError(f'{none_left}: {faults}. Use smaller half windows, or a recording with '
                           'fewer gaps and outliers.')
    return recording


def _alignment(
    tool_poses: Trajectory, package_poses: Trajectory, settings: PrepareSettings
) -> Alignment:
    """Return the alignment at the standstill after the begin of both streams, or of no markers."""
    if not settings.align_at_rest:
        to_com = settings.payload.com if settings.package_frame == 'lip' else np.zeros(3)
        return Alignment(np.eye(3), np.eye(3), to_com, np.zeros(3))
    start = max(int(poses.stamps_ns[0]) for poses in (tool_poses, package_poses))
    seconds = rest_of(tool_poses, package_poses).seconds
    tool, package = (
        standstill(poses, start, seconds, body)
        for poses, body in ((tool_poses, 'tool'), (package_poses, 'package')))
    return aligned_at_rest(tool, package, settings.package_frame, settings.payload.com)


class CleanPoses(NamedTuple):
    """Faults of a topic, and its poses in the world with marked outliers: recorded, uniform."""

    report: StreamReport
    marked: Trajectory
    uniform: Trajectory


def _clean(
    recorded: PoseStream, R_world_recorded: Array, is_tag: bool = False
) -> CleanPoses:
    """Return the poses of a topic in the world; poses of a tag are not searched for outliers."""
    with _naming(recorded.name):
        recorded, jitter_s = resampling.at_sampling(recorded)
        poses = in_world(recorded.trajectory(), R_world_recorded)
        timing = resampling.timing(poses.stamps_ns)
        if is_tag:  # the fit weights the errors of a tag
            outliers = Outliers(np.full(len(poses), True), ())
        else:
            outliers = find_outliers(poses, timing.longest_step_ns)
        marked = replace(poses, valid=outliers.good)
        good = np.flatnonzero(outliers.good)  # poses outside the recording's time are ignored
        if len(good) > 2:
            marked = marked.select(slice(good[0], good[-1] + 1))
        report = StreamReport(recorded, timing, outliers, arrival_jitter=jitter_s)
        return CleanPoses(report, marked, resampling.on_grid(marked, timing))


@contextmanager
def _naming(topic: str) -> Iterator[None]:
    """Add the topic to messages of errors."""
    try:
        yield
    except BellowsError as error:
        raise BellowsError(f"Topic '{topic}': {error}") from None


def _filter(poses: Trajectory, half_window: int, order: int, name: str) -> Filter:
    rate_hz, good = trajectory.uniform_rate_hz(poses.stamps_ns), poses.select(poses.valid)
    if 1 < len(good) < len(poses):
        poses = resampling.filled(
            poses, good, round(min(3.5 / rate_hz, 0.01) * NS_PER_S))  # two samples, 10 ms
    if half_window == 0:
        half_window = max(round(AUTOMATIC_HALF_WINDOW * rate_hz), (order + 1) // 2 + 1)
    with _naming(name):
        return Filter(poses, half_window, order, weights_for(poses, half_window, order))


def _with_filter(report: StreamReport, of_body: Filter, aligned: Trajectory) -> StreamReport:
    """Return a report with the numbers of samples by gaps and of interpolated ones of a filter."""
    filtered = of_body.poses.between(*of_body.stamps_ns[[0, -1]])
    return replace(
        report, overlapping_gap=int(np.count_nonzero(filtered.valid & ~of_body.whole)),
        interpolated=int(np.count_nonzero(of_body.poses.valid & ~aligned.valid)))


def _common(tool: Stamps, package: Stamps, recorded: tuple[PoseStream, PoseStream]) -> Stamps:
    """Return the package's stamps at which the tool is measured."""
    common: Stamps = package[(package >= tool[0]) & (package <= tool[-1])]
    if not len(common):
        covered = ', '.join(
            "'{}' covers {:.3f} to {:.3f} s".format(s.name, *s.stamps_ns[[0, -1]] / NS_PER_S)
            for s in recorded)
        raise BellowsError(
            f'The stamps of tool and package do not overlap: {covered}. They are of two clocks or '
            'two recordings: stamp both topics by one clock, or set fit.free: [time_offset].')
    return common


def _with_twist(
    tool: Trajectory, recorded: TwistStream, alignment: Alignment, settings: PrepareSettings
) -> Trajectory:
    """Return the tool with its recorded twists, interpolated, in axes of E."""
    if len(recorded) < 3:
        raise BellowsError(
            f"Topic '{recorded.name}' has {len(recorded)} usable twists, too few. Set "
            "topics.tool_twist to '' to estimate the twist from the poses.")
    R = (alignment.R_tool_markers_tool.T if settings.tool_twist_frame == 'tool'
         else np.swapaxes(tool.rotation, -1, -2) @ settings.R_world_recorded)
    stamps_ns, wanted_ns = recorded.stamps_ns, tool.stamps_ns
    end = np.clip(np.searchsorted(stamps_ns, wanted_ns), 1, len(stamps_ns) - 1)
    ends = stamps_ns[[end - 1, end]]  # ends of the step that contains a wanted stamp
    is_valid = (wanted_ns >= stamps_ns[0]) & (wanted_ns <= stamps_ns[-1]) & (
        (ends[1] - ends[0] <= resampling.timing(stamps_ns).longest_step_ns)
        | (ends == wanted_ns).any(axis=0))
    at, since = wanted_ns - stamps_ns[0], stamps_ns - stamps_ns[0]
    twist = np.stack([apply(R, np.column_stack([np.interp(at, since, axis) for axis in part.T]))
                      for part in (recorded.linear, recorded.angular)], axis=1)
    return replace(tool, twist=twist.reshape(-1, 6), valid=tool.valid & is_valid)


def _shifted_alike(stamps_ns: Stamps, before_ns: Stamps, after_ns: Stamps) -> Stamps:
    """Return stamps with the corrections of other stamps, interpolated."""
    moved = np.interp(stamps_ns - before_ns[0], before_ns - before_ns[0], after_ns - before_ns)
    return np.maximum.accumulate(stamps_ns + np.rint(moved).astype(np.int64) - np.arange(
        len(stamps_ns))) + np.arange(len(stamps_ns))


def _alignment_remarks(alignment: Alignment, settings: PrepareSettings) -> list[Finding]:
    """Return remarks on the lateral offsets of the lip and of the centre of mass."""
    remarks, aside = list[Finding](), float(np.linalg.norm(alignment.lateral_offset))
    if aside > MAX_LATERAL_OFFSET:
        remarks.append(Finding('aside', Level.WARN, {'part': 'lip', 'aside': aside}))
    lateral_com = float(np.hypot(*settings.payload.com[:2]))
    if settings.align_at_rest and lateral_com > MAX_LATERAL_COM:
        remarks.append(Finding(
            'aside', Level.WARN, {'part': 'centre of mass', 'aside': lateral_com}))
    return remarks


def remarks_on(report: StreamReport) -> list[Finding]:
    """Return remarks on the poses of one topic, before or after a fit."""
    recorded, time = report.recorded, report.timing
    topic, rate_hz = recorded.name, time.rate_hz
    remarks = list[Finding]()
    if lasting := lasting_steps(report):
        after_ns = recorded.stamps_ns[lasting[0].before] - recorded.stamps_ns[0]
        remarks.append(Finding('slip', Level.WARN, {
            'position': max(step.position for step in lasting),
            'rotation': max(step.rotation for step in lasting),
            'at': float(after_ns) / NS_PER_S}, topic))

    def jitter(seconds: float, instead: str = '', level: Level = Level.WARN) -> Finding:
        numbers = {'jitter': seconds, 'rate': rate_hz, 'instead': instead}
        return Finding('jitter', level, numbers, topic)

    if report.arrival_jitter:
        remarks.append(jitter(report.arrival_jitter, '; uniform times are used instead'))
    elif _in_bursts(report):
        return [jitter(time.jitter_s, level=Level.ERROR), *remarks]
    if rate_hz < LOW_RATE_HZ:
        remarks.append(Finding(
            'low_rate', Level.WARN, {'rate': rate_hz, 'least': LOW_RATE_HZ}, topic))
    if report.repeated_stamps > MAX_REPEATED * len(recorded):
        remarks.append(jitter(
            1.0 / rate_hz, f'; {report.repeated_stamps} poses repeat a stamp and are left out'))
    if time.jitter_s * rate_hz > resampling.MAX_RELATIVE_JITTER:
        remarks.append(jitter(time.jitter_s))
    return remarks


def _in_bursts(report: StreamReport) -> bool:
    return resampling.in_bursts(report.recorded.stamps_ns, report.timing)


def lasting_steps(report: StreamReport) -> list[LastingStep]:
    """Return the jumps without a return that neither uneven stamps nor fast motion explain."""
    if not report.outliers.steps:
        return []
    poses, time = report.recorded, report.timing
    moved, typical = np.linalg.norm(increments_of(poses), axis=2), np.zeros(2)
    if time.rate_hz < LOW_RATE_HZ:  # large motion between two poses
        # frequent steps, and errors with memory (m, rad), do not count
        typical = np.maximum(np.percentile(moved, 99.0, axis=1), (0.1, 0.5))

    def exceeds_motion(step: LastingStep) -> bool:
        """Return whether a step exceeds frequent steps, jitter and steps of the clock."""
        around = slice(max(step.before - 5, 0), step.before + 6)
        speed = moved[:, around.start:around.stop - 1].sum(axis=1) / (
            np.ptp(poses.stamps_ns[around]) / NS_PER_S)
        stamp_ns = poses.stamps_ns[step.before]
        is_of_clock = any(abs(stamp_ns - at_ns) < 1.5 * abs(size) * NS_PER_S
                          for at_ns, size in poses.clock_steps)
        return not is_of_clock and not any(np.all(step[1:] < limit) for limit in (
            typical, 10.0 * time.jitter_s * speed))

    return list(filter(exceeds_motion, report.outliers.steps))
