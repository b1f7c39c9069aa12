"""
Selection of the structure of K and P: candidates compared on held-out data.

More parameters always explain the recordings better. Whether they do so because the cup is like
that, AIC and BIC guess from the number of independent samples, and held-out parts of the
recordings show: a cup found without them has to simulate their motion.

Noise biases least squares, and a rich structure can mend with couplings that are not there what
the bias spoils. Its bias is therefore subtracted before cups simulate.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.identification import equations
from bellows_ros.core.identification.causes import DOUBTED
from bellows_ros.core.identification.hypotheses import Diagnosis
from bellows_ros.core.identification.least_squares import least_squares, noise_bias
from bellows_ros.core.identification.reduction import noise_products, SEED, statistics
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.model.cup_package import Cup, gripper_of
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.recording import FilterNoise
from bellows_ros.core.signals.residuals import compare
from bellows_ros.core.signals.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError, UndeterminedError, UnstableError
import numpy as np
from scipy.linalg import block_diag

FOLDS = 5
"""Folds of each recording; each is held out once."""

SHORTEST_SEGMENT = 1.0
"""Shortest simulated segment, s."""

DIVERGED: Array = np.array([[np.inf, np.inf], [0.0, 0.0]])
"""Sums of squares of a simulation that diverges."""

MAX_DISTANCE = 1e3
"""Distance (m) of a simulated package from the origin beyond which it has diverged."""

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
        Valid samples, and how many independent ones are as informative: residuals are correlated.
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
        excess = diagnosis.excess
        has_cause = any(own.likely and own.name != 'structure' for own in diagnosis.findings[:1])
        if best.usable and best.held_out < UNEXPLAINED and (excess < DOUBTED or not has_cause):
            return self
        size = (f', and held-out motion is simulated with an error of {best.held_out:.0%} of its '
                'size' if best.usable and np.isfinite(best.held_out) else '')
        residuals = (f': with the best one, {self.advised}, residuals are '
                     f'{np.sqrt(1.0 + excess):.2g} times those expected of noise'
                     if 0.0 < excess < np.inf else '')
        return replace(self, fits=False, advice=(
            ' '.join([f'No structure fits{residuals}{size}.', *causes]), *self.advice))


def select_structure(
    recordings: Sequence[Samples], cup_length: float, noises: Sequence[FilterNoise],
    of_gripper: Structure | None = None,
) -> StructureSelection:
    """
    Compare structures of K and P.

    Parameters
    ----------
    recordings : sequence of Samples
        Prepared recordings of one cup.
    cup_length : float
        Nominal length l0, m.
    noises : sequence of FilterNoise
        Of each recording.
    of_gripper : Structure, optional
        That of one cup of the gripper that was recorded.

    Raises
    ------
    BellowsError
        If no structure can be fitted.

    """
    structures = [*([of_gripper] if of_gripper else ()), *STRUCTURES.values()]
    fits = [_fit(recordings, cup_length, structure) for structure in structures]
    fitted = [(s, fit) for s, (fit, _) in zip(structures, fits, strict=True) if fit is not None]
    if not fitted:
        raise BellowsError(f'No structure can be fitted. {fits[0][1]}')
    whitening, effective = _common_weight(recordings, cup_length, *fitted[-1])
    problem = _Problem(
        recordings, cup_length, whitening, effective, sum(own.count for own in recordings),
        # With other draws than those of the fit, which subtracts what it sees in its own.
        np.sum([noise_products(samples, noise, cup_length, structures[-1], SEED + 1)
                for samples, noise in zip(recordings, noises, strict=True)], axis=0))
    marked = [_candidate(problem, s, *fit) for s, fit in zip(structures, fits, strict=True)]
    aic, bic = min(own.aic for own in marked), min(own.bic for own in marked)
    candidates = [replace(own, aic=own.aic - aic, bic=own.bic - bic) for own in marked]
    advised, advice = _advice(candidates)
    return StructureSelection(tuple(candidates), problem.used, effective, advised, advice)


class _Problem(NamedTuple):
    """
    What all structures have in common.

    Recordings; length (m); whitening (6, 6); effective and all samples; what noise adds to the
    products of the richest structure's rows (see `noise_products`).
    """

    recordings: Sequence[Samples]
    cup_length: float
    whitening: Array
    effective: float
    used: int
    noise: Array

    def folds(self) -> Iterator[list[tuple[Samples, slice]]]:
        """Yield each recording with its samples that are in a fold, fold by fold."""
        ends = [np.linspace(0, len(own.tool), FOLDS + 1).astype(int) for own in self.recordings]
        for fold in range(FOLDS):
            yield [(samples, slice(int(own[fold]), int(own[fold + 1])))
                   for samples, own in zip(self.recordings, ends, strict=True)]


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
    products, pairs = np.zeros((2, longest_lag + 1))
    for values, valid in residuals:
        r = np.where(valid[:, None], values, 0.0)
        for lag in range(min(longest_lag + 1, len(r))):
            products[lag] += np.sum(r[lag:] * r[:len(r) - lag])
            pairs[lag] += np.count_nonzero(valid[lag:] & valid[:len(r) - lag])
    if not products[0] > 0.0:
        return float(pairs[0])
    rho = products / np.maximum(pairs, 1.0) / (products[0] / pairs[0])
    return float(pairs[0] / (1.0 + 2.0 * np.sum(rho[1:] ** 2)))


def _fit(
    recordings: Sequence[Samples], cup_length: float, structure: Structure
) -> tuple[Fit | None, str]:
    """Return the least-squares fit, or why it failed."""
    try:
        return least_squares([statistics(s, cup_length, structure) for s in recordings]), ''
    except UndeterminedError as error:
        return None, str(error)


def _common_weight(
    recordings: Sequence[Samples], cup_length: float, structure: Structure, fit: Fit
) -> tuple[Array, float]:
    """Return the whitening by the richest fit's residuals, and the effective samples."""
    residuals = []
    for samples in recordings:
        every = np.zeros((len(samples.tool), 6))
        every[samples.lip.index] = np.concatenate(
            [c - L @ fit.parameters for L, c, _ in samples.lip.equations(cup_length, structure)])
        residuals.append((every, samples.valid))
    used = np.concatenate([values[valid] for values, valid in residuals])
    covariance = used.T @ used / len(used)
    # Exact recordings leave nothing but rounding, in some directions nothing at all.
    moments = equations.joined(equations.Moments.of(samples.lip.wrench) for samples in recordings)
    whitening = equations.whitening_of(
        covariance + 1e-18 * np.diag(np.diag(moments.covariance(structure))))
    white = [(values @ whitening.T, valid) for values, valid in residuals]
    windows = [own.window * uniform_rate_hz(own.package.stamps_ns) for own in recordings]
    return whitening, effective_samples(white, round(2.0 * max(windows)))


def _candidate(
    problem: _Problem, structure: Structure, fit: Fit | None, refused: str
) -> Candidate:
    """Return a structure with its marks; AIC and BIC are absolute."""
    size, parts, counts = 2 * structure.size, [], []
    for fold in problem.folds():
        lips = [samples.lip.select(slice(*np.searchsorted(
            samples.lip.index, [part.start, part.stop]))) for samples, part in fold]
        counts.append(sum(len(lip.index) for lip in lips))
        parts.append(equations.r_factor(
            (rows.whitened(problem.whitening).stacked for lip in lips
             for rows in lip.equations(problem.cup_length, structure, keep=False)), size + 1))
    T = block_diag(structure.within(list(STRUCTURES.values())[-1]), np.eye(1))
    noise = np.einsum('ipjq,pa,qb->iajb', problem.noise, T, T, optimize=True)
    simulated = []
    for number, fold in enumerate(problem.folds()):
        others = equations.r_factor(parts[:number] + parts[number + 1:], size + 1)
        x, inverse, *_ = equations.solution(others, structure)
        part_of_it = (1.0 - counts[number] / problem.used) * noise
        x = x - noise_bias(part_of_it, problem.whitening, x, inverse)[0]
        simulated.append(_simulated_errors(
            gripper_of(Cup(*structure.matrices(x), problem.cup_length,
                           problem.recordings[0].relaxation), structure.places),
            [segment for samples, part in fold for segment in _segments(samples.select(part))]))
    part = problem.effective / problem.used
    squares = part * float(equations.r_factor(parts, size + 1)[-1, -1] ** 2)
    return Candidate(structure.name, size, fit, refused, squares + 2.0 * size,
                     squares + size * float(np.log(problem.effective)),
                     _over_motion(np.array(simulated)))


def _over_motion(sums: Array) -> Array:
    """
    Return errors (F,) over the size of the motion, from sums (F, 2, 2) of all folds.

    The size is that of an average fold: one may be a hold. Errors are RMS values of positions and
    of rotations, taken together as the mean of the two ratios' squares.
    """
    errors, sizes = sums[:, 0], sums[:, 1].mean(axis=0)
    moving = sizes > 0.0
    if not moving.any():
        return np.full(len(sums), np.inf if np.isinf(errors).any() else np.nan)
    return np.asarray(np.sqrt(np.mean(errors[:, moving] / sizes[moving], axis=1)))


def _simulated_errors(cup: Cup, segments: Sequence[Samples]) -> Array:
    """
    Return sums of squares (2, 2) of simulated segments: of errors, and of their motion.

    Each of three positions, and of three rotations in the tool. Errors are infinite where a
    segment diverges.
    """
    squares, sizes = np.zeros(6), np.zeros(6)
    for segment in segments:
        package = segment.package
        assert package.twist is not None
        start = state_row(
            package.position[0], rotation_to_quaternion(package.rotation[0]), package.twist[0])
        try:
            moved = simulate(cup, segment.payload, segment.tool, start, segment.gravity)
        except UnstableError:
            return DIVERGED
        if float(np.abs(moved.position).max()) > MAX_DISTANCE:
            return DIVERGED
        scores = compare(moved, segment.tool, package).scores
        squares += scores.samples * scores.rms**2
        sizes += scores.samples * scores.motion**2
    return np.asarray(np.array([squares, sizes]).reshape(2, 2, 3).sum(axis=2))


def _segments(samples: Samples) -> Iterator[Samples]:
    """Yield the segments with a known tool, from a package pose on."""
    edges = np.flatnonzero(np.diff(samples.tool.valid, prepend=False, append=False))
    for first, last in edges.reshape(-1, 2).tolist():
        is_measured = samples.package.valid[first:last]
        if is_measured.any():
            segment = samples.select(slice(first + int(np.argmax(is_measured)), last))
            if segment.tool.seconds[-1] >= SHORTEST_SEGMENT:
                yield segment


def _advice(candidates: list[Candidate]) -> tuple[str, tuple[str, ...]]:
    """Return the structure to take, and why."""
    able = [own for own in candidates if own.usable and np.isfinite(own.held_out)]
    sentences = [
        f'{own.structure} cannot be fitted: {own.refused}' if own.fit is None else
        f'{own.structure} gives no usable cup: K or P is not definite.' if not own.usable else
        f'{own.structure} gives a cup whose simulation diverges on held-out parts.'
        for own in candidates if own not in able]
    if not able:
        return candidates[0].structure, (
            *sentences,
            'No structure gives a cup that can be simulated. Check frames, alignment, '
            'package.mass and package.com, and record a richer motion.')
    best = min(able, key=lambda own: own.held_out)
    advised = next(own for own in able if own is best or _is_as_good(own, best))
    errors = ', '.join(f'{own.structure} {own.held_out:.2%}' for own in able)
    why = ('It has the smallest held-out error' if advised is best else
           f'It is the simplest with a held-out error as small as that of {best.structure}')
    sentences.insert(0, f'Use fit.structure: {advised.structure}. {why} (error over motion: '
                        f'{errors}).')
    aic, bic = (min(candidates, key=criterion).structure
                for criterion in (attrgetter('aic'), attrgetter('bic')))
    if {aic, bic} != {advised.structure}:
        sentences.append(f'AIC prefers {aic}, BIC {bic}, but both fit the noise in the equations. '
                         'The held-out error does not.')
    return advised.structure, tuple(sentences)


def _is_as_good(candidate: Candidate, best: Candidate) -> bool:
    """Return whether a candidate is as good as the best, as far as the folds resolve."""
    worse = candidate.simulated**2 - best.simulated**2
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse)))
    small = (1.0 + AS_GOOD_WITHIN) ** 2 - 1.0
    return bool(np.mean(worse) <= max(error, small * best.held_out**2, NEGLIGIBLE**2))
