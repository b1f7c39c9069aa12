"""
Checks of stamps and poses, live and recorded.

Live, a state machine judges header stamps by their times of arrival. A single wrong stamp is
rejected; a consistent run of them is accepted: a clock was set, or a recording has restarted. Of
recorded messages, the longest strictly increasing sequence of stamps is used.

A driver that is faster than its sensor, or that freezes, repeats poses with new stamps. Of equal
poses in a row of a moving body the first counts; a body at rest may repeat its pose.
"""

from bisect import bisect_left
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.tuples import Quaternion, Vector
import numpy as np
from scipy.ndimage import median_filter

MAX_TOOL_SPEED = 20.0
"""Largest speed of an arm, m/s."""

MAX_TOOL_RATE = 60.0
"""Largest angular speed of an arm, rad/s."""

UNIT_TOLERANCE = 0.01
"""Largest deviation of a quaternion's length from 1; such a quaternion is normalised."""

MAX_PLACE = 100.0
"""Largest distance of a body from the origin of its frame, m. Larger numbers are millimetres."""

LONGEST_GAP_NS = 500_000_000
"""Longest gap over which a prediction continues; after it, prediction restarts from rest, ns."""

BACKWARD_RUN = 5
"""Number of consecutive backward stamps, increasing among themselves, that indicate a clock set
back."""

LEAP_NS = 20_000_000

SIDE_POSES = 6
"""Number of different poses on each side of equal ones that show the usual step."""

MIN_SIDE_POSES = 3
"""Smallest number of different poses beside equal ones of a moving body."""

CATCH_UP = 1.5
"""Ratio of a step to the usual step above which the body moved during the equal poses before."""

RESOLUTION_QUANTILE = 0.01
"""Quantile of the steps between different samples that is the resolution of a driver."""

COUNTED_SAMPLES = 20
"""Number of successive samples whose messages are counted together."""

MIN_REGULAR = 0.8
"""Smallest fraction of equal counts of a driver that repeats regularly."""

MIN_FREEZE = 1e-3
"""Smallest motion during equal poses at the end of a recording, by the speed before, m."""

LEVER = 0.1
"""Lever at which a rotation counts as a distance, m: the half of a package."""


class PoseSample(NamedTuple):
    """An accepted pose of the tool in the world."""

    stamp_ns: int
    position: Vector
    quaternion_xyzw: Quaternion


def why_no_pose(o: Vector, q: Quaternion) -> str:
    """Return the reason why numbers are not a pose, or ''."""
    squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if not math.isfinite(o[0] + o[1] + o[2] + squared):
        return 'nan'
    if squared < 1e-12:
        return 'zero_quaternion'
    if abs(squared - 1.0) > 2.0 * UNIT_TOLERANCE:
        return 'not_unit'
    return ''


class StampScreen:
    """
    State machine that judges stamps in the order of arrival.

    Attributes
    ----------
    newest_ns : int
        Newest accepted stamp, -1 before the first.
    period_ns : int
        Interval between the last two accepted stamps, 0 before the second.

    """

    def __init__(self) -> None:
        self.forget_stamps()

    def forget_stamps(self) -> None:
        """Accept any next stamp."""
        self.newest_ns = -1
        self.period_ns = 0
        self._least_age_ns = self._accepted = 0
        self._leap_ns = -1
        self._backward_run = 0
        self._backward_last_ns = -1
        self._leaps = False

    def judge_stamp(self, stamp_ns: int, arrival_ns: int | None) -> str:
        """
        Return the reason why a stamp is rejected or restarts the prediction, or ''.

        Parameters
        ----------
        stamp_ns : int
            Header stamp, ns.
        arrival_ns : int or None
            Arrival on a monotonic clock, which distinguishes a pause of the driver from a stamp in
            the future; without it a late stamp counts as a pause.

        """
        if self.newest_ns < 0:
            return ''
        if stamp_ns == self.newest_ns:
            return 'duplicate_stamp'
        if stamp_ns < self.newest_ns:
            return self._judge_backward(stamp_ns)
        leads = arrival_ns is not None and self._leads(stamp_ns, arrival_ns)
        before, self._leap_ns = self._leap_ns, stamp_ns if leads else -1
        if leads and not (self._leaps or 0 <= before < stamp_ns):
            return 'future_stamp'
        if stamp_ns - self.newest_ns <= LONGEST_GAP_NS:
            return ''
        return 'clock_set_forward' if leads else 'gap'  # or fast playback

    def accept_stamp(self, stamp_ns: int, arrival_ns: int | None, restart: str) -> None:
        """Make a stamp the reference of the next stamps; a restart forgets earlier stamps."""
        if restart:
            self.forget_stamps()
        elif self.newest_ns >= 0:
            self.period_ns = stamp_ns - self.newest_ns
        self.newest_ns = stamp_ns
        if arrival_ns is not None:
            # Smallest age of a stamp at arrival; it grows slowly, as clocks drift.
            above = arrival_ns - stamp_ns - self._least_age_ns
            self._least_age_ns += above // 1024 if self._accepted and above > 0 else above
            self._accepted += 1
        self._backward_run = 0
        self._leaps = restart == 'clock_set_forward'

    def _leads(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Return whether a stamp is in the future: a pause explains less than half of the step."""
        lead_ns = self._least_age_ns - (arrival_ns - stamp_ns)
        step_ns = stamp_ns - self.newest_ns
        if step_ns > LONGEST_GAP_NS:
            return self._accepted > 0 and 2 * lead_ns > step_ns
        return self._accepted >= 10 and (
            lead_ns > max(LEAP_NS, 4 * self.period_ns))

    def _judge_backward(self, stamp_ns: int) -> str:
        """Reject backward stamps unless they form a run."""
        if self._backward_run and stamp_ns <= self._backward_last_ns:
            self._backward_run = 0
        self._backward_run += 1
        self._backward_last_ns = stamp_ns
        return 'clock_set_back' if self._backward_run >= BACKWARD_RUN else 'backward_stamp'


REASONS = ('duplicate_stamp', 'backward_stamp', 'future_stamp')


def unusable_stamps(stamps_ns: Stamps, arrivals_ns: Stamps) -> dict[str, Mask]:
    """
    Return the messages with unusable stamps, by reason.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Header stamps in the order of arrival, ns.
    arrivals_ns : int array (N,)
        Times of arrival, ns, not decreasing.

    Returns
    -------
    dict of str to bool array (N,)
        The other messages have strictly increasing stamps, and are as many as possible.

    """
    kept = _longest_increasing(stamps_ns)
    ages = (arrivals_ns - stamps_ns)[kept[-BACKWARD_RUN:]]
    if len(ages) == BACKWARD_RUN and ages[:-1].min() - ages[-1] > LEAP_NS:
        kept = kept[:-1]  # after the last message, no stamp shows that its stamp is in the future
    unused = np.isin(np.arange(len(stamps_ns)), kept, invert=True)
    before = np.maximum.accumulate(np.where(unused, -1, stamps_ns))
    return dict(zip(REASONS, (
        unused & (stamps_ns == before), unused & (stamps_ns < before),
        unused & (stamps_ns > before)), strict=True))


def _longest_increasing(stamps_ns: Stamps) -> Stamps:
    """Return the indices of a longest sequence of increasing stamps, early ones if possible."""
    if np.all(np.diff(stamps_ns) > 0):
        return np.arange(len(stamps_ns))
    begins, firsts = list[int](), list[int]()  # latest first stamp of sequences of each length
    after = np.full(len(stamps_ns), -1)
    for i, stamp_ns in reversed(list(enumerate(stamps_ns.tolist()))):
        length = bisect_left(begins, -stamp_ns)
        after[i] = firsts[length - 1] if length else -1
        begins[length:length + 1], firsts[length:length + 1] = [-stamp_ns], [i]
    sequence = [firsts[-1]]
    while (following := int(after[sequence[-1]])) >= 0:
        sequence.append(following)
    return np.array(sequence)


def pose_steps(position: Array, rotation: Array) -> Array:
    """Return the distances (N - 1,) between poses (N, 3) and (N, 3, 3) in a row, m."""
    return np.asarray(np.linalg.norm(np.diff(position, axis=0), axis=1) + LEVER * np.linalg.norm(
        np.diff(rotation, axis=0), axis=(1, 2)))


def repeated(steps: Array) -> Mask:
    """
    Return the mask (N,) of the samples to be left out as repeats, by the steps (N - 1,) between.

    A driver shows each sample of its sensor in as many messages as most different samples in
    motion have. Equal samples at rest count once for each as many messages. If the step after
    equal samples is larger than usual, the body moved meanwhile, and only the first counts.
    """
    first = np.flatnonzero(np.append(True, steps > 0.0))  # of equal samples
    total = len(steps) + 1
    if not 1 < len(first) < total:
        return np.zeros(total, dtype=bool)
    counts = np.diff(np.append(first, total))
    steps = steps[first[1:] - 1]  # to the next different sample
    period = _messages_per_sample(counts[:-1][steps > np.min(steps) * counts[:-1]])
    usual = median_filter(steps, size=2 * SIDE_POSES + 1, mode='mirror')
    resolution = np.quantile(steps, RESOLUTION_QUANTILE)
    catches_up = np.append(steps > CATCH_UP * usual + resolution,
                           counts[-1] / period * usual[-1] > MIN_FREEZE)
    is_frozen = np.repeat(catches_up & _moves_beside(first, counts, period), counts)
    number = np.arange(total) - np.repeat(first, counts)
    is_sample = np.floor(number / period) > np.floor((number - 1) / period)
    return np.asarray(np.where(is_frozen, number > 0, ~is_sample))


def _messages_per_sample(counts: Stamps) -> float:
    """
    Return the mean number of messages of samples in motion, 1 unless nearly the same throughout.

    A driver at 500 Hz above a sensor at 200 Hz shows its samples in 2, 3, 2, 3, ... messages.
    """
    size = min(len(counts), COUNTED_SAMPLES)
    if not size:
        return 1.0
    totals = np.convolve(counts, np.ones(size), 'valid')
    usual = np.median(totals)
    regular = totals[np.abs(totals - usual) <= 1.0]
    is_regular = usual > size and len(regular) > MIN_REGULAR * len(totals)
    return float(np.mean(regular)) / size if is_regular else 1.0


def _moves_beside(first: Stamps, counts: Stamps, period: float) -> Mask:
    """Return whether there are different samples soon before and after equal ones, or an end."""
    reach, last = 2.0 * SIDE_POSES * period, first + counts - 1
    before = np.arange(len(first)) - np.searchsorted(first, first - reach)
    after = np.searchsorted(first, last + reach, 'right') - np.arange(len(first)) - 1
    begins, ends = first == 0, last == last[-1]
    return np.asarray(((before >= MIN_SIDE_POSES) | begins) & ((after >= MIN_SIDE_POSES) | ends))
