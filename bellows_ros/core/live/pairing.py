"""
Interpolation of the tool's twists to the stamps of its poses, in any order and at any rate.

A twist of the same stamp is taken as it is; between two twists it is interpolated; where neither
is to be had without waiting long, the pose goes on alone and its twist is estimated elsewhere.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.live.samples import PoseSample, TwistSample

PAIRING_TOLERANCE_NS = 100_000
"""Largest difference (ns) of the stamps of a pose and its twist."""

MAX_WAIT_NS = 20_000_000
"""Longest time (ns, in stamps) for which a pose waits for its twist."""

MAX_QUEUE = 256
"""Most poses that wait."""

MAX_BRACKET_NS = 30_000_000
"""Longest time (ns) between twists that is interpolated."""

MAX_TWISTS = 32
"""Most twists that wait."""

LOST_RUN = 3
"""Consecutive poses without a twist after which poses no longer wait."""

SMOOTHING = 0.1
"""Weight of a new period in the mean period, so that one lost twist hardly changes it."""

MAX_PERIOD_RATIO = 1.5
"""Poses do not wait for twists that are rarer than one in this many poses."""


class Pairing:
    """
    Queues of poses and twists, and the rule which pose may go on.

    Attributes
    ----------
    expect : bool
        Whether a pose waits for its twist. Set by callers that know of a publisher of twists, and
        by the pairs themselves.
    unpaired : int
        Twists that served no pose.
    interpolated : int
        Poses whose twist lies between two that came.

    """

    def __init__(self) -> None:
        """Start with empty queues; poses do not wait."""
        self.expect = False
        self.unpaired = self.interpolated = 0
        self.clear()

    def clear(self) -> None:
        """Drop all that waits."""
        self._poses: deque[PoseSample] = deque()
        self._twists: deque[TwistSample] = deque(maxlen=MAX_TWISTS)
        self._before: TwistSample | None = None
        self._before_served = True
        self._newest_ns = self._last_emitted_ns = -1
        self._pose_period_ns = self._twist_period_ns = 0.0
        self._newest_twist_ns = -1
        self._pairs_in_a_row = self._lost_in_a_row = self._late_in_a_row = 0
        self._last_paired = False
        self._without_twist: deque[int] = deque(maxlen=16)  # stamps that went on alone

    @property
    def waiting(self) -> int:
        """Number of poses that wait for their twist."""
        return len(self._poses)

    def add_pose(self, pose: PoseSample) -> None:
        """Queue a pose; stamps increase."""
        if self._newest_ns >= 0:
            self._pose_period_ns = smoothed(self._pose_period_ns, pose.stamp_ns - self._newest_ns)
        self._newest_ns = pose.stamp_ns
        self._poses.append(pose)

    def add_twist(self, twist: TwistSample) -> None:
        """Queue a twist, or note that it came behind its pose."""
        stamp_ns = twist.stamp_ns
        self._drop_leaps(stamp_ns)
        if self._twists and stamp_ns <= self._twists[-1].stamp_ns:
            self.unpaired += 1
            return
        newest_ns, self._newest_twist_ns = self._newest_twist_ns, max(
            self._newest_twist_ns, stamp_ns)
        if 0 <= newest_ns < stamp_ns:
            self._twist_period_ns = smoothed(self._twist_period_ns, stamp_ns - newest_ns)
        if abs(stamp_ns - self._last_emitted_ns) <= PAIRING_TOLERANCE_NS:
            if not self._last_paired:  # it came after its pose had gone on without it
                self._count_pair()
            self._set_before(twist, served=True)
        elif stamp_ns < self._last_emitted_ns:
            self._note_late(stamp_ns)
            if self._before is None or stamp_ns > self._before.stamp_ns:
                self._set_before(twist)
            else:
                self.unpaired += 1
        else:
            self.unpaired += len(self._twists) == MAX_TWISTS  # the oldest falls out
            self._twists.append(twist)

    def _drop_leaps(self, stamp_ns: int) -> None:
        """Drop twists whose stamps lay in the future, where one with an earlier stamp follows."""
        while self._twists and self._twists[-1].stamp_ns > max(
            stamp_ns, self._newest_ns + MAX_WAIT_NS
        ):
            self._twists.pop()
            self._newest_twist_ns = self._twists[-1].stamp_ns if self._twists else -1
            self.unpaired += 1

    def give_up_waiting(self) -> None:
        """Let all poses go on that wait, without their twists."""
        if self._poses:
            self.expect = False
            self._pairs_in_a_row = 0

    def ready(self) -> Iterator[tuple[PoseSample, TwistSample | None]]:
        """Yield the poses that need not wait, oldest first, with their twists."""
        while self._poses:
            pose = self._poses[0]
            twist = self._twist_of(pose.stamp_ns)
            sparse = self._twist_period_ns > MAX_PERIOD_RATIO * self._pose_period_ns > 0
            if twist is None and self.expect and not sparse:
                overdue = (self._newest_ns - pose.stamp_ns > MAX_WAIT_NS
                           or len(self._poses) > MAX_QUEUE)
                if not (overdue or self._twists):  # a newer twist says that this one is lost
                    return
                self._lost_in_a_row += 1
                self.expect = not overdue and self._lost_in_a_row < LOST_RUN
            self._poses.popleft()
            if not self._last_paired:
                self._pairs_in_a_row = 0
            self._last_emitted_ns, self._last_paired = pose.stamp_ns, False
            if twist is None:
                self._without_twist.append(pose.stamp_ns)
            else:
                self._count_pair()
            yield pose, twist

    def _twist_of(self, stamp_ns: int) -> TwistSample | None:
        """Return the twist of that instant, measured or interpolated."""
        while self._twists:
            difference = self._twists[0].stamp_ns - stamp_ns
            if difference > PAIRING_TOLERANCE_NS:
                return self._interpolated(stamp_ns)
            twist = self._twists.popleft()
            paired = difference >= -PAIRING_TOLERANCE_NS
            self._set_before(twist, served=paired)
            if paired:
                return twist
        return None

    def _interpolated(self, stamp_ns: int) -> TwistSample | None:
        """Return the twist between the last one before an instant and the first one after it."""
        before, after = self._before, self._twists[0]
        if before is None or before.stamp_ns >= stamp_ns:
            return None
        span = after.stamp_ns - before.stamp_ns
        if span > MAX_BRACKET_NS:
            return None
        self._before_served = True
        self.interpolated += 1
        s = (stamp_ns - before.stamp_ns) / span
        return TwistSample(stamp_ns, *(
            t3.add_scaled(t3.scale(1.0 - s, a), s, b)
            for a, b in zip(before[1:], after[1:], strict=True)))

    def _set_before(self, twist: TwistSample, served: bool = False) -> None:
        """Keep the last twist before the poses that wait."""
        if not self._before_served:
            self.unpaired += 1
        self._before, self._before_served = twist, served

    def _note_late(self, stamp_ns: int) -> None:
        """Wait for twists again when those of poses that went on alone come, only later."""
        if self._newest_ns - stamp_ns <= MAX_WAIT_NS and any(
                abs(stamp_ns - other) <= PAIRING_TOLERANCE_NS for other in self._without_twist):
            self._late_in_a_row += 1
            self.expect = self.expect or self._late_in_a_row >= 2

    def _count_pair(self) -> None:
        """Note that the newest pose has a twist; after two in a row wait for them."""
        self._last_paired = True
        self._lost_in_a_row = self._late_in_a_row = 0
        self._pairs_in_a_row += 1
        if self._pairs_in_a_row >= 2:
            self.expect = True


def smoothed(mean: float, value: float) -> float:
    """Return a running mean with a new value; a gap or a leap counts as twice the mean."""
    return mean + SMOOTHING * (min(value, 2.0 * mean) - mean) if mean else value
