"""
States of the package in a pick-and-place cycle, from valve, vacuum and camera.

A package is `NONE`, `GRIPPED` on a support, `HELD`, `RELEASED` or `LOST`. Loss and release differ
by the valve: vacuum that ends with the valve on is a loss. Without a valve signal, the tool's
motion decides, and at rest the camera, if the package is visible.
"""

from collections.abc import Iterator, Sequence

from bellows_ros.core.geometry.arrays import Array, Stamps
import numpy as np

NONE, GRIPPED, HELD, RELEASED, LOST = 'none', 'gripped', 'held', 'released', 'lost'

ON_CUP = GRIPPED, HELD
"""States with the package on the cup."""

LIFT = 0.01
"""Rise of the tool above the grip at which any package has left its support, m."""

FALL_NS = 100_000_000
"""Duration of a fall (49 mm) that every camera distinguishes from rest, ns."""


class Cycle:
    """
    State of the package.

    Parameters
    ----------
    is_held : bool
        Whether the cup holds a package initially.

    Attributes
    ----------
    state : str
        One of the module's constants.
    valve, vacuum : bool or None
        Last readings: valve on, vacuum in the cup; None before the first.
    lowest : float
        Height of the tool at the last grip, m.
    follows : bool
        Whether the state depends on the tool's motion, after the first grip or vacuum.

    """

    def __init__(self, is_held: bool) -> None:
        self.state = HELD if is_held else NONE
        self.follows = False
        self.valve: bool | None = None
        self.vacuum: bool | None = None
        self.lowest = self._due_ns = 0.0

    def grip(self) -> None:
        """Set the state of a newly gripped package."""
        self.state, self.lowest, self._due_ns = GRIPPED, float('inf'), 0.0
        self.follows = True

    def end(self, state: str) -> None:
        """Set a final state (released or lost), if the cup has a package."""
        if self.state in ON_CUP:
            self.state, self._due_ns = state, 0.0

    def on_valve(self, on: bool) -> None:
        """Update the state by a reading of the valve: on grips, off releases."""
        before, self.valve = self.valve, on
        if on == before:
            return
        if not on:
            self.end(RELEASED)
        elif self.state not in ON_CUP and self.vacuum is not False:
            self.grip()

    def on_vacuum(self, is_held: bool, stamp_ns: int, moves: bool, patience_ns: int) -> None:
        """
        Grip, release or lose the package by a reading of the vacuum.

        Parameters
        ----------
        is_held : bool
            Whether the vacuum holds.
        stamp_ns : int
            Time of the reading on the clock of the tool's poses, ns.
        moves : bool
            Whether the tool moves.
        patience_ns : int
            Time until the camera would have seen a fall, ns; 0 without a camera.

        """
        before, self.vacuum, self.follows = self.vacuum, is_held, True
        if is_held == before:
            return
        if is_held:
            self._due_ns = 0.0
            if self.state not in ON_CUP:
                self.grip()
        elif before is None:
            self.end(NONE)
        elif self.valve or moves:
            self.end(LOST)
        elif patience_ns and self.state == HELD:
            self._due_ns = stamp_ns + patience_ns
        else:
            self.end(RELEASED)

    def on_height(self, height: float) -> None:
        """Detect a lift from the height (m) of the tool, against gravity."""
        if self.state == GRIPPED:
            self.lowest = min(self.lowest, height)
            if height - self.lowest > LIFT:
                self.state = HELD

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether a package without vacuum must now be judged as released or lost."""
        return 0.0 < self._due_ns <= stamp_ns

    def decide(self, departs: bool) -> None:
        """Set a package without vacuum to released, or to lost if measured poses show a fall."""
        self.end(LOST if departs else RELEASED)


Signal = tuple[int, str, bool, int]
"""A signal: stamp (ns), 'vacuum' or 'valve', whether on, and index of the cup (-1 for all
cups)."""


def holds(stamps_ns: Stamps, heights: Array, signals: Sequence[Signal]) -> Iterator[
        tuple[int, int]]:
    """
    Yield the first and last stamp (ns) of each hold in a recording, without contact.

    A hold begins when the tool is `LIFT` above the grip, and ends when it is `LIFT` above the
    release.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
        Stamps of the tool's poses.
    heights : ndarray (N,)
        Heights of the tool against gravity, m.
    signals : sequence of Signal
        Signals in the order of time.

    """
    cycle, waiting, begun = Cycle(False), list(signals[::-1]), -1
    for k, (stamp_ns, height) in enumerate(zip(stamps_ns.tolist(), heights.tolist(), strict=True)):
        while waiting and waiting[-1][0] <= stamp_ns:
            signal_ns, name, is_on, cup = waiting.pop()
            if name == 'valve':
                cycle.on_valve(is_on)
            elif cup < 0:
                cycle.on_vacuum(is_on, signal_ns, False, 0)
        cycle.on_height(height)
        is_held = cycle.state == HELD
        begun = k if is_held and begun < 0 else begun
        if begun >= 0 and (not is_held or k == len(heights) - 1):
            above = np.flatnonzero(heights[begun:k] > height + LIFT)
            last = k if is_held or not len(above) else begun + above[-1]
            yield int(stamps_ns[begun]), int(stamps_ns[last])
            begun = -1
