"""
Selection of the structure of K and P: candidates compared on held-out data.

More parameters always explain the recordings better. Held-out parts of the recordings test whether
the cup needs them: a cup fitted without these parts has to simulate their motion. Without
compensation of noise, false couplings of a rich structure would compensate the bias of the fit.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.pool import here
from bellows_ros.core.identification.reduction import noise_products, Statistics, statistics
from bellows_ros.core.identification.result import NOTES
from bellows_ros.core.identification.samples import NOISE_SEED, Samples
from bellows_ros.core.model.cup_package import Cup, gripper_of
from bellows_ros.core.model.simulation import simulate, state_row, tool_rows
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.recording import FilterNoise
from bellows_ros.core.signals.residuals import compare
from bellows_ros.errors import BellowsError, UndeterminedError, UnstableError
import numpy as np

FOLDS = 5
"""Folds of each recording; each is held out once."""

MIN_SEGMENT_TIME = 1.0
"""Shortest simulated segment, s."""

DIVERGED: Array = np.array([[np.inf, np.inf], [0.0, 0.0]])
"""Sums of squares of a simulation that diverges."""

MAX_DISTANCE = 1e3
"""Distance (m) of a simulated package from the origin beyond which it has diverged."""

ERROR_TOLERANCE = 0.02
"""Largest relative excess of the held-out error with which a simpler structure is as good,"""

NEGLIGIBLE_ERROR = 5e-3
"""and largest absolute one, relative to the motion: filters contribute as much."""


class Candidate(NamedTuple):
    """
    One candidate.

    Parameters
    ----------
    structure : str
        Its name.
    parameters : int
        Number of free parameters.
    usable : bool
        Whether the fit to all samples can be used for prediction.
    refused : str
        Reason for a missing fit, or ''.
    simulated : ndarray (F,)
        Ratio of error and motion of simulated held-out parts by fold; infinite without a
        simulation.

    """

    structure: str
    parameters: int
    usable: bool
    refused: str
    simulated: Array

    @property
    def held_out(self) -> float:
        """Ratio of error and motion of the simulated held-out parts, over all folds."""
        return float(np.sqrt(np.mean(self.simulated**2)))


class StructureSelection(NamedTuple):
    """
    Comparison of structures.

    Parameters
    ----------
    candidates : tuple of Candidate
        From the simplest to the richest.
    samples : int
        Valid samples.
    advised : str
        Recommended structure.
    advice : tuple of str
        Reasons, as sentences.

    """

    candidates: tuple[Candidate, ...]
    samples: int
    advised: str
    advice: tuple[str, ...]


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
        Cup length l0, m.
    noises : sequence of FilterNoise
        Noise of each recording.
    of_gripper : Structure, optional
        Structure of one cup of the recorded gripper.

    Raises
    ------
    BellowsError
        If no structure can be fitted.

    """
    structures = [*([of_gripper] if of_gripper else ()), *STRUCTURES.values()]
    folds: list[list[Samples]] = [[] for _ in range(FOLDS)]
    parts: list[list[Statistics]] = [[] for _ in range(FOLDS)]
    for samples, noise in zip(recordings, noises, strict=True):
        # The seed differs from the seed of a fit, whose bias is already subtracted.
        added = noise_products(samples, noise, cup_length, structures[-1], NOISE_SEED + 1)
        ends = np.linspace(0, len(samples.tool), FOLDS + 1).astype(int)
        for fold, part, first, end in zip(folds, parts, ends, ends[1:], strict=False):
            fold.append(samples.select(slice(first, end)))
            reduced = statistics(fold[-1], cup_length, structures[-1])
            part.append(reduced._replace(noise=added * (reduced.used / max(samples.count, 1))))
    candidates = [_candidate(each, folds, parts) for each in structures]
    if all(candidate.refused for candidate in candidates):
        raise BellowsError(f'No structure can be fitted. {candidates[0].refused}')
    advised, advice = _advice(candidates)
    return StructureSelection(
        tuple(candidates), sum(samples.count for samples in recordings), advised, advice)


def _candidate(
    structure: Structure, folds: Sequence[Sequence[Samples]],
    parts: Sequence[Sequence[Statistics]],
) -> Candidate:
    """Return a structure with its errors on each fold, fitted to the parts of all other folds."""
    own = [[part.of(structure) for part in fold] for fold in parts]
    size = 2 * structure.size
    try:
        usable = least_squares(here(sum(own, []))).usable
        fits = [least_squares(here(sum(own[:k] + own[k + 1:], []))) for k in range(FOLDS)]
    except UndeterminedError as error:
        return Candidate(structure.name, size, False, str(error), np.full(FOLDS, np.inf))
    cups = [gripper_of(Cup(fit.stiffness, fit.damping, own[0][0].cup_length), structure.places)
            for fit in fits]
    sums = [_simulated_errors(cup, [segment for samples in fold for segment in _segments(samples)])
            for cup, fold in zip(cups, folds, strict=True)]
    return Candidate(structure.name, size, usable, '', _over_motion(np.array(sums)))


def _over_motion(sums: Array) -> Array:
    """
    Return the ratios of error and motion (F,), from sums (F, 2, 2) of all folds.

    The motion is averaged over folds, as one may be at rest. The ratio is the root mean square of
    the ratios of positions and of rotations.
    """
    errors, sizes = sums[:, 0], sums[:, 1].mean(axis=0)
    moving = sizes > 0.0
    if not moving.any():
        return np.full(len(sums), np.inf)
    return np.asarray(np.sqrt(np.mean(errors[:, moving] / sizes[moving], axis=1)))


def _simulated_errors(cup: Cup, segments: Sequence[Samples]) -> Array:
    """
    Return sums of squares (2, 2) of simulated segments: of errors, and of their motion.

    Each sum is over three positions, or over three rotations in the tool. Errors are infinite if a
    segment diverges.
    """
    squares, sizes = np.zeros(6), np.zeros(6)
    for segment in segments:
        start = state_row(*np.split(tool_rows(segment.package.select(slice(1)))[0], [3, 7]))
        try:
            moved = simulate(cup, segment.payload, segment.tool, start, segment.gravity)
        except UnstableError:
            return DIVERGED
        if float(np.abs(moved.position).max()) > MAX_DISTANCE:
            return DIVERGED
        scores = compare(moved, segment.tool, segment.package).scores
        squares += scores.samples * scores.rms**2
        sizes += scores.samples * scores.motion**2
    return np.asarray(np.array([squares, sizes]).reshape(2, 2, 3).sum(axis=2))


def _segments(samples: Samples) -> Iterator[Samples]:
    """Yield the segments with a measured tool, each from a package pose on."""
    edges = np.flatnonzero(np.diff(samples.tool.valid, prepend=False, append=False))
    for first, last in edges.reshape(-1, 2).tolist():
        is_measured = samples.package.valid[first:last]
        if is_measured.any():
            segment = samples.select(slice(first + int(np.argmax(is_measured)), last))
            if segment.tool.seconds[-1] >= MIN_SEGMENT_TIME:
                yield segment


def _advice(candidates: list[Candidate]) -> tuple[str, tuple[str, ...]]:
    """Return the recommended structure, and the reasons."""
    eligible = [each for each in candidates if each.usable and np.isfinite(each.held_out)]
    sentences = [
        NOTES['no_fit' if each.refused else 'diverging' if each.usable else 'no_cup'].format(
            structure=each.structure, refused=each.refused)
        for each in candidates if each not in eligible]
    if not eligible:
        return candidates[0].structure, (*sentences, NOTES['no_structure'])
    best = min(eligible, key=lambda candidate: candidate.held_out)
    advised = next(each for each in eligible if each is best or _is_as_good(each, best))
    errors = ', '.join(f'{each.structure} {each.held_out:.2%}' for each in eligible)
    why = NOTES['best' if advised is best else 'as_good'].format(best=best.structure)
    advice = NOTES['advised'].format(structure=advised.structure, why=why, errors=errors)
    return advised.structure, (advice, *sentences)


def _is_as_good(candidate: Candidate, best: Candidate) -> bool:
    """Return whether a candidate is as good as the best, within the resolution of the folds."""
    worse = candidate.simulated**2 - best.simulated**2
    error = float(np.std(worse, ddof=1) / np.sqrt(len(worse)))
    small = (1.0 + ERROR_TOLERANCE) ** 2 - 1.0
    return bool(np.mean(worse) <= max(error, small * best.held_out**2, NEGLIGIBLE_ERROR**2))
