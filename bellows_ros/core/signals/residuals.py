"""Errors of a prediction against a measurement: per axis, and their spectra."""

from dataclasses import dataclass
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
"""The tool-relative coordinates: position of B (m), then its rotation vector (rad), in E axes."""

DISPLAY_UNITS = ('mm',) * 3 + ('deg',) * 3
DISPLAY_FACTORS = np.repeat([1e3, np.rad2deg(1.0)], 3)
"""Display units of the axes, and their number per m or rad."""


@dataclass(frozen=True, eq=False)
class Scores:
    """
    Errors of predicted tool-relative coordinates, each (6,): m for x, y, z and rad for rx, ry, rz.

    Parameters
    ----------
    rms, largest : ndarray (6,)
        RMS and largest absolute error.
    motion : ndarray (6,)
        RMS deviation of the measured coordinate from its mean.
    samples : int
        Number of samples compared.

    """

    rms: Array
    largest: Array
    motion: Array
    samples: int

    @property
    def nrmse(self) -> Array:
        """RMS error over RMS deviation of the measured coordinate from its mean, (6,)."""
        return self.rms / np.where(self.motion > 0.0, self.motion, np.nan)


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    Predicted and measured package in the tool frame.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
        Common stamps of prediction and recording.
    measured, predicted : ndarray (N, 6)
        Tool-relative coordinates: position of B (m) and rotation vector (rad) in E axes. NaN if
        the tool is lost, and in `measured` also if the package is lost.
    scores : Scores
        Errors per axis, at samples valid in both.

    """

    stamps_ns: Stamps
    measured: Array
    predicted: Array
    scores: Scores

    @property
    def error(self) -> Array:
        """Predicted minus measured (N, 6); NaN if the tool or the package is lost."""
        return self.predicted - self.measured

    def select(self, which: Mask) -> 'Comparison':
        """Return the comparison at some of the stamps."""
        measured, predicted = self.measured[which], self.predicted[which]
        return Comparison(self.stamps_ns[which], measured, predicted, score(measured, predicted))


def relative_coordinates(tool: Trajectory, package: Trajectory) -> Array:
    """
    Return position (m) and rotation vector (rad) of the package in the tool frame (N, 6).

    Both trajectories are in the world, at the same N stamps.
    """
    if not np.array_equal(tool.stamps_ns, package.stamps_ns):
        raise BellowsError('Tool and package must have the same stamps; resample one of them.')
    R_tool_world = np.swapaxes(tool.rotation, 1, 2)
    position = apply(R_tool_world, package.position - tool.position)
    return np.hstack([position, log_so3(R_tool_world @ package.rotation)])


def score(measured: Array, predicted: Array) -> Scores:
    """Return the errors of predicted against measured coordinates, both (N, 6), NaN if lost."""
    both = np.isfinite(measured + predicted).all(axis=1)
    if not both.any():
        raise BellowsError('No sample has both a prediction and a measurement.')
    measured, error = measured[both], (predicted - measured)[both]
    return Scores(
        rms=np.sqrt(np.mean(error**2, axis=0)),
        largest=np.abs(error).max(axis=0),
        motion=np.std(measured, axis=0),
        samples=len(measured))


def compare(predicted: Trajectory, tool: Trajectory, package: Trajectory) -> Comparison:
    """
    Compare a prediction with a measurement.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world.
    tool, package : Trajectory
        Measured poses of E and B at the same stamps, aligned but not filtered.

    Raises
    ------
    BellowsError
        If stamps differ, or there is no sample at which both are valid.

    """
    tracked = np.where(tool.valid, 1.0, np.nan)[:, None]
    measured = relative_coordinates(tool, package) * tracked
    measured[~package.valid] = np.nan
    coordinates = relative_coordinates(tool, predicted) * tracked
    return Comparison(tool.stamps_ns, measured, coordinates, score(measured, coordinates))


def compare_recorded(predicted: Trajectory, tool: Trajectory, package: Trajectory) -> Comparison:
    """
    Compare a prediction with a recording, at the stamps of the recording.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world with body twists, at any stamps.
    tool, package : Trajectory
        Measured poses of E and B at common stamps, aligned but not filtered.

    """
    stamps = package.stamps_ns
    inside = slice(*np.searchsorted(stamps, predicted.stamps_ns[[0, -1]] + [0, 1]).tolist())
    at_stamps = resample(predicted, stamps[inside])
    return compare(at_stamps, tool.select(inside), package.select(inside))


SEGMENT_S = 2.0
"""Length of the segments of a spectrum, s: a resolution of 0.5 Hz."""


class Spectrum(NamedTuple):
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

    def band(self, part: float) -> tuple[Array, Array]:
        """
        Return the bands (C,), (C,) in Hz with the middle part of each channel's power.

        The remaining power is split equally below and above. NaN without power.
        """
        total = np.cumsum(self.density, axis=0)
        share = total / np.where(total[-1] > 0.0, total[-1], np.nan)
        low, high = (
            np.where(np.isfinite(share[-1]), self.frequency[np.argmax(share >= level, axis=0)],
                     np.nan)
            for level in (0.5 * (1.0 - part), 0.5 * (1.0 + part)))
        return low, high


def spectrum(values: Array, rate_hz: float, segment_s: float = SEGMENT_S) -> Spectrum:
    """
    Return power spectral densities by Welch's method with Hann windows that overlap by half.

    Parameters
    ----------
    values : ndarray (N, C)
        Values at a uniform rate; their mean is subtracted.
    rate_hz : float
        Samples per second.
    segment_s : float
        Length of a segment, s.

    """
    length = min(len(values), round(segment_s * rate_hz))
    window = np.sin(np.pi * np.arange(length) / length) ** 2
    scale = 2.0 / (rate_hz * np.sum(window**2))
    # SciPy's function takes 1 s and 50 MB to load, and more memory than this loop over channels.
    density = scale * np.column_stack([
        np.mean(np.abs(np.fft.rfft(window * segments)) ** 2, axis=0)
        for segments in (sliding_window_view(channel - channel.mean(), length)[
            ::length - length // 2] for channel in values.T)])
    density[[0] if length % 2 else [0, -1]] *= 0.5  # one-sided
    return Spectrum(np.asarray(np.fft.rfftfreq(length, 1.0 / rate_hz), np.float64), density)
