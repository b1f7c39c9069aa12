"""Intervals in which a support may carry a package, from the motion of the tool."""

from __future__ import annotations

import math

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.tuples import Vector, ZERO
from bellows_ros.core.model.kernels import State
from bellows_ros.core.signals.trajectory import NS_PER_S

NEAR = 1
"""A support may be near; 0 without."""

CONTACT = 2
"""A support carries the package."""

LIFT = 8e-3
"""Rise of the tool, beyond the sag of the cup, at which a package has left its support, m."""

ASIDE = 0.05
"""Horizontal distance at which a package has left its support, or its way, m."""

DESCENT = 0.03
"""Length of a straight descent after which an unknown support may be near, m."""

STRAIGHT = 0.3
"""Largest ratio of the horizontal part of a straight descent."""

FASTEST = 0.95
"""Fraction of the largest speed of a descent above which the tool does not yet stop."""

REMEMBERED_NS = 2_000_000_000
"""Age of the oldest support that is stored for late poses, ns."""


class Support:
    """
    Detect when a support may carry the package.

    A support carries the package from the grip until the tool has lifted it. It may be near at the
    height of the last grip, and from a straight descent until the tool rises again; from the stop
    of the tool on it carries the package. Without a grip the package is always held, and no
    support is near.
    """

    def __init__(self) -> None:
        self.use((0.0, 0.0, 1.0), 0.0)
        self._grip_height = -math.inf
        self._may_reach = self._is_gripping = False
        self._top: Vector | None = None
        self._begin: Vector = ZERO
        self._low = 0.0
        self._fastest, self._fastest_ns = 0.0, 0
        self._stop_height: float | None = None
        self._times: list[tuple[int, int, int]] = []  # first and last stamp, and kind, of each

    def use(self, up: Vector, sag: float) -> None:
        """Set the direction against gravity (unit vector) and the sag of the cup (m)."""
        self._up, self._lift = up, LIFT + sag

    def grip(self, height: float | None = None, stamp_ns: int = 0) -> None:
        """
        Let the next sample of the tool grip a package on a support.

        The height (m) is the height of the previous lift, if known. The newest support ends at the
        stamp (ns), with the release of its package.
        """
        if self.is_near:
            self._end(stamp_ns)
        self._top, self._may_reach = None, height is not None
        self._is_gripping = not self._may_reach
        if height is not None:
            self._grip_height = height

    @property
    def is_near(self) -> bool:
        """Whether a support may carry the package at the newest sample."""
        return bool(self._times) and self._times[-1][1] == 0

    def at(self, stamp_ns: int) -> int:
        """Return `NEAR` or `CONTACT` at a stamp, 0 without a support."""
        return max((kind for first, last, kind in self._times
                    if first <= stamp_ns and (last == 0 or stamp_ns <= last)), default=0)

    def _end(self, stamp_ns: int) -> None:
        self._times = [(first, last or stamp_ns, kind) for first, last, kind in self._times]
        self._stop_height = None

    def _height(self, position: Vector) -> float:
        return t3.dot(self._up, position)

    def _aside(self, position: Vector, since: Vector) -> float:
        way = t3.subtract(position, since)
        return t3.norm(t3.add_scaled(way, -t3.dot(self._up, way), self._up))

    def is_below_way(self, place: Vector, position: Vector) -> bool:
        """Return whether a place is below the straight way to a position since the support."""
        if not self._times:
            return False
        way = t3.subtract(position, self._begin)
        way = t3.add_scaled(way, -t3.dot(self._up, way), self._up)
        share = t3.dot(way, t3.subtract(place, self._begin)) / max(t3.dot(way, way), 1e-12)
        nearest = t3.add_scaled(self._begin, min(max(share, 0.0), 1.0), way)
        return self._height(place) < self._height(position) - ASIDE and self._aside(
            place, nearest) < ASIDE

    def _way_to_stop(self, stamp_ns: int, tool: State) -> float:
        """Return the distance (m) to the stop of a descent, once it slows down."""
        down = -t3.dot(self._up, t3.apply(t3.rotation_matrix(tool[1]), tool[2]))
        if down >= FASTEST * self._fastest:
            self._fastest, self._fastest_ns = max(down, self._fastest), stamp_ns
            return math.inf
        seconds = (stamp_ns - self._fastest_ns) / NS_PER_S
        return 0.5 * max(down, 0.0)**2 * seconds / (self._fastest - down)

    def follow(self, stamp_ns: int, tool: State) -> str:
        """Process a sample of the tool; return whether a package 'leaves' or 'meets' a support."""
        position = tool[0]
        height = self._height(position)
        if self._grip_height == -math.inf and not self._is_gripping:
            return ''
        if self.is_near:
            way = self._way_to_stop(stamp_ns, tool)
            self._low = min(self._low, height)
            rises = height > self._low + self._lift or self._aside(position, self._begin) > ASIDE
            if rises:
                self._top = position
            if rises or (self._stop_height is not None
                         and height < self._stop_height - self._lift):
                self._end(stamp_ns)
                return 'leaves'
            if self._times[-1][2] == NEAR and self._stop_height is None and way < self._lift:
                self._stop_height = height - way
                self._times.append((stamp_ns, 0, CONTACT))
                return 'meets'
            return ''
        self._may_reach |= height > self._grip_height + 2.0 * self._lift
        top = position if self._top is None else self._top
        drop = self._height(top) - height
        if drop <= 0.0 or self._aside(position, top) > STRAIGHT * drop + 1e-3:
            top, drop, self._fastest = position, 0.0, 0.0
        else:
            self._way_to_stop(stamp_ns, tool)
        self._top = top
        is_low = self._may_reach and height < self._grip_height + self._lift
        if not (self._is_gripping or is_low or drop > DESCENT):
            return ''
        kind = CONTACT if self._is_gripping else NEAR
        if self._is_gripping:
            self._grip_height, self._may_reach = height, False
        self._is_gripping, self._begin, self._low = False, position, height
        self._times = [each for each in self._times if each[1] > stamp_ns - REMEMBERED_NS]
        self._times.append((stamp_ns, 0, kind))
        return ''
