"""
Tracking of a plan driven by the tool: its progress, and the remaining motion.

Drivers start late, run scaled, pause and wait, so the plan is synchronised with the tool instead
of the clock. The progress along the plan (s) and its rate are a continuous state with a
covariance: a Kalman filter predicts both, and each pose and twist of the tool corrects them.
During standstills and slow parts of the plan, poses do not determine the progress; the progress is
then extrapolated at its rate, with a growing variance. If the tool is not near its predicted pose,
the plan is searched. Pure code, no ROS.
"""

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.live.tool_twist import ROTATION_LEVER
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model import simulation
from bellows_ros.core.model.kernels import State, tool_at, tool_segment
from bellows_ros.core.model.simulation import row_state, ToolRows, write_row
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

MAX_WAIT = 10.0
"""Largest time between a plan's stamp and the present, s. A plan with a larger difference may have
the stamp of another clock, and starts with the tool's motion."""
MAX_DEVIATION = 0.05
"""Largest distance of a tool that follows the plan, m."""

POSE_STD = 5e-5
"""Standard deviation of the tool's pose from the driven plan, m and rad."""

TWIST_STD = 0.005
"""Standard deviation of the tool's twist from the driven plan, m/s and rad/s."""
START_STD = 0.5
"""Standard deviation of a driver's rate before its first motion, relative to the plan."""
GATE = 4.0
"""Squared innovation over its variance above which the rate of the driver, or the tool's point on
the plan, has changed: two standard deviations."""
PAUSE_RATE = 0.1
"""Rate relative to the plan below which a driver pauses."""

MAX_RATE = 2.0
"""Highest rate of a driver relative to the plan."""

SEARCH_TIME = 0.1
"""Smallest range of a search to each side, s of the plan."""

SEARCH_STEP = 2.5e-3
"""Step of a search, s of the plan."""

MAX_SEARCH_STEPS = 400
"""Largest number of steps of a search."""
ITERATIONS = 4
"""Number of linearisations of the plan about the corrected progress."""

JOIN_SPEED = 0.05
"""Speed of the tool's return to the plan, m/s."""

MAX_JOIN_TIME = 0.1
"""Longest duration of the tool's return to the plan, s."""
SPACING = 0.01
"""Shortest time between points of the remaining plan, s."""

WAITING = 'waiting'
"""State of a plan that the tool has not started."""

DRIVEN = 'driven'
"""State of a plan that the tool follows."""

PAUSED = 'paused'
"""State of a plan on which the tool has stopped before the end."""

DEVIATED = 'deviated'
"""State of a plan that the tool has left."""

DONE = 'done'
"""State of a plan at whose end the tool has arrived."""


class PlanProgress(NamedTuple):
    """Progress of the tool on a plan at a stamp; immutable, because several threads read it."""

    stamp_ns: int
    time: float
    """Time on the plan, s."""
    rate: float
    """Rate of the driver, relative to the plan."""
    variance: float
    """Variance of the time, s^2."""
    covariance: float
    """Covariance of time and rate, s."""
    rate_variance: float


@entry
def pose_deviation(row: Any, o: Vector, q: Quaternion) -> float:
    """Return a tool's distance (m) from a point of a plan; `ROTATION_LEVER` weights rotations."""
    x, y, z = row[0] - o[0], row[1] - o[1], row[2] - o[2]
    same = abs(row[3] * q[0] + row[4] * q[1] + row[5] * q[2] + row[6] * q[3])
    rotation = ROTATION_LEVER * ROTATION_LEVER * 4.0 * max(0.0, 2.0 - 2.0 * same)
    return math.sqrt(x * x + y * y + z * z + rotation)


@kernel
def along(v: Vector, w: Vector, linear: Vector, angular: Vector) -> float:
    """Return the inner product of two twists; rates count by `ROTATION_LEVER`."""
    return t3.dot(v, linear) + ROTATION_LEVER * ROTATION_LEVER * t3.dot(w, angular)


@entry
def point_at(rows: Any, seconds: Any, t: float) -> State:
    """Return the tool on a plan at a time (s); at rest outside of the plan."""
    last = len(seconds) - 1
    if t <= 0.0 or t >= seconds[last]:
        o, q, v, w = row_state(rows[0 if t <= 0.0 else last])[:4]
        return o, q, t3.scale(0.0, v), t3.scale(0.0, w)
    k = simulation.first_after(seconds, t, len(seconds)) - 1
    duration = seconds[k + 1] - seconds[k]
    segment = tool_segment(row_state(rows[k]), row_state(rows[k + 1]), duration)
    return tool_at(segment, (t - seconds[k]) / duration)


@entry
def departure(rows: Any, seconds: Any) -> float:
    """Return the time (s) of the first point that differs measurably from the start."""
    o, q = row_state(rows[0])[:2]
    for k in range(len(rows)):
        if pose_deviation(rows[k], o, q) ** 2 > GATE * POSE_STD * POSE_STD:
            return seconds[k]  # type: ignore[no-any-return]
    return seconds[len(rows) - 1]  # type: ignore[no-any-return]


@kernel
def offset(point: State, tool: State) -> tuple[float, float, float]:
    """Return a tool's squared distance (m^2) from a point, its part along the path, speed^2."""
    o, q, v, w = point[:4]
    step = t3.apply_transposed(t3.rotation_matrix(q), t3.subtract(tool[0], o))
    rotation = t3.rotation_between(q, tool[1])
    return along(step, rotation, step, rotation), along(step, rotation, v, w), along(v, w, v, w)


@kernel
def corrected(
    rows: Any, seconds: Any, tool: State, t: float, variance: float
) -> tuple[float, float]:
    """
    Return the time (s) corrected by the tool's pose, and its prior variance, s^2.

    If the tool is further along the plan than the variance allows, the driver has changed its
    rate: the prior variance is increased by the square of the shift in time.
    """
    at = t
    for i in range(ITERATIONS):
        _, step, speed2 = offset(point_at(rows, seconds, at), tool)
        expected = variance * speed2 + POSE_STD * POSE_STD
        if i == 0 and step * step > GATE * expected * speed2:
            shift = min(abs(step) / speed2, SEARCH_TIME)
            variance += shift * shift
            expected = variance * speed2 + POSE_STD * POSE_STD
        moved = variance * ((at - t) * speed2 + step) / expected
        last = min(at + SEARCH_TIME, seconds[len(seconds) - 1])
        at = min(max(t + moved, at - SEARCH_TIME, 0.0), last)
    return at, variance


@kernel
def search(
    rows: Any, seconds: Any, tool: State, expected: float, ends: tuple[float, float]
) -> tuple[float, float]:
    """
    Return the time (s) at which the plan is nearest to the tool, within a range, and the step (s).

    Among equally near points, a point in the tool's direction of motion is preferred, then the one
    nearer to the expected time.
    """
    low, high = ends
    count = min(max(int((high - low) / SEARCH_STEP), 1), MAX_SEARCH_STEPS)
    h = (high - low) / count
    best, least = expected, math.inf
    for i in range(count + 1):
        at = low + i * h
        point = point_at(rows, seconds, at)
        squared, step, speed2 = offset(point, tool)
        if speed2 > 0.0:  # the nearest point is up to half a step away
            near = min(max(step / speed2, -0.5 * h), 0.5 * h)
            squared += near * near * speed2 - 2.0 * near * step
        against = min(along(tool[2], tool[3], point[2], point[3]), 0.0)
        wrong = against * against / (speed2 + TWIST_STD * TWIST_STD)
        late = (at - expected) / SEARCH_TIME
        cost = squared / (POSE_STD * POSE_STD) + wrong / (TWIST_STD * TWIST_STD) + late * late
        if cost < least:
            best, least = at, cost
    return best, h


@entry
def track(
    rows: Any, seconds: Any, tool: State, prior: tuple[float, float, float, float, float],
    ends: tuple[float, float],
) -> tuple[float, tuple[float, float, float, float, float]]:
    """
    Return the tool's distance from the plan (m), and the corrected time, rate and covariance.

    The prior is the time (s), the rate and their covariance. If the tool is not at the predicted
    point, the plan is searched within a range (s).
    """
    t, rate, variance, covariance, rate_variance = prior
    at, wide = corrected(rows, seconds, tool, t, variance)
    squared, _, _ = offset(point_at(rows, seconds, at), tool)
    if squared > GATE * POSE_STD * POSE_STD and ends[1] > ends[0]:
        found, step = search(rows, seconds, tool, t, ends)
        elsewhere, spread = corrected(rows, seconds, tool, found, step * step)
        nearest, _, _ = offset(point_at(rows, seconds, elsewhere), tool)
        if nearest < squared - GATE * POSE_STD * POSE_STD:
            squared, t, at, wide, covariance = nearest, found, elsewhere, spread, 0.0
    v, w = point_at(rows, seconds, at)[2:4]
    speed2 = along(v, w, v, w)
    if wide != variance:
        rate_variance = max(rate_variance, START_STD * START_STD)
    slower = speed2  # in the prior's range: the plan may start or stop there
    for k in range(3):
        v0, w0 = point_at(rows, seconds, t + (k - 1) * math.sqrt(wide))[2:4]
        slower = min(slower, along(v0, w0, v0, w0))
    gain = slower / (wide * slower + POSE_STD * POSE_STD)
    rate += covariance * (at - t) / wide
    rate_variance -= covariance * covariance * gain
    variance, covariance = wide - wide * wide * gain, covariance - wide * covariance * gain
    if speed2 <= TWIST_STD * TWIST_STD:
        return math.sqrt(squared), (at, rate, variance, covariance, rate_variance)
    measured = along(tool[2], tool[3], v, w) / speed2
    noise, innovation = TWIST_STD * TWIST_STD / speed2, min(measured, MAX_RATE) - rate
    if innovation * innovation > GATE * (rate_variance + noise):
        rate_variance, covariance = rate_variance + innovation * innovation, 0.0
    part = 1.0 / (rate_variance + noise)
    at += covariance * part * innovation
    rate += rate_variance * part * innovation
    variance -= covariance * covariance * part
    covariance -= covariance * rate_variance * part
    rate_variance -= rate_variance * rate_variance * part
    return math.sqrt(squared), (at, rate, variance, covariance, rate_variance)


@entry
def thin_out(times_ns: Stamps, states: Array, rate: float, in_world: bool) -> int:
    """
    Keep a limited number of states per second, and the last, at the front; return their number.

    Twists are optionally rotated into axes of the world.
    """
    count, last, before = 0, len(times_ns) - 1, -1.0
    for k in range(last + 1):
        slot = math.floor(times_ns[k] * (rate / NS_PER_S) + 1e-6)
        if slot != before or k == last:
            o, q, v, w = row_state(states[k])[:4]
            if in_world:
                R = t3.rotation_matrix(q)
                v, w = t3.apply(R, v), t3.apply(R, w)
            times_ns[count] = times_ns[k]
            write_row(states[count], (o, q, v, w))
            count += 1
        before = slot
    return count


class PlanTracker:
    """
    A plan that the tool drives now or later.

    Parameters
    ----------
    plan : Trajectory or ToolRows
        Plan of E in the world, with body twists.
    stamp_ns : int
        Stamp of the plan's start, ns; 0 for a start with the tool.

    Attributes
    ----------
    plan : ToolRows
    progress : PlanProgress
    state : str
        One of `WAITING`, `DRIVEN`, `PAUSED`, `DEVIATED`, `DONE`.

    """

    def __init__(self, plan: Trajectory | ToolRows, stamp_ns: int) -> None:
        self._stamp_ns = stamp_ns
        self.plan = ToolRows(plan.stamps_ns, simulation.tool_rows(plan))
        self._inputs = as_inputs(self.plan.rows, self.plan.seconds)
        self._end = float(self.plan.seconds[-1])
        self._leaves = departure(*self._inputs)
        self.state = WAITING
        self.progress = PlanProgress(-1, 0.0, 1.0, self._leaves**2, 0.0, START_STD**2)

    def follow(self, now: Prediction) -> None:
        """Correct the progress by a pose of the tool; call it for each pose."""
        before = self.progress
        ends, prior = self._predicted(now.stamp_ns)
        distance, (time, rate, *covariance) = track(*self._inputs, now.tool, prior, ends)
        if distance > MAX_DEVIATION:
            self.state = DEVIATED
            return
        if self.state == WAITING and time <= self._leaves:
            self.progress = PlanProgress(now.stamp_ns, min(time, prior[0]), *prior[1:])
            return
        is_paused = rate <= PAUSE_RATE
        self.progress = PlanProgress(
            now.stamp_ns, min(max(time, 0.0), self._end),
            before.rate if is_paused else min(rate, MAX_RATE), *covariance)
        self.state = (DONE if self.progress.time >= self._end - 1e-3 else
                      PAUSED if is_paused else DRIVEN)

    def _predicted(
        self, stamp_ns: int
    ) -> tuple[tuple[float, float], tuple[float, float, float, float, float]]:
        """Return the range (s) of a search, and the predicted time, rate and covariance."""
        stored_ns, time, rate, variance, covariance, rate_variance = self.progress
        elapsed = max(0.0, (stamp_ns - stored_ns) / NS_PER_S) if stored_ns >= 0 else 0.0
        if self.state == WAITING:
            overdue = max(0.0, -self._wait(stamp_ns))
            reach = MAX_RATE * (overdue if stored_ns < 0 else elapsed) + SEARCH_TIME
            is_due = stored_ns < 0 or overdue <= self._leaves
            expected = min(overdue, self._end) if is_due else 0.0
            return (0.0, min(reach, self._end)), (
                expected, 1.0, self._leaves**2, 0.0, START_STD**2)
        if self.state in (PAUSED, DEVIATED):
            reach = MAX_RATE * elapsed + SEARCH_TIME
            return (max(0.0, time - SEARCH_TIME), min(time + reach, self._end)), (
                time, rate, variance, 0.0, rate_variance)
        drift = 0.05**2 * elapsed  # 5 % change of the rate within 1 s
        variance += elapsed * (2.0 * covariance + elapsed * (rate_variance + drift / 3.0))
        covariance += elapsed * (rate_variance + 0.5 * drift)
        time = min(time + rate * elapsed, self._end)
        reach = 3.0 * math.sqrt(variance) + SEARCH_TIME
        return (max(0.0, time - reach), min(time + reach, self._end)), (
            time, rate, variance, covariance, rate_variance + drift)

    def _wait(self, stamp_ns: int) -> float:
        """Return the time (s) until the plan begins; infinite if it begins with the tool."""
        wait = (self._stamp_ns - stamp_ns) / NS_PER_S if self._stamp_ns else math.inf
        is_soon = -MAX_WAIT - self._end <= wait <= MAX_WAIT
        return wait if is_soon else math.inf

    def is_driven(self, now: Prediction) -> bool:
        """Return whether the tool is on the plan, or approaches its start."""
        return self.state == DRIVEN or (
            self.state == WAITING
            and -0.1 - self._leaves <= self._wait(now.stamp_ns) < math.inf)

    def rest(self, now: Prediction, spacing: float = SPACING, deviations: float = 0.0) -> ToolRows:
        """
        Return the present tool and the remaining plan, with stamps from the present on.

        A plan without a start time starts now. The tool joins the plan at `JOIN_SPEED`, and
        follows the plan at its last rate. Points have at least a spacing (s). Progress and rate
        are changed by a number of their standard deviations.
        """
        stored_ns, progress, rate, variance, _, rate_variance = self.progress
        seconds, last, wait = self.plan.seconds, len(self.plan) - 1, 0.0
        if self.state != WAITING:  # the last pose may be older
            progress += rate * max(0, now.stamp_ns - stored_ns) / NS_PER_S
        elif self._wait(now.stamp_ns) < math.inf:
            wait = max(0.0, self._wait(now.stamp_ns))
        if self.state == DRIVEN:
            rate = max(rate + deviations * math.sqrt(max(rate_variance, 0.0)), PAUSE_RATE)
        progress = min(max(progress + deviations * math.sqrt(max(variance, 0.0)), 0.0), self._end)
        nearest = np.concatenate(point_at(*self._inputs, progress))
        join = min(MAX_JOIN_TIME, pose_deviation(nearest, *now.tool[:2]) / JOIN_SPEED)
        start = progress + max(join, 1e-4 if wait == 0.0 else 0.0)
        first = min(int(np.searchsorted(seconds, start)), last)
        gap = max(seconds[last] - seconds[first], 1e-9) / max(1, last - first)
        chosen = np.append(np.arange(first, last, max(1, round(spacing / gap))), last)
        times = wait + np.maximum(seconds[chosen] - progress, 1e-4) / rate
        rows = self.plan.rows[chosen] * np.repeat([1.0, rate], [7, 6])
        return ToolRows(
            np.append(0, np.rint(times * NS_PER_S).astype(np.int64)),
            np.vstack([np.concatenate(now.tool), rows]))
