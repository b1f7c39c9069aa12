"""
The fit of a cup to recordings by the method in `fit.method`, with its uncertainty.

Output error is a fit by simulation.

From the minimum on, given quantities are estimated jointly with K and P, with their standard
deviations as priors. Their errors are part of the covariance: mass, inertia, K and P scaled by one
factor give equal motion, so that K is as uncertain as the mass.

Two clocks, two worlds and a marker anywhere on the package are also estimated, from one recording.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from typing import NamedTuple

from bellows_ros.core import Progress
from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Mask, Places
from bellows_ros.core.identification.causes import causes_of
from bellows_ros.core.identification.estimate import (
    approach,
    GROSS_CHI2,
    MAX_NOISE_CHI2,
    MAX_STEPS,
    minimise,
    no_report,
    Parts,
    Report,
    settled,
    Solution,
)
from bellows_ros.core.identification.least_squares import (
    least_squares,
    samples_of,
    Statistics,
    statistics,
)
from bellows_ros.core.identification.result import (
    CHANCE,
    FALSE_ALARMS,
    Fit,
    inverted,
    MAJORITY,
    MAX_RELATIVE_ERROR,
    NO_LAW,
    not_identifiable,
    with_unidentifiable,
)
from bellows_ros.core.identification.segments import (
    AnyRecording,
    Held,
    here,
    reduced,
    Segment,
    Segments,
    segments_of,
    whole_recordings,
)
from bellows_ros.core.identification.unknowns import (
    Free,
    given_std,
    KINDS,
    MARKERS,
    NOTHING,
    Problem,
    RATIO_STD,
    weak_prior,
)
from bellows_ros.core.model.cup_package import Cup, LAW
from bellows_ros.core.model.structure import AUTO, has_coupling, require_stretch, Structure
from bellows_ros.core.parameters.conversion import given_structure, one_cup_of, richest_structure
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError, UndeterminedError
import numpy as np
from scipy.special import chdtri

MAX_NOISY_ERROR = 0.06
"""
Fraction of its limit up to which K is known without its damping.

With unknown damping, noise looks like the resonance of an axis that hardly moves: in 4 of 176 weak
recordings K x or K rz was off by 6 to 1700 standard errors, each above 9 %; in 2 of 47 of a
population K z was off by 77 and 3.6, of 3.6 and 4.1 %. In a gripper the other cups damp each axis.
"""

MIN_SQUARED_DISTANCE = float(chdtri(2, FALSE_ALARMS))
"""Smallest squared Mahalanobis distance of two significant parameters from zero."""

MIN_MASS_RATIO = 1.3
"""Smallest ratio of two masses that separate bending from its stiffening by stretch."""

MAX_MISFIT_SHARE = 0.25
"""
Largest share of the misfit (chi² beyond noise) that a fit with stretch may leave, for one mass.

Stretch must also reduce the chi² by three of its standard deviations. For bellows by finite
elements, identified with 1.8 kg in tilts up to 15 degrees, both hold, and a swing of 1 kg is
predicted to 7 %; with tilts up to 20 degrees half of the misfit remains, and the error is 28 %.
"""

COMMON_WEIGHT = 10.0
"""Weight of the scatter common to all parameters, in segments of the recordings."""

HELD_OUT = 5
"""Number of seconds of a recording per held-out second."""

MAX_LEVERAGE = 0.999
"""Largest leverage of one second in the jackknife."""


OFF = dict.fromkeys(LAW, 'off')
"""No fitted terms of the law."""


def output_error(
    measured: Held | Sequence[Segment],
    structure: Structure,
    start: Cup,
    progress: Report = no_report,
    free: Free = NOTHING,
    named: Sequence[str] = (),
    law: Mapping[str, str] = OFF,
    given: Free = NOTHING,
    richer: Structure | None = None,
    common: tuple[str, ...] = (),
) -> Fit:
    """
    Fit K and P so that the model, driven by the measured tool, reproduces the package's poses.

    Parameters
    ----------
    measured : Held or sequence of Segment
        Parts of recordings of one cup: `Segments` where they are, or in this process.
    structure : Structure
        Structure of K and P: their free entries.
    start : Cup
        Initial guess, definite, with the cup length l0.
    progress : callable, optional
        Callback with the cup and chi^2 per residual after every step.
    free : mapping, optional
        Standard deviations, SI units, of quantities of `KINDS` without a given value.
    named : sequence of str
        Names of the free quantities that are results.
    law : mapping
        Whether the numbers of each term of `LAW` are free: 'off'; 'auto' if significant; 'on' with
        an error if insignificant.
    given : mapping, optional
        Standard deviations of given quantities, the priors with which they are free.
    richer : Structure, optional
        Structure that replaces the first one if its couplings are significant.
    common : tuple of str, optional
        Names of quantities that all recordings share instead of having their own.

    Raises
    ------
    UndeterminedError
        If a term of the law is 'on' and is not significant.

    """
    problem = Problem.of(measured, structure, start, free, common=common)
    given = {name: std for name, std in given.items() if problem.is_slow or name != 'exposure'}
    problem = replace(problem, free={**given, **free})
    found = minimise(problem, progress)
    for extension in _extensions(richer, law):
        wider = _tried(found, extension, progress)
        if wider is None and extension.refusal:
            raise UndeterminedError(extension.refusal)
        found = wider or found
    return _fit(found, named, given)


class Extension(NamedTuple):
    """
    An extension of the spring by free quantities or by a structure.

    The condition on the solutions with and without it must hold; the note is the error of a
    requested extension that is not significant.
    """

    free: Free
    structure: Structure | None
    holds: Callable[[Solution, Solution], bool]
    refusal: str = ''


def _extensions(richer: Structure | None, law: Mapping[str, str]) -> Iterator[Extension]:
    """Yield the extensions to be tested; those that are 'on' need not extrapolate."""
    if law['relaxation'] != 'off':
        yield Extension(weak_prior(['relaxation']), None, _explains_most, (
            'fit.relaxation: the recordings show no relaxation that exceeds its standard error. '
            'Hold a tilt for 5 to 10 s beside the motion, or set fit.relaxation: auto.')
            if law['relaxation'] == 'on' else '')
    if richer is not None:
        yield Extension({}, richer, lambda end, _: has_coupling(end.cup.stiffness))
    if law['stretch'] != 'off':
        yield Extension(weak_prior(['stretch']), None, *(
            (_is_passive, 'fit.stretch: the recordings show no stretch that exceeds its standard '
             'error. Record two masses that differ by a factor of two, or set fit.stretch: auto.')
            if law['stretch'] == 'on' else (_extrapolates,)))


def _tried(found: Solution, extension: Extension, report: Report) -> Solution | None:
    """
    Return the solution with an extension of the spring if significant.

    The covariance is from a jackknife, so that held-out motion confirms the extension.
    """
    more, structure, holds, _ = extension

    def place(wide: Problem) -> Places:
        couplings = structure.couplings if structure else []
        return np.asarray([*couplings, *(row for name in more for row in wide.places[name][0])])

    if found.is_plausible:
        near = found.freed(more, structure)
        H, g = near.information, near.slope
        rest = ~np.isin(np.arange(len(g)), place(near.problem))
        if H.fall(g, rest | True) - H.fall(g, rest) <= MIN_SQUARED_DISTANCE:
            return None
    elif 'relaxation' in more:  # without which the search went astray
        near = approach(found.problem.freed(found.problem.start, more, structure), report)
    else:
        return None
    end = settled(near, report)
    if end.converged and end.misfit < found.misfit and holds(end, found):
        x, tested = end.problem.reported(end.theta), place(end.problem)
        C = covariance_of(end)[0][np.ix_(tested, tested)]
        if float(x[tested] @ np.linalg.solve(C, x[tested])) > MIN_SQUARED_DISTANCE:
            return end
    return None


def _is_passive(found: Solution, _: Solution) -> bool:
    """Return whether the energy is positive definite in the usual range of stretch."""
    try:
        a, b = found.problem.extended('stretch', found.theta).tolist()
        require_stretch(found.cup.stiffness, (a, b))
    except BellowsError:
        return False
    return True


def _extrapolates(end: Solution, without: Solution) -> bool:
    """Return whether two masses determine the stretch, or stretch explains most of the misfit."""
    masses = [outline.payload.mass for outline in end.problem.outlines]
    excess, before = (each.chi2 - 1.0 for each in (end, without))
    chance = CHANCE * (2.0 / end.total.number) ** 0.5
    return _is_passive(end, without) and (max(masses) >= MIN_MASS_RATIO * min(masses) or (
        chance < before - excess and excess <= MAX_MISFIT_SHARE * before + chance))


def _explains_most(end: Solution, without: Solution) -> bool:
    """
    Return whether relaxation explains most of the misfit.

    Two time constants leave 39 % of the misfit of rubber with a loss factor of 0.1, without which
    the search does not converge.
    """
    return end.chi2 - MAX_NOISE_CHI2 <= max(MAJORITY * (without.chi2 - MAX_NOISE_CHI2), 0.0)


def _of_given(found: Solution, given: Free) -> Array:
    """Return the covariance (s, s), SI units, by the priors of freed given quantities."""
    problem, H = found.problem, found.information
    weights = np.zeros(len(found.theta))
    for name in given.keys() & problem.places.keys():
        if np.array_equal(given[name], problem.free[name]):
            weights[problem.places[name]] = problem.weights[problem.places[name]]
    C = problem.slopes(found.theta) @ H.covariance
    moved = H.carried @ C.T
    return np.asarray(C @ (weights[:C.shape[1], None] * C.T) + np.einsum(
        'ros,ro,rot->st', moved, weights[problem.own], moved))


def covariance_of(found: Solution) -> tuple[Array, Array]:
    """
    Return the covariance (s, s) of the shared numbers, and variances (m,) of all, SI units.

    The covariance is from a jackknife over seconds, at least that of the noise.
    """
    problem, H = found.problem, found.information
    directions = np.linalg.inv(np.linalg.cholesky(H.reduced)).T
    counts, squares = zip(*found.parts.pool.results(
        _influences, list(map(H.block, range(len(problem.outlines)))),
        [np.vstack([directions, -carried @ directions]) for carried in H.carried],
        found.parts), strict=True)
    count, scatter = sum(counts), np.sum(squares, axis=0)
    if count > 1:  # part of it is common to all directions
        scatter = scatter * count / (count - 1)
        scatter = (COMMON_WEIGHT * np.median(scatter) + count * scatter) / (COMMON_WEIGHT + count)
    scatter = np.maximum(1.0, scatter if count > 1 else 1.0)
    covariance = (directions * scatter) @ directions.T
    variances = H.variances_with(covariance, float(np.median(scatter))) * problem.units**2
    slopes = problem.slopes(found.theta)
    covariance = np.asarray(slopes @ covariance @ slopes.T)
    variances[:len(covariance)] = np.diag(covariance)
    return covariance, variances


def _seconds(parts: Parts) -> tuple[Array, Array]:
    """Return information (c, q, q) and slope (c, q) of each second of a recording."""
    return tuple(np.concatenate([getattr(part, name) for part in parts])
                 for name in ('information', 'slope'))  # type: ignore[return-value]


def _influences(covariance: Array, directions: Array, parts: Parts) -> tuple[int, Array]:
    """
    Return the number of a recording's seconds, and the sums (s,) of their squared influences.

    The influence of a second is the shift of the estimates along directions (q, s), in standard
    deviations, if this second is left out.
    """
    information, slope = _seconds(parts)
    leverage = MAX_LEVERAGE * information @ covariance
    influences = np.linalg.solve(
        np.eye(len(covariance)) - leverage, slope[..., None])[..., 0] @ directions
    return len(influences), np.sum(influences**2, axis=0)


def _without_last_fifth(found: Solution) -> Array:
    """
    Return the parameters of K and P (p,) without the last fifth of each recording, by one step.

    Other quantities keep their estimates.
    """
    problem, step = found.problem, np.zeros(len(found.theta))
    last = problem.held.pool.results(partial(_last_fifth, problem.count), found.parts)
    information, slope = (sum(numbers) for numbers in zip(*last, strict=True))
    size = slice(problem.count)
    step[size] = np.linalg.solve(found.information.shared[size, size] - information, -slope)
    return problem.reported(problem.moved(found.theta, step))[size]


def _last_fifth(count: int, parts: Parts) -> tuple[Array, Array]:
    """Return information (p, p) and slope (p,) of the last fifth of a recording."""
    information, slope = _seconds(parts)
    last = slice(len(slope) - len(slope) // HELD_OUT, None)
    return information[last, :count, :count].sum(axis=0), slope[last, :count].sum(axis=0)


def _fit(found: Solution, named: Sequence[str], given: Free) -> Fit:
    """Return the result of a solution, with the covariance of identifiable parameters."""
    problem, size, x = found.problem, found.problem.count, found.problem.reported(found.theta)
    covariance, from_given, std, identifiable, notes = _identifiable(found, given, named)
    own_std = np.where(identifiable, std, np.inf)
    total_std = np.hypot(own_std, np.sqrt(np.pad(np.diag(from_given), (0, problem.own.size))))
    poses, used = np.sum([outline.poses for outline in problem.outlines], axis=0).tolist()
    information = found.information.shared[:size, :size]
    of_law = {name: place[0] for name, place in problem.places.items() if name in LAW}
    if 'relaxation' in of_law:
        notes += _assumed(problem.extended('relaxation', found.theta), covariance[np.ix_(
            *[of_law['relaxation']] * 2)])
    others = {name: place for name, place in problem.places.items() if name not in LAW}
    return Fit(
        method='output_error',
        structure=problem.structure.name,
        parameters=x[:size],
        held_out=_without_last_fifth(found) if found.converged else None,
        covariance=with_unidentifiable(covariance[:size, :size], ~identifiable[:size]),
        from_given=from_given[:size, :size],
        samples_used=used,
        samples_rejected=poses - used,
        condition_number=inverted(information, np.sqrt(np.diag(information)))[2],
        residual_rms=np.sqrt(6.0 * found.total.residuals / found.total.number),
        notes=tuple(notes) if found.converged else (Finding('not_converged'),),
        misfit=Finding('misfit', Level.WARN, {'chi2': found.robust_chi2}) if (
            found.robust_chi2 > MAX_NOISE_CHI2) else None,
        chi2=found.total.squares / max(found.total.number - len(x), 1),
        robust_chi2=found.robust_chi2 * max(found.learned, 1.0),
        converged=found.converged,
        causes=causes_of(found, given),
        noise_in_motion=found.noise_in_motion,
        named=tuple(named),
        law={name: tuple(problem.extended(name, found.theta).tolist()) for name in LAW},
        law_std={**NO_LAW, **{
            name: tuple(own_std[place].tolist()) for name, place in of_law.items()}},
        nuisances={name: x[place] for name, place in others.items()},
        nuisances_std={name: total_std[place] for name, place in others.items()})


def _assumed(strengths: Array, covariance: Array) -> list[Finding]:
    """Return a finding if the prior gives the ratio of strengths of relaxation (2,)."""
    ratio = np.array([-1.0, 1.0])
    is_assumed = np.sqrt(ratio @ covariance @ ratio) > 0.7 * RATIO_STD * strengths[0]
    return [Finding('no_hold')] * bool(is_assumed)


def _identifiable(
    found: Solution, given: Free, named: Sequence[str]
) -> tuple[Array, Array, Array, Mask, list[Finding]]:
    """
    Return the covariances (s, s) by recordings alone and by given quantities.

    Further results are standard errors (m,) by recordings alone, SI units, the mask of
    identifiable numbers, and notes on the others.
    """
    problem, size = found.problem, found.problem.count
    covariance, variances = covariance_of(found)
    of_given = _of_given(found, given)
    largest = np.full(len(variances), np.inf)
    largest[:size] = MAX_RELATIVE_ERROR * problem.structure.sizes(
        found.cup.stiffness, found.cup.damping)
    for name in named:
        largest[problem.places[name]] = KINDS[name].max_std
    variances -= np.pad(np.diag(of_given), (0, problem.own.size))
    std = np.sqrt(np.maximum(variances, 0.0))
    total = std.copy()
    total[:size] = np.sqrt(std[:size]**2 + np.diag(of_given)[:size])
    identifiable = (total <= largest) & found.converged
    of_K, of_P = slice(size // 2), slice(size // 2, size)
    identifiable[of_K] &= identifiable[of_P] | (std <= MAX_NOISY_ERROR * largest)[of_K] | bool(
        problem.structure.places)
    notes = [_unidentifiable(problem, problem.structure.labels[i], *(
        float(numbers[i]) for numbers in (std / largest, total / largest)))
             for i in np.flatnonzero(~identifiable[:size])]
    return covariance - of_given, of_given, std, identifiable, notes


def _unidentifiable(
    problem: Problem, label: str, alone: float, total: float
) -> Finding:
    """
    Return the finding on an unidentifiable number.

    Standard errors by the recordings alone and in total are relative to the largest of an
    identifiable number.
    """
    error, both = (100.0 * MAX_RELATIVE_ERROR * each for each in (alone, total))
    why = f'its standard error is {both:.2g} % of its size, and {error:.2g} % due to noise alone'
    if total <= 1.0:
        why = f'its damping is not, and its standard error of {error:.2g} % may be due to noise'
    given = ', and measure package, cup.length and markers more exactly (package.com_std, ' \
            'cup.length_std, recording.marker_std)' if alone <= 1.0 < total else ''
    return not_identifiable(label, problem.structure, why, given)


def registered(
    recording: Recording, structure: Structure, start: Cup, free: Free
) -> Solution | None:
    """
    Estimate free quantities jointly with K and P by simulation; None for a clock alone not found.

    Initial guesses need no cup: rotations of both bodies agree, and their distance is nearly
    constant (see `recording.alignment`).

    Raises
    ------
    UndeterminedError
        If the search does not converge, unless the clock alone is free.

    """
    found = minimise(Problem.of(
        segments_of(recording), structure, start, free, is_rough=True))
    if found.converged:
        return found
    if list(free) == ['time_offset']:
        return None
    names = ', '.join(free).replace('package_world', 'recording.package_world')
    raise UndeterminedError(
        f'{names} cannot be found: the search did not converge. Check package.mass and '
        'package.com, and tilt and turn the tool more.')


MAX_DAMPING_STD = 0.25
"""Largest relative standard error of the most certain damping of a moving cup."""

UNLOADED_PARAMETER = 'K rz'
"""The stiffness that no weight loads: it also shows that the cup moves."""

Measured = Segments | Statistics
"""What a fit needs of a recording: its segments, or for least squares its statistics."""


def measured_of(recording: Recording, values: Values, number: int = 0) -> Measured:
    """Return what the method of the fit needs of a recording."""
    if values.fit.method == 'output_error':
        return segments_of(recording, number)
    structure = given_structure(values)
    weights = [body.weights for body in recording.filters]
    return recording.cached(('statistics', values.cup.length, structure), partial(
        statistics, samples_of(recording), values.cup.length, structure,
        [*zip(recording.noise, weights, strict=True)]))


def fit(
    recordings: Sequence[AnyRecording],
    values: Values,
    progress: Progress | None = None,
    measured: Held | None = None,
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
    measured : Held, optional
        Results of `measured_of`; required for reduced recordings.

    Raises
    ------
    BellowsError
        If the recordings do not determine the cup.

    """
    result = fitted(recordings, values, progress, measured)
    unknown = [name for name in result.named if not KINDS[name].each and not np.all(
        np.isfinite(result.nuisances_std[name]))]
    if result.converged and unknown:  # they keep their given values
        known = values.replaced({'fit.free': tuple(set(values.fit.free) - {*unknown})})
        result = fit(recordings, known, progress, measured)
        return replace(result, notes=(*result.notes, Finding('not_freed', Level.WARN, {
            'names': ', '.join(unknown)})))
    _require_motion(result)
    return result


def _require_motion(result: Fit) -> None:
    """Raise if the recordings determine no entry of P."""
    largest = MAX_DAMPING_STD if result.method == 'output_error' else np.inf
    explained = max(result.chi2 or 0.0, result.robust_chi2 or 0.0) <= GROSS_CHI2 and not any(
        cause.certain for cause in result.causes)  # otherwise errors of the misfit
    certain = [label for label, value, std in zip(
        result.labels, result.parameters, np.sqrt(np.diag(result.covariance)), strict=True)
        if std < np.inf and std <= largest * abs(value)]
    if result.converged and explained and not any(
            label[0] == 'P' or label == UNLOADED_PARAMETER for label in certain):
        raise BellowsError(
            'The recordings contain too little motion: damping is not identifiable from them, '
            f'nor {UNLOADED_PARAMETER}, which no weight loads. Move the tool in all directions at '
            '1-3 Hz, and along the cup at 4-6 Hz.')


def _report(progress: Progress, steps: Iterator[int], cup: Cup, chi2: float) -> None:
    """Report a step of a search."""
    step = next(steps)
    K, P = (' '.join(f'{x:.3g}' for x in np.diag(matrix))
            for matrix in (cup.stiffness, cup.damping))
    progress(f'step {step}: chi^2 {chi2:.4g}; K {K}, P {P}', min(step / max(MAX_STEPS), 1.0))


def fitted(
    recordings: Sequence[AnyRecording], values: Values, progress: Progress | None = None,
    measured: Held | None = None, exactly: bool = False,
) -> Fit:
    """
    Return the fit to recordings.

    A fit by simulation estimates all uncertain quantities jointly with K and P, or takes given
    quantities as exact, so that the causes of a misfit are found.
    """
    if measured is None:
        measured = here([
            measured_of(each, values, n) for n, each in enumerate(whole_recordings(recordings))])
    if values.fit.method == 'least_squares':
        return least_squares(measured.pool.gather(measured.values))
    structure = given_structure(values)
    law = {name: 'off' if structure.places and not term.is_additive else values[f'fit.{name}']
           for name, term in LAW.items() if f'fit.{name}' in values}
    start = one_cup_of(values).with_terms({name: NO_LAW[name] for name in law})
    parts = [reduced(recording, values.cup.length) for recording in recordings]
    named = tuple(dict.fromkeys([
        *values.fit.free, *['package_world'] * any(part.package_world for part in parts)]))
    return output_error(
        measured, structure, start,
        partial(_report, progress, count(1)) if progress else no_report, weak_prior(named), named,
        law, {} if exactly else given_std(values),
        richest_structure(values) if values.fit.structure == AUTO else None,
        MARKERS if values.recording.marker == 'shared' else ())
