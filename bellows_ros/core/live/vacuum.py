"""Detection of a held package from a vacuum signal."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.errors import BellowsError


class PressureSwitch:
    """
    A switch with hysteresis on the absolute pressure in the cup.

    Parameters
    ----------
    attach_below, detach_above : float
        Pa; between them nothing changes.

    """

    def __init__(self, attach_below: float, detach_above: float) -> None:
        """Take the thresholds."""
        self._attach_below = attach_below
        self._detach_above = detach_above

    def held(self, pressure: float, held: bool) -> bool:
        """Return whether the package is held, from a pressure (Pa) and the previous state."""
        if pressure < self._attach_below:
            return True
        return held and pressure <= self._detach_above


def why_no_pressure(pressure: float) -> str:
    """Return why a number is not an absolute pressure, or ''."""
    if not math.isfinite(pressure):
        return 'nan'
    return 'negative' if pressure < 0.0 else ''


def check_thresholds(values: Mapping[str, Any]) -> None:
    """Raise BellowsError where the pressure for attaching lies above that for detaching."""
    low, high = values['vacuum.attach_below'], values['vacuum.detach_above']
    if low > high:
        raise BellowsError(
            f'vacuum.attach_below is {low:g} Pa, above vacuum.detach_above, {high:g} Pa. The '
            'pressure falls when a package is picked up, so attach_below must be the lower one.'
        )
