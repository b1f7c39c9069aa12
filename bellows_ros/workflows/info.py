"""Contents and quality of a recording: topics, rates, gaps, and their probable roles."""

from collections.abc import Iterable, Mapping, Sequence
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.parameters import checks
from bellows_ros.core.parameters.conversion import tip_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment, preparation, recording
from bellows_ros.core.recording.faults import pose_remarks, recording_remarks
from bellows_ros.core.recording.outliers import find_outliers
from bellows_ros.core.recording.pose_faults import (
    noise_of,
    RecordedPoses,
    tool_z,
    upright_offset,
    UPRIGHT_OFFSETS,
)
from bellows_ros.core.recording.roles import (
    BodyPair,
    Guess,
    IMPLAUSIBLE_DISTANCE,
    likeliest_pair,
    MAX_CHANGE,
    roles_by_name,
    twist_of,
)
from bellows_ros.core.signals.resampling import at_sampling, common_span, timing
from bellows_ros.core.signals.trajectory import (
    NS_PER_S,
    PoseStream,
    same_frame,
    streams_at_tip,
    TwistStream,
)
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, File, results
from bellows_ros.files.bags import accepted_types, Contents, TopicCount, topics
from bellows_ros.files.detections import read_contents
from bellows_ros.files.messages import DETECTIONS
from bellows_ros.report.findings import text
from bellows_ros.workflows.holds import is_named, SIGNALS
from bellows_ros.workflows.recordings import sensor_findings, tag_sought, within_interval
import numpy as np

FLANGE_OUTWARD = UPRIGHT_OFFSETS[2, False]
"""Pose of the tool tip in a flange with z out of the arm: a half turn about x."""

READ_TYPES: Mapping[str, tuple[str, ...]] = {
    'pose': (*accepted_types('pose'), DETECTIONS), 'twist': tuple(accepted_types('twist'))}
"""Types of messages by their content, which is read."""


class TopicInfo(NamedTuple):
    """
    A topic, and the quality of its messages if they can be read.

    Parameters
    ----------
    name, type_name : str
    messages : int
    kind : str
        Content 'pose', 'twist', 'pose and twist', or '' for an unusable type.
    problem : str
        Reason for an unreadable topic of a suitable type; otherwise ''.
    frame_id : str
    start_ns : int
        First stamp, ns.
    duration_s, rate_hz, jitter_s : float
        Last minus first stamp (s); rate without gaps (Hz); robust deviation of the steps (s).
    gaps : tuple of (float, float)
        Start, from the recording's first stamp, and length of each, s.
    refused : mapping of str to int
        Numbers of omitted messages by reason.
    outliers : int
        Number of poses with tracking errors: jumps and steps.
    noise : mapping of str to list of 3 floats
        Standard deviations of 'position' (m) along the world's axes and of 'rotation' (rad) about
        body axes.
    remarks : tuple of Finding
        Findings for an identification from these poses.

    """

    name: str
    type_name: str
    messages: int
    kind: str = ''
    problem: str = ''
    frame_id: str = ''
    start_ns: int = 0
    duration_s: float = 0.0
    rate_hz: float = float('nan')
    jitter_s: float = float('nan')
    gaps: tuple[tuple[float, float], ...] = ()
    refused: Mapping[str, int] = MappingProxyType({})
    outliers: int = 0
    noise: Mapping[str, list[float]] = MappingProxyType({})
    remarks: tuple[Finding, ...] = ()


class Info(NamedTuple):
    """
    A recording.

    Parameters
    ----------
    path : str
    topics : tuple of TopicInfo
        Topics by name.
    tool, package, twist : Guess or None
    settings : mapping
        Parameters for reading the recording, by name.
    findings : tuple of Finding
        Findings for an identification from the recording.

    """

    path: str
    topics: tuple[TopicInfo, ...]
    tool: Guess | None
    package: Guess | None
    twist: Guess | None
    settings: Mapping[str, Any]
    findings: tuple[Finding, ...]

    @property
    def is_tag(self) -> bool:
        """Whether the package's poses seem to be of a detected tag."""
        return any(finding.code == 'sensor' for finding in self.findings)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of the findings."""
        return tuple(map(text, self.findings))

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return results.plain_items({
            **self._asdict(), 'findings': self.notes,
            'topics': [{**topic._asdict(), 'remarks': [*map(text, topic.remarks)]}
                       for topic in self.topics]})


def info(path: File, given: Mapping[str, Any] = MappingProxyType({})) -> Info:
    """
    Describe a recording and propose settings for reading it.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    given : mapping
        Parameters, such as 'recording.start'; they replace proposed ones.

    Raises
    ------
    BellowsError
        If there is no recording, or it is damaged.

    """
    counts = topics(path)
    wanted = {
        f'{topic.name} {kind}': topic.name for topic in counts if topic.messages
        for kind, types in READ_TYPES.items() if topic.type_name in types}
    tag = tag_sought(checks.resolve(given))
    contents = read_contents(path, wanted, tag) if wanted else Contents({}, {})
    problems = {wanted[role]: str(error) for role, error in contents.problems.items()}
    streams = {role: stream for role, stream in within_interval(contents.streams, given).items()
               if len(stream)}
    start_ns = min((int(s.stamps_ns[0]) for s in streams.values()), default=0)
    described = tuple(_describe_topic(topic, streams, problems, start_ns) for topic in counts)
    poses = {s.name: s for s in streams.values() if isinstance(s, PoseStream) and len(s) > 2}
    twists = {s.name: s for role, s in streams.items() if isinstance(s, TwistStream)
              and role.endswith('twist') and len(s) > 2}
    found = _with_roles(path, described, poses, twists, str(given.get('tool_pose.offset', '')))
    return found._replace(settings={**found.settings, **given, 'bags': found.settings['bags']})


def _describe_topic(
    topic: TopicCount, streams: Mapping[str, bags.Stream], problems: Mapping[str, str],
    start_ns: int,
) -> TopicInfo:
    """Return the description of a topic."""
    kinds = [kind for kind in READ_TYPES if f'{topic.name} {kind}' in streams]
    if not kinds:
        return TopicInfo(*topic, problem=problems.get(topic.name, ''))
    stream = streams[f'{topic.name} {kinds[0]}']
    return TopicInfo(
        *topic, ' and '.join(kinds), frame_id=stream.frame_id,
        start_ns=int(stream.stamps_ns[0]),
        duration_s=float(stream.stamps_ns[-1] - stream.stamps_ns[0]) / NS_PER_S,
        refused={reason: len(where) for reason, where in stream.refused.items()},
        **_describe_quality(stream, start_ns))


def _describe_quality(stream: bags.Stream, start_ns: int) -> dict[str, Any]:
    """Return rate, gaps, and, for poses, outliers, noise and motion; nothing of two messages."""
    if len(stream) <= 2:
        return {}
    time = timing(stream.stamps_ns)
    quality: dict[str, Any] = {
        'rate_hz': time.rate_hz,
        'jitter_s': time.jitter_s,
        'gaps': tuple(((gap.start_ns - start_ns) / NS_PER_S, gap.duration_s) for gap in time.gaps)}
    if isinstance(stream, PoseStream):
        stream, jitter_s = at_sampling(stream)
        time = timing(stream.stamps_ns)
        outliers = find_outliers(stream.trajectory(), time.longest_step_ns)
        noise = noise_of(stream.trajectory()).tolist()
        quality |= {
            'outliers': int(np.count_nonzero(~outliers.good)),
            'noise': {'position': noise[:3], 'rotation': noise[3:]} if np.isfinite(
                noise).all() else {},
            'remarks': tuple(preparation.remarks_on(
                recording.StreamReport(stream, time, outliers, arrival_jitter=jitter_s)))}
    return quality


def _with_roles(
    path: File, described: tuple[TopicInfo, ...], poses: Mapping[str, PoseStream],
    twists: Mapping[str, TwistStream], offset: str
) -> Info:
    """Return the recording with roles, settings and findings, for a given tool_pose.offset."""
    pair = likeliest_pair(poses)
    tool, package = (pair.tool, pair.package) if pair else roles_by_name(poses)
    twist = twist_of(poses[tool.topic], twists) if tool else None
    settings: dict[str, Any] = {'bags': (os.fspath(path),)}
    if tool:
        settings['topics.tool_pose'] = tool.topic
    if package:
        settings['topics.package_pose'] = package.topic
    settings['topics.tool_twist'] = twist.topic if twist else ''
    if twist:
        settings['tool_twist.frame'] = twist.frame
    if signal := _vacuum_signal(described):
        settings['vacuum.signal'] = signal
    used = {guess.topic for guess in (tool, package, twist) if guess}
    findings = [Finding('left_out', Level.WARN, {
        'part': topic.name, 'reason': topic.problem}) for topic in described if topic.problem]
    findings += [remark for topic in described if topic.name in used for remark in topic.remarks]
    rates_hz = [timing(poses[guess.topic].stamps_ns).rate_hz for guess in (tool, package) if guess]
    if any(rate_hz < recording.LOW_RATE_HZ for rate_hz in rates_hz):
        settings['fit.method'] = 'output_error'
    if tool and package:
        deduced = _both_bodies(
            pair, poses[tool.topic], poses[package.topic], twist and twists[twist.topic],
            twist.frame if twist else 'world', offset, findings)
        settings |= deduced.settings
        findings = deduced.findings
    else:
        several = [topic.name for topic in described if bags.has_several_bodies(topic.type_name)]
        findings.append(Finding('needs_both_poses', numbers={
            'cause': f' {", ".join(several)}: {bags.SEVERAL_BODIES.rstrip()}' if several else ''}))
    return Info(str(Path(path)), described, tool, package, twist, settings, tuple(findings))


def _vacuum_signal(described: Sequence[TopicInfo]) -> str:
    """Return the value of vacuum.signal for the topics of a recording, '' without a vacuum."""
    for signal, (kind, name) in SIGNALS.items():
        if any(topic.type_name == kind and is_named(topic.name, name) for topic in described):
            return signal
    return ''


class Deduced(NamedTuple):
    """Settings deduced from a recording, and findings."""

    settings: dict[str, Any]
    findings: list[Finding]


def _both_bodies(
    pair: BodyPair | None, tool: PoseStream, package: PoseStream, twist: TwistStream | None,
    twist_frame: str, given_offset: str, of_topics: Sequence[Finding],
) -> Deduced:
    """
    Return the settings from the poses of tool and package, and the findings with those of topics.

    Faults make other findings doubtful, and are then the only findings. `pair` is the pair of
    bodies recognised by its motion, and `given_offset` the user's tool_pose.offset.
    """
    R = alignment.world_rotation(pair.world if pair else 'z_up')
    offset = '' if given_offset else upright_offset(tool.rotation, R)
    of_axis = [*tool_z(RecordedPoses(tool, package, R))] if offset else []
    tool, twist = streams_at_tip(tool, twist, tip_of(Values(
        {'tool_pose.offset': offset or given_offset})), twist_frame == 'world')
    remarks = pose_remarks(RecordedPoses(tool, package, R, twist=twist, twist_frame=twist_frame))
    downward = [remark for remark in remarks if remark.code == 'tool_z']  # has a setting
    of_poses = [remark for remark in remarks if remark.code != 'tool_z']
    separate = None if _faults(of_poses) else _why_separate(pair, tool, package)
    settings, of_rest = dict[str, Any](), list[Finding]()
    if separate:
        of_tag = sensor_findings(package, package.corners is not None)
        settings, freed = _separate_settings(bool(of_tag))
        of_poses += of_tag
        of_rest += [separate, freed]
    elif pair:
        settings['recording.world'] = pair.world
    if pair:
        aligned, findings = _initial_rest(pair, tool, package, bool(separate))
        settings['recording.align_at_rest'] = aligned
        of_rest += findings
    if not (separate or _faults(remarks)):
        of_poses += _prepared_remarks(tool, package, settings)
    if faults := _faults(of_poses):
        return Deduced(settings, faults)
    if downward and not settings.get('recording.align_at_rest'):
        of_axis, offset = downward, FLANGE_OUTWARD
    if offset:
        settings['tool_pose.offset'] = offset
    return Deduced(settings, [*of_axis, *of_topics, *of_poses, *of_rest])


def _faults(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that are errors."""
    return [each for each in findings if each.level == Level.ERROR]


def _separate_settings(is_tag: bool) -> tuple[dict[str, Any], Finding]:
    """Return the settings for poses in two worlds or by two clocks, and the finding on them."""
    free: tuple[str, ...] = ('time_offset', 'package_marker')
    if is_tag:
        free = (*free, 'scale')
    settings = {'fit.method': 'output_error', 'recording.package_world': checks.ESTIMATE,
                'recording.package_frame': 'com', 'fit.free': free}
    return settings, Finding('freed', Level.OK, {'names': free})


def _prepared_remarks(
    tool: PoseStream, package: PoseStream, settings: Mapping[str, Any]
) -> tuple[Finding, ...]:
    """Return the remarks of the checks on the prepared recording, none if it is too short."""
    given = {name: settings[f'recording.{name}'] for name in ('world', 'align_at_rest')
             if f'recording.{name}' in settings}
    try:
        prepared = preparation.prepare(tool, package, recording.PrepareSettings(**given))
    except BellowsError:
        return ()
    return recording_remarks(prepared)


def _why_separate(
    pair: BodyPair | None, tool: PoseStream, package: PoseStream
) -> Finding | None:
    """Return the finding on two worlds or two clocks of two topics, None if consistent."""
    frames = {'tool': tool.frame_id, 'package': package.frame_id}
    if not same_frame(*frames.values()):
        return Finding('package_world', Level.WARN, {
            'why': ": their frames are '{tool}' and '{package}'".format(**frames)})
    first, last = common_span(tool, package)
    if last < first:
        late_ns = int(tool.stamps_ns[0] - package.stamps_ns[0])
        return Finding('time_offset', Level.WARN, {
            'size': abs(late_ns) / NS_PER_S, 'side': 'later' if late_ns > 0 else 'earlier'})
    low, high = IMPLAUSIBLE_DISTANCE
    if pair and low < pair.distance < high and pair.change > MAX_CHANGE:
        return Finding('package_world', Level.WARN, {
            'why': f': the package is {pair.distance:.2g} m from the tool, which changes by '
                   f'{pair.change:.2g} m'})
    return None


def _initial_rest(
    pair: BodyPair, tool_poses: PoseStream, package_poses: PoseStream, separate: bool
) -> tuple[bool, list[Finding]]:
    """
    Return recording.align_at_rest by the initial standstill, and findings.

    Distance and relative rotation of bodies in two worlds are not evaluated.
    """
    R = alignment.world_rotation(pair.world)
    tool, package = (alignment.in_world(poses.trajectory(), R)
                     for poses in (tool_poses, package_poses))
    rest = alignment.rest_of(tool, package)
    # An off-centre package is also rotated, and a fit estimates its marker.
    aligned = rest.is_turned and not separate and bool(
        rest.tilts[0] > np.deg2rad(1.0) or rest.turned > np.deg2rad(10.0))
    findings = []
    if not separate:
        findings.append(Finding('start_distance', Level.WARN, {'distance': pair.distance}))
    if rest.seconds < alignment.MIN_REST:
        findings.append(Finding('short_rest', Level.WARN, {'seconds': rest.seconds}))
    if not separate:
        findings += rest.remarks
    return aligned, findings
