"""Check parameter values together, by computing with them, and pressures against them."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.core.live.load import equivalent_box, Load
from bellows_ros.core.live.payload import prepared
from bellows_ros.core.live.samples import ORIGIN, Prediction, ZERO
from bellows_ros.core.live.uncertainty import Uncertainty
from bellows_ros.core.model.cup_package import cup_of, package_of
from bellows_ros.core.parameters.checks import ESTIMATE, gravity_of
from bellows_ros.errors import BellowsError
import numpy as np


def check_live(values: Mapping[str, Any]) -> None:
    """
    Refuse values with which the live predictor cannot compute, though each of them is allowed.

    Parameters
    ----------
    values : mapping
        All parameters by name, with the cup that is in use in cup.*.

    Raises
    ------
    BellowsError
        With what does not fit, or cannot be computed.

    """
    check_thresholds(values)
    if values['recording.package_world'] == ESTIMATE:
        raise BellowsError(
            f'recording.package_world: {ESTIMATE} is for recordings only. Give the node its '
            'seven numbers, from the file of bellows identify --out.'
        )
    model = prepared(cup_of(values), package_of(values), gravity_of(values)).model
    still = Prediction(1, *ORIGIN, ZERO, ZERO)
    load = Load(values, values['vacuum.ambient'])  # compiled even if no vacuum is known yet
    try:
        with np.errstate(all='ignore'):
            load.watch_force(model, still)
            load.watch_deflection(model, still)
            Uncertainty(model, values)
            equivalent_box(values)
    except (ArithmeticError, ValueError) as error:
        raise BellowsError(
            f'The prediction fails with these parameters ({error}). Check package.*, cup.*, '
            'envelope.* and their units.'
        ) from None


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
