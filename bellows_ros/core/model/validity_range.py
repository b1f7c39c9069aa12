"""
Validity range of a fit: deflection, rates, frequencies, mass and vacuum; range of the law.

A prediction outside the ranges of the identification is an extrapolation.
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

MIN_HALF = np.array([5e-4] * 3 + [5e-3] * 3 + [1e-2] * 3 + [1e-1] * 3 + [1.0] * 2 + [0.0] * 2)
"""Smallest half width of each range (16,), above the noise: m, rad; m/s, rad/s; Hz; kg, Pa."""

MARGIN = np.array([0.0] * 12 + [0.125] * 2 + [0.05] * 2)
"""Tolerated excess over frequencies, masses and vacuums, relative to twice the largest: 25 % for
frequencies, which a spectrum resolves to 0.5 Hz, and 10 % for loads."""

OUTSIDE = 1.001
"""Distance beyond which a state is outside: a file rounds ends of ranges to six digits."""

QUANTITIES = (
    *DIRECTIONS, *(f'the rate of {name}' for name in DIRECTIONS), 'the frequency of shift',
    'the frequency of rotation', 'the mass', 'the vacuum')
UNITS = (*DISPLAY_UNITS, *(f'{unit}/s' for unit in DISPLAY_UNITS), 'Hz', 'Hz', 'kg', 'kPa')
SCALES = np.hstack([DISPLAY_FACTORS, DISPLAY_FACTORS, 1.0, 1.0, 1.0, 1e-3])
"""Names, display units and their number per SI unit of the quantities (16,) of a range."""

SHAPES = {'deflection_low': (6,), 'deflection_high': (6,), 'rates': (6,), 'frequencies': (2, 2),
          'mass': (2,), 'vacuum': (2,)}

RANGE_PARAMETERS = {
    **{name: f'envelope.{name}' for name in [*SHAPES][:4]}, 'mass': 'cup.valid_mass',
    'vacuum': 'cup.valid_vacuum'}
"""Parameters of the ranges."""


@dataclass(frozen=True, eq=False)
class Envelope:
    """
    Ranges covered by the recordings of a fit.

    Parameters
    ----------
    deflection_low, deflection_high : ndarray (6,)
        Limits of the lip's deflection, in tool axes: shift (m), and rotation vector (rad) with
        bending as x and y and torsion as z.
    rates : ndarray (6,)
        Largest absolute twist of the lip in the tool, in lip axes, m/s and rad/s.
    frequencies : ndarray (2, 2)
        Bands (low, high) in Hz with 95 % of the power of shift and of rotation.
    mass : ndarray (2,)
        Smallest and largest mass, kg.
    vacuum : ndarray (2,)
        Smallest and largest vacuum, Pa below ambient; zeros if unknown.

    """

    deflection_low: Array
    deflection_high: Array
    rates: Array
    frequencies: Array
    mass: Array
    vacuum: ArrayLike = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            array = frozen_array(getattr(self, name), shape, f"envelope's {name}")
            object.__setattr__(self, name, array)
        low, high = self.box
        if np.any(low > high) or np.any(np.diff(self.frequencies) < 0.0):
            raise BellowsError('Envelope: a range ends below its beginning.')

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper ends of the `QUANTITIES` (16,), in SI units."""
        top, vacuum = self.frequencies[:, 1], np.asarray(self.vacuum)
        return (np.hstack([self.deflection_low, -self.rates, -top, self.mass[0], vacuum[0]]),
                np.hstack([self.deflection_high, self.rates, top, self.mass[1], vacuum[1]]))

    def parameters(self) -> dict[str, tuple[float, ...]]:
        """Return the parameters of the cup file with six digits."""
        return {
            RANGE_PARAMETERS[name]: tuple(
                float(f'{x:.6g}') for x in getattr(self, name).ravel().tolist())
            for name in SHAPES if name != 'vacuum' or np.any(self.vacuum)}

    def as_json(self) -> dict[str, Any]:
        """Return the content for the result of a fit."""
        shifts = ['m'] * 3 + ['rad'] * 3
        units = {'deflection_low': shifts, 'deflection_high': shifts,
                 'rates': ['m/s'] * 3 + ['rad/s'] * 3, 'frequencies': 'Hz', 'mass': 'kg',
                 'vacuum': 'Pa'}
        return {'directions': DIRECTIONS, 'units': units, **vars(self)}


def joined_envelopes(parts: Sequence[Envelope]) -> Envelope:
    """Return the validity range of all recordings: the union of their ranges."""
    low, high, rates, bands, mass = (
        np.array([getattr(part, name) for part in parts]) for name in [*SHAPES][:5])
    return Envelope(
        low.min(axis=0), high.max(axis=0), rates.max(axis=0),
        np.column_stack([bands[:, :, 0].min(axis=0), bands[:, :, 1].max(axis=0)]),
        np.array([mass[:, 0].min(), mass[:, 1].max()]))


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


def distance(
    valid: Envelope, deflection: ArrayLike, rates: ArrayLike, mass: float, vacuum: float = 0.0
) -> Distance:
    """
    Return the distance of a state from the validity range.

    A state has no frequency: motion faster than in the fit exceeds the rates. `beyond` compares
    bands.

    Parameters
    ----------
    valid : Envelope
        Ranges of the fit.
    deflection, rates : array_like (6,)
        Deflection and twist of the lip, as in `Envelope`.
    mass : float
        Mass of the package, kg.
    vacuum : float
        Pressure below ambient in the cup, Pa; 0 if unknown.

    """
    return _distance(valid, np.hstack([deflection, rates, 0.0, 0.0, mass, vacuum]))


def beyond(valid: Envelope, other: Envelope) -> tuple[str, ...]:
    """Return a phrase for each range that another envelope exceeds, the worst first."""
    return _distance(valid, *other.box).outside


def outside_loads(ranges: Sequence[ArrayLike], mass: float, vacuum: float) -> tuple[str, ...]:
    """Return a phrase for mass (kg) and vacuum (Pa) outside their ranges."""
    none = np.zeros(6)
    valid = Envelope(none, none, none, np.zeros((2, 2)), *map(np.asarray, ranges))
    return distance(valid, none, none, mass, vacuum).outside


def _distance(valid: Envelope, *states: Array) -> Distance:
    """
    Return the distance of the farthest of states (16,), of each quantity by itself.

    Frequencies, masses and vacuums of 0 are unknown, in states and ranges.
    """
    low, high = valid.box
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


def _shown(low: float, high: float) -> str:
    """Return the words for a range."""
    if low == -high:
        return f'up to {high:.3g}'
    return f'{low:.3g} to {high:.3g}' if low < high else f'{high:.3g}'


def flip_finding(angle: float) -> Finding | None:
    """Return the finding on a bending angle (rad) beyond the largest moment, else None."""
    return None if angle <= PEAK_MOMENT_BENDING else Finding('flips', Level.WARN, {
        'angle': angle, 'limit': PEAK_MOMENT_BENDING})
