"""
Screening of the tool's poses: a state machine over stamps, frames and values.

Each pose is accepted, rejected with a reason, or accepted as a restart with a reason. A single
implausible pose is rejected; a consistent run of them is accepted, so that the predictor recovers
when a clock was set, a recording restarts, a driver changes its frame or a tool was moved unseen.
Of equal poses of a moving tool the first counts, as in recordings (`signals.screening`).
"""

import math
from typing import NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.signals import screening
from bellows_ros.core.signals.screening import StampScreen
from bellows_ros.core.signals.trajectory import NS_PER_S, same_frame

REFUSALS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'duplicate_stamp', 'backward_stamp',
    'future_stamp', 'frame_id', 'repeated', 'jump', 'millimetres')
"""Reasons for rejecting poses of the tool."""

JUMP_RUN = 5
"""Number of consecutive poses, near to each other but far from the last accepted pose, after which
the new place is accepted."""

SHIFT_TOLERANCE = 0.05
"""Tolerance of a displacement in addition to the largest speed times the duration, m."""

ROTATION_TOLERANCE = 0.3
"""Tolerance of a rotation about the reach of an arm's motion, rad."""

MAX_ACCELERATION = (100.0, 1000.0)
"""Largest acceleration of an arm, m/s^2 and rad/s^2."""

JUMP_TOLERANCE = (0.02, 0.2)
"""Largest displacement and rotation without a jump of an arm without acceleration, m and rad."""

JITTER = 0.025
"""Largest error of stamps, s, as of bursts of messages that are stamped on arrival."""

NEW_FRAME_NS = 150_000_000
"""Time of poses in another frame alone after which this frame is accepted, ns."""

MAX_BURST_NS = 100_000_000
"""Longest pause between bursts of a driver, ns; longer ones are gaps."""

MAX_SAMPLE_NS = 100_000_000
"""Longest time between two samples of a sensor, ns: its driver may repeat a pose for so long."""

UNKNOWN_PERIOD = -1.0
"""Period of a pose at which the tool's speed is unknown."""


class Reference(NamedTuple):
    """A pose with which the next one is compared."""

    stamp_ns: int
    position: Vector
    quaternion_xyzw: Quaternion
    period: float = 0.0
    """Time since the previous pose, s; 0 for the first, with the tool at rest."""
    velocity: Vector = ZERO
    """Velocity since the previous pose in axes of the poses' frame, m/s."""
    rate: Vector = ZERO
    """Angular velocity since the previous pose in the tool's axes, rad/s."""

    @property
    def distance(self) -> float:
        """Distance from the previous pose, m, with the rotation at a lever."""
        return self.period * (t3.norm(self.velocity) + screening.LEVER * t3.norm(self.rate))

    def step_to(self, stamp_ns: int, o: Vector, q: Quaternion) -> tuple[float, 'Reference']:
        """Return the size of a step relative to the limit of an arm, and the pose at its end."""
        seconds = (stamp_ns - self.stamp_ns) / NS_PER_S
        size, v, w = pose_step(*self[1:3], *self[4:], self.period, o, q, seconds)
        return size, Reference(stamp_ns, o, q, seconds, v, w)


@kernel
def change(a: Vector, b: Vector) -> tuple[float, float]:
    """Return |b - a|, and the smaller of |a| and |b| (0 if a and b have opposite directions)."""
    return t3.norm(t3.subtract(b, a)), min(t3.norm(a), t3.norm(b)) if t3.dot(a, b) > 0.0 else 0.0


@entry
def pose_step(
    o: Vector, q: Quaternion, velocity: Vector, rate: Vector, period: float,
    other_o: Vector, other_q: Quaternion, seconds: float,
) -> tuple[float, Vector, Vector]:
    """
    Return size relative to the limit of an arm, velocity and rate of a step between two poses.

    The change of velocity is multiplied by the shorter of the two periods, and reduced in a steady
    motion, so that bursts and jitter of stamps do not count as jumps.
    """
    shift = t3.subtract(other_o, o)
    rotation = t3.rotation_between(q, other_q)
    v, w = t3.scale(1.0 / seconds, shift), t3.scale(1.0 / seconds, rotation)
    excess = max(
        t3.norm(shift) / (SHIFT_TOLERANCE + screening.MAX_TOOL_SPEED * seconds),
        t3.norm(rotation) / (ROTATION_TOLERANCE + screening.MAX_TOOL_RATE * seconds))
    if period == UNKNOWN_PERIOD:
        return excess, v, w
    velocity_change, speed = change(velocity, v)
    rate_change, angular_speed = change(rate, w)
    shorter = min(seconds, period) if period > 0.0 else seconds
    squared = 0.5 * (seconds + shorter) * shorter
    shift_jump = JUMP_TOLERANCE[0] + JITTER * speed + MAX_ACCELERATION[0] * squared
    turn_jump = JUMP_TOLERANCE[1] + JITTER * angular_speed + MAX_ACCELERATION[1] * squared
    return max(excess, velocity_change * shorter / shift_jump,
               rate_change * shorter / turn_jump), v, w


class SampleClock:
    """
    The samples of a sensor behind the poses of its driver, which may repeat each with new stamps.

    The time between samples is learned from poses that differ by more than the resolution in each
    of the messages between them, as those of a tool at rest do not.
    """

    def __init__(self) -> None:
        self._shown_ns = self._message_ns = -1  # first and newest message of the pose
        self._messages = 0  # with the pose
        self._period_ns, self._resolution = 0, math.inf

    def is_repeated(self, stamp_ns: int) -> bool:
        """Count a message with the pose before; return whether the next sample is not yet due."""
        half_ns = (stamp_ns - self._message_ns) // 2
        self._message_ns = stamp_ns
        self._messages += 1
        return stamp_ns + half_ns < self._shown_ns + self._period_ns

    def add(self, stamp_ns: int, step: float) -> None:
        """Add a pose after a step, a distance, from a different one."""
        since_ns = stamp_ns - self._shown_ns
        self._resolution = min(self._resolution, step)
        if since_ns <= MAX_SAMPLE_NS and step > self._messages * self._resolution:
            change_ns = since_ns - self._period_ns
            self._period_ns += change_ns if change_ns > 0 else change_ns // 16
        self._shown_ns = self._message_ns = stamp_ns
        self._messages = 1


class Screen(StampScreen):
    """
    State machine that judges and counts successive poses of the tool.

    Attributes
    ----------
    frame : str
        Frame of the accepted poses, '' before the first.
    newest_ns : int
        Stamp of the newest accepted pose, -1 before the first.
    arrival_ns : int or None
        Arrival of the newest accepted pose on a monotonic clock, ns; None before the first, and
        if messages do not arrive in real time.
    poses : int
        Number of judged poses.
    refused : dict
        Numbers of rejected poses, by reason.

    """

    def __init__(self) -> None:
        self.poses, self.refused = 0, dict.fromkeys(REFUSALS, 0)
        self.reset()

    def reset(self) -> None:
        """Accept any next stamp and frame."""
        self.frame = ''
        self.forget_motion()

    def forget_motion(self) -> None:
        """Accept any next stamp and position, in the same frame."""
        self.forget_stamps()
        self._last: Reference | None = None
        self._elsewhere: Reference | None = None  # newest of the rejected poses
        self._run, self._foreign_ns = 0, -1
        self._samples = SampleClock()
        self.forget_arrivals()

    def forget_arrivals(self) -> None:
        """Wait for the next pose without a limit."""
        self.arrival_ns: int | None = None
        self._pause_ns = 0  # between bursts; grows quickly, shrinks slowly

    def silent_ns(self, now_ns: int) -> int:
        """Return the time (ns) without a pose; 0 if usual for the poses' period and bursts."""
        silent_ns = 0 if self.arrival_ns is None else now_ns - self.arrival_ns
        usual_ns = max(20_000_000, 4 * self.period_ns, 3 * self._pause_ns // 2)
        return silent_ns if silent_ns > usual_ns else 0

    def judge(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        arrival_ns: int | None = None,
    ) -> str:
        """
        Count a pose; return the reason why it is rejected or restarts the prediction, or ''.

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
            Arrival on a monotonic clock, which distinguishes a pause of the driver from a stamp in
            the future; without it a late stamp counts as a pause.

        """
        self.poses += 1
        self._next = Reference(stamp_ns, position, quaternion_xyzw)
        reason = self._judge(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
        if reason in REFUSALS:
            self.refused[reason] += 1
            return reason
        if reason:
            self.forget_motion()
        self.accept_stamp(stamp_ns, arrival_ns, reason)
        if self._last is not None and self._next[1:3] != self._last[1:3]:
            self._samples.add(stamp_ns, self._next.distance)
        self.frame, self._last = frame_id or self.frame, self._next
        self._elsewhere, self._run, self._foreign_ns = None, 0, -1
        if arrival_ns is not None and self.arrival_ns is not None:
            change_ns = arrival_ns - self.arrival_ns - self._pause_ns
            if change_ns + self._pause_ns <= MAX_BURST_NS:
                self._pause_ns += change_ns // (2 if change_ns > 0 else 256)
        self.arrival_ns = arrival_ns
        return reason

    def _judge(
        self, stamp_ns: int, frame_id: str, o: Vector, q: Quaternion, arrival_ns: int | None
    ) -> str:
        """Return the reason of the first failed check, or ''."""
        if reason := screening.why_no_pose(o, q):
            return reason
        if not 0 < stamp_ns < 2**63:
            return 'zero_stamp'
        if frame_id != self.frame and not same_frame(self.frame, frame_id):
            if not 0 <= self._foreign_ns <= stamp_ns:
                self._foreign_ns = stamp_ns
            return 'frame_id' if stamp_ns - self._foreign_ns < NEW_FRAME_NS else 'frame_changed'
        return self.judge_stamp(stamp_ns, arrival_ns) or self._judge_place(stamp_ns, o, q)

    def _judge_place(self, stamp_ns: int, o: Vector, q: Quaternion) -> str:
        """Reject distant poses, unless they are consistent with each other for some time."""
        last = self._last
        if t3.norm(o) > screening.MAX_PLACE:
            return 'millimetres'
        if last is None:
            return ''
        if (o, q) == last[1:3] and self._samples.is_repeated(stamp_ns):
            return 'repeated'
        other = self._elsewhere
        if other is not None:  # the period before the rejected poses may be a burst's
            last = last._replace(period=(stamp_ns - last.stamp_ns) / NS_PER_S)
        excess, self._next = last.step_to(stamp_ns, o, q)
        if excess <= 1.0:
            return ''
        self._elsewhere = Reference(stamp_ns, o, q, UNKNOWN_PERIOD)
        excess = math.inf
        if other is not None and stamp_ns > other.stamp_ns:
            excess, self._next = other.step_to(stamp_ns, o, q)
        self._run = self._run + 1 if excess <= 1.0 else 1
        return 'moved' if self._run >= JUMP_RUN else 'jump'
