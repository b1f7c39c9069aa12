"""
Error of a prediction due to its unknown initial state.

A package is started at rest, hanging from its tool. Where the tool moves then, or where its poses
are thrown about later as no arm moves, the prediction is wrong by an amount that dies away with
the package's modes. Until then it is said to settle, and its covariance shows by how much.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.live.samples import Unsettled
from bellows_ros.core.model.kernels import State
import numpy as np

SPAN_NS = 100_000_000
"""Time (ns) after a start, in two halves, in which the tool's motion becomes known."""

UNSEEN = 0.5, 1.0, 5.0, 25.0
"""What a tool may do before it is observed: m/s, rad/s, m/s^2, rad/s^2."""

SMALL, SMALL_TURN = 1e-3, 5e-3
"""Errors (m, rad) below this are negligible."""

SLOWEST_DECAY, SLOWEST_MODE = 0.1, 1.0
"""Smallest decay rate (1/s) and frequency (rad/s) assumed of any package."""


class Modes(NamedTuple):
    """How a package moves a little about its rest."""

    decay: float
    """Of the mode that dies away slowest, 1/s."""
    frequency: float
    """Of the slowest mode, rad/s."""
    compliance: tuple[float, float, float]
    """Shift (m) and turn (rad) by 1 m/s^2 of the tool, and turn by 1 rad/s^2 of it."""


def modes_of(system: Array) -> Modes:
    """Return the modes of the small motions with a system matrix (12, 12), without relaxation."""
    eigenvalues = np.linalg.eigvals(system)
    compliance = np.linalg.inv(system[6:, :6])
    by_shift, by_turn, turn_by_turn = (float(np.linalg.norm(part, 2)) for part in (
        compliance[:3, :3], compliance[3:, :3], compliance[3:, 3:]))
    return Modes(
        max(SLOWEST_DECAY, -float(eigenvalues.real.max())),
        max(SLOWEST_MODE, float(np.abs(eigenvalues).min())),
        (by_shift, by_turn, turn_by_turn))


class Settling:
    """
    Track the error of the state after a start or after doubtful poses.

    Attributes
    ----------
    now : Unsettled or None
        None where nothing of it is left.
    modes : Modes
        Of the package, to be set first; with those of another one a running decay keeps its end.

    """

    def __init__(self) -> None:
        """Know of no package."""
        self.modes: Modes
        self.forget()

    def forget(self) -> None:
        """Know of no package."""
        self.now: Unsettled | None = None
        self._seen: list[tuple[int, State]] = []  # after a start, until it shows how it moves
        self._until_ns = 0

    def begin(self, stamp_ns: int, tool: State) -> None:
        """Note a start at rest below a tool whose motion is not yet known."""
        self._seen = [(stamp_ns, tool)]
        self.now = self._left_by(stamp_ns, *UNSEEN)

    def inflate(self, stamp_ns: int, shift: float, turn: float) -> None:
        """Note that the tool was shifted (m) and turned (rad) as no arm moves."""
        before = self.now or Unsettled(stamp_ns, 0.0, 0.0, 0.0, 0.0)
        self.now = before._replace(
            since_ns=stamp_ns, shift=max(shift, before.shift), turn=max(turn, before.turn))
        self._seen = []
        self._until_ns = stamp_ns + self._duration_ns(self.now)

    def follow(self, stamp_ns: int, tool: State) -> Unsettled | None:
        """Return the remaining error at a sample of the tool."""
        if self.now is None:
            return None
        if self._seen:
            self._watch(stamp_ns, tool)
        elif stamp_ns >= self._until_ns:
            self.now = None
        return self.now

    def _watch(self, stamp_ns: int, tool: State) -> None:
        """Measure the tool's motion after a start, from three poses."""
        start_ns, start = self._seen[0]
        since_ns = stamp_ns - start_ns
        if len(self._seen) == 1:
            if 2 * since_ns >= SPAN_NS:
                self._seen.append((stamp_ns, tool))
        elif since_ns >= SPAN_NS:
            middle_ns, middle = self._seen[1]
            self._seen = []
            self.now = left = self._left_by(start_ns, *motion_through(
                start, middle, tool, (middle_ns - start_ns) * 1e-9, since_ns * 1e-9))
            self._until_ns = start_ns + self._duration_ns(left)

    def _left_by(
        self, stamp_ns: int, speed: float, rate: float, acceleration: float, turning: float
    ) -> Unsettled:
        """Return the error of assuming rest below a moving tool."""
        by_shift, by_turn, turn_by_turn = self.modes.compliance
        turn = by_turn * acceleration + turn_by_turn * turning
        return Unsettled(stamp_ns, by_shift * acceleration, turn, speed, rate)

    def _duration_ns(self, left: Unsettled) -> int:
        """Return how long (ns) it takes until an error counts no more."""
        swing = 1.0 / self.modes.frequency
        parts = (
            (left.shift + swing * left.speed) / SMALL,
            (left.turn + swing * left.rate) / SMALL_TURN,
        )
        return round(1e9 * math.log(max(1.0, *parts)) / self.modes.decay)


@kernel
def motion_through(
    start: State, middle: State, end: State, s: float, t: float
) -> tuple[float, float, float, float]:
    """
    Return speed (m/s), rate (rad/s) at the start, and accelerations (m/s^2, rad/s^2).

    Of quadratics through three poses, s and t seconds after the start.
    """
    back = t3.quaternion_conjugate(start[1])
    v, a = quadratic(
        t3.subtract(middle[0], start[0]), t3.subtract(end[0], start[0]), s, t)
    w, b = quadratic(
        t3.log_quaternion(t3.quaternion_product(back, middle[1])),
        t3.log_quaternion(t3.quaternion_product(back, end[1])), s, t)
    return (*t3.norms(v, w), *t3.norms(a, b))


@kernel
def quadratic(x: Vector, y: Vector, s: float, t: float) -> tuple[Vector, Vector]:
    """Return slope at 0 and second derivative of the quadratic from 0 through x at s, y at t."""
    half = t3.scale(1.0 / (t - s), t3.add_scaled(t3.scale(1.0 / t, y), -1.0 / s, x))
    return t3.add_scaled(t3.scale(1.0 / s, x), -s, half), t3.scale(2.0, half)
