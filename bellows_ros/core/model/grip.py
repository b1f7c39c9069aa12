"""
Safety factors of a vacuum grip against peel and slip.

The vacuum presses the package on the lip with V = pressure below ambient times effective area (N).
The wrench (f, m) of the cup on the package is that at S in S axes, so f_z > 0 pulls the package
up into the cup, and the lip presses with N = V - f_z. Each factor is the largest s for which
s (f, m) still holds with the same V; infinite where no size of the wrench lets go, below 1 where
the grip is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import Vector
import numpy as np

Grip = tuple[float, float, float]
"""Suction force V (N), radius of the lip r (m), friction between lip and package."""

MODES = ('peel', 'slip')
"""Failure modes of the grip; an elastic lip peels before it tips."""


@kernel
def ratio(suction: float, load: float) -> float:
    """Return suction / load, or infinity if nothing pulls."""
    return suction / load if load > 0.0 else math.inf


@kernel
def peel_load(radius: float, f: Vector, m: Vector) -> float:
    """Return the suction force (N) at or below which the lip peels, f_z + 2 m_t / r."""
    return f[2] + 2.0 * math.sqrt(m[0] * m[0] + m[1] * m[1]) / radius


@kernel
def safety_factors(grip: Grip, f: Vector, m: Vector) -> tuple[float, float]:
    """
    Return the safety factors against peel and slip, as in `MODES`; the smaller one counts.

    Peel: the pressure of an elastic lip, linear across the ring, stays at or above zero all
    around, 2 m_t / r <= N. Slip, sliding and twisting: q <= friction N, a circle in force and
    moment. A thin ring with Coulomb friction holds less where a lateral force acts beside m_z:
    the factor is up to 11 % above it with even pressure, and up to 33 % where bending takes half
    of what peels the lip.
    """
    suction, radius, friction = grip
    twist = m[2] / radius
    q = math.sqrt(f[0] * f[0] + f[1] * f[1] + twist * twist)
    return (
        ratio(suction, peel_load(radius, f, m)), ratio(friction * suction, q + friction * f[2]))


def safety_factors_of(grip: Grip, wrench: Array) -> Array:
    """Return the safety factors (N, 2), as in `MODES`, of wrenches (N, 6) at S in S axes."""
    factors = np.empty((len(wrench), 2))
    _write_factors(grip, wrench, factors)
    return factors


class Margin(NamedTuple):
    """The smallest safety factor of a motion, its mode, and when it was, s."""

    factor: float
    mode: str
    time: float

    @property
    def sentence(self) -> str:
        """The margin as a sentence."""
        lost = ': the cup would have let go' if self.factor < 1.0 else ''
        return (
            f'The smallest safety factor of the grip is {self.factor:.3g} ({self.mode}, at '
            f'{self.time:.2f} s){lost}.')


def margin(grip: Grip, wrench: Array, seconds: Array) -> Margin:
    """Return the smallest safety factor of wrenches (N, 6) at times (N,), ignoring NaN."""
    factors = safety_factors_of(grip, wrench)
    row, mode = np.unravel_index(np.nanargmin(factors), factors.shape)
    return Margin(float(factors[row, mode]), MODES[mode], float(seconds[row]))


@kernel
def _write_factors(grip: Grip, wrench: Array, out: Array) -> None:
    """Write the factors of every row."""
    for k in range(len(wrench)):
        row = wrench[k]
        out[k, 0], out[k, 1] = safety_factors(
            grip, (row[0], row[1], row[2]), (row[3], row[4], row[5]))


def grip_of(values: Mapping[str, Any], vacuum: float | None = None) -> Grip | None:
    """
    Return the grip in parameter values, or None if it is incomplete.

    Parameters
    ----------
    values : mapping
        Parameters by name: cup.lip_radius, cup.suction_area, cup.friction, vacuum.holding.
    vacuum : float, optional
        Pressure below ambient (Pa) as it is measured, instead of vacuum.holding.

    """
    radius = float(values['cup.lip_radius'])
    pressure = float(values['vacuum.holding']) if vacuum is None else max(vacuum, 0.0)
    if radius == 0.0 or (vacuum is None and pressure == 0.0):
        return None
    area = float(values['cup.suction_area']) or math.pi * radius * radius
    return pressure * area, radius, float(values['cup.friction'])


def safety_sentence(factor: float, mode: str, time: float, std: float, least: float) -> str:
    """Return a sentence about a safety factor that is too small, else ''."""
    sigma = f' ± {std:.2g}' if std > 0.0 else ''
    finding = f'The smallest safety factor is {factor:.3g}{sigma} ({mode}, at {time:.3f} s)'
    if factor < 1.0:
        return f'{finding}: the cup lets go. Move slower, or raise the vacuum.'
    if factor - 2.0 * std < least:
        less = ' less two standard deviations' if std > 0.0 else ''
        return f'{finding},{less} below safety.least, {least:g}. Move slower, or raise the vacuum.'
    return ''
