"""
Contents and quality of a recording: topics, rates, gaps, and their probable roles.

Tool and package are distinguished by their poses: the package hangs below the tool, at a nearly
constant distance while both move. Names of topics decide only if the poses are ambiguous.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
import os
from pathlib import Path
import re
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
    twist_errors,
    TWIST_TOLERANCE,
    upright_offset,
    UPRIGHT_OFFSETS,
)
from bellows_ros.core.signals.resampling import at_sampling, common_span, resample, timing
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

IMPLAUSIBLE_DISTANCE = (0.3, 10.0)
"""Range of distances that are implausible for a package on its tool, m."""

MAX_CHANGE = 0.05
"""Largest change of a plausible distance from tool to package, m."""

TOOL_WORDS = frozenset('tool tcp ee eef effector flange arm robot gripper tip'.split())
PACKAGE_WORDS = frozenset(
    'package packet parcel box carton object item payload load plate workpiece camera marker tag '
    'aruco apriltag'.split())

MAX_DISTANCE = 1.0
"""Largest distance of tool and package of one cup, m."""

SAMPLES = 2000
"""Number of compared samples of two streams."""

KINDS = 'pose', 'twist'
"""Contents of topics that are read."""


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


class Guess(NamedTuple):
    """
    A probable topic for a role.

    Parameters
    ----------
    topic : str
    why : tuple of str
        Evidence for the role.
    frame : str
        Value of tool_twist.frame with which a twist is consistent with the poses.

    """

    topic: str
    why: tuple[str, ...]
    frame: str = ''


class BodyPair(NamedTuple):
    """
    A tool and its package.

    Parameters
    ----------
    tool, package : Guess
    world : str
        Value of recording.world with the package below the tool; 'z_up' if undecided.
    distance : float
        Initial distance of tool and package, m.
    change : float
        Range of the distance from its 1 % to its 99 % quantile, m.
    score : float
        Score that grows with the likelihood.

    """

    tool: Guess
    package: Guess
    world: str
    distance: float
    change: float
    score: float


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
        for kind in KINDS if topic.type_name in (
            *accepted_types(kind), *[DETECTIONS] * (kind == 'pose'))}
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
    kinds = [kind for kind in KINDS if f'{topic.name} {kind}' in streams]
    if not kinds:
        return TopicInfo(*topic, problem=problems.get(topic.name, ''))
    stream = streams[f'{topic.name} {kinds[0]}']
    return TopicInfo(
        *topic, ' and '.join(kinds), frame_id=stream.frame_id,
        start_ns=int(stream.stamps_ns[0]),
        duration_s=float(stream.stamps_ns[-1] - stream.stamps_ns[0]) / NS_PER_S,
        refused={reason: len(where) for reason, where in stream.refused.items()},
        **(_describe_quality(stream, start_ns) if len(stream) > 2 else {}))


def _describe_quality(stream: bags.Stream, start_ns: int) -> dict[str, Any]:
    """Return rate, gaps, and, for poses, outliers, noise and motion."""
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
    pairs = [_pair_of(poses[tool], poses[package]) for tool, package in permutations(poses, 2)]
    pair = max(filter(None, pairs), key=lambda pair: pair.score, default=None)
    tool, package = (pair.tool, pair.package) if pair else _roles_by_name(poses)
    twist = _twist_of(poses[tool.topic], twists) if tool else None
    settings: dict[str, Any] = {
        'bags': (os.fspath(path),),
        **{f'topics.{role}': guess.topic for role, guess in
           (('tool_pose', tool), ('package_pose', package)) if guess},
        **({'topics.tool_twist': ''} if twist is None else
           {'topics.tool_twist': twist.topic, 'tool_twist.frame': twist.frame}),
        **next(({'vacuum.signal': signal} for signal, (kind, name) in SIGNALS.items()
                for topic in described if topic.type_name == kind
                and is_named(topic.name, name)), {})}
    used = {guess.topic for guess in (tool, package, twist) if guess}
    findings = [Finding('left_out', Level.WARN, {
        'part': topic.name, 'reason': topic.problem}) for topic in described if topic.problem]
    findings += [remark for topic in described if topic.name in used for remark in topic.remarks]
    streams = tuple(poses[guess.topic] for guess in (tool, package) if guess)
    if any(timing(stream.stamps_ns).rate_hz < recording.LOW_RATE_HZ for stream in streams):
        settings['fit.method'] = 'output_error'
    if len(streams) == 2:
        findings = _both_bodies(
            pair, streams, twist and twists[twist.topic], settings, findings, offset)
    else:
        several = [topic.name for topic in described if bags.has_several_bodies(topic.type_name)]
        findings.append(Finding('needs_both_poses', numbers={
            'cause': f' {", ".join(several)}: {bags.SEVERAL_BODIES.rstrip()}' if several else ''}))
    return Info(str(Path(path)), described, tool, package, twist, settings, tuple(findings))


def _both_bodies(
    pair: BodyPair | None, streams: Sequence[PoseStream], twist: TwistStream | None,
    settings: dict[str, Any], findings: list[Finding], given_offset: str
) -> list[Finding]:
    """Add settings on both poses; return the findings."""
    tool, package = streams
    R = alignment.world_rotation(pair.world if pair else 'z_up')
    offset = '' if given_offset else upright_offset(tool.rotation, R)
    outward = [*tool_z(RecordedPoses(tool, package, R))] if offset else []
    frame = settings.get('tool_twist.frame', 'world')
    tool, twist = streams_at_tip(tool, twist, tip_of(Values(
        {'tool_pose.offset': offset or given_offset})), frame == 'world')
    remarked = pose_remarks(RecordedPoses(tool, package, R, twist=twist, twist_frame=frame))
    found = [remark for remark in remarked if remark.code != 'tool_z']  # has a setting
    is_wrong = any(each.level == Level.ERROR for each in found)
    separate = None if is_wrong else _why_separate(pair, tool, package)
    more: list[Finding] = [separate] if separate else []
    if separate:
        settings |= {
            'fit.method': 'output_error', 'recording.package_world': checks.ESTIMATE,
            'recording.package_frame': 'com'}
        found += (of_tag := sensor_findings(package, package.corners is not None))
        settings['fit.free'] = ('time_offset', 'package_marker', *['scale'] * bool(of_tag))
        more.append(Finding('freed', Level.OK, {'names': settings['fit.free']}))
    elif pair:
        settings['recording.world'] = pair.world
    if pair:
        at_rest, of_rest = _initial_rest(pair, tool, package, bool(separate))
        settings |= at_rest
        more += of_rest
    if not (separate or any(each.level == Level.ERROR for each in remarked)):
        found += _prepared_remarks(tool, package, settings)
    if wrong := [each for each in found if each.level == Level.ERROR]:  # others are doubtful then
        return [*wrong]
    is_aligned = settings.get('recording.align_at_rest')
    if down := [remark for remark in remarked if remark.code == 'tool_z' and not is_aligned]:
        outward, offset = down, FLANGE_OUTWARD
    settings |= {'tool_pose.offset': offset} if offset else {}
    return [*outward, *findings, *found, *more]


def _prepared_remarks(
    tool: PoseStream, package: PoseStream, settings: Mapping[str, Any]
) -> tuple[Finding, ...]:
    """Return the remarks of the checks on the prepared recording, none if it is too short."""
    try:
        prepared = preparation.prepare(tool, package, recording.PrepareSettings(**{
            name.removeprefix('recording.'): settings[name] for name in settings if name in (
                'recording.world', 'recording.align_at_rest')}))
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
        return Finding('time_offset', Level.WARN, {
            'size': abs(late_ns := int(tool.stamps_ns[0] - package.stamps_ns[0])) / NS_PER_S,
            'side': 'later' if late_ns > 0 else 'earlier'})
    low, high = IMPLAUSIBLE_DISTANCE
    if pair and low < pair.distance < high and pair.change > MAX_CHANGE:
        return Finding('package_world', Level.WARN, {
            'why': f': the package is {pair.distance:.2g} m from the tool, which changes by '
                   f'{pair.change:.2g} m'})
    return None


def _initial_rest(
    pair: BodyPair, tool_poses: PoseStream, package_poses: PoseStream, separate: bool
) -> tuple[dict[str, Any], list[Finding]]:
    """
    Return the settings of the initial standstill, and findings.

    Distance and relative rotation of bodies in two worlds are not evaluated.
    """
    R = alignment.world_rotation(pair.world)
    tool, package = (alignment.in_world(poses.trajectory(), R)
                     for poses in (tool_poses, package_poses))
    rest = alignment.rest_of(tool, package)
    # An off-centre package is also rotated, and a fit estimates its marker.
    aligned = rest.is_turned and not separate and bool(
        rest.tilts[0] > np.deg2rad(1.0) or rest.turned > np.deg2rad(10.0))
    numbers = {'distance': pair.distance, 'seconds': rest.seconds}
    findings: list[Finding] = [Finding(code, Level.WARN, numbers) for code, applies in (
        ('start_distance', not separate), ('short_rest', rest.seconds < alignment.MIN_REST))
        if applies]
    return {'recording.align_at_rest': aligned}, [
        *findings, *(() if separate else rest.remarks)]


def _roles_by_name(poses: Mapping[str, PoseStream]) -> tuple[Guess | None, Guess | None]:
    """Return tool and package by name alone, None if undecided."""
    tool, package = (
        next((Guess(name, reason) for name in poses if (reason := _name_reason(name, words))
              and not _name_reason(name, others)), None)
        for words, others in ((TOOL_WORDS, PACKAGE_WORDS), (PACKAGE_WORDS, TOOL_WORDS)))

    def rest(other: Guess | None) -> Guess | None:
        return next((Guess(name, ('it is the only other topic',)) for name in poses
                     if other and len(poses) == 2 and name != other.topic), None)

    return tool or rest(package), package or rest(tool)


def _name_reason(topic: str, words: frozenset[str]) -> tuple[str, ...]:
    """Return the name as a reason, if it contains one of the words."""
    there = "' and '".join(sorted(words.intersection(re.findall(r'[a-z]+', topic.lower()))))
    return (f"its name contains '{there}'",) if there else ()


def _pair_of(tool: PoseStream, package: PoseStream) -> BodyPair | None:
    """Return two topics as tool and package with the reasons; None without a common time."""
    first, last = common_span(tool, package)
    if last <= first:
        return None
    stamps = np.unique(np.linspace(first, last, SAMPLES).astype(np.int64)).clip(first, last)
    offset = np.subtract(*(resample(stream.trajectory(), stamps).position
                           for stream in (package, tool)))
    distances = np.linalg.norm(offset, axis=1)
    start = offset[: max(1, int(len(offset) * 0.01))].mean(axis=0)
    distance = float(np.linalg.norm(start))
    usual = np.median(offset, axis=0)
    down = {name: -float(alignment.world_rotation(name)[2] @ usual) for name in alignment.WORLDS}
    lowest = max(down, key=lambda name: down[name])
    is_comparable = same_frame(tool.frame_id, package.frame_id)
    below = is_comparable and distance > 0.0 and (
        down[lowest] > np.linalg.norm(usual) * np.cos(np.deg2rad(40.0)))
    world = lowest if below else 'z_up'
    low, quarter, most, high = np.percentile(distances, (1, 25, 75, 99))  # without tracking jumps
    constant = is_comparable and distance < MAX_DISTANCE and (
        most - quarter < 0.25 * distance) and (  # nearly constant for a package on a cup
        distance < IMPLAUSIBLE_DISTANCE[0] or high - low < MAX_CHANGE)
    why_tool = [*_name_reason(tool.name, TOOL_WORDS)]
    why_package = [*_name_reason(package.name, PACKAGE_WORDS)]
    if not is_comparable and len(tool.stamps_ns) > len(package.stamps_ns):
        why_tool.append(f"it has more poses than '{package.name}'")
    has_corners = package.corners is not None  # more precise than poses of the same tag
    why_package += ['it has the corners of the tag'] * has_corners
    score = (3.0 if constant else 1.0) * below + 2.0 * (constant + has_corners) + 1.5 * (
        len(why_tool) + len(why_package))
    if constant:
        why_package.insert(0, f'it stays {1e3 * low:.1f} to {1e3 * high:.1f} mm from it')
    if below:
        why_tool.append(f"'{package.name}' hangs below it")
        why_package.insert(0, f"it starts {distance * 1e3:.0f} mm from '{tool.name}', along "
                           f"{'-z' if world == 'z_up' else '-y'}")
    return BodyPair(
        Guess(tool.name, tuple(why_tool)), Guess(package.name, tuple(why_package)), world,
        distance, float(high - low), score)


def _twist_of(tool: PoseStream, twists: Mapping[str, TwistStream]) -> Guess | None:
    """Return the topic whose velocity matches the tool's poses, if any."""
    errors = {name: found for name, twist in twists.items()
              if (found := twist_errors(tool, twist)[0])}
    name = min(errors, key=lambda name: min(errors[name].values()), default='')
    if not name or (error := min(errors[name].values())) > TWIST_TOLERANCE:
        return None
    # without rotation of the tool both agree, and the usual one is selected
    frame = 'world' if errors[name]['world'] <= 1.2 * errors[name]['tool'] else 'tool'
    why = f'in {frame} axes it moves the tool as the poses do, to {100 * error:.1f} %'
    return Guess(name, (why,), frame)
