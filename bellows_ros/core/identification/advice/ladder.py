"""
Which structure of K and P to take: a ladder of models, judged by what was held out.

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
from dataclasses import dataclass

from bellows_ros.core.identification.advice.added_noise import FilterNoise, SEED, with_noise
from bellows_ros.core.identification.regression.least_squares import (
    BLOCK,
    equations,
    LARGEST_CONDITION,
    least_squares,
    Samples,
    whitening_of,
    wrench_covariance,
)
from bellows_ros.core.identification.regression.rows import rows_of
from bellows_ros.core.identification.regression.triangles import triangle
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.structure import Structure, STRUCTURES
from bellows_ros.core.lie import rotation_to_quaternion
from bellows_ros.core.model import Cup
from bellows_ros.core.score import relative_coordinates
from bellows_ros.core.simulation import simulate, state_row
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LADDER = ('axisymmetric', 'diagonal', 'full')
"""Structures from the simplest to the richest; each holds those before it."""

FOLDS = 5
"""Parts that every recording is cut into; each is held out once."""

DRAWS = 2
"""How often each size of noise is added."""

EXTRAPOLATED = (3.0, -3.0, 1.0)
"""Weights of estimates with one, two and three times the variance: a parabola's value at none."""

SHORTEST_RUN = 1.0
"""A stretch that is simulated lasts at least this long, s."""

AS_GOOD_WITHIN = 0.02
"""A simpler structure whose held-out error is larger by less than this part is as good, ..."""

NEGLIGIBLE = 5e-3
"""... and so is one that adds less than this to an error-free simulation: filters do as much."""


@dataclass(frozen=True, eq=False)
class Rung:
    """
    One structure on the ladder.

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
        Akaike's and the Bayesian criterion, less those of the best rung: 0 is the best.
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
        """Whether there is a fit that a predictor can take."""
        return self.fit is not None and self.fit.usable


@dataclass(frozen=True, eq=False)
class Ladder:
    """
    The structures compared.

    Parameters
    ----------
    rungs : tuple of Rung
        From the simplest to the richest.
    samples, effective_samples : float
        Valid samples, and how many independent ones tell as much: residuals are correlated.
    advised : str
        The structure to take.
    advice : tuple of str
        Why, in sentences.

    """

    rungs: tuple[Rung, ...]
    samples: int
    effective_samples: float
    advised: str
    advice: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Recordings cut into folds, and the weight that all structures share."""

    folds: list[list[Samples]]
    noisier: tuple[list[list[list[Samples]]], ...]
    count: int
    cup_length: float
    whitening: Array

    def triangles(self, folds: list[list[Samples]], structure: Structure) -> list[Array]:
        """Return the triangle of every fold's equations."""
        columns = 2 * structure.size + 1
        return [
            triangle(rows_of(fold, self.cup_length, structure, self.whitening), columns)
            for fold in folds
        ]

    def corrected(self, structure: Structure, plain: list[Array]) -> list[Array]:
        """Return the solutions (p,) without each fold, extrapolated to no noise."""
        if not self.noisier:
            return plain
        sizes = [np.array(plain)]
        for draws in self.noisier:
            found = [_solutions(self.triangles(folds, structure)) for folds in draws]
            sizes.append(np.mean(found, axis=0))
        extrapolated = np.tensordot(np.array(EXTRAPOLATED), np.array(sizes), axes=1)
        return list(extrapolated)


def structure_ladder(
    recordings: Sequence[Samples],
    cup_length: float,
    noises: Sequence[FilterNoise] = (),
    names: Sequence[str] = LADDER,
    folds: int = FOLDS,
) -> Ladder:
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
    noisier = _noisier(recordings, noises, folds)
    problem = _Problem(_cut(recordings, folds), noisier, count, cup_length, whitening)
    part = effective / count
    rungs = _relative_to_best(
        [_rung(problem, s, *fit, part) for s, fit in zip(structures, fits, strict=True)]
    )
    advised, advice = _advice(rungs)
    return Ladder(tuple(rungs), count, effective, advised, advice)


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
    """Return the least-squares fit, or why there is none."""
    try:
        return least_squares(recordings, cup_length, structure), ''
    except BellowsError as error:
        return None, str(error)


def _common_weight(
    recordings: list[Samples], cup_length: float, structure: Structure, fit: Fit
) -> tuple[Array, float]:
    """Return the whitening by the richest fit's residuals, and the effective samples."""
    x = structure.parameters(fit.stiffness, fit.damping)
    residuals = []
    for samples in recordings:
        parts = [
            c - L @ x
            for L, c, _ in (
                equations(block, cup_length, structure) for block in _all_blocks(samples)
            )
        ]
        residuals.append((np.concatenate(parts), samples.tool.valid & samples.package.valid))
    used = np.concatenate([values[valid] for values, valid in residuals])
    covariance = used.T @ used / len(used)
    # Exact recordings leave nothing but rounding, in some directions nothing at all.
    floor = 1e-18 * np.diag(wrench_covariance(recordings, STRUCTURES['diagonal']))
    whitening = whitening_of(covariance + np.diag(floor))
    white = [(values @ whitening.T, valid) for values, valid in residuals]
    return whitening, effective_samples(white, _longest_lag(recordings))


def _all_blocks(samples: Samples) -> Iterator[Samples]:
    """Yield all samples, the invalid ones too, in blocks that memory has room for."""
    for start in range(0, len(samples.tool), BLOCK):
        yield _part(samples, slice(start, start + BLOCK))


def _part(samples: Samples, index: slice) -> Samples:
    """Return some of the samples."""
    return Samples(
        samples.tool.select(index), samples.package.select(index), samples.held, samples.gravity,
        samples.window,
    )  # fmt: skip


def _longest_lag(recordings: list[Samples]) -> int:
    """Return the samples in two filter windows, within which residuals are correlated."""
    steps = [float(np.median(np.diff(s.package.stamps_ns))) / NS_PER_S for s in recordings]
    return max(round(2.0 * s.window / step) for s, step in zip(recordings, steps, strict=True))


def _cut(recordings: list[Samples], folds: int) -> list[list[Samples]]:
    """Return each recording's parts, fold by fold."""
    result: list[list[Samples]] = [[] for _ in range(folds)]
    for samples in recordings:
        ends = np.linspace(0, len(samples.tool), folds + 1).astype(int)
        for fold, (first, last) in zip(result, zip(ends[:-1], ends[1:], strict=True), strict=True):
            fold.append(_part(samples, slice(int(first), int(last))))
    return result


def _noisier(
    recordings: list[Samples], noises: Sequence[FilterNoise], folds: int
) -> tuple[list[list[list[Samples]]], ...]:
    """Return the folds with noise added, once and twice its variance, several times each."""
    if not noises:
        return ()
    if len(noises) != len(recordings):
        raise BellowsError(f'{len(recordings)} recordings need as many noises, not {len(noises)}.')
    draws = np.random.default_rng(SEED).spawn(DRAWS)
    return tuple(
        [
            _cut([with_noise(s, n.times(np.sqrt(variance)), draw)
                  for s, n in zip(recordings, noises, strict=True)], folds)
            for draw in draws
        ]
        for variance in (1.0, 2.0)
    )  # fmt: skip


def _rung(
    problem: _Problem, structure: Structure, fit: Fit | None, refused: str, part: float
) -> Rung:
    """Return a structure judged; AIC and BIC are absolute, `part` is that of effective samples."""
    parts = problem.triangles(problem.folds, structure)
    size = 2 * structure.size
    squares = float(triangle(parts, size + 1)[-1, -1] ** 2)
    plain = _solutions(parts)
    left = sum(
        float(np.sum((held_out @ np.append(x, -1.0)) ** 2))
        for held_out, x in zip(parts, plain, strict=True)
    )
    simulated = [
        _simulated_error(problem, number, structure, x)
        for number, x in enumerate(problem.corrected(structure, plain))
    ]
    return Rung(
        structure.name, size, fit, refused, part * squares + 2.0 * size,
        part * squares + size * float(np.log(part * problem.count)),
        float(np.sqrt(left / (6.0 * problem.count))), np.array(simulated),
    )  # fmt: skip


def _solutions(parts: list[Array]) -> list[Array]:
    """Return the solution (p,) without each of the folds whose triangles are given."""
    columns = parts[0].shape[1]
    return [
        _solution(triangle(parts[:i] + parts[i + 1:], columns)) for i in range(len(parts))
    ]


def _solution(R: Array) -> Array:
    """Return the least-squares solution (p,) of a triangle, the smallest if there are many."""
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
    for samples in problem.folds[fold]:
        for run in _runs(samples):
            try:
                error, motion = _simulated_run(cup, run)
            except BellowsError:
                return np.inf
            squares += np.sum(error**2, axis=0)
            sizes += np.sum(motion**2, axis=0)
    kinds = [(squares[kind].sum(), sizes[kind].sum()) for kind in (slice(0, 3), slice(3, 6))]
    ratios = [square / size for square, size in kinds if size > 0.0]
    return float(np.sqrt(np.mean(ratios))) if ratios else np.nan


def _runs(samples: Samples) -> list[Samples]:
    """Return the stretches in which the tool is known, from a package pose on."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], samples.tool.valid, [0]])))
    runs = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        known = np.flatnonzero(samples.package.valid[first:last])
        if not len(known):
            continue
        run = _part(samples, slice(first + int(known[0]), last))
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
    moved = simulate(cup, run.held, run.tool, state, run.gravity)
    valid = run.package.valid
    predicted = relative_coordinates(run.tool, _poses(moved))[valid]
    measured = relative_coordinates(run.tool, run.package)[valid]
    return predicted - measured, measured - measured.mean(axis=0)


def _poses(moved: Trajectory) -> Trajectory:
    """Return a simulated motion, or say that it left what can be compared."""
    if float(np.abs(moved.position).max()) > 1e3:
        raise BellowsError('The simulation went astray.')
    return moved


def _relative_to_best(rungs: list[Rung]) -> list[Rung]:
    """Return rungs with criteria relative to the best."""
    aic, bic = min(rung.aic for rung in rungs), min(rung.bic for rung in rungs)
    return [
        Rung(r.structure, r.parameters, r.fit, r.refused, r.aic - aic, r.bic - bic,
             r.held_out_wrench, r.simulated)
        for r in rungs
    ]  # fmt: skip


def _advice(rungs: list[Rung]) -> tuple[str, tuple[str, ...]]:
    """Return the structure to take, and why."""
    able = [rung for rung in rungs if rung.usable and np.isfinite(rung.held_out)]
    sentences = [_unable(rung) for rung in rungs if rung not in able]
    if not able:
        return rungs[0].structure, (
            *sentences,
            'No structure gives a cup that can be simulated: check frames, alignment, '
            'package.mass and package.com, and record a richer motion.',
        )
    best = min(able, key=lambda rung: rung.held_out)
    advised = next(rung for rung in able if _as_good(rung, best))
    sentences.insert(0, _reason(advised, best, able))
    preferred = {
        name: min(rungs, key=lambda rung: getattr(rung, name)).structure for name in ('aic', 'bic')
    }
    if set(preferred.values()) != {advised.structure}:
        sentences.append(
            f'AIC would take {preferred["aic"]}, BIC {preferred["bic"]}; but they count what '
            'noise does to the equations as if the cup did it. Held-out parts tell the two apart.'
        )
    return advised.structure, tuple(sentences)


def _as_good(rung: Rung, best: Rung) -> bool:
    """Tell whether a rung is as good as the best one, as far as the folds can tell."""
    if rung is best:
        return True
    worse = rung.simulated**2 - best.simulated**2
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse))) if len(worse) > 1 else 0.0
    small = (1.0 + AS_GOOD_WITHIN) ** 2 - 1.0
    return bool(np.mean(worse) <= max(error, small * best.held_out**2, NEGLIGIBLE**2))


def _reason(advised: Rung, best: Rung, able: list[Rung]) -> str:
    """Return the sentence that says why a structure is advised."""
    errors = ', '.join(f'{rung.structure} {rung.held_out:.2%}' for rung in able)
    if advised is best:
        why = 'It simulates held-out parts of the recordings best'
    else:
        why = (f'It is the simplest that simulates held-out parts of the recordings as well as '
               f'{best.structure} does')  # fmt: skip
    return f'Take fit.structure: {advised.structure}. {why} (error over motion: {errors}).'


def _unable(rung: Rung) -> str:
    """Return the sentence that says why a structure is out of the question."""
    if rung.fit is None:
        return f'{rung.structure} cannot be fitted: {rung.refused}'
    if not rung.fit.usable:
        return f'{rung.structure} gives no cup that can hold a package: K or P is not definite.'
    return f'{rung.structure} gives a cup whose simulation of held-out parts does not stay finite.'
