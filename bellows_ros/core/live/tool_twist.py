"""
The tool's twist at the stamps of its poses: measured, interpolated or estimated.

Measured twists come in any order and at any rate (`Pairing`). A twist with the stamp of the pose
is used unchanged; a pose between two twists gets an interpolated twist; for other poses, after a
short wait, the twist is estimated from the last poses by the Savitzky-Golay filter at the end of
its window. Measured twists are checked against these estimates (`ToolMotion`).
"""

from collections import deque
from collections.abc import Iterator
import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.live.held_package import Sample
from bellows_ros.core.live.tool_screening import TwistSample
from bellows_ros.core.model.kernels import extrapolated, ORIGIN, State
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

PAIRING_TOLERANCE_NS = 100_000
"""Largest difference of the stamps of a pose and its twist, ns."""

MAX_WAIT_NS = 20_000_000
"""Longest time for which a pose waits for its twist, in stamps, ns."""

MAX_QUEUE = 256
"""Largest number of waiting poses."""


MAX_SPAN_NS = 30_000_000
"""Longest interval between two twists in which a twist is interpolated, ns."""

MAX_ALONE = 3
"""Number of successive poses without a twist after which poses no longer wait."""


class Pairing:
    """
    Queues of poses and twists, and the rule for the release of poses.

    Attributes
    ----------
    expect : bool
        Whether a pose waits for its twist. Set by callers that know of a publisher of twists, and
        by twists that come soon after their poses.

    """

    def __init__(self) -> None:
        self.expect = False
        self._pairs = self._received = 0
        self.clear()

    def clear(self) -> None:
        """Discard waiting poses and twists."""
        self._poses: deque[PoseSample] = deque()
        self._twists: deque[TwistSample] = deque(maxlen=32)
        self._before: TwistSample | None = None
        self._newest_ns = self._released_ns = -1
        self._alone = self._since_twist = 0  # poses without a twist, poses since the last twist
        self._sparse = 0  # successive twists with several poses before each

    @property
    def waiting(self) -> int:
        """Number of poses that wait for their twist."""
        return len(self._poses)

    @property
    def unpaired(self) -> int:
        """Number of twists without a matching pose."""
        return max(0, self._received - self._pairs - len(self._twists))

    def add_pose(self, pose: PoseSample) -> None:
        """Queue a pose; stamps increase."""
        self._newest_ns = pose.stamp_ns
        self._since_twist += 1
        self._poses.append(pose)

    def add_twist(self, twist: TwistSample) -> None:
        """Queue a twist, or let poses wait if its pose has been released without it."""
        stamp_ns, twists, self._received = twist.stamp_ns, self._twists, self._received + 1
        while twists and twists[-1].stamp_ns > max(stamp_ns, self._newest_ns + MAX_WAIT_NS):
            twists.pop()  # their stamps were wrong
        if twists and stamp_ns <= twists[-1].stamp_ns:
            return
        self._sparse = self._sparse + 1 if self._since_twist > 1 else 0
        self._since_twist = 0
        if stamp_ns > self._released_ns + PAIRING_TOLERANCE_NS:
            twists.append(twist)
            return
        if self._alone and self._newest_ns - stamp_ns <= MAX_WAIT_NS:
            self.expect = True
        if self._before is None or stamp_ns > self._before.stamp_ns:
            self._before = twist

    def release_waiting_poses(self) -> None:
        """Release all waiting poses without their twists."""
        if self._poses:
            self.expect = False

    def ready(self) -> Iterator[tuple[PoseSample, TwistSample | None]]:
        """Yield the released poses with their twists, oldest first."""
        while self._poses:
            pose = self._poses[0]
            twist = self._twist_of(pose.stamp_ns)
            if twist is None and self.expect and not (self._twists or self._sparse > 1):
                if (self._newest_ns - pose.stamp_ns <= MAX_WAIT_NS
                        and len(self._poses) <= MAX_QUEUE):
                    return
                self.expect = False
            self._poses.popleft()
            self._released_ns = pose.stamp_ns
            self._pairs += twist is not None
            self._alone = self._alone + 1 if twist is None else 0
            self.expect = self.expect and self._alone < MAX_ALONE
            yield pose, twist

    def _twist_of(self, stamp_ns: int) -> TwistSample | None:
        """Return the twist at a stamp, measured or interpolated."""
        while self._twists:
            difference = self._twists[0].stamp_ns - stamp_ns
            if difference > PAIRING_TOLERANCE_NS:
                return self._interpolated(stamp_ns)
            self._before = self._twists.popleft()
            if difference >= -PAIRING_TOLERANCE_NS:
                return self._before
        return None

    def _interpolated(self, stamp_ns: int) -> TwistSample | None:
        """Return the twist interpolated at a stamp between the neighbouring twists."""
        before, after = self._before, self._twists[0]
        if before is None or before.stamp_ns >= stamp_ns or (
                after.stamp_ns - before.stamp_ns > MAX_SPAN_NS):
            return None
        s = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return TwistSample(stamp_ns, *(
            t3.add_scaled(t3.scale(1.0 - s, a), s, b)
            for a, b in zip(before[1:], after[1:], strict=True)))


HISTORY = 5
"""Number of poses from which a missing twist is estimated."""

ROTATION_LEVER = 0.1
"""Lever that converts rotations to distances, m."""


@entry
def append_row(rows: Any, count: int, seconds: float, o: Vector, q: Quaternion) -> int:
    """Append a pose, dropping the first when full; return the number of poses."""
    if count == len(rows):
        for i in range(count - 1):
            for j in range(8):
                rows[i][j] = rows[i + 1][j]
        count -= 1
    row = rows[count]
    row[0], row[1], row[2], row[3] = seconds, o[0], o[1], o[2]
    row[4], row[5], row[6], row[7] = q
    return count + 1


@entry
def pose_with_slope(rows: Any, count: int, at: int) -> State:
    """Return the pose in rows[at], and the slope there of a quadratic through rows[:count]."""
    o = (rows[at][1], rows[at][2], rows[at][3])
    q = (rows[at][4], rows[at][5], rows[at][6], rows[at][7])
    if count < 2:
        return o, q, ZERO, ZERO
    span = rows[count - 1][0] - rows[0][0]
    s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        s = (rows[i][0] - rows[at][0]) / span
        s1, s2, s3, s4 = s1 + s, s2 + s * s, s3 + s * s * s, s4 + s * s * s * s
    w0, w1, w2 = slope_weights(float(count), s1, s2, s3, s4)
    velocity, rate = ZERO, ZERO
    for i in range(count):
        s = (rows[i][0] - rows[at][0]) / span
        weight = (w0 + s * (w1 + s * w2)) / span
        shift = t3.subtract((rows[i][1], rows[i][2], rows[i][3]), o)
        turn = t3.rotation_between(q, (rows[i][4], rows[i][5], rows[i][6], rows[i][7]))
        velocity, rate = t3.add_scaled(velocity, weight, shift), t3.add_scaled(rate, weight, turn)
    return o, q, t3.apply_transposed(t3.rotation_matrix(q), velocity), rate


@kernel
def slope_weights(
    n: float, s1: float, s2: float, s3: float, s4: float
) -> tuple[float, float, float]:
    """
    Return the row for the slope at s = 0 of the inverse normal matrix of a quadratic fit.

    The normal matrix is [[n, s1, s2], [s1, s2, s3], [s2, s3, s4]], with the sums of powers of s.
    If the matrix is nearly singular, as for two samples, a line is fitted.
    """
    determinant = n * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s3 * s2) + s2 * (s1 * s3 - s2 * s2)
    if determinant < 1e-4:  # 0.06 for three uniform samples
        return (-s1 / (n * s2 - s1 * s1), n / (n * s2 - s1 * s1), 0.0)
    return ((s3 * s2 - s1 * s4) / determinant, (n * s4 - s2 * s2) / determinant,
            (s1 * s2 - n * s3) / determinant)


PERIOD_NS = 20_000_000
"""Time between two comparisons, ns."""

LATER_POSES = 2
"""Number of later poses for an accurate slope."""

FORGETTING = 0.98
"""Forgetting factor of the comparisons: the last 50, or 1 s, have most of the weight."""

MAX_MISFIT = 0.25
"""Largest fraction of the mean square of correct twists that poses do not explain."""

LAG_RANGE = 1e-3, 2e-2
"""Range of the corrected lag of the poses behind their twists, s: above the error of slopes, and
below a swing of the cup."""

LAG_DEVIATIONS = 5.0
"""Smallest significant lag, standard deviations: 1 in 1.7 million."""

MAX_JERK = 5e3
"""Largest jerk of an arm, m/s^3."""

SHIFT_TOLERANCE = 0.015
"""Tolerance of a position in addition to the largest jerk, m."""

MAX_ANGULAR_JERK = 5e4
"""Largest angular jerk of an arm, rad/s^3."""

ANGLE_TOLERANCE = 0.15
"""Tolerance of a rotation in addition to the largest angular jerk, rad."""


@kernel
def squared(v: Vector, w: Vector) -> float:
    """Return the square of a twist, with rotation weighted by `ROTATION_LEVER`."""
    return t3.dot(v, v) + ROTATION_LEVER * ROTATION_LEVER * t3.dot(w, w)


@entry
def misfit(
    tool: State, later: State, seconds: float, v: Vector, w: Vector
) -> tuple[float, float, float, float, float]:
    """
    Compare a measured body twist with the slopes v, w of the poses.

    The results are the squares of the slopes and of the deviation, and for the velocity the square
    of the acceleration until a later twist, its product with the deviation, and the square of the
    deviation. Poses that lag by T deviate by T times the acceleration.
    """
    d, a = t3.subtract(tool[2], v), t3.scale(1.0 / seconds, t3.subtract(later[2], tool[2]))
    return (squared(v, w), squared(d, t3.subtract(tool[3], w)), t3.dot(a, a), t3.dot(a, d),
            t3.dot(d, d))


@entry
def with_measured_twist(
    before: State, o: Vector, q: Quaternion, linear: Vector, angular: Vector, in_world: bool,
    seconds: float, lag: float,
) -> tuple[State, float]:
    """
    Return the tool with a measured twist, and its deviation from the twists' integral.

    A pose that lags (s) behind its twist is extrapolated by the twist.

    The deviation is relative to the largest possible deviation of an arm: the shift between two
    poses differs from the mean velocity times the time by at most j t^3 / 12, with the largest
    jerk j.
    """
    R_before, R = t3.rotation_matrix(before[1]), t3.rotation_matrix(q)
    v, w = linear, angular
    if in_world:
        v, w = t3.apply_transposed(R, linear), t3.apply_transposed(R, angular)
    if lag > 0.0:
        ahead = extrapolated((o, q, v, w), lag)
        o, q = ahead[0], ahead[1]
    mean = t3.scale(0.5, t3.add(t3.apply(R_before, before[2]), t3.apply(R, v)))
    shift = t3.norm(t3.subtract(t3.subtract(o, before[0]), t3.scale(seconds, mean)))
    rotation = t3.rotation_between(before[1], q)
    angle = t3.norm(t3.subtract(rotation, t3.scale(0.5 * seconds, t3.add(before[3], w))))
    cubed = seconds * seconds * seconds / 12.0
    return (o, q, v, w), max(shift / (SHIFT_TOLERANCE + MAX_JERK * cubed),
                             angle / (ANGLE_TOLERANCE + MAX_ANGULAR_JERK * cubed))


class ToolMotion:
    """
    Motion of E from messages of its pose and twist, or of another frame of the tool.

    A missing twist is the slope of a quadratic, fitted by least squares to the last positions and
    rotation vectors. Measured twists are regularly compared with such slopes; poses whose slopes
    lag behind the twists are extrapolated.

    Parameters
    ----------
    in_world : bool
        Whether twists are in axes of the world, instead of axes of the frame.

    Attributes
    ----------
    estimated, missed : int
        Number of estimated twists, and of measured ones that do not match the poses.

    """

    def __init__(self, in_world: bool) -> None:
        # stamp (s, from the first), position, quaternion xyzw
        self._rows, = as_inputs(np.zeros((HISTORY, 8)))
        self._in_world = in_world
        self._tip: tuple[Vector, Quaternion] | None = None
        self._recent: deque[State] = deque(maxlen=LATER_POSES + 1)
        self.estimated = self.missed = 0
        self._lag, self._products = 0.0, np.zeros(4)  # see `misfit`, and their number
        self.clear()

    def set_tip(self, tip: Array | None) -> None:
        """Set the pose (4, 4) of E in the frame of poses and twists."""
        self._tip = None if tip is None else (
            tuple(tip[:3, 3].tolist()), tuple(rotation_to_quaternion(tip[:3, :3]).tolist()))

    def clear(self) -> None:
        """Forget all poses and the comparison of twists, but not the lag."""
        self._count = self._origin_ns = self._compared = 0
        self._recent.clear()
        self._due_ns = -1
        self._squares = 0.0, 0.0  # see `misfit`

    def pose(self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion) -> PoseSample:
        """Return the pose of E in the world from the pose of the frame, m."""
        q = t3.normalised(quaternion_xyzw)
        if self._tip is not None:
            position = t3.add(position, t3.apply(t3.rotation_matrix(q), self._tip[0]))
            q = t3.quaternion_product(q, self._tip[1])
        return PoseSample(stamp_ns, position, q)

    def add(self, pose: PoseSample) -> None:
        """Append the next pose of E, dropping the oldest when full."""
        if self._count == 0:
            self._origin_ns = pose.stamp_ns
        seconds = (pose.stamp_ns - self._origin_ns) / NS_PER_S
        self._count = append_row(self._rows, self._count, seconds, *pose[1:])

    def state(self, back: int = 0) -> State:
        """Return the pose a number of samples before the newest, with its estimated body twist."""
        return pose_with_slope(self._rows, self._count, self._count - 1 - back)

    def measured(
        self, pose: PoseSample, twist: TwistSample, before: State, seconds: float
    ) -> tuple[State, float]:
        """
        Return the result of `with_measured_twist` for E at the newest pose.

        Twists are compared while a package is held (seconds > 0), because a tool without a
        package may jump.
        """
        q = pose.quaternion_xyzw
        if self._tip is not None:
            twist = _at_tip(twist, *self._tip, q, self._in_world)
        now, excess = with_measured_twist(
            before, pose.position, q, twist.linear, twist.angular, self._in_world, seconds,
            self._lag)
        self._recent.append(now)
        if seconds > 0.0 and len(self._recent) > LATER_POSES and pose.stamp_ns >= self._due_ns:
            self._due_ns = pose.stamp_ns + PERIOD_NS
            span = self._rows[self._count - 1][0] - self._rows[self._count - 1 - LATER_POSES][0]
            energy, deviation, *products = misfit(
                self._recent[0], now, span, *self.state(LATER_POSES)[2:4])
            self._squares = (FORGETTING * self._squares[0] + energy,
                             FORGETTING * self._squares[1] + deviation)
            self._compared += 1
            self._products += *products, 1.0
            self._follow_lag()
        return now, excess

    def _follow_lag(self) -> None:
        """Approach the lag of the poses behind the twists, if it is significant."""
        aa, ad, dd, count = self._products.tolist()
        found = ad / max(aa, 1e-12)
        std = math.sqrt(max(dd - found * ad, 0.0) / (3.0 * count * max(aa, 1e-12)))
        is_late = self.verdict == 'fits' and (
            max(LAG_RANGE[0], LAG_DEVIATIONS * std) < found < LAG_RANGE[1])
        step = 0.01 * PERIOD_NS / NS_PER_S  # 1 % of the speed
        self._lag += min(max(found * is_late - self._lag, -step), step)

    def states(
        self, pose: PoseSample, twist: TwistSample | None, last: Sample | None
    ) -> tuple[State | None, State]:
        """Return a better estimate of E at the last sample, if any, and E at the next pose."""
        self.add(pose)
        if twist is not None:
            start, seconds = (ORIGIN, 0.0) if last is None else (
                last.tool, (pose.stamp_ns - last.stamp_ns) / NS_PER_S)
            now, excess = self.measured(pose, twist, start, seconds)
            if last is None or excess <= 1.0:
                return None, now
            self.missed += 1
        self.estimated += 1
        self._recent.clear()
        # a later pose improves the slope at the previous one
        return self.state(back=1) if last else None, self.state()

    @property
    def verdict(self) -> str:
        """Verdict on measured twists: 'unknown', 'fits' or 'does_not_fit'."""
        energy, deviation = self._squares
        weight = (1.0 - FORGETTING ** self._compared) / (1.0 - FORGETTING)
        if self._compared < 20 or not (  # a first verdict takes 20 comparisons
                1e-3 * weight < energy < math.inf):  # (m/s)^2; noise dominates below
            return 'unknown'
        return 'does_not_fit' if deviation > MAX_MISFIT * energy else 'fits'


def _at_tip(
    twist: TwistSample, lever: Vector, rotation: Quaternion, q: Quaternion, in_world: bool
) -> TwistSample:
    """Return the twist of E, in unchanged axes, from a frame with E at lever and rotation."""
    R_tip, v, w = t3.rotation_matrix(rotation), twist.linear, twist.angular
    if in_world:
        lever = t3.apply(t3.rotation_matrix(q), t3.apply_transposed(R_tip, lever))
        return TwistSample(twist.stamp_ns, t3.add(v, t3.cross(w, lever)), w)
    v = t3.apply_transposed(R_tip, t3.add(v, t3.cross(w, lever)))
    return TwistSample(twist.stamp_ns, v, t3.apply_transposed(R_tip, w))
