"""
Guess which topic of a recording is the tool and which the package, from the poses.

The package hangs below the tool, at a distance that hardly changes while both move; that is seen
in any recording. The names of the topics are asked only where the poses leave a choice.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
import re

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.recording.alignment import world_rotation, WORLDS
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory, TwistStream
import numpy as np

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


def likely_pair(poses: Mapping[str, PoseStream]) -> Pair | None:
    """Return the likeliest tool and package among topics of poses; None without two."""
    found = [_pair(poses[tool], poses[package]) for tool, package in permutations(poses, 2)]
    pairs = [pair for pair in found if pair is not None]
    return max(pairs, key=lambda pair: pair.score, default=None)


def likely_alone(poses: Mapping[str, PoseStream]) -> tuple[Guess | None, Guess | None]:
    """Return tool and package judged by names alone, None if no name says so."""
    guesses = []
    for words, others in ((TOOL_WORDS, PACKAGE_WORDS), (PACKAGE_WORDS, TOOL_WORDS)):
        named = [name for name in poses if _said(name, words) and not _said(name, others)]
        guesses.append(Guess(named[0], (_by_name(named[0], words),)) if named else None)
    for i in (0, 1):
        other = guesses[1 - i]
        if guesses[i] is None and other and len(poses) == 2:
            rest = next(name for name in poses if name != other.topic)
            guesses[i] = Guess(rest, ('it is the other',))
    return guesses[0], guesses[1]


def _said(topic: str, words: frozenset[str]) -> set[str]:
    """Return which of some words are in a topic's name."""
    return set(re.findall(r'[a-z]+', topic.lower())) & words


def _by_name(topic: str, words: frozenset[str]) -> str:
    """Return the reason that is a name."""
    return "its name says '" + "' and '".join(sorted(_said(topic, words))) + "'"


def _pair(tool: PoseStream, package: PoseStream) -> Pair | None:
    """Return two topics as tool and package with the reasons; None without any."""
    apart = _from_tool_to_package(tool, package)
    if apart is None:
        return None
    distances = np.linalg.norm(apart, axis=1)
    start = apart[: max(1, int(len(apart) * 0.01))].mean(axis=0)
    world, below = _hanging(start)
    why_tool: list[str] = []
    why_package: list[str] = []
    score = 0.0
    spread = float(np.subtract(*np.percentile(distances, (75, 25))))
    distance = float(np.linalg.norm(start))
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
        if _said(name, words):
            why.append(_by_name(name, words))
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


def _hanging(apart: Array) -> tuple[str, bool]:
    """Return the world in which a body at this distance is lowest, and whether it hangs."""
    down = {world: -float(world_rotation(world)[2] @ apart) for world in WORLDS}
    world = max(down, key=lambda name: down[name])
    reach = float(np.linalg.norm(apart))
    below = reach > 0.0 and down[world] > reach * np.cos(BELOW_WITHIN)
    return (world if below else 'z_up'), bool(below)


def likely_twist(tool: PoseStream, twists: Mapping[str, TwistStream]) -> Guess | None:
    """
    Return the topic whose velocity matches the tool's poses; None without any.

    Where the tool hardly moves, the one with the stamps of the tool's poses.
    """
    compared = {name: _compared(tool, twist) for name, twist in twists.items()}
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


def _compared(tool: PoseStream, twist: TwistStream) -> tuple[float, str] | None:
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
