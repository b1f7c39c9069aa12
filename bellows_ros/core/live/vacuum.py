"""Detection of a held package from a vacuum signal."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.errors import BellowsError


def is_held(pressure: float, was_held: bool, values: Mapping[str, Any]) -> bool:
    """Return whether the package is held, by absolute pressure (Pa), with hysteresis."""
    if was_held:
        return bool(pressure <= values['vacuum.detach_above'])
    return bool(pressure < values['vacuum.attach_below'])


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
