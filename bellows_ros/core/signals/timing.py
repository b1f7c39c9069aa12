"""
Rate, jitter and gaps of the stamps of a stream, and stamps that are times of arrival.

Poses that come over a network in bursts are late by some time each, so that a moving body seems to
go to and fro. Where a sensor samples uniformly, how late each pose came follows from all stamps.
Whether it does, the poses tell: at the times of sampling their motion is smoother.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, UNIFORM_WITHIN
from bellows_ros.errors import BellowsError
import numpy as np

# A step of more than this many periods is a gap: at least one sample is missing. Jitter of the
# stamps adds to it, as many of its standard deviations as here.
GAP_PERIODS = 1.5
GAP_DEVIATIONS = 3.0
# Steps within this part of the period count as uniform; `savgol` allows twice as much, measured
# from the mean step instead of the period estimated here.
COPIED_WITHIN = 0.5 * UNIFORM_WITHIN
# Stamps come in bursts where the mean of so many steps is mostly not within these factors
# of the typical step: half the samples may be lost, but none is there twice.
STEPS_TOGETHER = 20
MEAN_WITHIN = (0.8, 2.5)
# Standard deviation of a normal distribution per median absolute deviation.
MAD_TO_STD = 1.4826

JITTER_WARNED = 0.1
"""Jitter in parts of the period that is worth a look."""

NEAR, MOST_GAPS, SURELY_LOST = 30, 200, 0.65
"""Samples compared on both sides of a gap, most gaps, and periods that tell that one is lost."""

WINDOW_S, FEWEST, ORDER = 1 / 12, 8, 5
"""Length of the polynomials that a motion follows (s; samples) and their order."""

SMOOTHER = 0.8
"""Product of the squared deviations of position and rotation below which stamps are replaced."""


@dataclass(frozen=True)
class Gap:
    """
    A time without samples.

    Parameters
    ----------
    index : int
        Sample before the gap, among those the stream has.
    start_ns : int
        Its stamp.
    duration_s : float
        Time to the next sample, s.

    """

    index: int
    start_ns: int
    duration_s: float


@dataclass(frozen=True)
class Timing:
    """
    How the stamps of a stream lie in time.

    Parameters
    ----------
    rate_hz : float
        Samples per second where none is missing.
    jitter_s : float
        Robust standard deviation of the steps between samples, s.
    uniform : bool
        Whether the stamps are uniform, so that no sample needs interpolation.
    gaps : tuple of Gap
        In order of time.

    """

    rate_hz: float
    jitter_s: float
    uniform: bool
    gaps: tuple[Gap, ...]

    @property
    def longest_step_ns(self) -> int:
        """Longest time between samples that is not a gap, ns."""
        return int(_longest_step(NS_PER_S / self.rate_hz, self.jitter_s * NS_PER_S))


def timing(stamps_ns: Stamps) -> Timing:
    """
    Estimate the rate and jitter of stamps, and find the gaps.

    The rate comes from the stamps alone, by medians, so that neither gaps nor a clock that runs
    fast or slow misleads it.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Strictly increasing, ns.

    Returns
    -------
    Timing

    Raises
    ------
    BellowsError
        With fewer than three stamps.

    """
    if len(stamps_ns) < 3:
        raise BellowsError(
            f'A rate needs at least 3 samples, got {len(stamps_ns)}. Record longer, or choose '
            'the topic with the poses.'
        )
    steps = np.diff(stamps_ns)
    period = _period(steps)
    jitter = MAD_TO_STD * float(np.median(np.abs(steps - period)))
    slots = np.maximum(np.rint(steps / period), 1.0)
    uniform = bool(np.all(np.abs(steps / (slots * period) - 1.0) <= COPIED_WITHIN))
    long = np.flatnonzero(steps > _longest_step(period, jitter))
    gaps = tuple(Gap(int(i), int(stamps_ns[i]), float(steps[i] / NS_PER_S)) for i in long)
    return Timing(NS_PER_S / period, jitter / NS_PER_S, uniform, gaps)


def _period(steps: Stamps) -> float:
    """
    Return the time between samples without gaps, ns.

    The median step knows the period to the stamps' resolution; the mean of the steps near it,
    which average that out, knows it better. Of stamps in pairs or bursts only the mean over many
    steps is the period.
    """
    together = min(STEPS_TOGETHER, max(len(steps) // 4, 1))
    typical = _typical(steps)
    mean = _typical(np.convolve(steps, np.ones(together), 'valid')) / together
    few, many = MEAN_WITHIN
    return typical if few * typical <= mean <= many * typical else mean


def _typical(values: Array | Stamps) -> float:
    """Return the mean of the values near their median, or the median if there are none."""
    median = float(np.median(values))
    near = values[np.abs(values - median) < 0.5 * median]
    return float(np.mean(near)) if len(near) else median


def _longest_step(period: float, jitter: float) -> float:
    """Return the longest step that is not a gap."""
    return GAP_PERIODS * period + GAP_DEVIATIONS * jitter


def subdivided(stamps_ns: Stamps, parts: Stamps) -> Stamps:
    """
    Return stamps with more of them put in between.

    Parameters
    ----------
    stamps_ns : int array (N,)
        ns.
    parts : int array (N - 1,)
        Into how many parts each step is cut.

    """
    last = len(parts) - 1
    step = np.append(np.repeat(np.arange(len(parts)), parts), last)
    number = np.arange(len(step)) - (np.cumsum(parts) - parts)[step]
    return np.asarray(stamps_ns[step] + number * np.diff(stamps_ns)[step] // parts[step])


class ArrivalStamps(NamedTuple):
    """
    Stamps that were times of arrival.

    Parameters
    ----------
    replaced : int
        Stamps that were replaced.
    jitter_s, latest_s : float
        Standard deviation and range of how late the poses came, s.
    rougher : (float, float)
        Deviation (m, rad) of the poses from smooth motion at the recorded stamps.
    smoother : (float, float)
        The same at the times of sampling.

    """

    replaced: int
    jitter_s: float
    latest_s: float
    rougher: tuple[float, float]
    smoother: tuple[float, float]

    def sentence(self, name: str) -> str:
        """Return what the user should know."""
        return (
            f"The stamps of topic '{name}' are times of arrival, which jitter by "
            f'{self.jitter_s * 1e3:.2g} ms (range {self.latest_s * 1e3:.2g} ms). All '
            f'{self.replaced} were replaced by uniform times of sampling, at which the poses '
            'deviate from smooth '
            f'motion by {self.smoother[0] * 1e3:.2g} mm and {self.smoother[1] * 1e3:.2g} mrad '
            f'instead of {self.rougher[0] * 1e3:.2g} and {self.rougher[1] * 1e3:.2g}. What all '
            'were late by at least is not known: stamp the poses when they are measured, or set '
            'fit.time_offset.')


def at_sampling(stream: PoseStream) -> tuple[PoseStream, ArrivalStamps | None]:
    """Return poses with the stamps of their sampling, where theirs are times of arrival."""
    if len(stream) < 4 * NEAR:
        return stream, None
    found = timing(stream.stamps_ns)
    if found.jitter_s * found.rate_hz < JITTER_WARNED:
        return stream, None
    sampled = sampling_stamps(stream.stamps_ns)
    if sampled is None:
        return stream, None
    size = max(round(WINDOW_S * found.rate_hz), FEWEST)
    before, after = (
        _deviation(stream.position, stream.rotation, stamps, size)
        for stamps in (stream.stamps_ns, sampled))
    if not np.prod((after / np.maximum(before, 1e-12)) ** 2) < SMOOTHER:
        return stream, None
    late = (stream.stamps_ns - sampled) / NS_PER_S
    return replace(stream, stamps_ns=sampled), ArrivalStamps(
        len(late), float(np.std(late)), float(np.ptp(late)),
        (float(before[0]), float(before[1])), (float(after[0]), float(after[1])))


def sampling_stamps(stamps_ns: Stamps) -> Stamps | None:
    """
    Return when samples were taken that arrived at some stamps, at the latest; None if unknown.

    No sample arrives before it is taken, so the uniform stamps are the earliest that touch one.
    After a gap all samples seem late, by whole periods. Samples lost every few periods, or
    jitter of many periods, leave it unknown.
    """
    since, number = (stamps_ns - stamps_ns[0]).astype(np.float64), np.arange(len(stamps_ns))
    period = float(np.quantile(since[2 * NEAR:] - since[:-2 * NEAR], 0.25)) / (2 * NEAR)
    for _ in range(MOST_GAPS):
        late = since - period * number
        earliest = np.min(np.lib.stride_tricks.sliding_window_view(late, NEAR), axis=1)
        steps = earliest[NEAR:] - earliest[:-NEAR]
        drift = float(np.median(steps))
        period += drift / NEAR
        i = int(np.argmax(steps))
        lost = int((steps[i] - drift) / period + 1.0 - SURELY_LOST)
        if lost < 1:
            sampled = _line_below(number, since)
            return np.asarray(stamps_ns[0] + np.rint(sampled).astype(np.int64))
        before = np.flatnonzero(late[i:i + 3 * NEAR] < earliest[i] + (lost - 0.1) * period)
        number[i + before[-1] + 1:] += lost
    return None


def _line_below(x: Array | Stamps, y: Array) -> Array:
    """Return the line (N,) below all points that is nearest to them in the mean."""
    middle, slope = int(np.searchsorted(x, np.mean(x))), (y[-1] - y[0]) / (x[-1] - x[0])
    ends = -1, -1
    while True:  # Newton's steps: through the lowest points of both halves above that slope
        above = y - slope * x
        new = int(np.argmin(above[:middle])), middle + int(np.argmin(above[middle:]))
        if new == ends:
            return np.asarray(slope * x + above[new[0]])
        ends = new
        slope = (y[new[1]] - y[new[0]]) / (x[new[1]] - x[new[0]])


def _deviation(position: Array, rotation: Array, stamps_ns: Stamps, size: int) -> Array:
    """Return how far poses are from polynomials (m, rad), in the median over short windows."""
    count = len(stamps_ns) // size
    t, o, R = (own[:count * size].reshape(count, size, *own.shape[1:])
               for own in (stamps_ns, position, rotation))
    t = (t - t[:, :1]) / (t[:, -1:] - t[:, :1])
    Q, _ = np.linalg.qr((2.0 * t - 1.0)[:, :, None] ** np.arange(ORDER + 1))
    squares = []
    for own in (o - o[:, :1], log_so3(np.swapaxes(R[:, :1], 2, 3) @ R)):
        left = own - Q @ (np.swapaxes(Q, 1, 2) @ own)
        squares.append(np.median(np.sum(left**2, axis=(1, 2))) / (3 * (size - ORDER - 1)))
    return np.sqrt(squares)
