"""
Selection of the structure of K and P: candidates compared on held-out data.

More parameters always explain the recordings better. Whether they do so because the cup is like
that, AIC and BIC guess from the number of independent samples, and held-out parts of the
recordings show: a cup found without them has to explain their wrenches, and to simulate their
motion.

Noise biases least squares, and a rich structure can mend with couplings that are not there what
the bias spoils. Where the noise is known, the cups that simulate are therefore corrected for it
first, by simulation and extrapolation: noise is added once and twice more, and what that changes
is extrapolated to no noise at all.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.identification.equations import (
    joined,
    LARGEST_CONDITION,
    LipMotion,
    Moments,
    r_factor,
    whitening_of,
)
from bellows_ros.core.identification.hypotheses import Diagnosis, DOUBTED
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.reduction import draws, statistics, with_noise
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.lie import rotation_to_quaternion
from bellows_ros.core.model import Cup
from bellows_ros.core.recording.recording import FilterNoise
from bellows_ros.core.residuals import relative_coordinates
from bellows_ros.core.simulation import simulate, state_row
from bellows_ros.core.structure import Structure, STRUCTURES
from bellows_ros.core.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError, UndeterminedError, UnstableError
import numpy as np

FOLDS = 5
"""Folds of each recording; each is held out once."""

DRAWS = 2
"""Draws of added noise of each size."""

EXTRAPOLATED = (3.0, -3.0, 1.0)
"""Weights that extrapolate estimates at noise variance 1, 2 and 3 to 0 along a parabola."""

SHORTEST_RUN = 1.0
"""Shortest simulated segment, s."""

UNEXPLAINED = 0.2
"""Error of held-out motion, in its size, with which no structure fits, whatever the cause."""

AS_GOOD_WITHIN = 0.02
"""A simpler structure is as good if its held-out error is larger by less than this fraction ..."""

NEGLIGIBLE = 5e-3
"""... or if it adds less than this to a simulation without errors: filters add as much."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    One candidate.

    Parameters
    ----------
    structure : str
        Its name.
    parameters : int
        Number of free parameters.
    fit : Fit or None
        Least squares on all samples; None where they do not determine the parameters.
    refused : str
        Why there is no fit, or ''.
    aic, bic : float
        Akaike's and the Bayesian criterion, less those of the best candidate: 0 is the best.
    held_out_wrench : float
        RMS of the whitened wrenches of held-out parts that are not explained; 1 is as good as the
        richest structure on its own samples.
    simulated : ndarray (F,)
        Error of simulated held-out parts over the size of their motion, fold by fold; infinite
        where there is no simulation.

    """

    structure: str
    parameters: int
    fit: Fit | None
    refused: str
    aic: float
    bic: float
    held_out_wrench: float
    simulated: Array

    @property
    def held_out(self) -> float:
        """Error of the simulated held-out parts over the size of their motion, over all folds."""
        return float(np.sqrt(np.mean(self.simulated**2)))

    @property
    def usable(self) -> bool:
        """Whether its fit can be used for prediction."""
        return self.fit is not None and self.fit.usable


@dataclass(frozen=True, eq=False)
class StructureSelection:
    """
    The structures compared.

    Parameters
    ----------
    candidates : tuple of Candidate
        From the simplest to the richest.
    samples, effective_samples : float
        Valid samples, and how many independent ones tell as much: residuals are correlated.
    advised : str
        The structure to take.
    advice : tuple of str
        Why, in sentences.
    fits : bool
        Whether any structure fits; the advice begins with why not.

    """

    candidates: tuple[Candidate, ...]
    samples: int
    effective_samples: float
    advised: str
    advice: tuple[str, ...]
    fits: bool = True

    def judged(self, diagnosis: Diagnosis, causes: Sequence[str]) -> 'StructureSelection':
        """Return it with the verdict that none fits, by what noise leaves, and sentences why."""
        best = next(own for own in self.candidates if own.structure == self.advised)
        excess, first = diagnosis.excess, diagnosis.findings[:1]
        of_another = bool(first) and first[0].likely and first[0].name != 'structure'
        if best.usable and best.held_out < UNEXPLAINED and (excess < DOUBTED or not of_another):
            return self
        size = (f', and held-out motion is simulated with an error of {best.held_out:.0%} of its '
                'size' if best.usable and np.isfinite(best.held_out) else '')
        residuals = (f': with the best one, {self.advised}, residuals are '
                     f'{np.sqrt(1.0 + excess):.2g} times those expected of noise'
                     if 0.0 < excess < np.inf else '')
        return replace(self, fits=False, advice=(
            ' '.join([f'No structure fits{residuals}{size}.', *causes]), *self.advice))


Folds = list[list[LipMotion]]
"""The lip's motion in every fold, segment by segment."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Recordings cut into folds, as they are and noisier, and the weight of all structures."""

    runs: list[list[Samples]]
    folds: Folds
    noisier: list[list[Folds]]
    count: int
    cup_length: float
    whitening: Array

    def r_factors(self, folds: Folds, structure: Structure) -> list[Array]:
        """Return the R factor of every fold's equations."""
        return [
            r_factor(
                (rows.whitened(self.whitening).stacked for lip in fold
                 for rows in lip.equations(self.cup_length, structure, keep=False)),
                2 * structure.size + 1)
            for fold in folds
        ]

    def corrected(self, structure: Structure, plain: list[Array]) -> list[Array]:
        """Return the solutions (p,) without each fold, extrapolated to no noise."""
        if not self.noisier:
            return plain
        sizes = [np.array(plain)]
        for drawn in self.noisier:
            found = [_solutions(self.r_factors(folds, structure)) for folds in drawn]
            sizes.append(np.mean(found, axis=0))
        extrapolated = np.tensordot(np.array(EXTRAPOLATED), np.array(sizes), axes=1)
        return list(extrapolated)


def select_structure(
    recordings: Sequence[Samples],
    cup_length: float,
    noises: Sequence[FilterNoise] = (),
    names: Sequence[str] = tuple(STRUCTURES),
    folds: int = FOLDS,
) -> StructureSelection:
    """
    Compare structures of K and P.

    Parameters
    ----------
    recordings : sequence of Samples
        Prepared recordings of one cup.
    cup_length : float
        Nominal length l0, m.
    noises : sequence of FilterNoise, optional
        Of each recording; without them nothing is corrected for noise.
    names : sequence of str
        Structures, from the simplest to the richest.
    folds : int
        Parts that every recording is cut into.

    Raises
    ------
    BellowsError
        If no structure can be fitted.

    """
    recordings = list(recordings)
    structures = [STRUCTURES[name] for name in names]
    fits = [_fit(recordings, cup_length, structure) for structure in structures]
    fitted = [(s, fit) for s, (fit, _) in zip(structures, fits, strict=True) if fit is not None]
    if not fitted:
        raise BellowsError(f'No structure can be fitted. {fits[0][1]}')
    whitening, effective = _common_weight(recordings, cup_length, *fitted[-1])
    count = sum(samples.count for samples in recordings)
    runs = [[samples.select(part) for samples, part in zip(recordings, fold, strict=True)]
            for fold in _folds(recordings, folds)]
    problem = _Problem(
        runs, _cut(recordings, folds), _noisier(recordings, noises, folds), count, cup_length,
        whitening)
    part = effective / count
    marked = [
        _candidate(problem, s, *fit, part) for s, fit in zip(structures, fits, strict=True)]
    aic, bic = min(own.aic for own in marked), min(own.bic for own in marked)
    candidates = [replace(own, aic=own.aic - aic, bic=own.bic - bic) for own in marked]
    advised, advice = _advice(candidates)
    return StructureSelection(tuple(candidates), count, effective, advised, advice)


def effective_samples(residuals: Sequence[tuple[Array, Mask]], longest_lag: int) -> float:
    """
    Return how many independent samples have as much information about a variance.

    It is N / (sum over all lags of rho^2), rho being the correlation of residuals so many samples
    apart (Bartlett): that of a mean square, which likelihoods are made of.

    Parameters
    ----------
    residuals : sequence of (array (N, 6), mask (N,))
        Of each recording at a uniform rate, and where they are valid.
    longest_lag : int
        Samples beyond which there is no correlation.

    """
    products, pairs = np.zeros(longest_lag + 1), np.zeros(longest_lag + 1)
    count = 0
    for values, valid in residuals:
        r = np.where(valid[:, None], values, 0.0)
        count += int(np.count_nonzero(valid))
        for lag in range(min(longest_lag + 1, len(r))):
            products[lag] += np.sum(r[lag:] * r[:len(r) - lag])
            pairs[lag] += np.count_nonzero(valid[lag:] & valid[:len(r) - lag])
    if not products[0] > 0.0:
        return float(count)
    rho = products / np.maximum(pairs, 1.0) / (products[0] / pairs[0])
    return float(count / (1.0 + 2.0 * np.sum(rho[1:] ** 2)))


def _fit(
    recordings: list[Samples], cup_length: float, structure: Structure
) -> tuple[Fit | None, str]:
    """Return the least-squares fit, or why it failed."""
    try:
        return least_squares([statistics(s, cup_length, structure) for s in recordings]), ''
    except UndeterminedError as error:
        return None, str(error)


def _common_weight(
    recordings: list[Samples], cup_length: float, structure: Structure, fit: Fit
) -> tuple[Array, float]:
    """Return the whitening by the richest fit's residuals, and the effective samples."""
    x = structure.parameters(fit.stiffness, fit.damping)
    residuals = []
    for samples in recordings:
        every = np.zeros((len(samples.tool), 6))
        every[samples.lip.index] = np.concatenate(
            [c - L @ x for L, c, _ in samples.lip.equations(cup_length, structure)])
        residuals.append((every, samples.valid))
    used = np.concatenate([values[valid] for values, valid in residuals])
    covariance = used.T @ used / len(used)
    # Exact recordings leave nothing but rounding, in some directions nothing at all.
    moments = joined(Moments.of(samples.lip.wrench) for samples in recordings)
    whitening = whitening_of(covariance + 1e-18 * np.diag(np.diag(moments.covariance(structure))))
    white = [(values @ whitening.T, valid) for values, valid in residuals]
    return whitening, effective_samples(white, _longest_lag(recordings))


def _longest_lag(recordings: list[Samples]) -> int:
    """Return the samples in two filter windows, within which residuals are correlated."""
    steps = [float(np.median(np.diff(s.package.stamps_ns))) / NS_PER_S for s in recordings]
    return max(round(2.0 * s.window / step) for s, step in zip(recordings, steps, strict=True))


def _folds(recordings: Sequence[Samples], folds: int) -> Iterator[list[slice]]:
    """Yield the samples of each recording that are in a fold, fold by fold."""
    ends = [np.linspace(0, len(samples.tool), folds + 1).astype(int) for samples in recordings]
    for fold in range(folds):
        yield [slice(int(own[fold]), int(own[fold + 1])) for own in ends]


def _cut(recordings: Sequence[Samples], folds: int) -> Folds:
    """Return the lip's motion in each fold."""
    return [
        [samples.lip.select(slice(*np.searchsorted(samples.lip.index, [part.start, part.stop])))
         for samples, part in zip(recordings, fold, strict=True)]
        for fold in _folds(recordings, folds)
    ]


def _noisier(
    recordings: list[Samples], noises: Sequence[FilterNoise], folds: int
) -> list[list[Folds]]:
    """Return the folds with noise added, once and twice its variance, several times each."""
    if not noises:
        return []
    if len(noises) != len(recordings):
        raise BellowsError(f'{len(recordings)} recordings need as many noise estimates, got '
                           f'{len(noises)}.')
    generators = draws(DRAWS)
    return [
        [
            _cut([with_noise(s, n.times(np.sqrt(variance)), draw)
                  for s, n in zip(recordings, noises, strict=True)], folds)
            for draw in generators
        ]
        for variance in (1.0, 2.0)
    ]


def _candidate(
    problem: _Problem, structure: Structure, fit: Fit | None, refused: str, part: float
) -> Candidate:
    """Return a structure with its marks, absolute ones; `part` is that of effective samples."""
    parts = problem.r_factors(problem.folds, structure)
    size = 2 * structure.size
    squares = float(r_factor(parts, size + 1)[-1, -1] ** 2)
    plain = _solutions(parts)
    left = sum(
        float(np.sum((held_out @ np.append(x, -1.0)) ** 2))
        for held_out, x in zip(parts, plain, strict=True)
    )
    simulated = [
        _simulated_error(problem, number, structure, x)
        for number, x in enumerate(problem.corrected(structure, plain))
    ]
    return Candidate(
        structure.name, size, fit, refused, part * squares + 2.0 * size,
        part * squares + size * float(np.log(part * problem.count)),
        float(np.sqrt(left / (6.0 * problem.count))), np.array(simulated),
    )


def _solutions(parts: list[Array]) -> list[Array]:
    """Return the solution (p,) without each of the folds with these R factors."""
    columns = parts[0].shape[1]
    return [
        _solution(r_factor(parts[:i] + parts[i + 1:], columns)) for i in range(len(parts))
    ]


def _solution(R: Array) -> Array:
    """Return the least-squares solution (p,) of an R factor, the smallest if there are many."""
    scale = np.linalg.norm(R[:-1, :-1], axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    x, *_ = np.linalg.lstsq(R[:-1, :-1] / scale, R[:-1, -1], rcond=1.0 / LARGEST_CONDITION)
    solution: Array = x / scale
    return solution


def _simulated_error(problem: _Problem, fold: int, structure: Structure, x: Array) -> float:
    """
    Return the error of the simulated motion of a fold over the size of that motion.

    Both are RMS values of three positions and of three rotations in the tool, taken together as
    the mean of the two ratios' squares.
    """
    stiffness, damping = structure.matrices(x)
    cup = Cup(stiffness, damping, problem.cup_length)
    squares, sizes = np.zeros(6), np.zeros(6)
    for samples in problem.runs[fold]:
        for run in _runs(samples):
            try:
                error, motion = _simulated_run(cup, run)
            except UnstableError:
                return np.inf
            squares += np.sum(error**2, axis=0)
            sizes += np.sum(motion**2, axis=0)
    kinds = [(squares[kind].sum(), sizes[kind].sum()) for kind in (slice(0, 3), slice(3, 6))]
    ratios = [square / size for square, size in kinds if size > 0.0]
    return float(np.sqrt(np.mean(ratios))) if ratios else np.nan


def _runs(samples: Samples) -> list[Samples]:
    """Return the segments with a known tool, from a package pose on."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], samples.tool.valid, [0]])))
    runs = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        known = np.flatnonzero(samples.package.valid[first:last])
        if not len(known):
            continue
        run = samples.select(slice(first + int(known[0]), last))
        if run.tool.seconds[-1] >= SHORTEST_RUN:
            runs.append(run)
    return runs


def _simulated_run(cup: Cup, run: Samples) -> tuple[Array, Array]:
    """Return errors of a simulation and deviations from the mean of the measurement (N, 6)."""
    start = run.package
    if start.twist is None:
        raise BellowsError('The package needs twists; filter the recording first.')
    state = state_row(
        start.position[0], rotation_to_quaternion(start.rotation[0]), start.twist[0]
    )
    moved = simulate(cup, run.payload, run.tool, state, run.gravity)
    if float(np.abs(moved.position).max()) > 1e3:
        raise BellowsError('The simulation went astray.')
    valid = run.package.valid
    predicted = relative_coordinates(run.tool, moved)[valid]
    measured = relative_coordinates(run.tool, run.package)[valid]
    return predicted - measured, measured - measured.mean(axis=0)


def _advice(candidates: list[Candidate]) -> tuple[str, tuple[str, ...]]:
    """Return the structure to take, and why."""
    able = [
        candidate
        for candidate in candidates
        if candidate.usable and np.isfinite(candidate.held_out)
    ]
    sentences = [_unable(candidate) for candidate in candidates if candidate not in able]
    if not able:
        return candidates[0].structure, (
            *sentences,
            'No structure gives a cup that can be simulated. Check frames, alignment, '
            'package.mass and package.com, and record a richer motion.',
        )
    best = min(able, key=lambda candidate: candidate.held_out)
    advised = next(candidate for candidate in able if _as_good(candidate, best))
    sentences.insert(0, _reason(advised, best, able))
    preferred = {
        name: min(candidates, key=lambda candidate: getattr(candidate, name)).structure
        for name in ('aic', 'bic')
    }
    if set(preferred.values()) != {advised.structure}:
        sentences.append(
            f'AIC prefers {preferred["aic"]}, BIC {preferred["bic"]}, but both fit the noise in '
            'the equations. The held-out error does not.'
        )
    return advised.structure, tuple(sentences)


def _as_good(candidate: Candidate, best: Candidate) -> bool:
    """Return whether a candidate is as good as the best, as far as the folds resolve."""
    if candidate is best:
        return True
    worse = candidate.simulated**2 - best.simulated**2
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
    small = (1.0 + AS_GOOD_WITHIN) ** 2 - 1.0
    return bool(np.mean(worse) <= max(error, small * best.held_out**2, NEGLIGIBLE**2))


def _reason(advised: Candidate, best: Candidate, able: list[Candidate]) -> str:
    """Return the sentence that justifies the recommended structure."""
    errors = ', '.join(f'{candidate.structure} {candidate.held_out:.2%}' for candidate in able)
    if advised is best:
        why = 'It has the smallest held-out error'
    else:
        why = (f'It is the simplest with a held-out error as small as that of {best.structure}')
    return f'Use fit.structure: {advised.structure}. {why} (error over motion: {errors}).'


def _unable(candidate: Candidate) -> str:
    """Return the sentence that rules a structure out."""
    if candidate.fit is None:
        return f'{candidate.structure} cannot be fitted: {candidate.refused}'
    if not candidate.fit.usable:
        return f'{candidate.structure} gives no usable cup: K or P is not definite.'
    return (
        f'{candidate.structure} gives a cup whose simulation diverges on held-out parts.'
    )
