"""The few numbers that were given, found together with K and P (Gauss and Newton)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.identification.equations.identifiable import IN_NULL_SPACE
from bellows_ros.core.identification.hypotheses.objective import Evidence, Objective, Solved
from bellows_ros.core.identification.hypotheses.variations import Given, Variation
import numpy as np

ROUNDS, HALVINGS = 12, 5

CONVERGED = 0.05
"""A round that goes less far than this part of the standard error is the last."""

SINGULAR = 1e-10
"""Eigenvalues of scaled information below this are no information."""


class Block(NamedTuple):
    """
    Numbers that are varied together.

    Parameters
    ----------
    name : str
        As in fit.free.
    vary : Variation
        What they do to a recording.
    steps : tuple of float
        Change of each for derivatives.
    raster : tuple of float
        Values of one of them that are tried first: where the weight stretches the cup by less
        than what is off, its stiffness has the wrong sign in a false minimum.
    raster_of : int
        Which one that is.
    furthest : float
        No round goes further than so many steps.
    each : bool
        Whether each recording has its own.

    """

    name: str
    vary: Variation
    steps: tuple[float, ...]
    raster: tuple[float, ...] = ()
    raster_of: int = 0
    furthest: float = 200.0
    each: bool = False

    def size(self, recordings: int) -> int:
        """Return how many numbers there are for so many recordings."""
        return len(self.steps) * (recordings if self.each else 1)


class Refined(NamedTuple):
    """Numbers (n,), their covariance (n, n), infinite where not identifiable, and what is left."""

    theta: Array
    covariance: Array
    solved: Solved

    @property
    def std(self) -> Array:
        """Standard errors (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def varied(blocks: Sequence[Block], theta: Array) -> Callable[[Sequence[Given]], list[Given]]:
    """Return what varies recordings by the numbers of blocks, one after the other."""
    def vary(given: Sequence[Given]) -> list[Given]:
        """Return the recordings varied."""
        changed, first = list(given), 0
        for block in blocks:
            width = len(block.steps)
            for number, own in enumerate(changed):
                start = first + (number * width if block.each else 0)
                changed[number] = block.vary(own, theta[start:start + width])
            first += block.size(len(given))
        return changed
    return vary


def refine(
    objective: Objective, evidence: Evidence, blocks: Sequence[Block], start: Array | None = None,
    rounds: int = ROUNDS,
) -> Refined:
    """
    Return the numbers of blocks with which noise explains most.

    They are looked for from a start, or from 0 and values on a raster where none is given.
    """
    count = len(evidence.given)
    steps = np.concatenate([np.tile(b.steps, b.size(count) // len(b.steps)) for b in blocks])
    far = np.concatenate([np.full(b.size(count), b.furthest) for b in blocks]) * steps

    def at(theta: Array) -> Solved:
        """Return what is left at some numbers."""
        return objective.solved(evidence.varied(varied(blocks, theta)))

    theta = _on_raster(objective, evidence, blocks, len(steps)) if start is None else start
    here = at(theta)
    for _ in range(rounds):
        gradient, D = _derivatives(at, theta, here, steps)
        step = -_inverse(D.T @ D)[0] @ gradient
        step *= min(1.0, float(np.min(far / np.maximum(np.abs(step), 1e-300))))
        for _ in range(HALVINGS):
            further = at(theta + step)
            if further.excess < here.excess:
                break
            step = 0.5 * step
        else:
            return Refined(theta, _covariance(here, D), here)
        theta, here = theta + step, further
        covariance = _covariance(here, D)
        if np.all(np.abs(step) <= CONVERGED * np.sqrt(np.diag(covariance))):
            break
    return Refined(theta, covariance, here)


def _on_raster(
    objective: Objective, evidence: Evidence, blocks: Sequence[Block], size: int
) -> Array:
    """Return the numbers (size,) on the rasters of blocks that explain most, 0 without any."""
    theta, first, count = np.zeros(size), 0, len(evidence.given)
    quiet = Evidence(evidence.given, ())
    least = objective.solved(quiet).excess
    for block in blocks:
        for place in range(first, first + block.size(count), len(block.steps)):
            for value in block.raster:
                there = theta.copy()
                there[place + block.raster_of] = value
                excess = objective.solved(quiet.varied(varied(blocks, there))).excess
                if excess < least:
                    theta, least = there, excess
        first += block.size(count)
    return theta


def _derivatives(
    at: Callable[[Array], Solved], theta: Array, here: Solved, steps: Array
) -> tuple[Array, Array]:
    """Return half the gradient (n,) of the squares left, and the residuals' Jacobian (N, n)."""
    gradient, columns = np.zeros(len(theta)), []
    for i, step in enumerate(steps):
        change = np.zeros(len(theta))
        change[i] = step
        after, before = at(theta + change), at(theta - change)
        gradient[i] = 0.25 * here.residuals * (after.excess - before.excess) / step
        columns.append(
            ((after.rows.A - before.rows.A) @ here.x - after.rows.b + before.rows.b)
            / (2.0 * step))
    D = np.column_stack(columns)
    return gradient, D - here.basis @ (here.basis.T @ D)  # what the cup explains as well


def _inverse(information: Array) -> tuple[Array, Mask]:
    """Return the inverse of an information matrix as far as it goes, and what is unknown."""
    diagonal = np.diag(information)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    known = values > SINGULAR * max(float(values[-1]), SINGULAR)
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    unknown: Mask = np.any(np.abs(vectors[:, ~known]) > IN_NULL_SPACE, axis=1)
    return inverse / np.outer(scale, scale), unknown


def _covariance(here: Solved, D: Array) -> Array:
    """Return the covariance that allows for residuals that hang together in clusters."""
    inverse, unknown = _inverse(D.T @ D)
    left = here.rows.A @ here.x - here.rows.b
    scores = np.array([D[part].T @ left[part] for part in here.rows.clusters])
    covariance: Array = inverse @ scores.T @ scores @ inverse
    covariance[np.ix_(unknown, unknown)] = 0.0
    covariance[unknown, unknown] = np.inf
    return covariance
