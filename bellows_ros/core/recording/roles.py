"""
Probable roles of recorded topics: tool, package, and the tool's twist.

Tool and package are distinguished by their poses: the package hangs below the tool, at a nearly
constant distance while both move. Names of topics decide only if the poses are ambiguous.
"""

from collections.abc import Mapping
from itertools import permutations
import re
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.signals.resampling import common_span, resample
from bellows_ros.core.signals.trajectory import PoseStream, same_frame, TwistStream
import numpy as np

from .alignment import world_rotation, WORLDS
from .pose_faults import twist_errors, TWIST_TOLERANCE

IMPLAUSIBLE_DISTANCE = (0.3, 10.0)
"""Range of distances that are implausible for a package on its tool, m."""

MAX_CHANGE = 0.05
"""Largest change of a plausible distance from tool to package, m."""

MAX_DISTANCE = 1.0
"""Largest distance of tool and package of one cup, m."""

MAX_QUARTILE_RANGE = 0.25
"""Largest interquartile range of a nearly constant distance, relative to the initial distance."""

MAX_ASIDE = np.deg2rad(40.0)
"""Largest angle from the vertical of a package that hangs below its tool, rad."""

SAMPLES = 2000
"""Number of compared samples of two streams."""

TOOL_WORDS = frozenset('tool tcp ee eef effector flange arm robot gripper tip'.split())
PACKAGE_WORDS = frozenset(
    'package packet parcel box carton object item payload load plate workpiece camera marker tag '
    'aruco apriltag'.split())


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


def likeliest_pair(poses: Mapping[str, PoseStream]) -> BodyPair | None:
    """Return the likeliest tool and package among topics by name; None without a common time."""
    pairs = [pair_of(poses[tool], poses[package]) for tool, package in permutations(poses, 2)]
    return max((pair for pair in pairs if pair), key=lambda pair: pair.score, default=None)


def roles_by_name(poses: Mapping[str, PoseStream]) -> tuple[Guess | None, Guess | None]:
    """Return tool and package by name alone, None if undecided."""
    tool = _named(poses, TOOL_WORDS, PACKAGE_WORDS)
    package = _named(poses, PACKAGE_WORDS, TOOL_WORDS)
    return tool or _other(poses, package), package or _other(poses, tool)


def _named(
    poses: Mapping[str, PoseStream], words: frozenset[str], others: frozenset[str]
) -> Guess | None:
    """Return the first topic with one of the words, and none of others, in its name."""
    for name in poses:
        reason = _name_reason(name, words)
        if reason and not _name_reason(name, others):
            return Guess(name, reason)
    return None


def _other(poses: Mapping[str, PoseStream], known: Guess | None) -> Guess | None:
    """Return the other one of two topics, if one is known."""
    if known is None or len(poses) != 2:
        return None
    (name,) = poses.keys() - {known.topic}
    return Guess(name, ('it is the only other topic',))


def _name_reason(topic: str, words: frozenset[str]) -> tuple[str, ...]:
    """Return the name as a reason, if it contains one of the words."""
    there = "' and '".join(sorted(words.intersection(re.findall(r'[a-z]+', topic.lower()))))
    return (f"its name contains '{there}'",) if there else ()


def pair_of(tool: PoseStream, package: PoseStream) -> BodyPair | None:
    """Return two topics as tool and package with the reasons; None without a common time."""
    first, last = common_span(tool, package)
    if last <= first:
        return None
    stamps = np.unique(np.linspace(first, last, SAMPLES).astype(np.int64)).clip(first, last)
    from_tool = resample(package.trajectory(), stamps).position - resample(
        tool.trajectory(), stamps).position
    distances = np.linalg.norm(from_tool, axis=1)
    begin = from_tool[:max(1, int(len(from_tool) * 0.01))].mean(axis=0)
    distance = float(np.linalg.norm(begin))
    is_comparable = same_frame(tool.frame_id, package.frame_id)
    world = _world_below(from_tool) if is_comparable and distance > 0.0 else ''
    low, quarter, most, high = np.percentile(distances, (1, 25, 75, 99))  # without tracking jumps
    is_constant = is_comparable and distance < MAX_DISTANCE and (
        most - quarter < MAX_QUARTILE_RANGE * distance) and (
        distance < IMPLAUSIBLE_DISTANCE[0] or high - low < MAX_CHANGE)
    why_tool = [*_name_reason(tool.name, TOOL_WORDS)]
    why_package = [*_name_reason(package.name, PACKAGE_WORDS)]
    if not is_comparable and len(tool) > len(package):
        why_tool.append(f"it has more poses than '{package.name}'")
    has_corners = package.corners is not None  # more precise than poses of the same tag
    if has_corners:
        why_package.append('it has the corners of the tag')
    score = 1.5 * (len(why_tool) + len(why_package))
    if has_corners:
        score += 2.0
    if is_constant:
        score += 2.0
        why_package.insert(0, f'it stays {1e3 * low:.1f} to {1e3 * high:.1f} mm from it')
    if world:
        score += 3.0 if is_constant else 1.0
        why_tool.append(f"'{package.name}' hangs below it")
        why_package.insert(0, f"it starts {distance * 1e3:.0f} mm from '{tool.name}', along "
                           f"{'-z' if world == 'z_up' else '-y'}")
    return BodyPair(
        Guess(tool.name, tuple(why_tool)), Guess(package.name, tuple(why_package)),
        world or 'z_up', distance, float(high - low), score)


def _world_below(from_tool: Array) -> str:
    """Return the world in which a body at positions (N, 3) hangs below the tool, '' if in none."""
    usual = np.median(from_tool, axis=0)
    down = {name: -float(world_rotation(name)[2] @ usual) for name in WORLDS}
    lowest = max(down, key=lambda name: down[name])
    return lowest if down[lowest] > np.linalg.norm(usual) * np.cos(MAX_ASIDE) else ''


def twist_of(tool: PoseStream, twists: Mapping[str, TwistStream]) -> Guess | None:
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
