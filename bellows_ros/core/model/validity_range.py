"""
Validity range of a fit: one box of deflection, rates, mass and vacuum; range of the law.

A prediction outside the box of the identification is an extrapolation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import frozen_array
from bellows_ros.core.signals.residuals import DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

DIRECTIONS = (
    'displacement in x', 'displacement in y', 'displacement in z',
    'bending about x', 'bending about y', 'torsion')
"""Names of the coordinates of the lip in the tool: shift (m) and rotation vector (rad)."""

FLAT_MOMENT_BENDING = 0.6
"""Bending beyond which the moment of (3.17) hardly grows, rad."""
PEAK_MOMENT_BENDING = math.pi / 4.0
"""Bending with the largest moment of (3.17), rad."""

OVERTURN_ANGLE = 1.5
"""Rotation beyond which no package is still on its cup, rad."""

MIN_HALF = np.array([5e-4] * 3 + [5e-3] * 3 + [1e-2] * 3 + [1e-1] * 3 + [0.0] * 2)
"""Smallest half width of each range (14,), above the noise: m, rad; m/s, rad/s; kg, Pa."""

MARGIN = np.array([0.0] * 12 + [0.05] * 2)
"""Tolerated excess over masses and vacuums, relative to twice the largest: 10 % of a load."""

OUTSIDE = 1.001
"""Distance beyond which a state is outside: a file rounds ends of ranges to six digits."""

QUANTITIES = (
    *DIRECTIONS, *(f'the rate of {name}' for name in DIRECTIONS), 'the mass', 'the vacuum')
UNITS = (*DISPLAY_UNITS, *(f'{unit}/s' for unit in DISPLAY_UNITS), 'kg', 'kPa')
SCALES = np.hstack([DISPLAY_FACTORS, DISPLAY_FACTORS, 1.0, 1e-3])
"""Names, display units and their number per SI unit of the quantities (14,) of the box."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """
    The box covered by the recordings of a fit.

    Parameters
    ----------
    low, high : ndarray (14,)
        Ends of the `QUANTITIES`: shift (m) and rotation vector (rad) of the lip in tool axes, its
        twist relative to the tool in lip axes (m/s, rad/s), mass (kg), and vacuum (Pa below
        ambient). A mass or vacuum of 0 is unknown.

    """

    low: Array
    high: Array

    def __post_init__(self) -> None:
        for name in ('low', 'high'):
            object.__setattr__(self, name, frozen_array(
                getattr(self, name), (len(QUANTITIES),), f'validity range, cup.valid_{name},'))
        if np.any(self.low > self.high):
            first = int(np.argmax(self.low > self.high))
            raise BellowsError(
                f'The validity range of {QUANTITIES[first]} ends below its beginning: '
                f'cup.valid_low has {self.low[first]:g}, cup.valid_high {self.high[first]:g}; '
                'expected increasing ends. Set both.')

    @property
    def is_known(self) -> bool:
        """Whether deflections and rates are known."""
        return bool(self.low[:12].any() or self.high[:12].any())

    def widened(self, states: ArrayLike) -> 'Envelope':
        """Return the box widened to states (N, 14), NaN for quantities without a change."""
        every = np.vstack([self.low, self.high, states])
        return Envelope(np.nanmin(every, axis=0), np.nanmax(every, axis=0))

    def parameters(self) -> dict[str, tuple[float, ...]]:
        """Return the parameters of the cup file with six digits."""
        return {f'cup.valid_{name}': tuple(float(f'{x:.6g}') for x in end.tolist())
                for name, end in vars(self).items()}

    def as_json(self) -> dict[str, Any]:
        """Return the content for the result of a fit."""
        return {'quantities': QUANTITIES, **vars(self)}


def joined_envelopes(parts: Sequence[Envelope], vacuum: float) -> Envelope:
    """Return the union of the ranges of recordings, with a vacuum (Pa)."""
    low, high = (np.array([getattr(part, end) for part in parts]) for end in ('low', 'high'))
    low[:, -1] = high[:, -1] = vacuum
    return Envelope(low.min(axis=0), high.max(axis=0))


class Distance(NamedTuple):
    """
    Distance of a state from the validity range.

    Parameters
    ----------
    value : float
        0 in the middle of all ranges, 1 on the edge of a range, above 1 outside of a range.
    outside : tuple of str
        A phrase for each exceeded range, the farthest first.

    """

    value: float
    outside: tuple[str, ...]


def distance(valid: Envelope, *states: ArrayLike) -> Distance:
    """
    Return the distance of the farthest of states (14,) from the validity range.

    Each quantity counts by itself. Masses and vacuums of 0 are unknown, in states and ranges.
    """
    low, high = valid.low, valid.high
    half = np.maximum(0.5 * (high - low), MIN_HALF) + MARGIN * (np.abs(high) + np.abs(low))
    values = np.array(states)
    is_known = (np.arange(len(low)) < 12) | ((high > 0.0) & (values > 0.0))
    parts = np.abs(values - 0.5 * (low + high)) / np.where(half > 0.0, half, np.inf) * is_known
    order = np.argsort(-parts.max(axis=0)).tolist()
    value = np.take_along_axis(values, np.argmax(parts, axis=0)[None], axis=0)[0]
    value, low, high = SCALES * [value, low, high]
    return Distance(float(parts.max()), tuple(
        f'{QUANTITIES[i]} is {value[i]:.3g} {UNITS[i]}, seen {_shown(low[i], high[i])} '
        f'{UNITS[i]}' for i in order if parts[:, i].max() > OUTSIDE))


def beyond(valid: Envelope, other: Envelope) -> tuple[str, ...]:
    """Return a phrase for each range that another box exceeds, the worst first."""
    return distance(valid, other.low, other.high).outside


def outside_loads(valid: Envelope, mass: float, vacuum: float) -> tuple[str, ...]:
    """Return a phrase for mass (kg) and vacuum (Pa) outside their ranges."""
    return distance(valid, [*0.5 * (valid.low + valid.high)[:12], mass, vacuum]).outside


def _shown(low: float, high: float) -> str:
    """Return the words for a range."""
    if low == -high:
        return f'up to {high:.3g}'
    return f'{low:.3g} to {high:.3g}' if low < high else f'{high:.3g}'


def flip_finding(angle: float) -> Finding | None:
    """Return the finding on a bending angle (rad) beyond the largest moment, else None."""
    return None if angle <= PEAK_MOMENT_BENDING else Finding('flips', Level.WARN, {
        'angle': angle, 'limit': PEAK_MOMENT_BENDING})
