"""Prepared recordings as the prediction-error method sees them."""

from collections.abc import Iterator
from dataclasses import dataclass

from bellows_ros.core.identification.noise import Noise, noise_of, TOOL_HALF_WINDOW, TOOL_ORDER
from bellows_ros.core.model import Package
from bellows_ros.core.resampling import resample
from bellows_ros.core.savgol import savgol
from bellows_ros.core.trajectory import Mask, NS_PER_S, Stamps, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

LONGEST_TOOL_GAP = 0.15
"""Over a longer time (s) without tool poses the motion is unknown: the recording is cut there."""

BRIDGE_HALF_WINDOW, BRIDGE_ORDER = 2, 4
"""Quartics through five poses meet them all: they give the twists beside gaps."""

SHORTEST_SEGMENT = 1.0
"""Shorter stretches (s) between such gaps are left out."""

BLIND_STEPS = 3.0
"""Package poses in tool gaps of more than so many steps are not compared."""


SETTLING = 0.2
"""Time (s) after a gap in which predictions are corrected by measured poses, but not judged."""


@dataclass(frozen=True, eq=False)
class Measured:
    """
    One stretch of a recording.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world with body twists at stamps that cover the package's.
    package : Trajectory
        N measured poses of B, not smoothed, and where they are valid.
    counted : ndarray (N,)
        Which of them are compared with predictions: those that are valid, but for a moment after
        a gap of either body, in which the observer does not know what it takes itself to know.
    held : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float
        m/s^2 along -z of the world.
    tool_noise, package_noise : Noise
        White noise of the measured poses.
    tool_period : float
        Time between tool poses, s.
    recording : int
        Number of the recording it is of.

    """

    tool: Trajectory
    package: Trajectory
    counted: Mask
    held: Package
    gravity: float
    tool_noise: Noise
    package_noise: Noise
    tool_period: float
    recording: int = 0


def measured_stretches(
    tool: Trajectory,
    package: Trajectory,
    held: Package,
    gravity: float,
    margin: float = 0.0,
    recording: int = 0,
) -> list[Measured]:
    """
    Return the stretches of a recording in which the tool's motion is known throughout.

    Parameters
    ----------
    tool, package : Trajectory
        Aligned poses of E and B in the world, each at its own uniform rate, with what is wrong
        in them marked.
    held : Package
        What hung on the cup.
    gravity : float
        m/s^2 along -z of the world.
    margin : float
        Time (s) by which the tool must be known before and after the package: for a time offset.
    recording : int
        Number of the recording.

    Raises
    ------
    BellowsError
        If no stretch is long enough.

    """
    rate_hz = uniform_rate_hz(tool.stamps_ns)
    noises = noise_of(tool), noise_of(package)
    marked, settled = _marked(tool, package)
    stretches = []
    for part in _parts(in_motion(tool)):
        edge = round(margin * NS_PER_S)
        inside = slice(
            *np.searchsorted(
                package.stamps_ns, [part.stamps_ns[0] + edge, part.stamps_ns[-1] - edge + 1]))
        poses = marked.select(inside)
        if len(poses) < SHORTEST_SEGMENT * uniform_rate_hz(package.stamps_ns):
            continue
        stretches.append(
            Measured(
                part, poses, poses.valid & settled[inside], held, gravity, *noises, 1.0 / rate_hz,
                recording,
            )
        )
    if not stretches:
        raise BellowsError(
            f'No stretch of {SHORTEST_SEGMENT:g} s in which both bodies are tracked. Record '
            'longer, or look at the gaps and outliers in the report.'
        )
    return stretches


def _parts(moving: Trajectory) -> Iterator[Trajectory]:
    """Yield the parts of the tool's motion between gaps that are too long to be bridged."""
    known = moving.select(moving.valid)
    steps = np.diff(known.stamps_ns) / NS_PER_S
    cuts = [0, *(np.flatnonzero(steps > LONGEST_TOOL_GAP) + 1).tolist(), len(known)]
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        if last - first > 1:
            yield known.select(slice(first, last))


def _marked(tool: Trajectory, package: Trajectory) -> tuple[Trajectory, Mask]:
    """Return the package's poses, invalid in gaps of the tool, and which are settled again."""
    stamps = package.stamps_ns
    (of_tool, longest_of_tool), (of_package, longest_of_package) = (
        (body.stamps_ns[body.valid], BLIND_STEPS / uniform_rate_hz(body.stamps_ns))
        for body in (tool, package)
    )
    seen = _away_from_gaps(of_tool, stamps, longest_of_tool)
    settled = _settled(of_tool, stamps, longest_of_tool)
    settled &= _settled(of_package, stamps, longest_of_package)
    poses = Trajectory(stamps, package.position, package.rotation, valid=package.valid & seen)
    return poses, settled


def in_motion(poses: Trajectory) -> Trajectory:
    """
    Return measured poses of the tool with twists, smoothed as the observer takes them to be.

    Short gaps are bridged first, by cubics that meet poses and twists on both sides: a filter that
    stopped at each gap would lose half a window more before it and behind it.
    """
    quartic = savgol(poses, BRIDGE_HALF_WINDOW, BRIDGE_ORDER)
    known = quartic.select(quartic.valid)
    lost = ~poses.valid
    if len(known) and lost.any():
        lost &= poses.stamps_ns > known.stamps_ns[0]
        lost &= poses.stamps_ns < known.stamps_ns[-1]
        between = Trajectory(known.stamps_ns, known.position, known.rotation, known.twist)
        bridge = resample(between, poses.stamps_ns[lost], round(LONGEST_TOOL_GAP * NS_PER_S))
        position, rotation = poses.position.copy(), poses.rotation.copy()
        valid = poses.valid.copy()
        position[lost], rotation[lost], valid[lost] = (
            bridge.position, bridge.rotation, bridge.valid)
        poses = Trajectory(poses.stamps_ns, position, rotation, valid=valid)
    return savgol(poses, TOOL_HALF_WINDOW, TOOL_ORDER)


def _away_from_gaps(tracked: Stamps, stamps: Stamps, longest: float) -> Mask:
    """Return which stamps are not in a gap of what was tracked that is longer than that (s)."""
    after = np.clip(np.searchsorted(tracked, stamps), 1, len(tracked) - 1)
    step = (tracked[after] - tracked[after - 1]) / NS_PER_S
    return np.asarray((tracked[after] == stamps) | (step <= longest))


def _settled(tracked: Stamps, stamps: Stamps, longest: float) -> Mask:
    """Return which stamps are some time behind the last gap of what was tracked."""
    ends = tracked[1:][np.diff(tracked) / NS_PER_S > longest]
    if not len(ends):
        return np.ones(len(stamps), dtype=bool)
    last = np.searchsorted(ends, stamps, side='right') - 1
    since = (stamps - ends[np.maximum(last, 0)]) / NS_PER_S
    return np.asarray((last < 0) | (since > SETTLING))
