"""
Whether the filter follows what the cup does.

Of a fast motion it leaves less, and of each derivative another part: K and P of least squares are
then off, which their standard errors do not know.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.told import DIRECTIONS
from bellows_ros.core.identification.judgement.whiteness import Spectrum
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from bellows_ros.core.identification.advice.excitation import Axis

Array = NDArray[np.float64]

FOLLOWED = 0.013
"""A filter follows while it takes less than this part of a velocity: up to 6 Hz, if automatic."""

LOST, STANDS_OUT = 0.03, 5.0
"""
A direction is too fast if the filter takes more than this part of its velocities.

Velocities count as so many times the power of the noise at least, which is known to some percent.
"""

RESOLUTION = 0.05
"""Step (Hz) in which the end of a pass band is looked for."""

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


def too_fast(
    axes: Sequence['Axis'], twists: Sequence[Spectrum], rates_hz: Sequence[float],
    noises: Sequence[FilterNoise],
) -> Iterator[str]:
    """
    Yield a warning for each direction whose motion the filter does not follow.

    Parameters
    ----------
    axes : sequence of Axis
        The six directions.
    twists : sequence of Spectrum
        Of the lip's filtered twist in each recording, in the tool.
    rates_hz : sequence of float
        Of each recording's samples.
    noises : sequence of FilterNoise
        Of each recording.

    """
    if not noises:
        return
    power, lost, of_noise = np.zeros(6), np.zeros(6), 0.0
    for twist, rate_hz, noise in zip(twists, rates_hz, noises, strict=True):
        part = left(noise.package_weights, rate_hz, twist.frequency)
        white = (part * twist.frequency) ** 2
        of_noise += (1.0 - part) @ white / white.sum() / len(twists)
        power += twist.frequency[1] * twist.density.sum(axis=0) / len(twists)
        lost += twist.frequency[1] * (1.0 - part) @ twist.density / len(twists)
    variance = np.array([axis.twist_noise for axis in axes]) ** 2
    moving, lost = power - variance, lost - of_noise * variance
    least = LOST * np.maximum(moving, STANDS_OUT * variance)
    ends = [pass_band(n.package_weights, r) for n, r in zip(noises, rates_hz, strict=True)]
    first = int(np.argmin(ends))
    for axis, is_lost in zip(axes, lost > least, strict=True):
        if is_lost:
            yield _sentence(axis, ends[first], noises[first])


def _sentence(axis: 'Axis', end: float, noise: FilterNoise) -> str:
    """Return what is said of a direction that is too fast for the filter, with the remedy."""
    fastest = axis.band_hz[1]
    tool, package = (
        max(int(weights.shape[1] // 2 * end / fastest), SHORTEST)
        for weights in (noise.tool_weights, noise.package_weights)
    )
    return (
        f'{DIRECTIONS[axis.name][0]} of up to {fastest:.1f} Hz is too fast for the filter, which '
        f'follows up to {end:.1f} Hz: least squares may find its stiffness and damping wrong by '
        'more than the standard errors say. Take fit.method: prediction_error, or shorter windows '
        f'(filter.tool.half_window: {tool}, filter.package.half_window: {package}).'
    )
