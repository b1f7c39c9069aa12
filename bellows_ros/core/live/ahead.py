"""
Tracking of a plan while the tool drives it: the tool's place on the plan, and the rest of it.

Drivers start late and run scaled, so the plan is anchored to the tool: to the plan's nearest time
along its path, not to the clock. Pure code, no ROS.
"""

from __future__ import annotations

import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import as_inputs, kernel
from bellows_ros.core.geometry.tuples import (
    apply,
    apply_transposed,
    dot,
    log_quaternion,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    scale,
    subtract,
    Vector,
)
from bellows_ros.core.live.samples import Prediction
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import row_state, Rows, tool_rows, write_row
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

LEVER = 0.1
"""Distance (m) that counts as much as a rotation by 1 rad."""
WINDOW = 0.25
"""The tool is searched up to this far (s of the plan) ahead of its expected place."""
AT_ONCE = 2e-4
"""Places of the plan whose distances differ by less (m) are distinguished by the clock."""
OFF_THE_PLAN = 0.05
"""A tool farther than this (m) from the plan does not follow it."""

MOVING = 0.05
"""Fraction of the plan's highest speed above which the driver's speed can be measured."""
SLOWEST, QUICKEST = 0.1, 2.0
"""Range of the driver's speed relative to the plan; below it, the driver pauses."""

SMOOTHING = 0.8
"""Weight of the latest measured speed factor."""

JOIN_SPEED, LONGEST_JOIN = 0.05, 0.1
"""The tool returns to the plan at this speed (m/s), within this time (s)."""
SPACING = 0.01
"""Minimum spacing (s) of the points of the remaining plan."""


@kernel
def apart(row: Any, o: Vector, q: Quaternion) -> float:
    """Return how far (m) a tool is from a point of a plan, turns counted as by `LEVER`."""
    x, y, z = row[0] - o[0], row[1] - o[1], row[2] - o[2]
    same = abs(row[3] * q[0] + row[4] * q[1] + row[5] * q[2] + row[6] * q[3])
    turned = LEVER * LEVER * 4.0 * max(0.0, 2.0 - 2.0 * same)
    return math.sqrt(x * x + y * y + z * z + turned)


@kernel
def along(v: Vector, w: Vector, linear: Vector, angular: Vector) -> float:
    """Return the product of two twists, turns counted as by `LEVER`."""
    return dot(v, linear) + LEVER * LEVER * dot(w, angular)


@kernel
def locate(
    rows: Any, seconds: Any, reach: Any, slow: float, tool: State, progress: float, expected: float
) -> tuple[float, float, float]:
    """
    Return how far (m) a tool is from a plan, where on it (s), and at how many times its speed.

    It is sought from the progress on, and of places as near as each other where it is expected.
    The speed is negative where the plan is slow.
    """
    o, q, v, w = tool
    until = max(expected, progress) + WINDOW
    nearest, last = math.inf, len(seconds) - 1
    for i in range(len(seconds)):
        if progress - 1e-9 <= seconds[i] <= until:
            nearest = min(nearest, apart(rows[i], o, q))
    found, beside = last, math.inf
    for i in range(len(seconds)):
        if (progress - 1e-9 <= seconds[i] <= until and abs(seconds[i] - expected) < beside
                and apart(rows[i], o, q) <= nearest + AT_ONCE + reach[i]):
            found, beside = i, abs(seconds[i] - expected)
    point = row_state(rows[found])
    speed = along(point[2], point[3], point[2], point[3])
    if speed <= slow * slow:
        return nearest, seconds[found], -1.0
    R = rotation_matrix(point[1])
    turn = log_quaternion(quaternion_product(quaternion_conjugate(point[1]), q))
    way = along(apply_transposed(R, subtract(o, point[0])), turn, point[2], point[3])
    return (
        nearest, min(max(seconds[found] + way / speed, 0.0), seconds[last]),
        along(v, w, point[2], point[3]) / speed,
    )


@kernel
def left(
    rows: Any, seconds: Any, tool: State, progress: float, rate: float, wait: float,
    spacing: float, stamps_ns: Stamps, out: Array,
) -> int:
    """
    Write the tool as it is, then what is left of a plan from the progress (s) on.

    The plan starts after a wait (s) and is driven at so many times its speed; its points are
    thinned to a spacing (s). Return how many points that makes.
    """
    last, here = len(seconds) - 1, 0
    for i in range(len(seconds)):
        if abs(seconds[i] - progress) < abs(seconds[here] - progress):
            here = i
    join = min(LONGEST_JOIN, apart(rows[here], tool[0], tool[1]) / JOIN_SPEED)
    first, k = progress + max(join, 1e-4 if wait == 0.0 else 0.0), 0
    while k < last and seconds[k] < first:
        k += 1
    gap = max(seconds[last] - seconds[k], 1e-9) / max(1, last - k)
    stride, count = max(1, round(spacing / gap)), 1
    stamps_ns[0] = 0
    write_row(out[0], tool)
    while True:
        o, q, v, w = row_state(rows[k])
        stamps_ns[count] = round(
            (wait + max(seconds[k] - progress, 1e-4) / rate) * NS_PER_S)
        write_row(out[count], (o, q, scale(rate, v), scale(rate, w)))
        count += 1
        if k == last:
            return count
        k = min(k + stride, last)


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
            o, q, v, w = row_state(states[k])
            if in_world:
                R = rotation_matrix(q)
                v, w = apply(R, v), apply(R, w)
            times_ns[count] = times_ns[k]
            write_row(states[count], (o, q, v, w))
            count += 1
        before = slot
    return count


class Ahead:
    """
    A plan of the tool that is being driven, or will be.

    Parameters
    ----------
    plan : Trajectory or Rows
        Of E in the world with body twists.
    stamp_ns : int
        When it starts, ns; 0 for when the tool starts.

    Attributes
    ----------
    plan : Rows
    progress : float
        s of the plan.
    rate : float
        Its speed is so many times that of the plan.
    done, off : bool
        Whether the tool has arrived, and whether it is elsewhere.

    """

    def __init__(self, plan: Trajectory | Rows, stamp_ns: int) -> None:
        """Take the plan."""
        self._stamp_ns = stamp_ns
        self.plan = Rows(plan.stamps_ns, tool_rows(plan))
        self._seconds, self._rows = self.plan.seconds, self.plan.rows
        speed = np.linalg.norm(self._rows[:, 7:] * np.repeat([1.0, LEVER], 3), axis=1)
        gaps = np.diff(self._seconds)
        reach = 0.5 * speed * np.maximum(np.append(gaps, 0.0), np.append(0.0, gaps))
        self._inputs = as_inputs(self._rows, self._seconds, reach)
        self._slow = MOVING * float(speed.max())
        self.progress, self.rate = 0.0, 1.0
        self.done = self.off = False
        self._seen_ns = -1

    def follow(self, now: Prediction) -> None:
        """Find where on the plan the tool is, and how fast it is driven."""
        far, progress, rate = locate(
            *self._inputs, self._slow, now.tool, self.progress, self._expected(now.stamp_ns))
        self._seen_ns = now.stamp_ns
        self.off = far > OFF_THE_PLAN
        self.progress = max(self.progress, progress)
        self.done = self.progress >= self._seconds[-1] - 1e-3
        if rate > SLOWEST:  # else the driver pauses
            self.rate += SMOOTHING * (min(rate, QUICKEST) - self.rate)

    def _expected(self, stamp_ns: int) -> float:
        """Return the expected time in the plan according to the clock, s."""
        if self._seen_ns >= 0 and self.progress > 0.0:
            return self.progress + self.rate * (stamp_ns - self._seen_ns) / NS_PER_S
        return max(0.0, (stamp_ns - self._stamp_ns) / NS_PER_S) if self._stamp_ns else 0.0

    def rest(self, now: Prediction, spacing: float = SPACING) -> Rows:
        """Return the rest of the plan from the current tool pose, with stamps from now."""
        wait = 0.0
        if self.progress == 0.0 and self._stamp_ns > now.stamp_ns:
            wait = (self._stamp_ns - now.stamp_ns) / NS_PER_S
        stamps_ns = np.empty(len(self._rows) + 1, np.int64)
        rows = np.empty((len(stamps_ns), 13))
        count = left(*self._inputs[:2], now.tool, self.progress, self.rate, wait, spacing,
                     stamps_ns, rows)
        return Rows(stamps_ns[:count], rows[:count])
