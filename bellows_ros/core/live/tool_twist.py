"""
The tool's twist at the stamps of its poses: measured, interpolated or estimated.

Measured twists come in any order and at any rate (`Pairing`). A twist with the stamp of the pose
is used unchanged; a pose between two twists gets an interpolated twist; for other poses, after a
short wait, the twist is estimated from the last poses by the Savitzky-Golay filter at the end of
its window. Measured twists are regularly compared with these estimates (`ToolMotion`).
"""

from collections import deque
from collections.abc import Iterator
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.model.kernels import extrapolated, ORIGIN, State
from bellows_ros.core.signals.screening import MAX_TOOL_RATE, MAX_TOOL_SPEED, PoseSample
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


TWIST_REFUSALS = ('twist_nan', 'twist_too_fast', 'twist_stamp')
"""Reasons for rejecting twists of the tool."""


class TwistSample(NamedTuple):
    """A twist of the tool in the axes its driver uses, m/s and rad/s."""

    stamp_ns: int
    linear: Vector
    angular: Vector


class Pairing:
    """
    Queues of poses and twists, and the rule for the release of poses.

    Attributes
    ----------
    expect : bool
        Whether a pose waits for its twist. Set by callers that know of a publisher of twists, and
        by twists that come soon after their poses.
    twists : int
        Number of twists.
    refused : dict
        Numbers of rejected twists, by reason.

    """

    def __init__(self) -> None:
        self.expect, self.twists = False, 0
        self.refused = dict.fromkeys(TWIST_REFUSALS, 0)
        self.clear()

    def clear(self) -> None:
        """Discard waiting poses and twists."""
        self._poses: deque[PoseSample] = deque()
        self._twists: deque[TwistSample] = deque(maxlen=32)  # the first before the next pose
        self._newest_ns = self._released_ns = -1
        self._since_twist = self._sparse = 0  # poses, and successive twists too late for them

    @property
    def waiting(self) -> int:
        """Number of poses that wait for their twist."""
        return len(self._poses)

    def add_pose(self, pose: PoseSample) -> None:
        """Queue a pose; stamps increase."""
        self._newest_ns = pose.stamp_ns
        self._since_twist += 1
        self._poses.append(pose)

    def add_twist(self, twist: TwistSample) -> None:
        """Queue a twist, or let poses wait if its pose has been released without it."""
        self.twists += 1
        speed, rate = math.hypot(*twist.linear), math.hypot(*twist.angular)
        if not (speed <= MAX_TOOL_SPEED and rate <= MAX_TOOL_RATE):  # or NaN
            is_finite = all(map(math.isfinite, (*twist.linear, *twist.angular)))
            self.refused['twist_too_fast' if is_finite else 'twist_nan'] += 1
            return
        stamp_ns, twists = twist.stamp_ns, self._twists
        while twists and twists[-1].stamp_ns > max(stamp_ns, self._newest_ns + MAX_WAIT_NS):
            twists.pop()  # their stamps were wrong
            self.refused['twist_stamp'] += 1
        last_ns = twists[-1].stamp_ns if twists else -1
        if stamp_ns <= last_ns:
            self.refused['twist_stamp'] += 1
            return
        is_soon = stamp_ns - last_ns <= MAX_SPAN_NS or (
            abs(stamp_ns - self._newest_ns) <= PAIRING_TOLERANCE_NS)
        self._sparse = 0 if is_soon and self._since_twist <= 1 else self._sparse + 1
        self._since_twist = 0
        if stamp_ns <= self._released_ns + PAIRING_TOLERANCE_NS:
            self.expect |= self._newest_ns - stamp_ns <= MAX_WAIT_NS
        twists.append(twist)

    def release_waiting_poses(self) -> None:
        """Release all waiting poses without their twists."""
        self.expect = self.expect and not self._poses

    def ready(self) -> Iterator[tuple[PoseSample, TwistSample | None]]:
        """Yield the released poses with their twists, oldest first."""
        while self._poses:
            pose = self._poses[0]
            twist = self._twist_of(pose.stamp_ns)
            if twist is None and self.expect and self._sparse < 2 and (
                    not self._twists or self._twists[-1].stamp_ns <= pose.stamp_ns):
                if (self._newest_ns - pose.stamp_ns <= MAX_WAIT_NS
                        and len(self._poses) <= MAX_QUEUE):
                    return
                self.expect = False
            self._poses.popleft()
            self._released_ns = pose.stamp_ns
            yield pose, twist

    def _twist_of(self, stamp_ns: int) -> TwistSample | None:
        """Return the twist at a stamp, measured, or interpolated between its neighbours."""
        twists = self._twists
        while len(twists) > 1 and twists[1].stamp_ns <= stamp_ns + PAIRING_TOLERANCE_NS:
            twists.popleft()
        if twists and abs(twists[0].stamp_ns - stamp_ns) <= PAIRING_TOLERANCE_NS:
            return twists[0]
        if len(twists) < 2:
            return None
        before, after = twists[0], twists[1]
        span_ns, part_ns = after.stamp_ns - before.stamp_ns, stamp_ns - before.stamp_ns
        if not 0 < part_ns < span_ns <= MAX_SPAN_NS:
            return None
        return TwistSample(stamp_ns, *(
            t3.add_scaled(a, part_ns / span_ns, t3.subtract(b, a))
            for a, b in zip(before[1:], after[1:], strict=True)))


HISTORY = 5
"""Number of poses from which a missing twist is estimated."""


STRAIGHT = 1e-4
"""Relative sum of squares of a quadratic, orthogonal to a line, below which a line is fitted: 0.17
for three uniform samples."""


@entry
def pose_with_slope(rows: Any, number: int, back: int) -> State:
    """
    Return the pose some samples before the newest, and the slope there of a quadratic.

    The rows (k, 8) have the last k of a number of samples, each in the row of its number modulo k:
    stamp (s), position, quaternion. The quadratic is the sum of polynomials 1, u and
    u^2 - a u - b, which are orthogonal for times u from the mean.
    """
    at, count = (number - 1 - back) % len(rows), min(number, len(rows))
    o = (rows[at][1], rows[at][2], rows[at][3])
    q = (rows[at][4], rows[at][5], rows[at][6], rows[at][7])
    velocity, rate, mean, squares, cubes, others = ZERO, ZERO, 0.0, 0.0, 0.0, 0.0
    if count < 2:
        return o, q, velocity, rate
    for i in range(count):
        mean += (rows[i][0] - rows[at][0]) / count
    for i in range(count):
        u = rows[i][0] - rows[at][0] - mean
        squares, cubes = squares + u * u, cubes + u * u * u
    a, b = cubes / squares, squares / count
    for i in range(count):
        u = rows[i][0] - rows[at][0] - mean
        others += (u * u - a * u - b) ** 2
    bend = (-2.0 * mean - a) / others if others > STRAIGHT * squares * squares else 0.0
    for i in range(count):
        u = rows[i][0] - rows[at][0] - mean
        weight = u / squares + bend * (u * u - a * u - b)
        shift = t3.subtract((rows[i][1], rows[i][2], rows[i][3]), o)
        turn = t3.rotation_between(q, (rows[i][4], rows[i][5], rows[i][6], rows[i][7]))
        velocity, rate = t3.add_scaled(velocity, weight, shift), t3.add_scaled(rate, weight, turn)
    return o, q, t3.apply_transposed(t3.rotation_matrix(q), velocity), rate


PERIOD_NS = 20_000_000
"""Time between two comparisons, ns."""

LATER_POSES = 2
"""Number of later poses for an accurate slope."""

FORGETTING = 0.998
"""Forgetting factor of the comparisons: the last 500, or 10 s of motion, have most weight."""

MAX_MISFIT = 0.25
"""Largest fraction of the mean square of correct twists that poses do not explain."""

LAG_RANGE = 1e-3, 2e-2
"""Range of the corrected lag of the poses behind their twists, s: above the error of slopes, and
below a swing of the cup."""

LAG_DEVIATIONS = 5.0
"""Smallest significant lag, standard deviations: 1 in 1.7 million."""

LAG_STEP = 2e-4
"""Largest change of the corrected lag in a comparison, s: 1 % of the speed."""

AT_TIP = ORIGIN[:2]
"""Pose of E in the frame of poses and twists, unless given."""

WEIGHTS = np.repeat([1.0, 0.1 ** 2], 3)
"""Weights of the squares of twists: a lever of 0.1 m converts rotations to distances."""


@entry
def with_measured_twist(
    o: Vector, q: Quaternion, linear: Vector, angular: Vector, in_world: bool,
    tip: tuple[Vector, Quaternion], lag: float,
) -> State:
    """
    Return the tool with a measured twist.

    The twist is of a frame in which E has the pose `tip`, in axes of the world or of this frame.
    A pose that lags (s) behind its twist is extrapolated by the twist.
    """
    R_tip, v, w = t3.rotation_matrix(tip[1]), linear, angular
    if in_world:
        R = t3.multiply(t3.rotation_matrix(q), t3.transposed(R_tip))
        v, w = t3.apply_transposed(R, linear), t3.apply_transposed(R, angular)
    v = t3.apply_transposed(R_tip, t3.add(v, t3.cross(w, tip[0])))
    w = t3.apply_transposed(R_tip, w)
    if lag > 0.0:
        ahead = extrapolated((o, q, v, w), lag)
        o, q = ahead[0], ahead[1]
    return o, q, v, w


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
    estimated : int
        Number of estimated twists.

    """

    def __init__(self, in_world: bool) -> None:
        self._rows, = as_inputs(np.zeros((HISTORY, 8)))
        self._in_world, self._tip = in_world, AT_TIP
        self._recent: deque[State] = deque(maxlen=LATER_POSES + 1)
        self.estimated = 0
        self.clear()

    def set_tip(self, tip: Array | None) -> None:
        """Set the pose (4, 4) of E in the frame of poses and twists."""
        self._tip = AT_TIP if tip is None else (
            tuple(tip[:3, 3].tolist()), tuple(rotation_to_quaternion(tip[:3, :3]).tolist()))

    def clear(self) -> None:
        """Forget all poses and twists."""
        self._lag, self._sums = 0.0, np.zeros(5)  # see `_compare`
        self._count = self._origin_ns = 0
        self._recent.clear()
        self._due_ns = -1

    def pose(self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion) -> PoseSample:
        """Return the pose of E in the world from the pose of the frame, m."""
        q = t3.normalised(quaternion_xyzw)
        if self._tip is not AT_TIP:
            position = t3.add(position, t3.apply(t3.rotation_matrix(q), self._tip[0]))
            q = t3.quaternion_product(q, self._tip[1])
        return PoseSample(stamp_ns, position, q)

    def add(self, pose: PoseSample) -> None:
        """Append the next pose of E, dropping the oldest when full."""
        if self._count == 0:
            self._origin_ns = pose.stamp_ns
        seconds = (pose.stamp_ns - self._origin_ns) / NS_PER_S
        self._rows[self._count % HISTORY] = seconds, *pose.position, *pose.quaternion_xyzw
        self._count += 1

    def state(self, back: int = 0) -> State:
        """Return the pose a number of samples before the newest, with its estimated body twist."""
        return pose_with_slope(self._rows, self._count, back)

    def _compare(self, tool: State, later: State) -> None:
        """
        Compare a measured twist with the slope of the poses, and approach their lag.

        Poses that lag by T deviate by T times the acceleration. The weighted sums are the squares
        of slope, deviation and acceleration, the product of both, and the number.
        """
        stamp, earlier = (self._rows[(self._count - 1 - back) % HISTORY][0]
                          for back in (0, LATER_POSES))
        slope, twist, after = (
            np.ravel(each[2:4]) for each in (self.state(LATER_POSES), tool, later))
        deviation, acceleration = twist - slope, (after - twist) / (stamp - earlier)
        self._sums = FORGETTING * self._sums + [*(WEIGHTS @ (x * y) for x, y in (
            (slope, slope), (deviation, deviation), (acceleration, acceleration),
            (acceleration, deviation))), 1.0]
        _, dd, aa, ad, count = self._sums.tolist()
        lag = ad / max(aa, 1e-12)
        std = math.sqrt(max(dd - lag * ad, 0.0) / (6.0 * count * max(aa, 1e-12)))
        is_late = self.verdict == 'fits' and (
            max(LAG_RANGE[0], LAG_DEVIATIONS * std) < lag < LAG_RANGE[1])
        self._lag += min(max(lag * is_late - self._lag, -LAG_STEP), LAG_STEP)

    def states(
        self, pose: PoseSample, twist: TwistSample | None, is_held: bool
    ) -> tuple[State | None, State]:
        """
        Return a better estimate of E at the previous pose, if any, and E at the next pose.

        Twists are compared while a package is held, because a tool without one may jump.
        """
        self.add(pose)
        if twist is None:
            self.estimated += 1
            self._recent.clear()
            # a later pose improves the slope at the previous one
            return self.state(back=1) if is_held else None, self.state()
        now = with_measured_twist(*pose[1:], *twist[1:], self._in_world, self._tip, self._lag)
        self._recent.append(now)
        if is_held and len(self._recent) > LATER_POSES and pose.stamp_ns >= self._due_ns:
            self._due_ns = pose.stamp_ns + PERIOD_NS
            self._compare(self._recent[0], now)
        return None, now

    @property
    def verdict(self) -> str:
        """Verdict on measured twists: 'unknown', 'fits' or 'does_not_fit'."""
        energy, deviation, *_, count = self._sums.tolist()
        if count < 20 or not (  # a first verdict takes 20 comparisons
                1e-3 * count < energy < math.inf):  # (m/s)^2; noise dominates below
            return 'unknown'
        return 'does_not_fit' if deviation > MAX_MISFIT * energy else 'fits'
