"""Identify the law of release from recorded drops and tosses."""

import math
import os
from typing import Any, NamedTuple

from bellows_ros.core.model import grip
from bellows_ros.core.model.cup_package import cup_of, model_tuple, package_of
from bellows_ros.core.parameters import checks, table
from bellows_ros.core.toss import landing, release_fit
from bellows_ros.core.toss.release import law_of, RELEASE_NAMES
from bellows_ros.errors import BellowsError, NoTopicError, UndeterminedError, UnexplainedError
from bellows_ros.files import bags, messages, results, Values
from bellows_ros.workflows.identify import resolved
from bellows_ros.workflows.recordings import load, no_progress, Progress, values_of_each
import numpy as np

RELEASE_UNITS = {name: table.PARAMETERS[name].unit for name in RELEASE_NAMES}


class ReleaseResult(NamedTuple):
    """
    The law of release from recordings of drops and tosses.

    Parameters
    ----------
    fit : ReleaseFit
        The law, and how it explains each drop.
    bags : tuple of str
        Of all recordings.
    used : tuple of str
        The recording of each drop.
    left_out : tuple of str
        The valve-offs that were not used, and why.
    values : mapping
        All parameters.

    """

    fit: release_fit.ReleaseFit
    bags: tuple[str, ...]
    used: tuple[str, ...]
    left_out: tuple[str, ...]
    values: Values

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        count, fixed, fit = len(self.left_out), self.fit.not_identifiable, self.fit
        numbers = (f'{RELEASE_NAMES[k]} ({fit.law[k]:.3g} +- {fit.std[k]:.2g} '
                   f'{RELEASE_UNITS[RELEASE_NAMES[k]]}'.rstrip() + ')' for k in fixed)
        return tuple(text for text, applies in (
            (f'Not identifiable from these drops, so the given or default value is used: '
             f'{", ".join(numbers)}. Tosses of other masses are less certain; drops of a '
             'package of half or twice the mass would determine more.', fixed),
            (f'{count} of {count + len(self.used)} valve-offs are not used: '
             f'{"; ".join(self.left_out)}.', count)) if applies)

    def masses(self) -> list[tuple[float, int, float, float, float]]:
        """Return mass (kg), drops, letting go (s; NaN if later), and rms (m, m/s)."""
        rows = []
        for mass in sorted({drop.mass for drop in self.fit.drops}):
            released, position, velocity = np.array([
                (drop.released, drop.position, drop.velocity)
                for drop in self.fit.drops if drop.mass == mass]).T
            observed = released[np.isfinite(released)]
            rows.append((
                mass, len(released), float(observed.mean()) if len(observed) else math.nan,
                *np.sqrt([np.mean(position**2), np.mean(velocity**2)]).tolist()))
        return rows

    def parameters(self) -> dict[str, Any]:
        """Return the parameters for the release file."""
        return release_fit.parameters_of(self.fit)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        fit = self.fit
        return results.with_units({
            'law': dict(zip(RELEASE_NAMES, fit.law, strict=True)),
            'standard_errors': {RELEASE_NAMES[k]: fit.std[k] for k in fit.free},
            'units': RELEASE_UNITS,
            'fitted': [RELEASE_NAMES[k] for k in fit.free],
            'not_identifiable': [RELEASE_NAMES[k] for k in fit.not_identifiable],
            'scatter': {RELEASE_NAMES[k]: fit.scatter[k] for k in fit.free},
            'chi2': fit.chi2,
            'lack_of_fit': fit.lack,
            'in_common': fit.common,
            'drops': [{'bag': bag, **drop._asdict()}
                      for bag, drop in zip(self.used, fit.drops, strict=True)],
            'left_out': self.left_out,
            'warnings': self.warnings,
            'settings': self.values})


def identify_release(settings: Values, progress: Progress = no_progress) -> ReleaseResult:
    """
    Identify the law of release from the drops in the recordings that `bags` names.

    Parameters
    ----------
    settings : mapping
        Parameters by name, with the cup, and the package of each recording.
    progress : callable
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, the drops are too few, or no law explains
        them.

    """
    values = resolved(settings)
    bags = tuple(os.fspath(bag) for bag in values['bags'])
    each = values_of_each(values)
    valves = [_valve_times(bag, parameters) for bag, parameters in zip(bags, each, strict=True)]
    drops, used, left_out = list[release_fit.Drop](), list[str](), list[str]()
    for number, (bag, parameters) in enumerate(zip(bags, each, strict=True)):
        progress(f'looking for drops in {bag}', 0.5 * number / len(bags))
        model = model_tuple(
            cup_of(parameters), package_of(parameters), parameters['gravity.magnitude'])
        usable, not_used = release_fit.drops_of(
            load(bag, parameters), model, grip.grip_of(parameters), valves[number])
        drops += usable
        used += [bag] * len(usable)
        left_out += [f'{bag}, {text}' for text in not_used]
    progress(f'fitting the law of release to {len(drops)} drops', 0.5)
    try:
        fit = release_fit.fit_release(drops, law_of(values), landing.as_law(np.array(
            [values[f'{name}_std'] for name in RELEASE_NAMES])))
    except UndeterminedError as error:
        raise type(error)(' '.join([str(error), *(f'Not used: {t}.' for t in left_out)])) from None
    progress('done', 1.0)
    result = ReleaseResult(fit, bags, tuple(used), tuple(left_out), values)
    try:
        checks.resolve({**values, **result.parameters()})
    except BellowsError as error:
        raise UnexplainedError(f'The best law of release is not allowed: {error}') from None
    return result


def _valve_times(bag: str, values: Values) -> list[int]:
    """Return when the valve is switched off, ns as received."""
    topic = values['topics.valve']
    switched = sorted(
        (log_ns, on) for _, log_ns, data in bags.messages_of(bag, (messages.BOOL,), topic)
        if (on := messages.decode_bool(data)) is not None) if topic else []
    if not switched:
        raise NoTopicError(
            f"'{bag}' has no std_msgs/Bool on '{topic}', so the times of the "
            'valve are unknown. Record it (false for off), or name its topic with topics.valve.')
    return [log_ns for k, (log_ns, on) in enumerate(switched)
            if not on and (not k or switched[k - 1][1])]
