"""
Whether the filter follows what the cup does.

Of a fast motion it leaves less, and of each derivative another part: K and P of least squares are
then off, which their standard errors do not know.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.advice.identifiability import Axis, DIRECTIONS
from bellows_ros.core.recording.noise import FilterNoise
from bellows_ros.core.spectra import Spectrum
import numpy as np

FOLLOWED = 0.013
"""A filter follows while it takes less than this part of a velocity: up to 6 Hz, if automatic."""

LOST, STANDS_OUT = 0.03, 5.0
"""
A direction is too fast if the filter takes more than this part of its velocities.

Velocities count as so many times the power of the noise at least, which is known to some percent.
"""

RESOLUTION = 0.05
"""Step (Hz) in which the end of a pass band is looked for."""

NO_FLOOR = 1e-3
"""Frequencies at which the filter leaves less than this part of white noise show none."""

SHORTEST = 4
"""Half window (samples) that is the shortest for polynomials of order 6."""


def left(weights: Array, rate_hz: float, frequency: Array) -> Array:
    """Return the parts (F,) of velocities at frequencies (F,) in Hz that a filter leaves."""
    half_window = weights.shape[1] // 2
    time = np.arange(-half_window, half_window + 1) / rate_hz
    omega = 2.0 * np.pi * np.maximum(frequency, RESOLUTION)
    return np.asarray(np.sin(omega[:, None] * time) @ weights[1] / omega)


def pass_band(weights: Array, rate_hz: float) -> float:
    """Return the frequency (Hz) up to which a filter with weights (3, 2n+1) follows."""
    frequency = np.arange(RESOLUTION, 0.5 * rate_hz, RESOLUTION)
    beyond = left(weights, rate_hz, frequency) < 1.0 - FOLLOWED
    return float(frequency[np.argmax(beyond)]) if beyond.any() else 0.5 * rate_hz


class PassBand(NamedTuple):
    """
    What the filter of one recording's package leaves of the lip's twist.

    Mean squares (6,) of the filtered twist, power, and of what the filter took of it, lost; the
    part of white noise that it took; the end (Hz) of its pass band; half windows (samples) of the
    filters of tool and package; and the mean squares of the white noise that the spectra show
    beyond the pass band, where noise in one axis is larger than in the others.
    """

    power: Array
    lost: Array
    of_noise: float
    end_hz: float
    half_windows: tuple[int, int]
    floor: Array

    @classmethod
    def of(cls, twist: Spectrum, rate_hz: float, noise: FilterNoise) -> 'PassBand':
        """Return that of a recording by the spectrum of its twist, at a rate of samples."""
        part = left(noise.package_weights, rate_hz, twist.frequency)
        white = (part * twist.frequency) ** 2
        end = pass_band(noise.package_weights, rate_hz)
        beyond = (twist.frequency > 2.0 * end) & (white > NO_FLOOR * white.max())
        level = twist.density[beyond] / white[beyond, None]
        floor = np.median(level, axis=0) * white.sum() if beyond.any() else np.zeros(6)
        return cls(
            twist.frequency[1] * twist.density.sum(axis=0),
            twist.frequency[1] * (1.0 - part) @ twist.density,
            float((1.0 - part) @ white / white.sum()), end,
            (noise.tool_half_window, noise.package_weights.shape[1] // 2),
            twist.frequency[1] * floor)


def too_fast(axes: Sequence[Axis], passed: Sequence[PassBand]) -> Iterator[str]:
    """
    Yield a warning for each direction whose motion the filter does not follow.

    Parameters
    ----------
    axes : sequence of Axis
        The six directions.
    passed : sequence of PassBand
        Of each recording.

    """
    if not passed:
        return
    power = np.mean([own.power for own in passed], axis=0)
    lost = np.mean([own.lost for own in passed], axis=0)
    of_noise = np.mean([own.of_noise for own in passed])
    floor = np.mean([own.floor for own in passed], axis=0)
    variance = np.maximum(np.array([axis.twist_noise for axis in axes]) ** 2, floor)
    moving, lost = power - variance, lost - of_noise * variance
    least = LOST * np.maximum(moving, STANDS_OUT * variance)
    first = min(passed, key=lambda own: own.end_hz)
    for axis, is_lost in zip(axes, lost > least, strict=True):
        if is_lost:
            yield _sentence(axis, first)


def _sentence(axis: Axis, passed: PassBand) -> str:
    """Return what is said of a direction that is too fast for the filter, with the remedy."""
    end, fastest = passed.end_hz, axis.band_hz[1]
    tool, package = (max(int(n * end / fastest), SHORTEST) for n in passed.half_windows)
    shorter = (f', or shorter windows (filter.tool.half_window: {tool}, '
               f'filter.package.half_window: {package})' if fastest > end else '')
    return (
        f'{DIRECTIONS[axis.name][0]} of up to {fastest:.1f} Hz is too fast for the filter, which '
        f'follows up to {end:.1f} Hz: least squares may find its stiffness and damping wrong by '
        'more than the standard errors say. Take fit.method: '
        f'prediction_error{shorter}.'
    )
