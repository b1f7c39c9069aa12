"""
Checks of stamps and poses, live and recorded.

A state machine judges header stamps by their times of arrival. A single wrong stamp is rejected; a
consistent run of them is accepted: a clock was set, or a recording has restarted. Recorded
messages are judged by the same state machine. If a clock was set back, the stamps before and after
the change overlap; as few messages as possible are then omitted.
"""

import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Mask, Stamps
from bellows_ros.core.geometry.tuples import Quaternion, Vector
import numpy as np

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
        The other messages have strictly increasing stamps.

    """
    unusable = {reason: np.zeros(len(stamps_ns), dtype=bool) for reason in REASONS}
    if _are_plain(stamps_ns, arrivals_ns):
        return unusable
    accepted: list[Stamps] = []
    for part in _parts(stamps_ns, arrivals_ns, unusable):
        while len(part) and accepted and stamps_ns[accepted[-1][-1]] >= stamps_ns[part[0]]:
            before = accepted.pop()
            ahead = stamps_ns[before] >= stamps_ns[part[0]]
            behind = stamps_ns[part] <= stamps_ns[before[-1]]
            if _first_is_smaller_loss((ahead, before), (behind, part)):
                unusable['future_stamp'][before[ahead]] = True
                before = before[~ahead]
            else:
                unusable['backward_stamp'][part[behind]] = True
                part = part[~behind]
            if len(before):
                accepted.append(before)
        if len(part):
            accepted.append(part)
    unusable['backward_stamp'] &= ~_in_place(stamps_ns, unusable)
    return unusable


def _in_place(stamps_ns: Stamps, unusable: dict[str, Mask]) -> Mask:
    """Return a mask of seemingly late messages that lie between their neighbours."""
    bad = np.logical_or.reduce(list(unusable.values()))
    before = np.maximum.accumulate(np.where(bad, -1, stamps_ns))
    after = np.minimum.accumulate(np.where(bad, np.iinfo(np.int64).max, stamps_ns)[::-1])[::-1]
    in_place: Mask = unusable['backward_stamp'] & (before < stamps_ns) & (stamps_ns < after)
    stamps = stamps_ns[in_place]
    largest_before = np.maximum.accumulate(np.concatenate([[-1], stamps]))[:-1]
    in_place[in_place] = stamps > largest_before
    return in_place


def _first_is_smaller_loss(one: tuple[Mask, Stamps], other: tuple[Mask, Stamps]) -> bool:
    """
    Return whether the overlapping stamps of the first of two parts are dropped.

    If both parts lose a similar number of messages, the stamps of the shorter part are dropped,
    which is the same choice for all topics of a recording.
    """
    costs = np.count_nonzero(one[0]), np.count_nonzero(other[0])
    if max(costs) > 2 * min(costs):
        return bool(costs[0] < costs[1])
    return len(one[1]) < len(other[1])


def _are_plain(stamps_ns: Stamps, arrivals_ns: Stamps) -> bool:
    """Return whether the screen would accept all stamps, without checking each."""
    ages = arrivals_ns - stamps_ns
    leaps = np.maximum.accumulate(ages)[:-1] - ages[1:] > LEAP_NS
    return not np.any(leaps | (np.diff(stamps_ns) <= 0))


def _parts(
    stamps_ns: Stamps, arrivals_ns: Stamps, unusable: dict[str, Mask]
) -> list[Stamps]:
    """Return the indices of the usable messages between the times at which a clock was set."""
    screen = StampScreen()
    parts: list[list[int]] = [[]]
    for i, (stamp_ns, arrival_ns) in enumerate(zip(
            stamps_ns.tolist(), arrivals_ns.tolist(), strict=True)):
        reason = screen.judge_stamp(stamp_ns, arrival_ns)
        if reason in unusable:
            unusable[reason][i] = True
            continue
        if reason:
            parts.append([])
        parts[-1].append(i)
        screen.accept_stamp(stamp_ns, arrival_ns, reason)
    return [np.array(part, dtype=np.int64) for part in parts if part]
