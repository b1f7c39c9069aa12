"""
Validity range of a fit: deflection, rates, frequencies, mass and vacuum; range of the law.

A prediction outside the ranges of the identification is an extrapolation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Context, ROUND_CEILING, ROUND_FLOOR
import math
from typing import Any

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

MIN_RATE = np.array([1e-2] * 3 + [1e-1] * 3)
"""Smallest width of a validity range, above the noise (m, rad; m/s, rad/s)."""

MIN_FREQUENCY = 1.0
"""Smallest upper end of a frequency band, Hz."""

FREQUENCY_MARGIN = 1.25
"""Ratio of a frequency to the end of a band, above which the frequency is outside."""

DOWN, UP = (Context(prec=6, rounding=mode) for mode in (ROUND_FLOOR, ROUND_CEILING))
ROUNDING_MODES = {
    'deflection_low': (DOWN,) * 6, 'deflection_high': (UP,) * 6, 'rates': (UP,) * 6,
    'frequencies': (DOWN, UP) * 2, 'mass': (DOWN, UP), 'vacuum': (DOWN, UP)}
"""Rounding of the bounds outward, so that each range still contains its data."""

FIELDS = tuple(ROUNDING_MODES)

RANGE_PARAMETERS = {
    **{name: f'envelope.{name}' for name in FIELDS[:4]}, 'mass': 'cup.valid_mass',
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
        for name, shape in zip(FIELDS, ((6,), (6,), (6,), (2, 2), (2,), (2,)), strict=True):
            array = frozen_array(getattr(self, name), shape, f"envelope's {name}")
            object.__setattr__(self, name, array)
        if not (
                (self.deflection_low <= self.deflection_high).all()
                and (np.diff(self.frequencies) >= 0.0).all() and np.diff(self.mass) >= 0.0
                and np.diff(np.asarray(self.vacuum)) >= 0.0
                and (self.rates >= 0.0).all()):
            raise BellowsError('Envelope: a range ends below its beginning.')

    def parameters(self) -> dict[str, tuple[float, ...]]:
        """Return the parameters of the cup file with six digits, rounded outward."""
        return {
            RANGE_PARAMETERS[name]: tuple(
                float(context.create_decimal(repr(x)))
                for x, context in zip(getattr(self, name).ravel().tolist(), contexts, strict=True))
            for name, contexts in ROUNDING_MODES.items()
            if name != 'vacuum' or np.any(self.vacuum)}

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
        np.array([getattr(part, name) for part in parts]) for name in FIELDS[:5])
    return Envelope(
        low.min(axis=0), high.max(axis=0), rates.max(axis=0),
        np.column_stack([bands[:, :, 0].min(axis=0), bands[:, :, 1].max(axis=0)]),
        np.array([mass[:, 0].min(), mass[:, 1].max()]))


@dataclass(frozen=True)
class Distance:
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
    return _worst_first(
        _deflections(valid, np.asarray(deflection, dtype=float))
        + _rates(valid, np.asarray(rates, dtype=float))
        + _loads((valid.mass, valid.vacuum), mass, vacuum))


def _worst_first(distances: list[tuple[float, str]]) -> Distance:
    """Return the largest distance, and the phrases for distances above 1."""
    ranked = sorted(distances, key=lambda item: -item[0])
    return Distance(ranked[0][0], tuple(phrase for size, phrase in ranked if size > 1.0))


def beyond(valid: Envelope, other: Envelope) -> tuple[str, ...]:
    """Return a phrase for each range that another envelope exceeds, the worst first."""
    ends = (_deflections(valid, end) for end in (other.deflection_low, other.deflection_high))
    return _worst_first([
        *map(max, *ends), *_rates(valid, other.rates), *_frequencies(valid, other.frequencies),
        *max(_loads((valid.mass, valid.vacuum), mass, vacuum) for mass, vacuum in zip(
            other.mass.tolist(), np.asarray(other.vacuum).tolist(), strict=True))]).outside


def outside_loads(ranges: Sequence[ArrayLike], mass: float, vacuum: float) -> tuple[str, ...]:
    """Return a phrase for mass (kg) and vacuum (Pa) outside their ranges."""
    return tuple(phrase for size, phrase in _loads(ranges, mass, vacuum) if size > 1.0)


def _deflections(valid: Envelope, value: Array) -> list[tuple[float, str]]:
    """Return distance and phrase for each deflection."""
    middle = 0.5 * (valid.deflection_high + valid.deflection_low)
    half = np.maximum(0.5 * (valid.deflection_high - valid.deflection_low),
                      np.repeat([5e-4, 5e-3], 3))  # m, rad
    size, low, high = (
        DISPLAY_FACTORS * x for x in (value, valid.deflection_low, valid.deflection_high))
    return [
        (part, f'{DIRECTIONS[i]} is {size[i]:.3g} {DISPLAY_UNITS[i]}, seen {low[i]:.3g} to '
               f'{high[i]:.3g} {DISPLAY_UNITS[i]}')
        for i, part in enumerate((np.abs(value - middle) / half).tolist())]


def _rates(valid: Envelope, value: Array) -> list[tuple[float, str]]:
    """Return distance and phrase for each rate."""
    rate, largest = (DISPLAY_FACTORS * np.abs(x) for x in (value, valid.rates))
    return [
        (part, f'the rate of {DIRECTIONS[i]} is {rate[i]:.3g} {DISPLAY_UNITS[i]}/s, seen up to '
               f'{largest[i]:.3g}')
        for i, part in enumerate((np.abs(value) / np.maximum(valid.rates, MIN_RATE)).tolist())]


def _frequencies(valid: Envelope, bands: Array) -> list[tuple[float, str]]:
    """
    Return distance and phrase for the upper ends of frequency bands, if known.

    Slower motion is no extrapolation: the spring also holds at rest.
    """
    tops = np.maximum(valid.frequencies[:, 1], MIN_FREQUENCY).tolist()
    return [
        (top / valid_top / FREQUENCY_MARGIN,
         f'the {name} goes up to {top:.3g} Hz, seen {valid_top:.3g} Hz')
        for name, top, valid_top in zip(('shift', 'rotation'), bands[:, 1], tops, strict=True)
        if valid.frequencies.any()]


def _loads(ranges: Sequence[ArrayLike], mass: float, vacuum: float) -> list[tuple[float, str]]:
    """Return distance and phrase for mass and vacuum, without unknown ranges."""
    found = []
    for range_, (name, value, scale, unit) in zip(ranges, (
            ('mass', mass, 1.0, 'kg'), ('vacuum', vacuum, 1e-3, 'kPa')), strict=True):
        low, high = np.asarray(range_).tolist()
        if high > 0.0 and value > 0.0:
            half = 0.5 * (high - low) + 0.05 * (high + low)  # a margin of 10 %
            seen = f'{scale * low:.4g}' + (f' to {scale * high:.4g}' if low < high else '')
            found.append((abs(value - 0.5 * (low + high)) / half,
                          f'the {name} is {scale * value:.4g} {unit}, seen {seen}'))
    return found


def flip_finding(angle: float) -> Finding | None:
    """Return the finding on a bending angle (rad) beyond the largest moment, else None."""
    return None if angle <= PEAK_MOMENT_BENDING else Finding('flips', Level.WARN, {
        'angle': angle, 'limit': PEAK_MOMENT_BENDING})
