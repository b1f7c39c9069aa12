"""Test whether fits of several recordings or packages are of the same cup."""

from collections.abc import Sequence
from dataclasses import dataclass

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.equations import covariance_of, information_of
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.model.structure import structure_named
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.special import chdtrc

SIGNIFICANT = 0.01
"""p-value below which the cups differ."""

SIGNIFICANT_ERRORS = 3.0
"""Standard errors above which the difference of a single parameter is significant."""

MATERIAL = 0.05
"""Smallest material relative difference of a parameter from the mean."""


@dataclass(frozen=True, eq=False)
class Consistency:
    """
    Outcome of the test.

    Parameters
    ----------
    probability : float
        Of a larger Wald's chi^2 if all cups are the same.
    deviations : ndarray (n, p)
        Of each fit from the weighted mean, in its own standard errors; 0 where it does not know.
    probability_stiffness, probability_damping : float
        The same probability for K alone, and for P alone; NaN where nothing can be compared.
    verdict : str
        In words.

    """

    probability: float
    deviations: Array
    probability_stiffness: float
    probability_damping: float
    verdict: str

    @property
    def differs(self) -> bool:
        """Whether the cups differ significantly and materially."""
        return self.probability < SIGNIFICANT


def same_cup(fits: Sequence[Fit], names: Sequence[str]) -> Consistency:
    """
    Test whether independent fits of one structure found the same K and P.

    Parameters
    ----------
    fits : sequence of Fit
        At least two, of different recordings.
    names : sequence of str
        Their names, such as the packages' masses.

    Raises
    ------
    BellowsError
        If there are fewer than two, or their parameters are not the same.

    """
    if len(fits) < 2 or any(fit.labels != fits[0].labels for fit in fits):
        raise BellowsError(
            'Whether cups are the same needs at least two fits of the same structure.'
        )
    structure = structure_named(fits[0].structure)
    sizes = structure.sizes(fits[0].stiffness, fits[0].damping)
    sizes[sizes == 0.0] = 1.0
    relative = np.array([fit.parameters for fit in fits]) / sizes
    covariances = [fit.covariance / np.outer(sizes, sizes) for fit in fits]
    mean, probability = _compared(relative, covariances)
    half = structure.size
    parts = [
        _compared(relative[:, part], [c[part, part] for c in covariances])[-1]
        for part in (slice(0, half), slice(half, None))
    ]
    std = np.sqrt([np.diag(c) for c in covariances])
    away = np.where(np.isfinite(std), relative - mean, 0.0)
    deviations = away / np.where(std > 0.0, std, np.inf)
    relative_size = np.divide(away, mean, out=np.zeros_like(away), where=mean != 0.0)
    verdict = _verdict(fits[0].labels, names, relative_size, deviations, probability, parts)
    return Consistency(probability, deviations, parts[0], parts[1], verdict)


def _compared(x: Array, covariances: Sequence[Array]) -> tuple[Array, float]:
    """Return the weighted mean (p,), and the chance of more scatter, NaN without a comparison."""
    weights = [information_of(covariance) for covariance in covariances]
    total = np.sum(weights, axis=0)
    together = covariance_of(total)
    known = np.isfinite(np.diag(together))
    together = np.where(np.outer(known, known), together, 0.0)
    mean = together @ np.sum([W @ row for W, row in zip(weights, x, strict=True)], axis=0)
    statistic = float(sum((r - mean) @ W @ (r - mean) for r, W in zip(x, weights, strict=True)))
    known_alone = [np.isfinite(np.diag(covariance)) for covariance in covariances]
    degrees = int(np.sum(known_alone) - np.sum(known))
    return mean, float(chdtrc(degrees, statistic)) if degrees else np.nan


def _verdict(
    labels: Sequence[str], names: Sequence[str], relative: Array, deviations: Array, p: float,
    parts: Sequence[float],
) -> str:
    """Return the outcome in words."""
    if np.isnan(p):
        return ('No parameter is identifiable from two of the recordings, so the cups cannot be '
                'compared.')
    if p >= SIGNIFICANT:
        return (
            'The fits are consistent with one cup: K and P are the same for '
            f'{" and ".join(names)} (probability of larger differences by chance: {p:.2g}).'
        )
    row, column = divmod(int(np.argmax(np.abs(deviations))), deviations.shape[1])
    size = float(relative[row, column])
    differ = [name for name, own in zip('KP', parts, strict=True) if own < SIGNIFICANT]
    which = f'{differ[0]} is' if len(differ) == 1 else 'K and P are'
    said = (
        f'The fits are not of one cup (chance {p:.1g}): {which} not the same for '
        f'{" and ".join(names)}; {labels[column]} of {names[row]} is '
        f'{abs(size) * 100:.2g} % {"above" if size > 0 else "below"} the common value, '
        f'{abs(deviations[row, column]):.1f} standard errors.'
    )
    large = np.abs(relative[np.abs(deviations) > SIGNIFICANT_ERRORS])
    if not (large > MATERIAL).any():
        return (f'{said} The significant differences are below {MATERIAL * 100:g} %, which hardly '
                'matters.')
    return f'{said} The model of stiffness and damping may not hold over this range.'
