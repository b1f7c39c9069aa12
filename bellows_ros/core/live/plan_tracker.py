"""
Tracking of a plan while the tool drives it: the tool's place on the plan, and the rest of it.

Drivers start late and run scaled, so the plan is anchored to the tool: to the plan's nearest time
along its path, not to the clock. Pure code, no ROS.
"""

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import as_inputs, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.live.tool_twist import ROTATION_LEVER
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model import simulation
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import row_state, ToolRows, write_row
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

SEARCH_TIME = 0.05
"""The tool is searched up to this far (s of the plan) ahead of its expected place."""
MAX_DELAY = 0.1
"""A tool that stands for longer (s) than its plan does at the beginning, waits."""
MAX_WAIT = 10.0
"""A plan that begins later than this (s) is not ahead yet, and one that should have ended longer
ago begins with the tool, as its stamp may be of another clock."""
PLACE_TOLERANCE = 2e-4
"""Places of the plan within this distance (m) of the tool are distinguished by the clock."""
MAX_DEVIATION = 0.05
"""A tool farther than this (m) from the plan does not follow it."""

MIN_SPEED_RATIO = 0.05
"""Fraction of the plan's highest speed above which the driver's speed can be measured."""
MIN_RATE, MAX_RATE = 0.1, 2.0
"""Range of the driver's speed relative to the plan; below it, the driver pauses."""

SMOOTHING = 0.8
"""Weight of the latest measured speed factor."""

JOIN_SPEED, MAX_JOIN_TIME = 0.05, 0.1
"""The tool returns to the plan at this speed (m/s), within this time (s)."""
SPACING = 0.01
"""Minimum spacing (s) of the points of the remaining plan."""


@kernel
def pose_distance(row: Any, o: Vector, q: Quaternion) -> float:
    """Return the distance (m) of a tool from a point of a plan, turns at `ROTATION_LEVER`."""
    x, y, z = row[0] - o[0], row[1] - o[1], row[2] - o[2]
    same = abs(row[3] * q[0] + row[4] * q[1] + row[5] * q[2] + row[6] * q[3])
    turned = ROTATION_LEVER * ROTATION_LEVER * 4.0 * max(0.0, 2.0 - 2.0 * same)
    return math.sqrt(x * x + y * y + z * z + turned)


@kernel
def along(v: Vector, w: Vector, linear: Vector, angular: Vector) -> float:
    """Return the product of two twists, turns counted as by `ROTATION_LEVER`."""
    return t3.dot(v, linear) + ROTATION_LEVER * ROTATION_LEVER * t3.dot(w, angular)


@kernel
def index_at(seconds: Any, t: float) -> int:
    """Return the index of the last time that is not after t (s), or of the first."""
    return max(simulation.first_after(seconds, t, len(seconds)) - 1, 0)


@kernel
def locate(
    rows: Any, seconds: Any, reach: Any, slow: float, tool: State, progress: float, expected: float
) -> tuple[float, float, float]:
    """
    Return how far (m) a tool is from a plan, where on it (s), and at how many times its speed.

    It is sought from the progress on, and of places as near as each other where it is expected.
    The speed is infinite where the plan is slow.
    """
    o, q, v, w = tool[:4]
    last = len(seconds) - 1
    first, end = index_at(seconds, progress), 1 + min(
        last, 1 + index_at(seconds, max(expected, progress) + SEARCH_TIME))
    nearest = math.inf
    for i in range(first, end):
        nearest = min(nearest, pose_distance(rows[i], o, q))
    index, difference = first, math.inf
    for i in range(first, end):
        if (abs(seconds[i] - expected) < difference
                and pose_distance(rows[i], o, q) <= max(nearest, PLACE_TOLERANCE) + reach[i]):
            index, difference = i, abs(seconds[i] - expected)
    point = row_state(rows[index])
    speed = along(point[2], point[3], point[2], point[3])
    if speed <= slow * slow:
        return nearest, seconds[index], math.inf
    R = t3.rotation_matrix(point[1])
    rotation = t3.rotation_between(point[1], q)
    step = along(t3.apply_transposed(R, t3.subtract(o, point[0])), rotation, point[2], point[3])
    return (
        nearest, min(max(seconds[index] + step / speed, 0.0), seconds[last]),
        along(v, w, point[2], point[3]) / speed)


@kernel
def thin_out(times_ns: Stamps, states: Array, rate: float, in_world: bool) -> int:
    """
    Move at most so many states a second, and the last, to the front; return how many.

    Their twists are turned into axes of the world if asked.
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
    A plan of the tool that is being driven, or will be.

    Parameters
    ----------
    plan : Trajectory or ToolRows
        Of E in the world with body twists.
    stamp_ns : int
        When it starts, ns; 0 for when the tool starts.

    Attributes
    ----------
    plan : ToolRows
    progress : float
        s of the plan.
    done, deviated, paused : bool
        Whether the tool has arrived, is elsewhere, or stands where the plan moves.

    """

    def __init__(self, plan: Trajectory | ToolRows, stamp_ns: int) -> None:
        """Take the plan."""
        self._stamp_ns = stamp_ns
        self.plan = ToolRows(plan.stamps_ns, simulation.tool_rows(plan))
        self._seconds, self._rows = self.plan.seconds, self.plan.rows
        speed = np.linalg.norm(self._rows[:, 7:] * np.repeat([1.0, ROTATION_LEVER], 3), axis=1)
        gaps = np.diff(self._seconds)
        reach = 0.5 * speed * np.maximum(np.append(gaps, 0.0), np.append(0.0, gaps))
        self._inputs = as_inputs(self._rows, self._seconds, reach)
        self._slow = MIN_SPEED_RATIO * float(speed.max())
        o, q = row_state(self._rows[0])[:2]
        self._leaves = float(next((
            t for t, row, tolerance in zip(self._seconds, self._rows, reach, strict=True)
            if pose_distance(row, o, q) > PLACE_TOLERANCE + tolerance), self._seconds[-1]))
        self.done = self.deviated = self.paused = False
        self._anchor = -1, 0.0, 1.0  # stamp, progress, and speed of the tool in that of the plan

    @property
    def progress(self) -> float:
        """Time in the plan of the last pose of the tool, s."""
        return self._anchor[1]

    def follow(self, now: Prediction) -> None:
        """Find where on the plan the tool is, and how fast it is driven; for each of its poses."""
        _, before, rate = self._anchor
        distance, progress, measured = locate(
            *self._inputs, self._slow, now.tool, before, self._expected(now.stamp_ns))
        self.deviated = distance > MAX_DEVIATION
        if self.deviated:
            return
        self.paused = measured <= MIN_RATE
        if MIN_RATE < measured < math.inf:
            rate += SMOOTHING * (min(measured, MAX_RATE) - rate)
        self._anchor = now.stamp_ns, max(before, progress), rate  # at once: threads read it
        self.done = self.progress >= self._seconds[-1] - 1e-3

    def _expected(self, stamp_ns: int) -> float:
        """Return the expected time in the plan according to the clock, s."""
        stored_ns, progress, rate = self._anchor
        overdue = -self._wait(stamp_ns)
        if stored_ns < 0 or (progress == 0.0 and overdue <= 0.0):
            return max(0.0, overdue)
        return progress + rate * (stamp_ns - stored_ns) / NS_PER_S

    def _wait(self, stamp_ns: int) -> float:
        """Return the time (s) until the plan begins; infinite where it does with the tool."""
        wait = (self._stamp_ns - stamp_ns) / NS_PER_S if self._stamp_ns else math.inf
        is_soon = -MAX_WAIT - self._seconds[-1] <= wait <= MAX_WAIT
        return wait if is_soon else math.inf

    def is_driven(self, now: Prediction) -> bool:
        """Return whether the tool is on the plan, or will be soon."""
        return not (self.done or self.deviated or self.paused) and (
            self.progress > self._leaves
            or -MAX_DELAY - self._leaves <= self._wait(now.stamp_ns) < math.inf)

    def rest(self, now: Prediction, spacing: float = SPACING) -> ToolRows:
        """
        Return the tool as it is, then the rest of the plan, with stamps from now.

        A plan that has not begun and has no time to begin, begins now. The tool joins it at
        `JOIN_SPEED`, and drives it as fast as last; its points are thinned to a spacing (s).
        """
        _, progress, rate = self._anchor
        seconds, last, wait = self._seconds, len(self._seconds) - 1, 0.0
        if progress > 0.0:  # the last pose and this one need not be the same
            progress = min(self._expected(now.stamp_ns), float(seconds[last]))
        elif self._wait(now.stamp_ns) < math.inf:
            wait = max(0.0, self._wait(now.stamp_ns))
        nearest = self._rows[np.abs(seconds - progress).argmin()]
        join = min(MAX_JOIN_TIME, pose_distance(nearest, *now.tool[:2]) / JOIN_SPEED)
        start = progress + max(join, 1e-4 if wait == 0.0 else 0.0)
        first = min(int(np.searchsorted(seconds, start)), last)
        gap = max(seconds[last] - seconds[first], 1e-9) / max(1, last - first)
        chosen = np.append(np.arange(first, last, max(1, round(spacing / gap))), last)
        times = wait + np.maximum(seconds[chosen] - progress, 1e-4) / rate
        rows = self._rows[chosen] * np.repeat([1.0, rate], [7, 6])
        return ToolRows(
            np.append(0, np.rint(times * NS_PER_S).astype(np.int64)),
            np.vstack([np.concatenate(now.tool), rows]))
