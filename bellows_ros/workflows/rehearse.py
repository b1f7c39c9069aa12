"""A rehearsal: the reader's own sensors and motion, simulated with cups near the given one."""

from collections import Counter
from collections.abc import Iterable, Mapping
import math
from pathlib import Path
import re
import tempfile
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import NOTE_TEXTS, parameter_units
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.conversion import one_cup_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
from bellows_ros.files import results
from bellows_ros.report.sentences import sentence
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.info import check_sentence, info
from bellows_ros.workflows.recordings import no_progress, Progress
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from scipy.stats import binom, norm

USUAL_MOTION: Mapping[str, Any] = {
    'kind': 'multi_sine', 'duration': 20.0, 'rest_duration': 2.0, 'ramp_duration': 1.0,
    'multi_sine': {
        'position': {
            'x': {'amplitude': [0.05, 0.01, 0.002], 'frequency': [0.31, 1.07, 2.63]},
            'y': {'amplitude': [0.05, 0.01, 0.002], 'frequency': [0.37, 1.19, 2.89]},
            'z': {'amplitude': [0.05, 0.012, 0.004], 'frequency': [0.29, 1.31, 4.97]}},
        'rotation': {
            'x': {'amplitude': [0.15, 0.05, 0.012], 'frequency': [0.41, 1.37, 3.37]},
            'y': {'amplitude': [0.15, 0.05, 0.012], 'frequency': [0.43, 1.49, 3.53]},
            'z': {'amplitude': [0.2, 0.15, 0.05], 'frequency': [0.33, 1.43, 3.29]}}},
    'tool': {'rate_hz': 500.0, 'noise': {'position': 2e-5, 'rotation': 5e-5}},
    'package': {'rate_hz': 120.0, 'noise': {'position': 2e-4, 'rotation': 1e-3}}}
"""Motion and sensors without a motion file: all axes for 20 s, a camera at 120 Hz."""

SPREAD = 0.3
"""Standard deviation of the logarithms of stiffness and damping of the drawn cups."""

SIGMAS = 2.0
"""Half width of the interval that should have the truth, in standard errors."""

MAX_RELATIVE_STD = 0.1
"""Largest relative standard error that needs no other motion."""

MAX_RATIO = 3.0
"""Largest ratio of an error to `MAX_RELATIVE_STD` that a longer recording removes: nine times."""

COUPLING = 'Coupling', 'move both axes at once, each at its own frequencies'
"""Remedy for a coupling, as the remedies of the axes in `NOTE_TEXTS`."""


NUMBERS = re.compile(r'[-+]?\d[\d.e+-]*')
"""Numbers in a sentence."""

RARE = 0.01
"""Probability below which too few intervals with the truth are no coincidence."""


class Number(NamedTuple):
    """
    A number of the cup.

    Parameters
    ----------
    name : str
        As 'K x'; two axes for a coupling.
    unit : str
        Unit of the number.
    expected, expected_std : float
        Medians over the runs of the true number and of its standard error.
    inside, runs : int
        Number of runs with the truth within two standard errors, and of all runs in which the
        number is identifiable.

    """

    name: str
    unit: str
    expected: float
    expected_std: float
    inside: int
    runs: int

    @property
    def error(self) -> float:
        """Return the relative standard error; infinite if the number is not identifiable."""
        return self.expected_std / abs(self.expected) if self.expected else 0.0

    @property
    def advice(self) -> tuple[str, ...]:
        """Return what to change, if the standard error is large or wrong."""
        found = []
        ratio = self.error / MAX_RELATIVE_STD
        if not ratio <= 1.0:
            code = ('weak' if ratio < MAX_RATIO else
                    'hidden' if math.isfinite(ratio) else 'unknown')
            how = NOTE_TEXTS['directions'].get(self.name[2:], COUPLING)[1]
            found.append(sentence(
                'rehearsal', code, name=self.name, error=self.error, most=MAX_RELATIVE_STD,
                how=how, times=ratio**2, noise=1.0 / ratio))
        if binom.cdf(self.inside, self.runs, norm.cdf(SIGMAS) - norm.cdf(-SIGMAS)) < RARE:
            found.append(sentence(
                'rehearsal', 'outside', name=self.name, inside=self.inside, runs=self.runs))
        return tuple(found)


class Rehearsal(NamedTuple):
    """
    The result of a rehearsal.

    Parameters
    ----------
    runs : int
        Number of simulated recordings.
    numbers : tuple of Number
        Numbers of the cup, of the runs that were identified.
    checks : mapping
        Failed checks of `info`, refusals and warnings of `identify` on the recording and the fit,
        with the number of runs in which they occur.
    refused : tuple of str
        Reasons of runs that were not identified.

    """

    runs: int
    numbers: tuple[Number, ...]
    checks: Mapping[str, int]
    refused: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether all runs were identified."""
        return not self.refused

    @property
    def advice(self) -> tuple[str, ...]:
        """Return what to change."""
        return tuple(text for each in self.numbers for text in each.advice)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return results.with_units({
            'runs': self.runs, 'numbers': [each._asdict() for each in self.numbers],
            'checks': [{'text': text, 'runs': count} for text, count in self.checks.items()],
            'refused': self.refused, 'advice': self.advice})


def rehearse(
    settings: Mapping[str, Any], motion: Mapping[str, Any] | None = None, runs: int = 5,
    progress: Progress = no_progress,
) -> Rehearsal:
    """
    Simulate recordings of cups near the given one, describe and identify each.

    Parameters
    ----------
    settings : mapping
        Parameters by name: cup and package, and settings of the identification.
    motion : mapping, optional
        Content of a motion file, with the sensors; default: `USUAL_MOTION`.
    runs : int
        Number of recordings.
    progress : callable
        Callback with the current step and its completed fraction (0 to 1).

    Raises
    ------
    BellowsError
        If a parameter or a setting is invalid, or the cup cannot hold the package.

    """
    if runs < 1:
        raise BellowsError(f'--runs must be at least 1, got {runs}.')
    values = resolve(settings, PACKAGE_PARAMETERS)
    found = list[tuple[Values, Identification]]()
    remarks, refused = list[str](), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        for run in range(runs):
            progress(f'run {run + 1} of {runs}', run / runs)
            bag = Path(folder) / f'run_{run + 1}'
            truth = drawn(values, run)
            simulate_recording(truth, {**(motion or USUAL_MOTION), 'seed': run}, bag)
            described = info(bag)
            remarks.extend(check_sentence(each) for each in described.checks if not each.passed)
            try:
                result = identify({**settings, **described.settings, 'bags': (str(bag),)})
            except BellowsError as error:
                refused.append(str(error).replace(str(bag), bag.name))
                continue
            found.append((truth, result))
            remarks.extend(text.replace(str(bag), 'the recording') for text in _remarks(result))
    progress('done', 1.0)
    return Rehearsal(runs, _numbers(found), counted(remarks), tuple(refused))


def _remarks(result: Identification) -> dict[str, None]:
    """Return the refusals and warnings on the recording and the fit, each once."""
    misfit = (result.fit.misfit,) if result.fit.misfit else ()
    return dict.fromkeys((
        *result.refusals, *result.fit.warnings, *misfit,
        *(text for part in result.parts for text in part.report['warnings'])))


def counted(texts: Iterable[str]) -> dict[str, int]:
    """Count sentences that differ in numbers alone; the first stands for all, frequent first."""
    first, counts = dict[str, str](), Counter[str]()
    for text in texts:
        counts[first.setdefault(NUMBERS.sub('#', text), text)] += 1
    return dict(counts.most_common())


def drawn(values: Values, seed: int) -> Values:
    """Return parameters with a random cup: D K D and E P E, with equal factors along x and y."""
    rng = np.random.default_rng(seed)
    changes = dict[str, tuple[float, ...]]()
    cup = one_cup_of(values)
    for name, matrix in (('stiffness', cup.stiffness), ('damping', cup.damping)):
        factor = np.exp(0.5 * SPREAD * rng.standard_normal(6))[[0, 0, 2, 3, 3, 5]]
        changes[f'cup.{name}'] = tuple((np.outer(factor, factor) * matrix).ravel().tolist())
    return values.replaced(changes)


def _numbers(found: list[tuple[Values, Identification]]) -> tuple[Number, ...]:
    """Return the numbers of the cup over all identified runs."""
    if not found:
        return ()
    structure: Structure = structure_named(found[0][1].fit.structure)
    alike = [(truth, each.fit) for truth, each in found if each.fit.structure == structure.name]
    fits, std, truths = (np.array(part) for part in zip(*[
        (fit.parameters, np.sqrt(np.diag(fit.covariance)), _truth(structure, truth))
        for truth, fit in alike], strict=True))
    known = np.isfinite(std)
    inside = np.sum(known & (np.abs(fits - truths) <= SIGMAS * std), axis=0)
    return tuple(
        Number(label, unit, float(np.median(truths[:, k])), float(np.median(std[:, k])),
               int(inside[k]), int(np.sum(known[:, k])))
        for k, (label, unit) in enumerate(zip(
            structure.labels, parameter_units(structure), strict=True)))


def _truth(structure: Structure, values: Values) -> Array:
    """Return the parameters (2 n,) of the true cup."""
    cup = one_cup_of(values)
    return structure.parameters(cup.stiffness, cup.damping)
