"""Identify a valve from recordings of tosses: delay, tau, blow-off, and their scatter."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
import os
from typing import Any

from bellows_ros.core.model.cup_package import cup_of, model_tuple, package_of
from bellows_ros.core.model.grip import grip_of
from bellows_ros.core.toss.release_fit import (
    LettingGo,
    tosses_of,
    valve_fit,
    ValveFit,
)
from bellows_ros.errors import UndeterminedError
from bellows_ros.files.bags import messages_of
from bellows_ros.files.messages import BOOL, decode_bool
from bellows_ros.files.results import with_units
from bellows_ros.workflows.identify import resolved
from bellows_ros.workflows.recordings import load, Progress, values_of_each
import numpy as np

CHI2_WARNED = 2.0
"""Chi^2 per pose above which the model does not explain the poses."""

NO_VALVE = (
    'No valve was recorded on topics.valve: only the blow-off is identifiable, not delay and '
    'tau. Record the std_msgs/Bool that switches the valve.')
NO_GRIP = (
    'cup.lip_radius or vacuum.holding is not set: tau is not identifiable, and the delay is the '
    'whole time from the valve to the release.')


@dataclass(frozen=True, eq=False)
class ReleaseResult:
    """
    The estimates of valve and blow-off from recordings of tosses.

    Parameters
    ----------
    fit : ValveFit
        Delay, tau and impulse.
    bags : tuple of str
        Of all recordings.
    tosses : tuple of (str, LettingGo)
        Recording, and what was found, of each toss that was used.
    left_out : tuple of str
        Why others were not.
    values : mapping
        All parameters.

    """

    fit: ValveFit
    bags: tuple[str, ...]
    tosses: tuple[tuple[str, LettingGo], ...]
    left_out: tuple[str, ...]
    values: Mapping[str, Any]

    @property
    def speed(self) -> float:
        """Of the package that is let go fastest, m/s."""
        return max(toss.speed for _, toss in self.tosses)

    @property
    def chi2(self) -> float:
        """Mean over the tosses."""
        return float(np.mean([toss.chi2 for _, toss in self.tosses]))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        found = [f'Left out: {text}.' for text in self.left_out]
        if math.isnan(self.fit.delay):
            found.append(NO_VALVE)
        elif math.isnan(self.fit.tau):
            found.append(NO_GRIP)
        if self.chi2 > CHI2_WARNED:
            found.append(
                f'chi2 per pose is {self.chi2:.2g}, expected 1: cup, package or their frames do '
                'not explain the tosses. Check them with bellows replay.')
        return tuple(found)

    def parameters(self) -> dict[str, float]:
        """Return the identifiable parameters for the release file."""
        fit = self.fit
        found = {
            'release.delay': fit.delay,
            'release.delay_std': math.hypot(fit.delay_scatter, fit.delay_error),
            'release.tau': fit.tau, 'release.tau_std': fit.tau_error,
            'release.impulse': fit.impulse,
            'release.impulse_std': math.hypot(fit.impulse_scatter, fit.impulse_error),
        }
        return {name: value for name, value in found.items() if not math.isnan(value)}

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return with_units({
            **vars(self.fit),
            'units': {name: 'N s' if 'impulse' in name else 's' for name in vars(self.fit)},
            'largest_speed': {'value': self.speed, 'unit': 'm/s'},
            'chi2': self.chi2,
            'tosses': [{'bag': bag, **vars(toss)} for bag, toss in self.tosses],
            'left_out': self.left_out,
            'warnings': self.warnings,
            'settings': self.values,
        })


def identify_release(
    settings: Mapping[str, object],
    progress: Progress = lambda what, part: None,
) -> ReleaseResult:
    """
    Identify the valve from the tosses in the recordings that the parameter `bags` names.

    Parameters
    ----------
    settings : mapping
        Parameters by name; cup and package are known.
    progress : callable
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or the tosses are too few or too much alike.

    """
    values = resolved(settings)
    grip = grip_of(values)
    tosses, left_out = list[tuple[str, LettingGo]](), list[str]()
    bags = tuple(os.fspath(bag) for bag in values['bags'])
    for number, (bag, own) in enumerate(zip(bags, values_of_each(values), strict=True)):
        progress(f'looking for tosses in {bag}', number / len(bags))
        model = model_tuple(cup_of(own), package_of(own), own['gravity.magnitude'])
        found, not_used = tosses_of(load(bag, own), model, grip, _valves(bag, own))
        tosses += [(bag, toss) for toss in found]
        left_out += [f'{bag}, {text.rstrip(".")}' for text in not_used]
    progress('done', 1.0)
    try:
        fit = valve_fit([toss for _, toss in tosses], grip[0] if grip else 0.0)
    except UndeterminedError as error:
        reasons = (f'Left out: {text}.' for text in left_out)
        raise UndeterminedError(' '.join([str(error), *reasons])) from None
    return ReleaseResult(fit, bags, tuple(tosses), tuple(left_out), values)


def _valves(bag: str, values: Mapping[str, Any]) -> list[int] | None:
    """Return when the valve is switched off, ns as received; None without a recording of it."""
    if not values['topics.valve']:
        return None
    said = sorted(
        (log_ns, on) for _, _, log_ns, data in messages_of(bag, (BOOL,), values['topics.valve'])
        if (on := decode_bool(data)) is not None)
    if not said:
        return None
    return [log_ns for k, (log_ns, on) in enumerate(said) if not on and (not k or said[k - 1][1])]
