"""Speed, acceleration and jerk of a motion, and its stretching in time to meet limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

RATES = {
    'speed': 'm/s', 'acceleration': 'm/s^2', 'jerk': 'm/s^3',
    'angular_speed': 'rad/s', 'angular_acceleration': 'rad/s^2', 'angular_jerk': 'rad/s^3',
}
"""Limited quantities and their units."""

SPACING_NS = 1_000_000
"""Spacing (ns) of the points that accelerations and jerks are computed from, as in drives."""

SLOWEST, STEP, RESOLUTION = 20.0, 1.02, 1.001
"""The time is sought up to this factor, in steps of at least this factor, and to this factor."""
STEEPNESS = 4
"""What is asked of the tool falls at most with so many powers of the time more than for a rigid
package: the inverse differentiates the package's motion twice more, and smooths it."""

NONE = 1e12
"""Stands for no limit."""


def read_rates(settings: Settings, default: float | None = None) -> dict[str, float]:
    """Return the limits by the names of `RATES`, of the blocks `linear` and `angular`."""
    found = {}
    for kind, names in (('linear', tuple(RATES)[:3]), ('angular', tuple(RATES)[3:])):
        block = settings.block(kind)
        for name in names:
            found[name] = block.number(
                name.removeprefix('angular_'), default, RATES[name], above=0.0)
    return found


class TooFastError(BellowsError):
    """A motion does not exist within a limit of this name; it may in more time."""

    def __init__(self, message: str, limit: str) -> None:
        """Name the limit."""
        super().__init__(message)
        self.limit = limit


class Limits(NamedTuple):
    """Limits of a motion; `NONE`, or 0 for the safety factor, means no limit."""

    rates: Mapping[str, float]
    """By the names of `RATES`, SI units."""
    low: Array
    high: Array
    """Corners (3,) of the workspace of the tool tip, m."""
    safety_factor: float
    joint_acceleration: float = NONE
    """Of each joint of the arm, rad/s^2 or m/s^2; their speeds are in its URDF."""


NO_LIMITS = Limits(dict.fromkeys(RATES, NONE), np.full(3, -NONE), np.full(3, NONE), 0.0)


def largest_rates(rotation: Array, twist: Array, step: float) -> dict[str, float]:
    """
    Return the largest speed, acceleration and jerk, and the angular ones, SI, as in `RATES`.

    Of rotations (N, 3, 3) to the world and body twists (N, 6) a step (s) apart, by differences.
    """
    found = []
    for part in (twist[:, :3], twist[:, 3:]):
        rate = apply(rotation, part)
        for order in range(3):
            sizes = np.linalg.norm(np.diff(rate, order, axis=0), axis=1) / step ** order
            found.append(float(sizes.max()))
    return dict(zip(RATES, found, strict=True))


def demands(tool: Trajectory) -> dict[str, float]:
    """Return the `largest_rates` of a motion from rest to rest, at points `SPACING_NS` apart."""
    count = max(3, round(float(tool.stamps_ns[-1] - tool.stamps_ns[0]) / SPACING_NS))
    at = np.linspace(0, int(tool.stamps_ns[-1] - tool.stamps_ns[0]), count + 1).astype(np.int64)
    points = resample(tool, tool.stamps_ns[0] + at)
    ends = ((2, 2), (0, 0))
    return largest_rates(
        np.pad(points.rotation, (*ends, (0, 0)), 'edge'), np.pad(np.asarray(points.twist), ends),
        float(at[1]) / NS_PER_S)


def excess(
    limits: Limits, tool: Trajectory, safety_factor: float, joints: tuple[float, str] = (1.0, '')
) -> tuple[float, str]:
    """Return the factor on time that is needed at least, 1 if none is, and the limit."""
    asked = demands(tool)
    over = [((asked[name] / limits.rates[name]) ** (1.0 / (1 + i % 3 + STEEPNESS)), name)
            for i, name in enumerate(RATES)]
    inside = (tool.position >= limits.low - 1e-9) & (tool.position <= limits.high + 1e-9)
    over.append((1.0 if inside.all() else STEP, 'workspace'))
    over.append((1.0 if safety_factor >= limits.safety_factor else STEP, 'safety_factor'))
    over.append(joints)
    return max([(1.0, ''), *(each for each in over if each[0] > 1.0)])


def stretched(
    limits: Limits, motion: Callable[[float], tuple[Trajectory, float, tuple[float, str]]]
) -> tuple[float, str]:
    """
    Return the smallest factor on time with which a motion keeps to limits, and the last exceeded.

    Parameters
    ----------
    limits : Limits
        To keep to.
    motion : callable
        From a factor on time to the motion, its smallest safety factor, and the factor on time
        that the joints of the arm need with their limit, (1, '') if none; raises `TooFastError`
        where there is no motion that fast.

    Raises
    ------
    BellowsError
        If nothing helps.

    """
    def tried(scale: float) -> tuple[float, str]:
        try:
            return excess(limits, *motion(scale))
        except TooFastError as error:
            if scale >= SLOWEST:
                raise
            return STEP, error.limit

    below, scale, reason = 1.0, 1.0, ''
    while (found := tried(scale))[1]:
        if scale >= SLOWEST:
            break
        below, reason = scale, found[1]
        scale = min(scale * max(found[0], STEP), SLOWEST)
    else:
        while scale > RESOLUTION * below:
            middle = math.sqrt(scale * below)
            found = tried(middle)
            below, scale, reason = (middle, scale, found[1]) if found[1] else (
                below, middle, reason)
        return scale, reason
    reason = found[1]
    raise BellowsError(
        f'The motion exceeds the limit {reason} even at {SLOWEST:g} times its duration. Check '
        'the limits.')
