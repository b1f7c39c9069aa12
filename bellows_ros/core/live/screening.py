"""
Which poses of the tool can be used: a state machine over stamps, frames and values.

Each pose is accepted, refused with a reason, or accepted as a fresh start with a reason. What
looks wrong once is refused; what goes on in a consistent way is believed after a short run, so
that the predictor comes back by itself when a clock was set, a recording starts again, a driver
changes its frame or a tool was moved while nobody saw it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.jit import kernel
from bellows_ros.core.tuples import (
    dot,
    log_quaternion,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    subtract,
    Vector,
)

UNIT_WITHIN = 0.01
"""A quaternion whose length is off by more is refused, by less is scaled to unit length."""

LONGEST_GAP_NS = 500_000_000
"""After a longer time without poses the package's motion is unknown: start from rest again."""

BACKWARD_RUN = 5
"""So many backward stamps in a row, themselves increasing, are a clock that was set back."""

FAR_BACKWARD_RUN = 3
"""The same where they lie further back than any late message: a recording that starts again."""

FRAME_RUN = 3
FRAME_RUN_NS = 150_000_000
"""A new frame is believed after so many poses in a row that span so much time (ns)."""

LEAP_NS = 20_000_000
LEAP_PERIODS = 4
"""Stamps further ahead (ns, periods) of their arrival than before leap: one does not count."""

SETTLED_AFTER = 10
"""Poses after which it is known how far stamps lie behind their arrivals."""

JUMP_RUN = 5
"""So many poses in a row, near each other but far from the last accepted, are a new place."""

LARGEST_SPEED, SPEED_SLACK = 20.0, 0.05
"""No arm is faster (m/s); and the position (m) by which a pose may be off all the same."""

LARGEST_RATE, RATE_SLACK = 60.0, 0.3
"""The same for rotations (rad/s, rad)."""

HARDEST_STOP, HARDEST_TURN_STOP = 30.0, 300.0
"""No arm comes to a complete stop within one sample with more (m/s^2, rad/s^2)."""

ACCEPTED = ''


class Verdict(NamedTuple):
    """What is to be done with a pose."""

    refused: str
    """Why it is refused, or nothing."""
    restart: str
    """Why everything starts afresh with this pose, or nothing."""


GOOD = Verdict(ACCEPTED, '')


class Reference(NamedTuple):
    """The pose that the next one is compared with."""

    stamp_ns: int
    position: Vector
    quaternion_xyzw: Quaternion
    step: tuple[float, float]
    """Speed (m/s) and rate (rad/s) from the pose before."""
    speed: float
    """The smaller speed of the last two steps, m/s: one jump is no motion."""
    rate: float
    """The smaller rate of the last two steps, rad/s."""
    period: float
    """Time since the pose before, s."""


@kernel
def length(a: Vector) -> float:
    """Return the length of a vector."""
    return math.sqrt(dot(a, a))


@kernel
def lengths(a: Vector, b: Vector) -> tuple[float, float]:
    """Return the lengths of two vectors."""
    return length(a), length(b)


@kernel
def separation(
    o: Vector, q: Quaternion, other_o: Vector, other_q: Quaternion
) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    turn = log_quaternion(quaternion_product(quaternion_conjugate(q), other_q))
    return length(subtract(other_o, o)), length(turn)


class FrameChange:
    """Tells when another frame_id than before is to be believed: when it goes on for a while."""

    def __init__(self) -> None:
        """Know of no other frame."""
        self._frame_id: str | None = None
        self._run = self._first_ns = self._last_ns = 0

    def clear(self) -> None:
        """Note that the frame is the same as before."""
        self._run = 0

    def is_believed(self, frame_id: str | None, stamp_ns: int) -> bool:
        """Return whether nothing but this other frame has come for long enough."""
        if not self._run or frame_id != self._frame_id or stamp_ns <= self._last_ns:
            self._frame_id, self._run, self._first_ns = frame_id, 0, stamp_ns
        self._run += 1
        self._last_ns = stamp_ns
        return self._run >= FRAME_RUN and stamp_ns - self._first_ns >= FRAME_RUN_NS


class Screen:
    """
    Judge the tool's poses one after the other.

    Attributes
    ----------
    frame_id : str
        Frame of the accepted poses; '' before the first.
    newest_ns : int
        Stamp of the newest accepted pose, -1 before the first.

    """

    def __init__(self) -> None:
        """Know nothing."""
        self.reset()

    def reset(self) -> None:
        """Take whatever stamp and frame come next."""
        self.frame_id = ''
        self._change = FrameChange()
        self.forget_motion()

    def forget_motion(self) -> None:
        """Take whatever stamp and place come next, in the same frame."""
        self.newest_ns = -1
        self._last: Reference | None = None
        self._moved = (0.0, 0.0)  # distance (m) and angle (rad) from there, if judged by its place
        self._newest_arrival_ns: int | None = None
        self._least_age_ns = self._accepted = 0
        self._leap_ns = -1
        self._backward_run = 0
        self._backward_last_ns = -1
        self._ahead_ns = -1
        self._leaps = False
        self._elsewhere: Reference | None = None
        self._elsewhere_run = 0

    def judge(
        self,
        stamp_ns: int,
        frame_id: str,
        position: Vector,
        quaternion_xyzw: Quaternion,
        arrival_ns: int | None = None,
    ) -> Verdict:
        """
        Return whether a pose can be used, and keep it as reference if so.

        Parameters
        ----------
        stamp_ns : int
            Header stamp, ns.
        frame_id : str
            Frame in its header.
        position : (x, y, z)
            m.
        quaternion_xyzw : (x, y, z, w)
            Orientation.
        arrival_ns : int, optional
            When it came, on a clock that nobody sets. Tells a pause of the driver from a stamp
            that lies in the future; without it a late stamp is taken for a pause.

        """
        verdict = self._judge(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
        if not verdict.refused:
            if verdict.restart:
                self.forget_motion()
            self._accept(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
            self._leaps = verdict.restart == 'clock_set_forward'
        return verdict

    def _judge(
        self, stamp_ns: int, frame_id: str, o: Vector, q: Quaternion, arrival_ns: int | None
    ) -> Verdict:
        """Return the verdict of the first check that has something to say."""
        reason = _why_no_pose(o, q)
        if reason:
            return Verdict(reason, '')
        if stamp_ns <= 0:
            return Verdict('zero_stamp', '')
        if self.frame_id and frame_id != self.frame_id:
            believed = self._change.is_believed(frame_id, stamp_ns)
            return Verdict(ACCEPTED, 'frame_changed') if believed else Verdict('frame_id', '')
        self._change.clear()
        if self._last is None:
            return GOOD
        if stamp_ns == self.newest_ns:
            return Verdict('duplicate_stamp', '')
        if stamp_ns < self.newest_ns:
            return self._judge_backward(stamp_ns)
        if stamp_ns - self.newest_ns > LONGEST_GAP_NS:
            return self._judge_ahead(stamp_ns, arrival_ns)
        if arrival_ns is not None and self._leaps_alone(stamp_ns, arrival_ns - stamp_ns):
            return Verdict('future_stamp', '')
        return self._judge_place(stamp_ns, o, q)

    def _accept(
        self, stamp_ns: int, frame_id: str, o: Vector, q: Quaternion, arrival_ns: int | None
    ) -> None:
        """Compare what follows with this pose."""
        step = before = (0.0, 0.0)
        seconds = 0.0
        if self._last is not None:
            before = self._last.step
            seconds = (stamp_ns - self.newest_ns) * 1e-9
            step = (self._moved[0] / seconds, self._moved[1] / seconds)
        self._last = Reference(
            stamp_ns, o, q, step, min(step[0], before[0]), min(step[1], before[1]), seconds)
        self.frame_id, self.newest_ns = frame_id, stamp_ns
        if arrival_ns is not None:
            self._note_age(arrival_ns - stamp_ns)
        self._newest_arrival_ns = arrival_ns
        self._change.clear()
        self._backward_run = self._elsewhere_run = 0
        self._ahead_ns = -1

    # ----------------------------------------------------------------- stamps

    def _note_age(self, age_ns: int) -> None:
        """Keep the least time between stamp and arrival; it grows again, as clocks drift."""
        above = age_ns - self._least_age_ns
        self._least_age_ns = self._least_age_ns + above // 1024 if (
            self._accepted and above > 0) else age_ns  # fmt: skip
        self._accepted += 1

    def _leaps_alone(self, stamp_ns: int, age_ns: int) -> bool:
        """Return whether a stamp lies in the future, and the one before it did not."""
        ahead_ns = self._least_age_ns - age_ns
        if ahead_ns <= LEAP_NS or self._accepted < SETTLED_AFTER or self._last is None:
            self._leap_ns = -1
            return False
        if ahead_ns <= LEAP_PERIODS * self._last.period * 1e9:
            return False
        before, self._leap_ns = self._leap_ns, stamp_ns
        return not 0 <= before < stamp_ns

    def _judge_backward(self, stamp_ns: int) -> Verdict:
        """Refuse stamps that go back until they have done so long enough."""
        if self._backward_run and stamp_ns <= self._backward_last_ns:
            self._backward_run = 0
        self._backward_run += 1
        self._backward_last_ns = stamp_ns
        far = self.newest_ns - stamp_ns > LONGEST_GAP_NS
        if self._backward_run >= (FAR_BACKWARD_RUN if far else BACKWARD_RUN):
            return Verdict(ACCEPTED, 'clock_set_back')
        return Verdict('backward_stamp', '')

    def _judge_ahead(self, stamp_ns: int, arrival_ns: int | None) -> Verdict:
        """Tell a pause, after which all starts from rest, from a stamp in the future."""
        if arrival_ns is None or self._newest_arrival_ns is None:
            return Verdict(ACCEPTED, 'gap')
        waited = arrival_ns - self._newest_arrival_ns
        if 2 * waited >= stamp_ns - self.newest_ns:
            return Verdict(ACCEPTED, 'gap')
        before, self._ahead_ns = self._ahead_ns, stamp_ns
        if self._leaps or 0 <= before < stamp_ns:  # the next one too: the clock, or fast playback
            return Verdict(ACCEPTED, 'clock_set_forward')
        return Verdict('future_stamp', '')

    # ------------------------------------------------------------------ places

    def _judge_place(self, stamp_ns: int, o: Vector, q: Quaternion) -> Verdict:
        """Refuse poses of a tracker that has lost its body: repeated, or far away."""
        self._ahead_ns = -1
        last = self._last
        if last is None:
            return GOOD
        if o == last.position and q == last.quaternion_xyzw:
            self._moved = (0.0, 0.0)
            return Verdict('repeated_pose', '') if _cannot_stop(last) else GOOD
        self._moved = separation(last.position, last.quaternion_xyzw, o, q)
        if _is_reachable(self._moved, stamp_ns - last.stamp_ns):
            return GOOD
        elsewhere = self._elsewhere
        self._elsewhere = Reference(stamp_ns, o, q, (0.0, 0.0), 0.0, 0.0, 0.0)
        together = (
            self._elsewhere_run and elsewhere is not None and stamp_ns > elsewhere.stamp_ns
            and _is_reachable(
                separation(elsewhere.position, elsewhere.quaternion_xyzw, o, q),
                stamp_ns - elsewhere.stamp_ns)
        )  # fmt: skip
        self._elsewhere_run = self._elsewhere_run + 1 if together else 1
        if self._elsewhere_run >= JUMP_RUN:
            return Verdict(ACCEPTED, 'moved')
        return Verdict('jump', '')


def _why_no_pose(o: Vector, q: Quaternion) -> str:
    """Return why numbers are no pose, or nothing."""
    squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if not math.isfinite(o[0] + o[1] + o[2] + squared):
        return 'nan'
    if squared < 1e-12:
        return 'zero_quaternion'
    if abs(squared - 1.0) > 2.0 * UNIT_WITHIN:
        return 'not_unit'
    return ''


def _is_reachable(moved: tuple[float, float], duration_ns: int) -> bool:
    """Return whether an arm can go a distance (m) and an angle (rad) in that time."""
    seconds = duration_ns * 1e-9
    return (
        moved[0] <= SPEED_SLACK + LARGEST_SPEED * seconds
        and moved[1] <= RATE_SLACK + LARGEST_RATE * seconds
    )


def _cannot_stop(last: Reference) -> bool:
    """Return whether an arm moves too fast to stand still one sample later."""
    return (
        last.speed > HARDEST_STOP * last.period or last.rate > HARDEST_TURN_STOP * last.period
    )
