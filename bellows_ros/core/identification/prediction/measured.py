"""Prepared recordings as the prediction-error method sees them."""

from dataclasses import dataclass

from bellows_ros.core.identification.noise import Noise, noise_of, TWIST_HALF_WINDOW, TWIST_ORDER
from bellows_ros.core.model import Package
from bellows_ros.core.savgol import savgol
from bellows_ros.core.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

LONGEST_TOOL_GAP = 0.15
"""Over a longer time (s) without tool poses the motion is unknown: the recording is cut there."""

SHORTEST_SEGMENT = 1.0
"""Shorter stretches (s) between such gaps are left out."""

BLIND_STEPS = 3.0
"""Package poses in tool gaps of more than so many steps are not compared."""


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
    moving = savgol(tool, TWIST_HALF_WINDOW, TWIST_ORDER)
    known = moving.select(moving.valid)
    steps = np.diff(known.stamps_ns) / NS_PER_S
    seen = _away_from_gaps(known, package, BLIND_STEPS / rate_hz)
    cuts = [0, *(np.flatnonzero(steps > LONGEST_TOOL_GAP) + 1).tolist(), len(known)]
    stretches = []
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        part = known.select(slice(first, last))
        if len(part) < 2:
            continue
        edge = round(margin * NS_PER_S)
        stamps = package.stamps_ns
        inside = (stamps >= part.stamps_ns[0] + edge) & (stamps <= part.stamps_ns[-1] - edge)
        if np.count_nonzero(inside) < SHORTEST_SEGMENT * uniform_rate_hz(stamps):
            continue
        poses = package.select(inside)
        marked = Trajectory(
            poses.stamps_ns, poses.position, poses.rotation, valid=poses.valid & seen[inside]
        )
        stretches.append(
            Measured(part, marked, held, gravity, *noises, 1.0 / rate_hz, recording)
        )
    if not stretches:
        raise BellowsError(
            f'No stretch of {SHORTEST_SEGMENT:g} s in which both bodies are tracked. Record '
            'longer, or look at the gaps and outliers in the report.'
        )
    return stretches


def _away_from_gaps(
    tool: Trajectory, package: Trajectory, longest: float
) -> NDArray[np.bool_]:
    """Return which package stamps are not in a gap of the tool's poses longer than that (s)."""
    after = np.clip(np.searchsorted(tool.stamps_ns, package.stamps_ns), 1, len(tool) - 1)
    step = (tool.stamps_ns[after] - tool.stamps_ns[after - 1]) / NS_PER_S
    exact = tool.stamps_ns[after] == package.stamps_ns
    return np.asarray(exact | (step <= longest))
