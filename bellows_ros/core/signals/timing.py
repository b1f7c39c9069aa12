"""Rate, jitter and gaps of the stamps of a stream."""

from dataclasses import dataclass

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.signals.trajectory import NS_PER_S, UNIFORM_WITHIN
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
