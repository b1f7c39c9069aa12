"""Output error: K and P by simulation, with their uncertainty and what would explain the rest."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from types import MappingProxyType

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.causes import Finding
from bellows_ros.core.identification.given import causes, moved_between, stated, with_given
from bellows_ros.core.identification.identifiability import remedy_for
from bellows_ros.core.identification.least_squares import (
    DEFAULT_RATIO,
    MOST_LEFT,
    NOT_RELAXING,
    R2_ASSUMED,
    RATIO_STD,
    SIGNIFICANT,
)
from bellows_ros.core.identification.quantities import anything, Free, KINDS
from bellows_ros.core.identification.result import (
    Fit,
    Freed,
    Iteration,
    LARGEST_ERROR,
    without,
)
from bellows_ros.core.identification.search import (
    MAX_NOISE_CHI2,
    MeasuredSegment,
    Minimum,
    Search,
    Segment,
    WhitenedSegment,
)
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.recording import BodyNoise
from bellows_ros.core.signals.savgol import correlated
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import UndeterminedError
import numpy as np

NOTHING: Free = MappingProxyType({})

LARGEST_SHARE, MOST_OF_ERROR = 0.9, 0.5
"""Most noise in information that errors allow for, and in the error of what is identifiable."""

ANOTHER = 0.2
"""Part by which K moves to another minimum, which has causes of its own."""

SEED, SHAKEN, LEAST_SHAKEN = 0, 3.0, 0.1
"""Of the noise with which that is looked at, and its sizes in that of the poses."""

LARGEST_CHI2 = 1.2
"""Chi^2 per degree of freedom above this triggers a warning."""

CLUSTER = 1.0
"""Length (s) of the segments whose gradients are kept."""

COMMON = 10.0
"""Weight of the scatter common to all parameters, in segments of the recordings."""

LEAST_EXCESS = 0.25
"""Scatter below this fraction of the noise model's belongs to directions without information."""

LARGEST_LEVERAGE = 0.999
"""Largest leverage of one second in the jackknife."""

MEDIAN_OF_NORMAL = 0.6744897501960817
"""Median of the absolute value of a standard normal variable."""

ALSO_GIVEN = (
    'Measure them more exactly and state it (package.com_std, cup.length_std, '
    'recording.marker_std)')

NOT_CONVERGED = (
    'The search for K and P did not converge: they must not be used, and there are no standard '
    'errors. Check package.mass, package.com, the frames and the clocks, or use a simpler '
    'fit.structure.')


def output_error(
    measured: Sequence[MeasuredSegment],
    structure: Structure,
    start: Cup,
    progress: Callable[[Iteration], None] | None = None,
    free: Free = NOTHING,
    named: Sequence[str] = (),
    relaxation: str = 'off',
    given: Free = NOTHING,
) -> Fit:
    """
    Fit K and P so that the model, moved as the tool was, meets the package's poses.

    Parameters
    ----------
    measured : sequence of MeasuredSegment
        Parts of recordings of one cup.
    structure : Structure
        Which entries of K and P are free.
    start : Cup
        First guess, definite, with the nominal length l0.
    progress : callable, optional
        Called with every iteration.
    free : mapping, optional
        Standard deviations, SI units, of quantities of `KINDS` that are free from the start.
    named : sequence of str
        Those of them that are results, too.
    relaxation : str
        Whether the strengths of relaxation are free: 'off', 'auto' where they are significant,
        'on' where the recordings are refused else.
    given : mapping, optional
        Standard deviations of quantities that were given; see `with_given`.

    Raises
    ------
    UndeterminedError
        If relaxation is 'on' and none is significant.

    """
    search = Search([Segment(own) for own in measured], structure, start, free)
    iterations: list[Iteration] = []

    def note(cup: Cup, chi2: float) -> None:
        iterations.append(Iteration(len(iterations), chi2, cup.stiffness, cup.damping))
        if progress is not None:
            progress(iterations[-1])

    found = search.minimum(note)
    if relaxation != 'off':  # rubber may be why a search without it does not converge
        if 'relaxation' not in search.places:
            search, found = _with_relaxation(search, found, note)
        elif not _relaxes(search, found):  # as least squares, which noise disturbs, has it
            stiff = search.with_free(found.theta, {}, relaxes=False)
            search, found = stiff, stiff.minimum(note, stiff.transferred(search, found.theta))
        if relaxation == 'on' and 'relaxation' not in search.places:
            raise UndeterminedError(NOT_RELAXING)
    reasons = causes(search, found, stated(given))
    search.accept(found.parts)
    wide, there, from_given = with_given(search, found, given, note, bool(reasons))
    if reasons and moved_between((search, found), (wide, there)) > ANOTHER:
        reasons = tuple(own for own in reasons if own.name in wide.places) or causes(
            wide, there, stated(given))
    return _fit(wide, there, from_given, iterations, named, reasons)


def _with_relaxation(
    search: Search, found: Minimum, note: Callable[[Cup, float], None]
) -> tuple[Search, Minimum]:
    """Return the search with strengths of relaxation where they are significant, else as it is."""
    more = search.with_free(found.theta, anything(['relaxation']))
    (own,), theta = more.places['relaxation'], more.transferred(search, found.theta)
    _, H, g = more.system(theta)
    base = np.arange(own[0])
    H_own, slope = H[np.ix_(own, base)], g[own]
    S = H[np.ix_(own, own)] - H_own @ np.linalg.solve(H[np.ix_(base, base)], H_own.T)
    if slope @ np.linalg.solve(S, slope) > SIGNIFICANT:
        again = more.minimum(note, theta)
        noise = MAX_NOISE_CHI2 * again.residual_count
        left, before = again.squares - noise, found.squares - noise
        if again.converged and left <= max(MOST_LEFT * before, 0.0) and _relaxes(more, again):
            return more, again
        search.accept(found.parts)
    return search, found


def _relaxes(search: Search, found: Minimum) -> bool:
    """Return whether strengths of relaxation are significant."""
    r, covariance = _strengths(search, found, covariance_of(search, found)[0])
    return bool(r @ np.linalg.solve(covariance, r) > SIGNIFICANT)


def _strengths(search: Search, found: Minimum, covariance: Array) -> tuple[Array, Array]:
    """Return the strengths of relaxation (2,) with their covariance, zeros without it."""
    if 'relaxation' not in search.places:
        return np.zeros(2), np.zeros((2, 2))
    (own,) = search.places['relaxation']
    return search.strengths(found.theta), covariance[np.ix_(own, own)]


def covariance_of(
    search: Search, found: Minimum, noise: Array | None = None
) -> tuple[Array, Array]:
    """
    Return the covariance (m, m) of the unknowns, SI units, and what noise (m,) is of their errors.

    By the jackknife. Information that is noise (m, m) in the derivatives steers no step.
    """
    directions = np.linalg.inv(np.linalg.cholesky(found.information)).T
    shares = np.zeros(len(directions))
    if noise is not None:
        shares, turn = np.linalg.eigh(directions.T @ noise @ directions)
        directions = directions @ turn
    scatter = _excess(np.array([
        directions.T @ gradient for segment, own in zip(search.segments, found.parts, strict=True)
        for gradient in _left_out(found.information, own, segment.period)]))
    wide = directions / (1.0 - np.clip(shares, 0.0, LARGEST_SHARE))
    covariance = (wide * np.maximum(scatter, 1.0)) @ wide.T
    return (np.asarray(covariance * np.outer(search.units, search.units)),
            1.0 - np.sqrt(np.sum(directions**2, axis=1) / np.sum(wide**2, axis=1)))


def _left_out(information: Array, part: WhitenedSegment, period: float) -> Iterator[Array]:
    """Yield the gradient (m,) of each second of a segment, as it is for the fit without it."""
    length = 6 * max(round(CLUSTER / period), 1)
    for first in range(0, len(part.innovations), length):
        J, r = part.jacobian[first:first + length], part.innovations[first:first + length]
        rest = information - LARGEST_LEVERAGE * (J.T @ J)
        yield np.asarray(information @ np.linalg.solve(rest, J.T @ r), dtype=np.float64)


def _excess(influences: Array) -> Array:
    """
    Return the variances (m,) along directions over those of the noise model.

    Influences (c, m) are by how much each part of the recordings moves the estimates along them,
    in standard deviations.
    """
    count = len(influences)
    if count < 2:
        return np.ones(influences.shape[1])
    own = np.maximum(np.sum(influences**2, axis=0) * count / (count - 1), LEAST_EXCESS)
    common = float(np.median(own))
    return np.asarray((COMMON * common + count * own) / (COMMON + count))


def _fit(
    search: Search, found: Minimum, from_given: Array, iterations: list[Iteration],
    named: Sequence[str], reasons: tuple[Finding, ...],
) -> Fit:
    """Return the result, with the covariance of what is identifiable."""
    size, x = search.count, search.units * found.theta
    covariance, known, notes = _identifiable(search, found, from_given, named)
    strengths, of_strengths = _strengths(search, found, covariance)
    (r1, r2), (r1_std, r2_std) = strengths.tolist(), np.sqrt(np.diag(of_strengths)).tolist()
    ratio = np.array([-DEFAULT_RATIO, 1.0])
    if np.sqrt(ratio @ of_strengths @ ratio) > 0.7 * RATIO_STD * r1:
        notes.append(R2_ASSUMED)
    std = np.where(known, np.sqrt(np.diag(covariance)), np.inf)
    r = np.concatenate([own.innovations for own in found.parts])
    left = found.residuals
    robust_chi2 = float((np.median(np.abs(r)) / MEDIAN_OF_NORMAL) ** 2)
    total = sum(len(segment.measured.package) for segment in search.segments)
    offsets = np.ravel(search.places['time_offset']) if 'time_offset' in named else slice(0)
    return Fit(
        method='output_error',
        structure=search.structure.name,
        parameters=x[:size],
        covariance=without(covariance[:size, :size], ~known[:size]),
        from_given=from_given[:size, :size],
        samples_used=len(left),
        samples_rejected=total - len(left),
        condition_number=_condition(found.information[:size, :size]),
        weight=np.diag(search.segments[0].std ** -2),
        residual_rms=np.sqrt(np.mean(left**2, axis=0)),
        notes=tuple(notes) if found.converged else (NOT_CONVERGED,),
        misfit=_misfit(robust_chi2),
        chi2=found.squares / max(len(r) - len(x), 1),
        robust_chi2=robust_chi2,
        converged=found.converged,
        iterations=tuple(iterations),
        delays=tuple(x[offsets].tolist()),
        delays_std=tuple(std[offsets].tolist()),
        freed=tuple(
            Freed(name, tuple(x[own].tolist()), tuple(std[own].tolist()))
            for name, (own, *_) in search.places.items()
            if name in named and not KINDS[name].each),
        causes=reasons,
        found={name: x[own] for name, own in search.places.items()
               if name != 'relaxation' and (KINDS[name].each or name not in named)},
        relaxation=(r1, r2),
        relaxation_std=(r1_std, r2_std),
    )


def _misfit(chi2: float) -> str:
    """Return a sentence if chi^2 per degree of freedom is too large."""
    if chi2 <= LARGEST_CHI2:
        return ''
    return (
        f'The model does not explain the recording: chi^2 per degree of freedom is {chi2:.2f}, '
        'expected 1. Check package.mass, package.com, the frames and whether one clock stamped '
        'both streams (else set fit.time_offset), or use a richer fit.structure.')


def _condition(information: Array) -> float:
    """Return the condition number of the scaled problem behind an information matrix."""
    scale = np.sqrt(np.diag(information))
    values = np.linalg.eigvalsh(information / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))


def _identifiable(
    search: Search, found: Minimum, from_given: Array, named: Sequence[str]
) -> tuple[Array, Mask, list[str]]:
    """Return the covariance (m, m), SI units, what is identifiable, and notes on the rest."""
    size = search.count
    covariance, shares = covariance_of(
        search, found, noise_information(search, found) if found.converged else None)
    cup, std = search.cup(found.theta), np.sqrt(np.diag(covariance))
    largest = np.full(len(std), np.inf)
    largest[:size] = LARGEST_ERROR * search.structure.sizes(cup.stiffness, cup.damping)
    for name in named:
        largest[search.places[name]] = KINDS[name].known
    known = (std <= largest) & (shares <= MOST_OF_ERROR) & found.converged
    notes = list(_unknown(search, std / (largest / LARGEST_ERROR), shares, known[:size]))
    total = (np.sqrt(std**2 + np.diag(from_given)) / largest)[:size]
    vague = known[:size] & (total > 1.0)
    notes += [
        f'{search.structure.labels[i]} is not identifiable with what was given: its standard '
        f'error is {100.0 * LARGEST_ERROR * total[i]:.2g} % of its size, and '
        f'{100.0 * LARGEST_ERROR * std[i] / largest[i]:.2g} % with exact package, cup.length and '
        f'markers. {ALSO_GIVEN}; or '
        f'{remedy_for(search.structure.labels[i].split()[1], search.structure)}.'
        for i in np.flatnonzero(vague)]
    known[:size] &= ~vague
    return covariance, known, notes


def noise_information(search: Search, found: Minimum) -> Array:
    """
    Return the information (m, m) on the unknowns that is of noise, not of motion.

    Noise in the path shakes the simulated package, too. With some more of it, once with either
    sign, information of motion stays, and that of noise grows with the noise squared.
    """
    noisier, size, more = copy(search), SHAKEN, list[Array]()
    while len(more) < 2:
        noisier.segments, draw = [], np.random.default_rng(SEED)
        for own in search.segments:
            measured = own.measured
            noise = BodyNoise(own.std, measured.package_noise.correlation), measured.tool_noise
            package, tool = (
                _shaken(body, seen, size * (-1.0) ** len(more), draw)
                for body, seen in zip((measured.package, measured.tool), noise, strict=True))
            noisier.segments.append(Segment(
                replace(measured, tool=tool, package=package), own.half_window))
            noisier.segments[-1].start, noisier.segments[-1].std = own.start, own.std
        parts, H, g = noisier.system(found.theta)
        if np.all(np.isfinite(g)):
            noisier.accept(parts)
            H, g = noisier.system(found.theta)[1:]
        if np.all(np.isfinite(g)):
            more.append((H - found.information) / size**2)
        elif size < LEAST_SHAKEN:
            return found.information
        else:  # so much noise turns the package over
            size, more = 0.5 * size, []
    return np.asarray(np.mean(more, axis=0))


def _shaken(
    body: Trajectory, noise: BodyNoise, size: float, draw: np.random.Generator
) -> Trajectory:
    """Return poses with noise of a size in their own."""
    e = size * noise.std * correlated(draw.standard_normal((len(body), 6)), noise.correlation)
    return replace(body, position=body.position + e[:, :3],
                   rotation=body.rotation @ exp_so3(e[:, 3:]))


def _unknown(search: Search, errors: Array, shares: Array, known: Mask) -> Iterator[str]:
    """Yield a sentence about each number that is not identifiable, with what would make it so."""
    size = len(known)
    for label, error, share, is_known in zip(
            search.structure.labels, errors[:size].tolist(), shares[:size].tolist(),
            known.tolist(), strict=True):
        less = LARGEST_ERROR / error
        how = remedy_for(label.split()[1], search.structure)
        if share > MOST_OF_ERROR and (1.0 - share) * error < 1.0:
            yield (f'{label} is not identifiable: {share:.0%} of its standard error is of noise '
                   f'that moves it; {how}.')
        elif error >= 1.0:  # the prior limits it
            yield (f'{label} is not identifiable: its standard error is as large as itself or '
                   f'larger; {how}, or measure with less noise.')
        elif not is_known:
            yield (
                f'{label} is not identifiable from this motion with this noise: its standard '
                f'error is {100.0 * error:.2g} % of its size. {1e2 * less:.0f} % of the noise '
                f'would do, or {less**-2:.2g} times as long a recording'
                f'{", or one of one cup alone" if search.structure.places else ""}.')
