"""
Power spectral densities, of samples of which some may be missing.

Residuals with samples missing (NaN) are taken as they are: powers of the samples there. A motion
with samples missing is interpolated first: cut to zero there, it would seem to have power at all
frequencies.
"""

from dataclasses import dataclass

from bellows_ros.core.arrays import Array
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

SEGMENT_S = 2.0
"""Length of the segments of a spectrum, s: lines half a hertz apart are kept apart."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """
    One-sided power spectral densities of C channels.

    Parameters
    ----------
    frequency : ndarray (F,)
        Hz.
    density : ndarray (F, C)
        Square of the channel's unit per Hz; its integral is the channel's mean square.

    """

    frequency: Array
    density: Array

    @property
    def peak(self) -> Array:
        """Frequency (Hz) of the largest density of each channel (C,)."""
        return np.asarray(self.frequency[np.argmax(self.density, axis=0)])

    def band(self, part: float) -> tuple[Array, Array]:
        """
        Return the bands (C,), (C,) in Hz that hold the middle part of each channel's power.

        The rest is left out in equal shares below and above. NaN where there is no power.
        """
        total = np.cumsum(self.density, axis=0)
        share = np.full_like(total, np.nan)
        np.divide(total, total[-1], out=share, where=total[-1] > 0.0)
        outside = 0.5 * (1.0 - part)
        edges = [
            np.array([self._reached(column, level) for column in share.T])
            for level in (outside, 1.0 - outside)
        ]
        return edges[0], edges[1]

    def _reached(self, share: Array, level: float) -> float:
        """Return the frequency at which a cumulated share reaches a level."""
        if not np.isfinite(share[-1]):
            return float('nan')
        return float(self.frequency[np.argmax(share >= level)])


def interpolated(values: Array) -> Array:
    """Return values (N, C) with the samples that are missing (NaN) on lines between the others."""
    there = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not len(there):
        raise BellowsError('There is no sample of which to take a spectrum.')
    every = np.arange(len(values))
    return np.column_stack([np.interp(every, there, channel[there]) for channel in values.T])


def spectrum(values: Array, rate_hz: float, segment_s: float = SEGMENT_S) -> Spectrum:
    """
    Return power spectral densities by Welch's method: Hann windows that overlap by half.

    Parameters
    ----------
    values : ndarray (N, C)
        At a uniform rate; their mean is taken out. NaN where a sample is missing: it counts as
        zero, and the density is made up for the power that is missing so. That is right for what
        is white; see `interpolated` for the rest.
    rate_hz : float
        Samples per second.
    segment_s : float
        Length of a segment, s.

    """
    there = np.asarray(np.isfinite(values).all(axis=1))
    if not there.any():
        raise BellowsError('There is no sample of which to take a spectrum.')
    made_up = len(values) / np.count_nonzero(there)
    length = min(len(values), round(segment_s * rate_hz))
    densities = [
        made_up * _density(np.where(there, channel - channel[there].mean(), 0.0), length, rate_hz)
        for channel in values.T
    ]
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / rate_hz), dtype=np.float64)
    return Spectrum(frequency, np.array(densities).T)


def _density(channel: Array, length: int, rate_hz: float) -> Array:
    """
    Return the one-sided density of a channel (N,), as `scipy.signal.welch` does.

    That is not imported for it: SciPy's signal module takes 0.4 s and 25 MB.
    """
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi / length * np.arange(length))
    segments = sliding_window_view(channel, length)[:: max(length - length // 2, 1)]
    power = np.mean(np.abs(np.fft.rfft(segments * window)) ** 2, axis=0)
    power[1:(length + 1) // 2] *= 2.0  # what stands for the negative frequencies as well
    return np.asarray(power / (rate_hz * np.sum(window**2)))
