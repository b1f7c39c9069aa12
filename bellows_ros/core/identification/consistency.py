"""Whether fits of several recordings or packages found the same cup."""

from collections.abc import Sequence
from dataclasses import dataclass

from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]

SIGNIFICANT = 0.01
"""Probability of such differences by chance below which the cups are said to differ."""

MATTERS = 0.05
"""Relative differences of a parameter from the mean that are worth a word."""


@dataclass(frozen=True, eq=False)
class Consistency:
    """
    Outcome of the test.

    Parameters
    ----------
    statistic, probability : float
        Wald's chi^2, and the probability of a larger one if all cups are the same.
    degrees : int
        Degrees of freedom.
    mean : ndarray (p,)
        Weighted mean of the parameters.
    deviations : ndarray (n, p)
        Of each fit from the mean, in its own standard errors.
    verdict : str
        In words.

    """

    statistic: float
    probability: float
    degrees: int
    mean: Array
    deviations: Array
    verdict: str


def same_cup(fits: Sequence[Fit], names: Sequence[str]) -> Consistency:
    """
    Test whether independent fits of one structure found the same K and P.

    Parameters
    ----------
    fits : sequence of Fit
        At least two, of different recordings.
    names : sequence of str
        What tells them apart, such as the packages' masses.

    Raises
    ------
    BellowsError
        If there are fewer than two, or their parameters are not the same.

    """
    if len(fits) < 2 or any(fit.labels != fits[0].labels for fit in fits):
        raise BellowsError(
            'Whether cups are the same needs at least two fits of the same structure.'
        )
    x = np.array([parameters_of(fit) for fit in fits])
    weights = [np.linalg.pinv(_scaled(fit.covariance, x[0])) for fit in fits]
    relative = x / x[0]
    total = np.sum(weights, axis=0)
    mean = np.linalg.pinv(total) @ np.sum(
        [W @ r for W, r in zip(weights, relative, strict=True)], axis=0
    )
    away = relative - mean
    statistic = float(sum(d @ W @ d for d, W in zip(away, weights, strict=True)))
    degrees = (len(fits) - 1) * x.shape[1]
    probability = float(chi2.sf(statistic, degrees))
    std = np.array([np.sqrt(np.diag(fit.covariance)) for fit in fits])
    deviations = away * x[0] / std
    verdict = _verdict(fits[0].labels, names, away / mean, deviations, probability)
    return Consistency(statistic, probability, degrees, mean * x[0], deviations, verdict)


def parameters_of(fit: Fit) -> Array:
    """Return the values of a fit's labels."""
    return structure_named(fit.structure).parameters(fit.stiffness, fit.damping)


def _scaled(covariance: Array, by: Array) -> Array:
    """Return the covariance of parameters divided by typical values."""
    return np.asarray(covariance / np.outer(by, by))


def _verdict(
    labels: Sequence[str], names: Sequence[str], relative: Array, deviations: Array, p: float
) -> str:
    """Return the outcome in words."""
    if p >= SIGNIFICANT:
        return (
            f'The fits are of one cup as far as they can tell (differences as large come by '
            f'chance with a probability of {p:.2g}).'
        )
    row, column = divmod(int(np.argmax(np.abs(deviations))), deviations.shape[1])
    size = float(relative[row, column])
    said = (
        f'The fits are not of one cup (chance {p:.1g}): {labels[column]} of {names[row]} is '
        f'{abs(size) * 100:.2g} % {"above" if size > 0 else "below"} the common value, '
        f'{abs(deviations[row, column]):.1f} standard errors.'
    )
    if np.abs(relative).max() < MATTERS:
        return f'{said} All differences are below {MATTERS * 100:g} %, which hardly matters.'
    return f'{said} The model of stiffness and damping may not hold over this range.'
