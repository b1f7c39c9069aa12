"""
Output error: K and P by simulation, with their uncertainty and the causes of a misfit.

From the minimum on, given quantities are estimated jointly with K and P, with their standard
deviations as priors. Their errors are part of the covariance: mass, inertia, K and P scaled by one
factor give equal motion, so that K is as uncertain as the mass.

Two clocks, two worlds and a marker anywhere on the package are also estimated, from one recording.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
import math
from operator import attrgetter
from typing import Any, NamedTuple

from bellows_ros.core import findings
from bellows_ros.core.geometry.arrays import Array, Mask, Places
from bellows_ros.core.identification.causes import is_explained, likeliest_setting, rank
from bellows_ros.core.identification.estimate import (
    approach,
    MAX_NOISE_CHI2,
    minimise,
    Parts,
    Report,
    settled,
    Solution,
)
from bellows_ros.core.identification.information import inverted, with_unidentifiable
from bellows_ros.core.identification.pool import Held, here
from bellows_ros.core.identification.quantities import (
    Free,
    KINDS,
    NOTHING,
    STRETCH_UNITS,
    weak_prior,
)
from bellows_ros.core.identification.residuals import at_rest
from bellows_ros.core.identification.result import (
    Cause,
    CHANCE,
    Fit,
    Freed,
    Iteration,
    MAX_RELATIVE_ERROR,
    remedy_for,
)
from bellows_ros.core.identification.segments import (
    measured_segments,
    MeasuredSegment,
    segments_of,
)
from bellows_ros.core.identification.unknowns import DEFAULT_RATIO, Problem, RATIO_STD
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import has_coupling, require_stretch, Structure
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.errors import BellowsError, UndeterminedError
import numpy as np

MAX_NOISY_ERROR = 0.1
"""
Fraction of its limit up to which K is known without its damping.

With unknown damping, noise looks like the resonance of an axis that hardly moves: in 4 of 176 weak
recordings K x or K rz was off by 6 to 1700 standard errors, and each standard error was above 9 %.
"""

LOADED_PARAMETER = 'K z'
"""
The stiffness that the weight loads: the sag shows it without motion.

In a gripper the other cups load each stiffness of one cup.
"""

MIN_SQUARED_DISTANCE = -2.0 * math.log(1e-3)
"""Smallest squared Mahalanobis distance of two significant parameters from zero; false-alarm rate
1 in 1000."""

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

LEAST_OF_SETTING = 4.0
"""
Smallest chi² per residual with a wrong world, or a frame rotated by 90 degrees: the mean over
axes, and the robust value of the worst axis.
"""

HELD_OUT = 5
"""Number of seconds of a recording per held-out second."""

MAX_LEVERAGE = 0.999
"""Largest leverage of one second in the jackknife."""


def output_error(
    measured: Held | Sequence[MeasuredSegment],
    structure: Structure,
    start: Cup,
    progress: Callable[[Iteration], None] | None = None,
    free: Free = NOTHING,
    named: Sequence[str] = (),
    relaxation: str = 'off',
    given: Free = NOTHING,
    other_start: Cup | None = None,
    richer: Structure | None = None,
    stretch: str = 'off',
    common: tuple[str, ...] = (),
    standstills: Sequence[Standstill] = (),
) -> Fit:
    """
    Fit K and P so that the model, driven by the measured tool, reproduces the package's poses.

    Parameters
    ----------
    measured : Held or sequence of MeasuredSegment
        Parts of recordings of one cup: `Segments` where they are, or in this process.
    structure : Structure
        Structure of K and P: their free entries.
    start : Cup
        Initial guess, definite, with the cup length l0.
    progress : callable, optional
        Callback after every iteration.
    free : mapping, optional
        Standard deviations, SI units, of quantities of `KINDS` without a given value.
    named : sequence of str
        Names of the free quantities that are results.
    relaxation : str
        Whether the strengths of relaxation are free: 'off'; 'auto' if significant; 'on' with an
        error if insignificant.
    given : mapping, optional
        Standard deviations of given quantities, the priors with which they are free.
    other_start : Cup, optional
        Second initial guess, for a search with an implausible end.
    richer : Structure, optional
        Structure that replaces the first one if its couplings are significant.
    stretch : str
        Whether the coefficients of stretch are free, like `relaxation`.
    common : tuple of str, optional
        Names of quantities that all recordings share instead of having their own.
    standstills : sequence of Standstill
        Standstills of the cup, whose balance is part of the fit.

    Raises
    ------
    UndeterminedError
        If relaxation or stretch is 'on' and is not significant.

    """
    iterations = list[Iteration]()

    def record(cup: Cup, chi2: float) -> None:
        iterations.append(Iteration(len(iterations), chi2, cup.stiffness, cup.damping))
        if progress is not None:
            progress(iterations[-1])

    held = measured if isinstance(measured, Held) else here([
        segments_of(list(own)) for _, own in groupby(measured, attrgetter('recording'))])
    problem = Problem.of(held, structure, start, free, common=common,
                         standstills=tuple(standstills))
    given = {name: std for name, std in given.items() if problem.is_slow or name != 'exposure'}
    problem = replace(problem, free={**given, **free})
    near = approach(problem, record)
    found = settled(near, record)
    if not found.is_plausible and other_start is not None:
        other = minimise(problem.from_cup(other_start), record)
        found = other if other.is_plausible else found
    found = _extended(found, _extensions(richer, stretch, relaxation), record)
    if found.worst_chi2 * max(found.learned, 1.0) > LEAST_OF_SETTING and (
            setting := likeliest_setting(near, other_start or start)):
        return _fit(replace(found, converged=False), iterations, named, given, (setting,))
    reasons = () if is_explained(found, given) else rank(found, given)
    return _fit(found, iterations, named, given, reasons)


NOT_RELAXING = (
    'fit.relaxation: the recordings show no relaxation that exceeds its standard error. Hold a '
    'tilt for 5 to 10 s beside the motion, or set fit.relaxation: auto.')
NOT_STRETCHING = (
    'fit.stretch: the recordings show no stretch that exceeds its standard error. Record two '
    'masses that differ by a factor of two, or set fit.stretch: auto.')


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


def _extensions(richer: Structure | None, stretch: str, relaxation: str) -> Iterator[Extension]:
    """Yield the extensions to be tested; those that are 'on' need not extrapolate."""
    if richer is not None:
        yield Extension({}, richer, lambda end, _: has_coupling(end.cup.stiffness))
    if stretch != 'off':
        yield Extension(weak_prior(['stretch']), None, *(
            (_is_passive, NOT_STRETCHING) if stretch == 'on' else (_extrapolates,)))
    if relaxation != 'off':
        yield Extension(weak_prior(['relaxation']), None, _explains_most,
                        NOT_RELAXING if relaxation == 'on' else '')


def _extended(
    found: Solution, extensions: Iterable[Extension], report: Report
) -> Solution:
    """Return the solution of nested models, each extension kept if significant."""
    for extension in extensions:
        before = found
        found = _tried(found, extension, report)
        if extension.refusal and found is before:
            raise UndeterminedError(extension.refusal)
    return found


def _tried(found: Solution, extension: Extension, report: Report) -> Solution:
    """
    Return the solution with an extension of the spring if significant, else without.

    The covariance is from a jackknife, so that held-out motion confirms the extension.
    """
    more, structure, holds, _ = extension

    def place(wide: Problem) -> Places:
        couplings = structure.couplings if structure else []
        return np.asarray([*couplings, *(row for name in more for row in wide.places[name][0])])

    near = found.freed(more, structure)
    H, g = near.information, near.slope
    rest = ~np.isin(np.arange(len(g)), place(near.problem))
    if H.fall(g, rest | True) - H.fall(g, rest) <= MIN_SQUARED_DISTANCE:
        return found
    end = settled(near, report)
    if end.converged and end.misfit < found.misfit and holds(end, found):
        x, tested = end.problem.reported(end.theta), place(end.problem)
        C = covariance_of(end)[0][np.ix_(tested, tested)]
        if float(x[tested] @ np.linalg.solve(C, x[tested])) > MIN_SQUARED_DISTANCE:
            return end
    return found


def _is_passive(found: Solution, _: Solution) -> bool:
    """Return whether the energy is positive definite in the usual range of stretch."""
    try:
        require_stretch(found.cup.stiffness, found.problem.stretch(found.theta))
    except BellowsError:
        return False
    return True


def _extrapolates(end: Solution, without: Solution) -> bool:
    """Return whether two masses determine the stretch, or stretch explains most of the misfit."""
    masses = [outline.payload.mass for outline in end.problem.outlines]
    excess, before = (each.squares / each.residual_count - 1.0 for each in (end, without))
    chance = CHANCE * (2.0 / end.residual_count) ** 0.5
    return _is_passive(end, without) and (max(masses) >= MIN_MASS_RATIO * min(masses) or (
        chance < before - excess and excess <= MAX_MISFIT_SHARE * before + chance))


def _explains_most(end: Solution, without: Solution) -> bool:
    """
    Return whether relaxation explains more than half of the misfit.

    Two time constants leave 39 % of the misfit of rubber with a loss factor of 0.1, without which
    the search does not converge.
    """
    noise = MAX_NOISE_CHI2 * end.residual_count
    return end.squares - noise <= max(0.5 * (without.squares - noise), 0.0)


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
    directions, pool = np.linalg.inv(np.linalg.cholesky(H.reduced)).T, problem.held.pool
    counts, squares = zip(*pool.results(
        _influences, pool.each(list(map(H.block, range(len(problem.outlines))))),
        pool.each([np.vstack([directions, -carried @ directions]) for carried in H.carried]),
        found.parts), strict=True)
    scatter = np.maximum(1.0, _relative_variances(sum(counts), np.sum(squares, axis=0)))
    covariance = (directions * scatter) @ directions.T
    variances = H.variances_with(covariance, float(np.median(scatter))) * problem.units**2
    slopes = problem.slopes(found.theta)
    covariance = np.asarray(slopes @ covariance @ slopes.T)
    variances[:len(covariance)] = np.diag(covariance)
    return covariance, variances


def _influences(covariance: Array, directions: Array, parts: Parts) -> tuple[int, Array]:
    """
    Return the number of a recording's seconds, and the sums (s,) of their squared influences.

    The influence of a second is the shift of the estimates along directions (q, s), in standard
    deviations, if this second is left out.
    """
    information, slope = (np.concatenate([getattr(part, name) for part in parts])
                          for name in ('information', 'slope'))
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
    last = problem.held.pool.results(_last_fifth, problem.count, found.parts)
    information, slope = (sum(numbers) for numbers in zip(*last, strict=True))
    size = slice(problem.count)
    step[size] = np.linalg.solve(found.information.shared[size, size] - information, -slope)
    return problem.reported(problem.moved(found.theta, step))[size]


def _last_fifth(count: int, parts: Parts) -> tuple[Array, Array]:
    """Return information (p, p) and slope (p,) of the last fifth of a recording."""
    information, slope = (np.concatenate([getattr(part, name) for part in parts])
                          for name in ('information', 'slope'))
    last = slice(len(slope) - len(slope) // HELD_OUT, None)
    return information[last, :count, :count].sum(axis=0), slope[last, :count].sum(axis=0)


def _relative_variances(count: int, squares: Array) -> Array:
    """
    Return the variances (s,) along directions relative to the noise model.

    By the number of parts of the recordings and the sums (s,) of their squared influences.
    """
    if count < 2:
        return np.ones(len(squares))
    scatter = squares * count / (count - 1)
    common = float(np.median(scatter))
    return np.asarray((COMMON_WEIGHT * common + count * scatter) / (COMMON_WEIGHT + count))


def _fit(
    found: Solution, iterations: list[Iteration], named: Sequence[str], given: Free,
    reasons: tuple[Cause, ...],
) -> Fit:
    """Return the result of a solution, with the covariance of identifiable parameters."""
    problem, size, x = found.problem, found.problem.count, found.problem.reported(found.theta)
    covariance, from_given, std, identifiable, notes = _identifiable(found, given, named)
    own_std = np.where(identifiable, std, np.inf)
    poses, used = np.sum([outline.poses for outline in problem.outlines], axis=0).tolist()
    information = found.information.shared[:size, :size]
    fit = Fit(
        method='output_error',
        structure=problem.structure.name,
        parameters=x[:size],
        held_out=_without_last_fifth(found) if found.converged else None,
        covariance=with_unidentifiable(covariance[:size, :size], ~identifiable[:size]),
        from_given=from_given[:size, :size],
        samples_used=used,
        samples_rejected=poses - used,
        condition_number=inverted(information, np.sqrt(np.diag(information)))[2],
        weight=np.diag(1.0 / found.mean_square),
        residual_rms=np.sqrt(found.mean_square),
        notes=tuple(notes),
        misfit=findings.Finding('misfit', findings.Level.WARN, {'chi2': found.robust_chi2}) if (
            found.robust_chi2 > MAX_NOISE_CHI2) else None,
        chi2=found.squares / max(found.residual_count - len(x), 1),
        robust_chi2=found.robust_chi2 * max(found.learned, 1.0),
        converged=found.converged,
        iterations=tuple(iterations),
        causes=reasons,
        standstills=(len(problem.standstills), at_rest(
            problem.local, found.theta[problem.index(0)])[2]) if problem.standstills else None,
        noise_in_motion=found.noise_in_motion,
        stretch=problem.stretch(found.theta),
        **_of_quantities(problem, x, own_std, np.pad(
            np.diag(from_given), (0, problem.own.size)), named))
    if 'relaxation' in problem.places:
        fit = _relaxed(fit, found, covariance)
    return fit if found.converged else replace(fit, notes=(findings.Finding('not_converged'),))


def _of_quantities(
    problem: Problem, x: Array, std: Array, from_given: Array, named: Sequence[str]
) -> dict[str, Any]:
    """
    Return the fields of a fit on quantities beside K and P.

    By their values (m,), standard errors (m,) by the recordings alone, and additional variances
    (m,) by given quantities.
    """
    places, total_std = problem.places, np.sqrt(std**2 + from_given)
    results = [name for name in places if name in named and not KINDS[name].each]
    nuisances = {name: place for name, place in places.items()
                 if name not in ('relaxation', 'stretch', *results)}
    offsets = np.ravel(places['time_offset']) if 'time_offset' in named else slice(0)
    return {
        'delays': tuple(x[offsets].tolist()),
        'delays_std': tuple(std[offsets].tolist()),
        'freed': tuple(
            Freed(name, *(tuple(each[places[name][0]].tolist()) for each in (x, total_std)))
            for name in results),
        'nuisances': {name: x[place] for name, place in nuisances.items()},
        'nuisances_std': {name: total_std[place] for name, place in nuisances.items()},
        'stretch_std': _pair(std[places['stretch'][0]] * STRETCH_UNITS) if (
            'stretch' in places) else (0.0, 0.0)}


def _relaxed(fit: Fit, found: Solution, covariance: Array) -> Fit:
    """Return a fit with the strengths of relaxation, and a note if a prior gives their ratio."""
    (place,) = found.problem.places['relaxation']
    strengths, of_strengths = found.problem.strengths(found.theta), covariance[place][:, place]
    ratio = np.array([-DEFAULT_RATIO, 1.0])
    is_assumed = np.sqrt(ratio @ of_strengths @ ratio) > 0.7 * RATIO_STD * strengths[0]
    return replace(
        fit, relaxation=_pair(strengths), relaxation_std=_pair(np.sqrt(np.diag(of_strengths))),
        notes=(*fit.notes, *[findings.Finding(
            'no_hold', numbers={'assumed': ': r2 is assumed'})] * bool(is_assumed)))


def _pair(values: Array) -> tuple[float, float]:
    """Return two numbers as a tuple."""
    first, second = values.tolist()
    return first, second


def _identifiable(
    found: Solution, given: Free, named: Sequence[str]
) -> tuple[Array, Array, Array, Mask, list[findings.Finding]]:
    """
    Return the covariances (s, s) by recordings alone and by given quantities.

    Further results are standard errors (m,) by recordings alone, SI units, the mask of
    identifiable numbers, and notes on the others.
    """
    problem, size = found.problem, found.problem.count
    covariance, variances = covariance_of(found)
    of_given = _of_given(found, given)
    by_given = np.pad(np.diag(of_given), (0, problem.own.size))
    largest = np.full(len(variances), np.inf)
    largest[:size] = MAX_RELATIVE_ERROR * problem.structure.sizes(
        found.cup.stiffness, found.cup.damping)
    for name in named:
        largest[problem.places[name]] = KINDS[name].max_std
    std = np.sqrt(np.maximum(variances - by_given, 0.0))
    total = np.where(np.arange(len(std)) < size, np.hypot(std, np.sqrt(by_given)), std)
    identifiable = (total <= largest) & found.converged
    of_K, of_P = slice(size // 2), slice(size // 2, size)
    is_loaded = np.array([label == LOADED_PARAMETER or bool(problem.structure.places)
                          for label in problem.structure.labels])
    identifiable[of_K] &= (
        identifiable[of_P] | (is_loaded | (std <= MAX_NOISY_ERROR * largest)[:size])[of_K])
    notes = [_unidentifiable(problem, problem.structure.labels[i], *(
        float(numbers[i]) for numbers in (std / largest, total / largest)))
             for i in np.flatnonzero(~identifiable[:size])]
    return covariance - of_given, of_given, std, identifiable, notes


def _unidentifiable(
    problem: Problem, label: str, alone: float, total: float
) -> findings.Finding:
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
    return findings.Finding('not_identifiable', findings.Level.WARN, {
        'label': label, 'why': why, 'how': remedy_for(label, problem.structure), 'given': given})


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
    segments = here([segments_of(measured_segments(recording))])
    found = minimise(Problem.of(segments, structure, start, free))
    if found.converged:
        return found
    if list(free) == ['time_offset']:
        return None
    names = ', '.join(free).replace('package_world', 'recording.package_world')
    raise UndeterminedError(
        f'{names} cannot be found: the search did not converge. Check package.mass and '
        'package.com, and tilt and turn the tool more.')
