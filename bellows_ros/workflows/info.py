"""
Contents and quality of a recording: topics, rates, gaps, and their probable roles.

Which is the tool and which the package is seen from the poses: the package hangs below the tool,
at a distance that hardly changes while both move. The names of the topics are asked only where
the poses leave a choice.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import permutations
import os
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.identification.causes import finding_sentence, IN_DEGREES
from bellows_ros.core.parameters.checks import ESTIMATE
from bellows_ros.core.parameters.table import short
from bellows_ros.core.recording import alignment
from bellows_ros.core.recording.conventions import convention_sentence
from bellows_ros.core.recording.outliers import find_outliers
from bellows_ros.core.recording.preparation import stream_warnings
from bellows_ros.core.recording.recording import LOW_RATE_HZ
from bellows_ros.core.signals.resampling import at_sampling, resample, timing
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory, TwistStream
from bellows_ros.files import File
from bellows_ros.files.bags import accepted_types, Contents, read_contents, TopicCount, topics
from bellows_ros.files.messages import BOOL
from bellows_ros.files.plans import read_transforms, TF
from bellows_ros.files.results import with_units
from bellows_ros.workflows.recordings import part_of
import numpy as np

Stream = PoseStream | TwistStream

REST_USED = 0.9  # of the standstill that was found


SHORTEST_HOLD, LEAST_TILT = 4.0, 0.1
"""A tilt beyond this (rad) that is held so long (s) shows how rubber creeps."""
NO_CUP, MOST_CHANGE = (0.3, 10.0), 0.05
"""Distances (m) of the package from the tool at the start that are no cup's, if they change by
more (m)."""
MOST_FRAMES = 20
"""Frames of transforms that are named."""
HOLD_STEP, HELD = 0.25, (0.01, 0.04)
"""Time (s) between the poses that are compared, and what stands still (m/s, rad/s)."""


TOOL_WORDS = frozenset({'tool', 'tcp', 'ee', 'eef', 'effector', 'flange', 'arm', 'robot',
                        'gripper', 'tip'})
PACKAGE_WORDS = frozenset({'package', 'packet', 'parcel', 'box', 'carton', 'object', 'item',
                           'payload', 'load', 'plate', 'workpiece'})

LONGEST_DISTANCE = 1.0  # m, between tool and package
LARGEST_CHANGE = 0.25  # of the distance, between its quartiles, of a package that is held
BELOW_WITHIN = np.deg2rad(40.0)  # of straight down, for what hangs below
SAMPLES = 2000  # at which two streams are compared
TWIST_WINDOW = 0.05  # s, over which a twist is compared with the way its body goes
WAY, TURN = 2e-3, 5e-3  # m and rad, over that time: less is too little to compare with
SAME_WITHIN = 0.3  # relative difference between the two, at most, to belong together


@dataclass(frozen=True)
class TopicInfo:
    """
    A topic, and the quality of its messages if they can be read.

    Parameters
    ----------
    name, type_name : str
    messages : int
    kind : str
        'pose', 'twist', 'pose and twist', or '' where it is none that can be used.
    problem : str
        Why it cannot be read, though its type fits; else ''.
    frame_id : str
    start_ns : int
        First stamp.
    duration_s, rate_hz, jitter_s : float
        Last minus first stamp; rate where nothing is missing; robust deviation of the steps.
    gaps : tuple of (float, float)
        Start, from the recording's first stamp, and length of each, s.
    refused : mapping of str to int
        Reason to number of messages that would be left out.
    outliers : int
        Poses that look like lost tracking: jumps, steps, repeats.
    noise : mapping of str to list of 3 floats
        Standard deviation of 'position' (m) along the world's axes and of 'rotation' (rad) about
        the body's.
    motion : mapping of str to list of 3 floats
        Largest minus smallest coordinate of 'position' (m) and of 'rotation', the rotation vector
        (rad) from the start, in recorded axes.
    warnings : tuple of str
        What to know before identifying from these poses.

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
    refused: Mapping[str, int] = field(default_factory=dict)
    outliers: int = 0
    noise: Mapping[str, list[float]] = field(default_factory=dict)
    motion: Mapping[str, list[float]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Guess:
    """
    A topic for a role.

    Parameters
    ----------
    topic : str
    why : tuple of str
        The evidence for it.
    frame : str
        Of a twist the value of tool_twist.frame that agrees with the poses.

    """

    topic: str
    why: tuple[str, ...]
    frame: str = ''


@dataclass(frozen=True)
class Pair:
    """
    A tool and the package it holds.

    Parameters
    ----------
    tool, package : Guess
    world : str
        Value of recording.world under which the package hangs below the tool; 'z_up' where neither
        shows it.
    distance : float
        Between the two at the start, m.
    change : float
        Of the distance, from its lowest to its highest percent, m.
    score : float
        The more, the likelier.

    """

    tool: Guess
    package: Guess
    world: str
    distance: float
    change: float
    score: float


@dataclass(frozen=True)
class Info:
    """
    A recording.

    Parameters
    ----------
    path : str
    topics : tuple of TopicInfo
        By name.
    tool, package, twist : Guess or None
    rest_s : float or None
        How long both stand still at the beginning.
    settings : mapping
        Parameters with which to read it, by name.
    notes : tuple of str
        What to know before identifying from it.

    """

    path: str
    topics: tuple[TopicInfo, ...]
    tool: Guess | None
    package: Guess | None
    twist: Guess | None
    rest_s: float | None
    settings: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def valve(self) -> str:
        """The topic that switches the valve, if only one can; else ''."""
        able = [topic.name for topic in self.topics if topic.type_name == BOOL]
        return able[0] if len(able) == 1 else ''

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return with_units({**vars(self), 'valve': self.valve, 'version': __version__})


def info(path: File, span: Mapping[str, Any] = MappingProxyType({})) -> Info:
    """
    Look into a recording.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    span : mapping
        Parameters 'recording.start' and 'recording.end', s, where only a part is looked at.

    Raises
    ------
    BellowsError
        If there is no such recording, or it is damaged.

    """
    notes: list[str] = []
    found = topics(path, notes)
    pose_types, twist_types = accepted_types('pose'), accepted_types('twist')
    wanted = {
        f'{topic.name} {kind}': topic.name
        for topic in found if topic.messages
        for kind, types in (('pose', pose_types), ('twist', twist_types))
        if topic.type_name in types}
    contents = read_contents(path, wanted) if wanted else Contents({}, {}, ())
    problems = {wanted[role]: str(error) for role, error in contents.problems.items()}
    streams = {role: own for role, own in part_of(contents.streams, span).items() if len(own)}
    start_ns = min((int(s.stamps_ns[0]) for s in streams.values()), default=0)
    described = tuple(_topic(topic, streams, problems, start_ns) for topic in found)
    poses = {s.name: s for s in streams.values() if isinstance(s, PoseStream) and len(s) > 2}
    twists = {s.name: s for s in streams.values() if isinstance(s, TwistStream) and len(s) > 2}
    if not poses and any(topic.type_name == TF and topic.messages for topic in found):
        notes.append(_frames_note(path))
    return _assigned(path, described, poses, twists, span, notes)


def _frames_note(path: File) -> str:
    """Return which frames move in the transforms, and how to make a recording with poses."""
    links = read_transforms(path)
    moving = sorted(name for name, link in links.items() if len(link.stamps_ns) > 1)
    named = [short(name) for name in moving[:MOST_FRAMES]]
    rest = f' and {len(moving) - len(named)} more' if len(moving) > len(named) else ''
    return (
        f'It has transforms instead of poses. Frames that move: {", ".join(named) or "none"}'
        f"{rest}. Make a recording with poses: 'bellows convert {short(os.fspath(path))} "
        "--tool-frame FRAME --package-frame FRAME --out with_poses'.")


def _topic(
    topic: TopicCount, streams: Mapping[str, Stream], problems: Mapping[str, str], start_ns: int
) -> TopicInfo:
    """Return the description of a topic."""
    mine = {kind: streams[f'{topic.name} {kind}'] for kind in ('pose', 'twist')
            if f'{topic.name} {kind}' in streams}
    if not mine:
        return TopicInfo(*topic, problem=problems.get(topic.name, ''))
    stream = next(iter(mine.values()))
    quality = _quality(stream, start_ns) if len(stream) > 2 else {}
    return TopicInfo(
        *topic, ' and '.join(mine), frame_id=stream.frame_id,
        start_ns=int(stream.stamps_ns[0]),
        duration_s=float(stream.stamps_ns[-1] - stream.stamps_ns[0]) / NS_PER_S,
        refused={reason: len(where) for reason, where in stream.refused.items()}, **quality)


def _quality(stream: Stream, start_ns: int) -> dict[str, Any]:
    """Return rate, gaps, and of poses outliers, noise and motion."""
    time = timing(stream.stamps_ns)
    quality: dict[str, Any] = {
        'rate_hz': time.rate_hz,
        'jitter_s': time.jitter_s,
        'gaps': tuple(((gap.start_ns - start_ns) / NS_PER_S, gap.duration_s) for gap in time.gaps)}
    if isinstance(stream, PoseStream):
        stream, arrivals = at_sampling(stream)
        time, poses = timing(stream.stamps_ns), stream.trajectory()
        outliers = find_outliers(poses, time.longest_step_ns)
        moved, turned = (part[outliers.good] for part in (poses.position, poses.rotation))
        quality |= {
            'outliers': int(np.count_nonzero(~outliers.good)),
            'noise': {name: x.tolist() for name, x in outliers.noise.items()},
            'motion': {name: np.ptp(x, axis=0).tolist() for name, x in (
                ('position', moved), ('rotation', log_so3(np.swapaxes(turned[:1], 1, 2) @ turned)))
                if len(x)},
            'warnings': tuple(stream_warnings(stream, time, outliers, arrivals))}
    return quality


def _assigned(
    path: File, described: tuple[TopicInfo, ...], poses: Mapping[str, PoseStream],
    twists: Mapping[str, TwistStream], span: Mapping[str, Any], notes: list[str]
) -> Info:
    """Return the recording with roles, settings and notes."""
    pairs = [_pair(poses[tool], poses[package]) for tool, package in permutations(poses, 2)]
    pair = max(filter(None, pairs), key=lambda pair: pair.score, default=None)
    tool, package = (pair.tool, pair.package) if pair else likely_by_name(poses)
    twist = likely_twist(poses[tool.topic], twists) if tool else None
    settings: dict[str, Any] = {'bags': (os.fspath(path),), **span}
    settings |= {f'topics.{role}': guess.topic for role, guess in
                 (('tool_pose', tool), ('package_pose', package)) if guess}
    in_degrees = twist is not None and tool is not None and is_in_degrees(
        poses[tool.topic], twists[twist.topic])
    settings |= {'topics.tool_twist': ''} if twist is None or in_degrees else {
        'topics.tool_twist': twist.topic, 'tool_twist.frame': twist.frame}
    used = {guess.topic for guess in (tool, package, twist) if guess}
    notes += [f'{topic.name} cannot be used: {topic.problem}' for topic in described
              if topic.problem]
    notes += [text for topic in described if topic.name in used for text in topic.warnings]
    if not (tool and package):
        notes.append(
            'An identification needs the poses of tool and package; the tool alone is enough '
            'only for a simulation or a prediction.')
    if any(timing(poses[guess.topic].stamps_ns).rate_hz < LOW_RATE_HZ
           for guess in (tool, package) if guess):
        settings['fit.method'] = 'output_error'
    rest_s = None
    if tool and package:
        wrong, apart, rest_s, remarks = _arranged(
            pair, poses[tool.topic], poses[package.topic], path)
        settings |= apart
        notes = [wrong, *notes] if wrong else notes + remarks  # before that, nothing else is known
    if in_degrees and twist:
        notes.insert(0, finding_sentence(IN_DEGREES, {'topics.tool_twist': twist.topic}))
    return Info(str(Path(path)), described, tool, package, twist, rest_s, settings, tuple(notes))


def _arranged(
    pair: Pair | None, tool: PoseStream, package: PoseStream, path: File
) -> tuple[str, dict[str, Any], float | None, list[str]]:
    """Return what is wrong with two streams, settings, how long they rest at first, and notes."""
    wrong = apart = ''
    if len({own.frame_id for own in (tool, package) if own.frame_id}) < 2:
        wrong = convention_sentence(tool, package, path)
    settings, notes, rest_s = dict[str, Any](), list[str](), None
    if not wrong and (apart := _why_apart(pair, tool, package)):
        settings = {
            'fit.method': 'output_error', 'recording.package_world': ESTIMATE,
            'fit.time_offset': True, 'fit.free': ('package_marker',)}
        notes.append(
            f'{apart} recording.package_world: {ESTIMATE} finds how the world of the package '
            'lies in that of the tool, best with standstills tilted to several sides at the end; '
            'if you know it, give its seven numbers. The time offset and the marker are '
            'estimated, too: leave out what you know.')
    if pair:
        rest_s, at_rest, more = _at_rest(pair, tool, package, bool(apart))
        settings |= at_rest if apart else {'recording.world': pair.world, **at_rest}
        notes += more
    return wrong, settings, rest_s, notes


def _why_apart(pair: Pair | None, tool: PoseStream, package: PoseStream) -> str:
    """Return why two topics are of two worlds or two clocks, '' where they are not."""
    frames = short(tool.frame_id), short(package.frame_id)
    if all(frames) and frames[0] != frames[1]:
        return f"The tool is in frame '{frames[0]}', the package in '{frames[1]}'."
    if tool.stamps_ns[-1] < package.stamps_ns[0] or package.stamps_ns[-1] < tool.stamps_ns[0]:
        return 'The stamps of tool and package do not overlap: they are of two clocks.'
    if pair and NO_CUP[0] < pair.distance < NO_CUP[1] and pair.change > MOST_CHANGE:
        return (f'The package is {pair.distance * 1e3:.0f} mm from the tool, which changes by '
                f'{pair.change * 1e3:.0f} mm: no cup. Their poses are of two worlds.')
    return ''


def _at_rest(
    pair: Pair, tool_poses: PoseStream, package_poses: PoseStream, apart: bool
) -> tuple[float, dict[str, Any], list[str]]:
    """
    Return the duration of the initial standstill, the settings from it, and remarks.

    Where their worlds are apart, distance and turn say nothing of the bodies.
    """
    R = alignment.world_rotation(pair.world)
    tool, package = (alignment.in_world(own.trajectory(), R)
                     for own in (tool_poses, package_poses))
    rest = alignment.rest_of(tool, package)
    notes = [
        f'At the start the package is {pair.distance * 1e3:.1f} mm from the tool. That is about '
        'cup.length if its poses are those of the lip (recording.package_frame: lip), or '
        'cup.length plus the depth of package.com if they are those of the centre of mass '
        '(com).'] if not apart else []
    if rest.seconds < alignment.SHORTEST_REST:
        notes.append(
            f'The standstill at the beginning lasts only {rest.seconds:.1f} s. Start with 2 s of '
            'standstill, so that rotated marker frames can be detected.')
    if longest_hold(tool) < SHORTEST_HOLD:
        notes.append(
            f'No tilt is held for {SHORTEST_HOLD:g} s, so how far the rubber creeps '
            '(cup.relaxation) is not seen. Hold one still for 5 to 10 s beside the motion.')
    aligned = rest.is_turned and not apart
    if aligned:
        notes += rest.turned_sentence
    duration = max(0.1, np.floor(10.0 * REST_USED * rest.seconds) / 10.0)
    return rest.seconds, {
        'recording.align_at_rest': aligned, 'recording.rest_duration': float(duration)}, notes


def longest_hold(tool: Trajectory) -> float:
    """Return the longest time (s) for which a tool stands still, tilted against its start."""
    steps = (tool.stamps_ns - tool.stamps_ns[0]) // round(HOLD_STEP * NS_PER_S)
    some = tool.select(np.unique(steps, return_index=True)[1])  # stamps may be years apart
    up = some.rotation[:, 2]
    turn = log_so3(np.swapaxes(some.rotation[:-1], 1, 2) @ some.rotation[1:])
    still = (np.linalg.norm(turn, axis=1) < HOLD_STEP * HELD[1]) & (
        np.linalg.norm(np.diff(some.position, axis=0), axis=1) < HOLD_STEP * HELD[0])
    held = still & (np.arccos(np.clip(up[1:] @ up[0], -1.0, 1.0)) > LEAST_TILT)
    edges = np.flatnonzero(np.diff(held, prepend=False, append=False)).reshape(-1, 2)
    return float(HOLD_STEP * np.max(edges[:, 1] - edges[:, 0], initial=0))


def likely_by_name(poses: Mapping[str, PoseStream]) -> tuple[Guess | None, Guess | None]:
    """Return tool and package judged by names alone, None if no name says so."""
    guesses = []
    for words, others in ((TOOL_WORDS, PACKAGE_WORDS), (PACKAGE_WORDS, TOOL_WORDS)):
        named = [name for name in poses if _words_in(name, words) and not _words_in(name, others)]
        guesses.append(Guess(named[0], (_name_reason(named[0], words),)) if named else None)
    for i in (0, 1):
        other = guesses[1 - i]
        if guesses[i] is None and other and len(poses) == 2:
            rest = next(name for name in poses if name != other.topic)
            guesses[i] = Guess(rest, ('it is the other',))
    return guesses[0], guesses[1]


def _words_in(topic: str, words: frozenset[str]) -> set[str]:
    """Return which of some words are in a topic's name."""
    return set(re.findall(r'[a-z]+', topic.lower())) & words


def _name_reason(topic: str, words: frozenset[str]) -> str:
    """Return the reason that is a name."""
    return "its name says '" + "' and '".join(sorted(_words_in(topic, words))) + "'"


def _pair(tool: PoseStream, package: PoseStream) -> Pair | None:
    """Return two topics as tool and package with the reasons; None without any."""
    apart = _from_tool_to_package(tool, package)
    if apart is None:
        return None
    distances = np.linalg.norm(apart, axis=1)
    start = apart[: max(1, int(len(apart) * 0.01))].mean(axis=0)
    distance = float(np.linalg.norm(start))
    down = {name: -float(alignment.world_rotation(name)[2] @ start) for name in alignment.WORLDS}
    lowest = max(down, key=lambda name: down[name])
    below = distance > 0.0 and down[lowest] > distance * np.cos(BELOW_WITHIN)
    world = lowest if below else 'z_up'
    why_tool: list[str] = []
    why_package: list[str] = []
    score = 0.0
    spread = float(np.subtract(*np.percentile(distances, (75, 25))))
    low, high = np.percentile(distances, (1, 99))  # jumps of tracking do not count
    if below:
        axis = '-z' if world == 'z_up' else '-y'
        why_package.append(f"it starts {distance * 1e3:.0f} mm from '{tool.name}', along {axis}")
        score += 3.0
    if distance < LONGEST_DISTANCE and spread < LARGEST_CHANGE * distance:
        why_package.append(f'it stays {1e3 * low:.1f} to {1e3 * high:.1f} mm from it')
        score += 2.0
    for name, words, why in ((tool.name, TOOL_WORDS, why_tool),
                             (package.name, PACKAGE_WORDS, why_package)):
        if _words_in(name, words):
            why.append(_name_reason(name, words))
            score += 1.5
    if below:
        why_tool.append(f"'{package.name}' hangs below it")
    return Pair(
        Guess(tool.name, tuple(why_tool)), Guess(package.name, tuple(why_package)), world,
        distance, float(high - low), score)


def _from_tool_to_package(tool: PoseStream, package: PoseStream) -> Array | None:
    """Return the vectors (N, 3) between two bodies in recorded axes, m; None without overlap."""
    first = max(tool.stamps_ns[0], package.stamps_ns[0])
    last = min(tool.stamps_ns[-1], package.stamps_ns[-1])
    if last <= first:
        return None
    stamps = np.unique(np.linspace(first, last, SAMPLES).astype(np.int64))
    stamps = stamps[(stamps >= first) & (stamps <= last)]
    ends = [resample(stream.trajectory(), stamps).position for stream in (package, tool)]
    return np.asarray(ends[0] - ends[1])


def likely_twist(tool: PoseStream, twists: Mapping[str, TwistStream]) -> Guess | None:
    """
    Return the topic whose velocity matches the tool's poses; None without any.

    Where the tool hardly moves, the one with the stamps of the tool's poses.
    """
    compared = {name: _twist_misfit(tool, twist) for name, twist in twists.items()}
    fitting = [(*found, name) for name, found in compared.items() if found]
    error, frame, name = min(fitting, default=(np.inf, '', ''))
    if error < SAME_WITHIN:
        why = f'in {frame} axes it moves the tool as the poses do, to {100 * error:.1f} %'
        return Guess(name, (why,), frame)
    for name, twist in twists.items():
        if compared[name] is None and np.mean(np.isin(twist.stamps_ns, tool.stamps_ns)) > 0.5:
            why = 'it has the stamps of the tool, which moves too little to determine its axes'
            return Guess(name, (why,), 'world')
    return None


def is_in_degrees(tool: PoseStream, twist: TwistStream) -> bool:
    """Return whether the angular velocity of a twist is 180 / pi times that of the poses."""
    found = _overlap(tool, twist)
    if found is None:
        return False
    body, inside, window = found
    turned = log_so3(np.swapaxes(body.rotation[:-window], 1, 2) @ body.rotation[window:])
    said = _ways(body, np.radians(twist.angular[inside]), window)
    sizes = [float(np.sqrt(np.mean(np.sum(own**2, axis=1)))) for own in (turned, said)]
    return sizes[0] > TURN and abs(sizes[1] / sizes[0] - 1.0) < SAME_WITHIN


def _overlap(tool: PoseStream, twist: TwistStream) -> tuple[Trajectory, Mask, int] | None:
    """Return the tool where a twist is known, these twists, and the samples compared at once."""
    inside = (twist.stamps_ns >= tool.stamps_ns[0]) & (twist.stamps_ns <= tool.stamps_ns[-1])
    if np.count_nonzero(inside) < 10:
        return None
    body = resample(tool.trajectory(), twist.stamps_ns[inside])
    window = max(1, round(TWIST_WINDOW * NS_PER_S / float(np.median(np.diff(body.stamps_ns)))))
    return (body, inside, window) if len(body) > 2 * window else None


def _ways(body: Trajectory, rates: Array, window: int) -> Array:
    """Return how far rates (N, 3) at the stamps of a body lead over so many samples."""
    steps = np.diff(body.stamps_ns)[:, None] / NS_PER_S
    way = np.cumsum(np.vstack([np.zeros((1, 3)), 0.5 * steps * (rates[1:] + rates[:-1])]), axis=0)
    return np.asarray(way[window:] - way[:-window])


def _twist_misfit(tool: PoseStream, twist: TwistStream) -> tuple[float, str] | None:
    """Return the misfit of a twist to the poses, and its axes; None if unknown."""
    found = _overlap(tool, twist)
    if found is None:
        return None
    body, inside, window = found
    expected = body.position[window:] - body.position[:-window]
    if np.sqrt(np.mean(np.sum(expected**2, axis=1))) <= WAY:
        return None
    linear = twist.linear[inside]
    in_world, in_tool = (
        float(np.sqrt(np.mean((_ways(body, rates, window) - expected)**2) / np.mean(expected**2)))
        for rates in (linear, apply(body.rotation, linear)))
    # Where the tool does not turn both agree; then the usual one is meant.
    return (in_world, 'world') if in_world <= 1.2 * in_tool else (in_tool, 'tool')
