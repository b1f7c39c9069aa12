"""Check of measured twists against the poses, in both choices of axes."""

from __future__ import annotations

from collections import deque
import math

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.model.kernels import State

PERIOD_NS = 20_000_000
"""Time (ns) between two comparisons."""

BACK = 2
"""So many poses lie behind the one whose slope is known well."""

MEMORY = 0.98
"""Forgetting factor: about 50 comparisons count, 1 s."""

ENOUGH = 20
"""Comparisons before the first verdict."""

MISFIT = 0.25
"""Twists are wrong if the poses leave this fraction of their mean square unexplained."""

LEVER = 0.1
"""Arm (m) by which rotations are weighed against translations."""

LEAST = 1e-3
"""Mean square speed (m^2/s^2) below which noise dominates and there is no verdict."""

LARGEST_JERK, SLACK = 5e3, 0.015
"""Largest jerk of an arm (m/s^3), and tolerance of a position beside it (m)."""

LARGEST_TURN_JERK, TURN_SLACK = 5e4, 0.15
"""The same for rotations (rad/s^3, rad)."""

DOUBTED_JERK, DOUBTED_TURN_JERK = 5e2, 5e3
"""Jerk (m/s^3, rad/s^3) above which twists are suspect."""


@kernel
def misfits(
    q: Quaternion, linear: Vector, angular: Vector, v: Vector, w: Vector
) -> tuple[float, float, float]:
    """
    Return the mean squares of the body twist (v, w) and of its residual.

    What is left with the measured twist (linear, angular) taken to be in world axes, and in tool
    axes; rotations count with the lever.
    """
    R = t3.rotation_matrix(q)
    weight = LEVER * LEVER
    dv = t3.subtract(t3.apply_transposed(R, linear), v)
    dw = t3.subtract(t3.apply_transposed(R, angular), w)
    ev, ew = t3.subtract(linear, v), t3.subtract(angular, w)
    return (
        t3.dot(v, v) + weight * t3.dot(w, w),
        t3.dot(dv, dv) + weight * t3.dot(dw, dw),
        t3.dot(ev, ev) + weight * t3.dot(ew, ew),
    )


class TwistCheck:
    """
    Compare measured twists with the slopes of the poses, now and then.

    Parameters
    ----------
    in_world : bool
        True where the twists are said to be in world axes, False in tool axes.

    """

    def __init__(self, in_world: bool) -> None:
        """Start without comparisons."""
        self._in_world = in_world
        self._recent: deque[tuple[int, Quaternion, Vector, Vector]] = deque(maxlen=BACK + 1)
        self.clear()

    def clear(self) -> None:
        """Forget all comparisons."""
        self._recent.clear()
        self._due_ns = -1
        self._count = 0
        self._energy = self._world = self._tool = 0.0

    def skip(self) -> None:
        """Note that a pose came without a measured twist."""
        self._recent.clear()

    def is_due(self, stamp_ns: int, q: Quaternion, linear: Vector, angular: Vector) -> bool:
        """Store a measured twist; return whether an earlier one is due for comparison."""
        self._recent.append((stamp_ns, q, linear, angular))
        return len(self._recent) > BACK and stamp_ns >= self._due_ns

    def compare(self, state: State) -> None:
        """Compare the twist of some poses before with the slope of the poses there."""
        stamp_ns, q, linear, angular = self._recent[0]
        self._due_ns = self._recent[-1][0] + PERIOD_NS
        energy, world, tool = misfits(q, linear, angular, state[2], state[3])
        self._energy = MEMORY * self._energy + energy
        self._world = MEMORY * self._world + world
        self._tool = MEMORY * self._tool + tool
        self._count += 1

    @property
    def verdict(self) -> str:
        """'unknown', 'fits', 'other_axes' or 'does_not_fit'."""
        weight = (1.0 - MEMORY ** self._count) / (1.0 - MEMORY)
        if self._count < ENOUGH or not LEAST * weight < self._energy < float('inf'):
            return 'unknown'
        ours, other = (self._world, self._tool) if self._in_world else (self._tool, self._world)
        if not ours > MISFIT * self._energy:
            return 'fits'
        return 'other_axes' if other < 0.25 * ours else 'does_not_fit'


@kernel
def misfit(
    before: State, now: State, seconds: float
) -> tuple[float, float, tuple[float, float]]:
    """
    Return how far a pose is from where the body twists at it and at the one before lead.

    As a part of what any arm does, as a part of what is not suspect, and as a shift (m) and turn
    (rad). The way between two poses differs from the mean of both velocities times the time by no
    more than the largest jerk makes of it, j t^3 / 12.
    """
    R_before, R_now = t3.rotation_matrix(before[1]), t3.rotation_matrix(now[1])
    mean = t3.scale(0.5, t3.add(t3.apply(R_before, before[2]), t3.apply(R_now, now[2])))
    off = t3.subtract(t3.subtract(now[0], before[0]), t3.scale(seconds, mean))
    turn = t3.log_quaternion(t3.quaternion_product(t3.quaternion_conjugate(before[1]), now[1]))
    turn_off = t3.subtract(turn, t3.scale(0.5 * seconds, t3.add(before[3], now[3])))
    shift, angle = math.sqrt(t3.dot(off, off)), math.sqrt(t3.dot(turn_off, turn_off))
    cubed = seconds * seconds * seconds / 12.0
    excess = max(
        shift / (SLACK + LARGEST_JERK * cubed), angle / (TURN_SLACK + LARGEST_TURN_JERK * cubed))
    suspicion = max(
        shift / (SLACK + DOUBTED_JERK * cubed), angle / (TURN_SLACK + DOUBTED_TURN_JERK * cubed))
    return excess, suspicion, (shift, angle)


@kernel
def measured(
    before: State, position: Vector, q: Quaternion, linear: Vector, angular: Vector,
    in_world: bool, seconds: float,
) -> tuple[State, float, float, tuple[float, float]]:
    """Return the tool with the measured twist, in tool axes, and its `misfit`."""
    v, w = linear, angular
    if in_world:
        R = t3.rotation_matrix(q)
        v, w = t3.apply_transposed(R, linear), t3.apply_transposed(R, angular)
    now = position, q, v, w
    excess, suspicion, off = misfit(before, now, seconds)
    return now, excess, suspicion, off
