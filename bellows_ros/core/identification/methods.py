"""The fit of a cup to recordings, by the method in `fit.method`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import math
from operator import getitem

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.identification import least_squares
from bellows_ros.core.identification.causes import MARKERS
from bellows_ros.core.identification.output_error import output_error
from bellows_ros.core.identification.pool import Held, here
from bellows_ros.core.identification.quantities import given_std, weak_prior
from bellows_ros.core.identification.result import Fit, Freed, Iteration
from bellows_ros.core.identification.samples import (
    AnyRecording,
    reduced,
    samples_of,
    whole_recordings,
)
from bellows_ros.core.identification.segments import measured_segments, Segments, segments_of
from bellows_ros.core.model.cup_package import Cup, varied
from bellows_ros.core.model.structure import AUTO
from bellows_ros.core.parameters.conversion import (
    given_structure,
    one_cup_of,
    package_of,
    richest_structure,
)
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import LOW_RATE_HZ, Recording, TimeOffset
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.errors import BellowsError
import numpy as np

Progress = Callable[[str, float], None]

TYPICAL_STEPS = 12
"""Typical number of steps of a fit by simulation."""

MAX_DAMPING_STD = 0.25
"""Largest relative standard error of the most certain damping of a moving cup."""

UNLOADED_PARAMETER = 'K rz'
"""The stiffness that no weight loads: it also shows that the cup moves."""

MAX_MISFIT_TO_NOISE = 2.0
"""Largest ratio of misfit and noise for output error, in residuals and standstills."""

Pair = tuple[Segments, least_squares.Statistics]
"""The segments of a recording, empty for least squares, and its statistics."""


def pair_of(recording: Recording, values: Values, number: int = 0) -> Pair:
    """Return the parts of a recording for a fit."""
    is_simulated, structure = values.fit.method == 'output_error', given_structure(values)
    return (
        segments_of(measured_segments(recording, number)) if is_simulated else (),
        recording.cached(('statistics', values.cup.length, structure), partial(
            least_squares.statistics, samples_of(recording), values.cup.length, structure,
            recording.noise)))


def fit(
    recordings: Sequence[AnyRecording],
    values: Values,
    progress: Progress | None = None,
    standstills: Sequence[Standstill] = (),
    pairs: Held | None = None,
) -> Fit:
    """
    Fit a cup to recordings, as the parameters specify.

    Results that do not depend on the parameters are cached with the recordings, for later calls
    with other parameters.

    Parameters
    ----------
    recordings : sequence of Recording or ReducedRecording
        Recordings of one cup.
    values : mapping
        Parameters by name: fit.*, cup.*, gravity.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    standstills : sequence of Standstill
        Standstills of the cup, whose balance is part of a fit by output error.
    pairs : Held, optional
        Pairs of `pair_of`, necessary for reduced recordings.

    Raises
    ------
    BellowsError
        If the recordings do not determine the cup.

    """
    result = fitted(recordings, values, progress, pairs, standstills=standstills)
    _require_motion(result)
    if 'time_offset' in values.fit.free:
        result = _with_offsets(result, [
            reduced(recording, values.cup.length).time_offset for recording in recordings])
    if result.standstills and result.standstills[1] > MAX_MISFIT_TO_NOISE**2:
        result = replace(result, notes=(
            *result.notes, Finding('disagreement', Level.WARN, {'chi2': result.standstills[1]})))
    return result


def _require_motion(result: Fit) -> None:
    """Raise if the recordings determine not all free quantities, or no entry of P."""
    unknown = [freed.name for freed in result.freed if not np.all(np.isfinite(freed.std))]
    if result.converged and unknown:
        raise BellowsError(
            f'fit.free: {", ".join(unknown)} cannot be estimated from these recordings; the '
            'standard errors are too large. Leave out what you know best (mass and inertia are '
            'never identifiable together, nor com and cup.length along z with poses of the '
            'centre of mass), or record a richer motion.')
    largest = MAX_DAMPING_STD if result.method == 'output_error' else math.inf
    explained = max(result.chi2 or 0.0, result.robust_chi2 or 0.0) <= (
        MAX_MISFIT_TO_NOISE**2) and not any(
        cause.certain for cause in result.causes)  # otherwise errors of the misfit
    certain = [label for label, value, std in zip(
        result.labels, result.parameters, np.sqrt(np.diag(result.covariance)), strict=True)
        if std < np.inf and std <= largest * abs(value)]
    if result.converged and explained and not any(
            label[0] == 'P' or label == UNLOADED_PARAMETER for label in certain):
        raise BellowsError(
            'The recordings contain too little motion: damping is not identifiable from them, '
            f'nor {UNLOADED_PARAMETER}, which no weight loads. Move the tool in all directions at '
            '1-3 Hz, and along the cup at 4-6 Hz; standstills are for static.bags.')


def _report(progress: Progress, iteration: Iteration) -> None:
    step = iteration.number + 1
    K, P = (' '.join(f'{x:.3g}' for x in np.diag(matrix))
            for matrix in (iteration.stiffness, iteration.damping))
    progress(f'step {step}: chi^2 {iteration.chi2:.4g}; K {K}, P {P}',
             step / (step + TYPICAL_STEPS))


def fitted(
    recordings: Sequence[AnyRecording], values: Values, progress: Progress | None = None,
    pairs: Held | None = None, exactly: bool = False, standstills: Sequence[Standstill] = (),
) -> Fit:
    """
    Return the fit to recordings.

    A fit by simulation estimates all uncertain quantities jointly with K and P, or takes given
    quantities as exact, so that the causes of a misfit are found.
    """
    if pairs is None:
        pairs = here([
            pair_of(each, values, n) for n, each in enumerate(whole_recordings(recordings))])
    structure, statistics = given_structure(values), pairs.pool.results(getitem, pairs, 1)
    if values.fit.method == 'least_squares':
        return least_squares.least_squares(statistics)
    start = given = replace(one_cup_of(values), relaxation=(0.0, 0.0), stretch=(0.0, 0.0))
    parts = [reduced(recording, values.cup.length) for recording in recordings]
    if all(part.rate_hz >= LOW_RATE_HZ for part in parts):
        start = start_cup(statistics, start)
    named = tuple(dict.fromkeys([
        *values.fit.free, *['package_world'] * any(part.package_world for part in parts)]))
    return output_error(
        pairs.pool.keep(getitem, pairs, 0), structure, start,
        progress and partial(_report, progress), weak_prior(named), named, values.fit.relaxation,
        {} if exactly else given_std(values), given,
        richest_structure(values) if values.fit.structure == AUTO else None,
        'off' if structure.places else values.fit.stretch,
        MARKERS if values.recording.marker == 'shared' else (), standstills)


def _with_offsets(result: Fit, offsets: Sequence[TimeOffset | None]) -> Fit:
    """Return a fit with total time offsets: subtracted before, plus estimated by the fit."""
    removed = [offset or TimeOffset(0.0, math.inf) for offset in offsets]
    if not result.delays:
        values, errors = zip(*removed, strict=True)
        return replace(result, delays=values, delays_std=errors)
    return replace(result, delays=tuple(
        delay + offset.value for delay, offset in zip(result.delays, removed, strict=True)))


def with_freed(values: Values, freed: Sequence[Freed]) -> Values:
    """Return parameters with the estimates of fit.free."""
    change = {quantity.name: quantity.change for quantity in freed}
    result = values.replaced({'cup.length': values.cup.length + sum(change.pop('length', ()))})
    if change:
        package = varied(package_of(values), **change)
        entries = package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        result = result.replaced({
            'package.mass': package.mass, 'package.com': tuple(package.com.tolist()),
            'package.inertia': tuple(entries.tolist())})
    return result


def start_cup(parts: Sequence[least_squares.Statistics], given: Cup) -> Cup:
    """
    Return the initial cup of output error, by least squares of few parameters.

    Unidentifiable or negative entries are taken from the given cup.
    """
    result = least_squares.least_squares(parts)
    stiffness, damping = (
        np.where(np.isfinite(error) & (value >= 0.0), value, instead)
        for value, error, instead in (
            (result.stiffness, result.stiffness_std, given.stiffness),
            (result.damping, result.damping_std, given.damping)))
    return replace(given, stiffness=stiffness, damping=damping)
