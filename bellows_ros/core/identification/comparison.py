"""
Test whether fits are of one cup.

Estimates of independent fits scatter about their weighted mean by their covariances: Wald's chi^2
is the sum of their squared deviations in standard errors.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import covariance_of, information_of
from bellows_ros.core.model.structure import common_structure, Structure
import numpy as np
from scipy.special import chdtrc

FALSE_ALARMS = 0.01
"""Fraction of comparisons of one cup that report different cups."""

SIGNIFICANT_ERRORS = 3.0
"""Smallest significant deviation of one entry, standard errors: by chance in 0.3 %."""

MATERIAL_DIFFERENCE = 0.05
"""Smallest material relative deviation of an entry; 5 % of K shift a frequency by 2.5 %."""


TIED_VARIANCE = 1e-12
"""Relative variance of the difference of two entries that are equal by the fit's structure."""


class Estimates(NamedTuple):
    """
    K and P of a fit.

    Parameters
    ----------
    structure : Structure
        Structure of K and P.
    values : ndarray (p,)
        Free parameters, in the order of the structure's labels.
    covariance : ndarray (p, p)
        Covariance of the values; infinite for parameters that are not identifiable.

    """

    structure: Structure
    values: Array
    covariance: Array


class Consistency(NamedTuple):
    """
    Outcome of the test of n fits.

    Parameters
    ----------
    structure : Structure
        Simplest structure that contains the structures of all fits.
    values, std : ndarray (n, p)
        Free parameters of the structure and their standard errors.
    mean : ndarray (p,)
        Weighted mean; 0 if no fit identifies the parameter.
    probability, probability_stiffness, probability_damping : float
        Probability of a larger chi^2 for one cup: of all parameters, of K alone, and of P alone;
        NaN if fewer than two fits identify a parameter.

    """

    structure: Structure
    values: Array
    std: Array
    mean: Array
    probability: float
    probability_stiffness: float
    probability_damping: float

    @property
    def differs(self) -> bool:
        """Whether the fits are of different cups."""
        return self.probability < FALSE_ALARMS

    @property
    def deviations(self) -> Array:
        """Deviations (n, p) from the mean in standard errors; 0 if not identifiable."""
        deviation = np.where(np.isfinite(self.std), self.values - self.mean, 0.0)
        return np.asarray(deviation / np.where(self.std > 0.0, self.std, np.inf))

    @property
    def code(self) -> str:
        """Code of the verdict."""
        if np.isnan(self.probability):
            return 'not_comparable'
        if not self.differs:
            return 'one_cup'
        is_significant = np.abs(self.deviations) > SIGNIFICANT_ERRORS
        is_material = np.abs(self.values - self.mean) > MATERIAL_DIFFERENCE * np.abs(self.mean)
        return 'other_cups' if np.any(is_significant & is_material) else 'nearly_one_cup'

    @property
    def numbers(self) -> dict[str, Any]:
        """Numbers of the verdict: probability, differing matrices, and the largest deviation."""
        fit, entry = divmod(int(np.argmax(np.abs(self.deviations))), self.values.shape[1])
        mean = float(self.mean[entry])
        parts = {'K': self.probability_stiffness, 'P': self.probability_damping}
        return {
            'chance': self.probability, 'fit': fit, 'label': self.structure.labels[entry],
            'matrices': [name for name, p in parts.items() if p < FALSE_ALARMS] or [*parts],
            'difference': float(self.values[fit, entry] - mean) / mean if mean else 0.0,
            'errors': float(self.deviations[fit, entry])}


def same_cup(fits: Sequence[Estimates]) -> Consistency:
    """Test whether two or more independent fits have the same K and P."""
    structure = fits[0].structure
    for fit in fits[1:]:
        if fit.structure.name != structure.name:
            structure = common_structure(structure, fit.structure)
    embeddings = [fit.structure.within(structure) for fit in fits]
    values = np.array([T @ fit.values for T, fit in zip(embeddings, fits, strict=True)])
    covariances = np.array([
        _propagated(T, fit.covariance) for T, fit in zip(embeddings, fits, strict=True)])
    sizes = np.abs(values).max(axis=0)
    sizes[sizes == 0.0] = 1.0
    relative, scaled = values / sizes, covariances / np.outer(sizes, sizes)
    scaled += [TIED_VARIANCE * np.eye(len(sizes)) * (fit.structure.name != structure.name)
               for fit in fits]
    mean, probability = _weighted_mean(relative, scaled)
    parts = [_weighted_mean(relative[:, part], scaled[:, part, part])[1]
             for part in (slice(0, structure.size), slice(structure.size, None))]
    std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    return Consistency(structure, values, std, mean * sizes, probability, *parts)


def _propagated(jacobian: Array, covariance: Array) -> Array:
    """Return the covariance of a quantity with Jacobian (m, n), with infinite entries kept."""
    finite = np.isfinite(np.diag(covariance))
    part = jacobian[:, finite]
    unknown = np.any(jacobian[:, ~finite] != 0.0, axis=1)
    return np.asarray(part @ covariance[np.ix_(finite, finite)] @ part.T
                      + np.diag(np.where(unknown, np.inf, 0.0)))


def _weighted_mean(x: Array, covariances: Array) -> tuple[Array, float]:
    """Return the weighted mean (p,) and the probability of a larger chi^2."""
    weights = np.array([information_of(covariance) for covariance in covariances])
    covariance = covariance_of(weights.sum(axis=0))
    finite = np.isfinite(np.diag(covariance))
    mean = np.where(np.outer(finite, finite), covariance, 0.0) @ np.einsum('nij,nj', weights, x)
    statistic = np.einsum('ni,nij,nj', x - mean, weights, x - mean)
    compared = np.isfinite(np.diagonal(covariances, axis1=1, axis2=2))
    degrees = np.count_nonzero(compared) - np.count_nonzero(finite)
    return mean, float(chdtrc(degrees, statistic)) if degrees else np.nan
