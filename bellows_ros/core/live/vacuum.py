"""Readings of the vacuum: whether the cup holds, and which cups of a gripper do not."""

from __future__ import annotations

from collections.abc import Mapping
import math
import re
from typing import Any

ALL = -1
"""Stands for the cup, or for all cups of a gripper together."""

Reading = tuple[bool, int]
"""Whether a cup holds, and its index in cup.layout or `ALL`."""


class Vacuum:
    """
    Follow absolute pressures in the cup, or in single cups of a gripper.

    Attributes
    ----------
    values : mapping
        Parameters by name: vacuum.*, cup.layout.
    held : bool
        Whether the package is held; a gripper holds it while any of its cups does.
    pressure : float or None
        The newest, Pa; of single cups the highest of those that hold, None if none does.
    open_cups : tuple of int
        Cups of cup.layout without vacuum; as before where none holds.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Know of no sensor."""
        self.values, self.held = values, False
        self.open_cups: tuple[int, ...] = ()
        self.pressure: float | None = None
        self._pressures: dict[int, float] = {}  # by cup, of those that hold
        self._seen: set[int] = set()  # cups with a sensor

    def update(self, pressure: float, frame_id: str) -> tuple[Reading, ...] | str:
        """
        Take a pressure (Pa), and return who holds by it, or why it is refused.

        A frame_id that ends in cup_2 is of this one cup.
        """
        cups = len(self.values['cup.layout']) // 3
        of_cup = re.search(r'cup_(\d{1,3})$', frame_id) if cups > 1 else None
        cup = int(of_cup[1]) if of_cup else ALL
        if not math.isfinite(pressure):
            return 'nan'
        if pressure < 0.0:
            return 'negative'
        if cup >= cups > 1:
            return 'no_such_cup'
        was_held = self.held if cup == ALL else cup in self._pressures
        is_held = bool(pressure <= self.values['vacuum.detach_above'] if was_held
                       else pressure < self.values['vacuum.attach_below'])
        if cup == ALL:
            self.held, self.pressure = is_held, pressure
            return ((is_held, ALL),)
        self._seen.add(cup)
        self._pressures.pop(cup, None)
        if is_held:
            self._pressures[cup] = pressure
        self.held = bool(self._pressures)
        self.pressure = max(self._pressures.values(), default=None)
        if not self.held:  # the package is lost, which is more than its last cup
            return ((False, ALL),)
        self.open_cups = tuple(sorted(self._seen - set(self._pressures)))
        return (is_held, cup), (True, ALL)
