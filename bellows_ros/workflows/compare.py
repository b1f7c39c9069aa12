"""Comparison of the fits to single recordings."""

from collections.abc import Callable, Sequence
from functools import reduce
from statistics import NormalDist
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import AnyRecording
from bellows_ros.core.model.structure import common_structure, Structure, structure_named
from bellows_ros.report.sentences import sentence
import numpy as np

FALSE_ALARMS = 0.01
"""Fraction of comparisons of one cup in which the largest z-score exceeds its limit."""

MATERIAL_DIFFERENCE = 0.05
"""Smallest relative difference of an entry that matters in use: 5 % of K shift a frequency by 2.5
%."""

Estimates = tuple[Structure, Array, Array]
"""Structure of a fit, parameters (p,), and their covariance, infinite for unidentifiable ones."""


class ComparedFits(NamedTuple):
    """
    Comparison of n fits by z-scores: differences over their standard errors.

    Parameters
    ----------
    names : tuple of str
        Names of the fits.
    structure : Structure
        Simplest structure that contains the structures of all fits.
    values, std : ndarray (n, p)
        Parameters of the structure, and their standard errors.

    """

    names: tuple[str, ...]
    structure: Structure
    values: Array
    std: Array

    @property
    def others(self) -> tuple[Array, Array]:
        """Weighted means (n, p) of the other fits by entry, and their variances."""
        least = 1e-12 * np.abs(self.values).max(axis=0) + 1e-300  # of entries that a fit ties
        weights, others = np.maximum(self.std, least)**-2, 1.0 - np.eye(len(self.names))
        with np.errstate(divide='ignore', invalid='ignore'):
            variance = 1.0 / (others @ weights)
            return variance * (others @ (weights * self.values)), variance

    @property
    def z(self) -> Array:
        """Differences (n, p) from the mean of the others over their standard errors, or nan."""
        mean, variance = self.others
        error = np.sqrt(self.std**2 + variance)
        with np.errstate(divide='ignore', invalid='ignore'):
            return np.where(np.isfinite(error), (self.values - mean) / error, np.nan)

    @property
    def limit(self) -> float:
        """Limit of the largest z-score, exceeded by chance in `FALSE_ALARMS` (Bonferroni)."""
        count = self.values.size if len(self.names) > 2 else self.values.shape[1]
        return -NormalDist().inv_cdf(0.5 * FALSE_ALARMS / count)

    @property
    def differs(self) -> bool:
        """Whether the fits are of different cups."""
        return bool(np.any(np.abs(self.z) > self.limit))

    @property
    def verdict(self) -> str:
        """Sentence on the largest difference."""
        z = np.where(np.isfinite(self.z), self.z, 0.0)
        change = np.where(np.isfinite(self.z), self.values / self.others[0] - 1.0, 0.0)
        is_material = np.abs(change) > MATERIAL_DIFFERENCE
        significant = np.abs(z) * (np.abs(z) > self.limit)
        material = np.any(significant * is_material)
        fit, entry = divmod(int(np.argmax(significant * is_material if material else np.abs(z))),
                            z.shape[1])
        code = ('not_comparable' if not np.isfinite(self.z).any() else 'one_cup'
                if not self.differs else 'other_cups' if material else 'nearly_one_cup')
        return sentence(
            'comparison', code, names=self.names, name=self.names[fit],
            label=self.structure.labels[entry], difference=float(change[fit, entry]),
            z=float(z[fit, entry]), limit=self.limit)

    def verdict_json(self) -> dict[str, Any]:
        """Return the test for one cup."""
        return {'one_cup': not self.differs, 'verdict': self.verdict, 'z': self.z}


def compared(names: Sequence[str], fits: Sequence[Estimates]) -> ComparedFits:
    """Return the comparison of fits, in the simplest structure that contains all of theirs."""
    common = reduce(lambda one, other: one if one.name == other.name else common_structure(
        one, other), (structure for structure, *_ in fits))
    values, std = [], []
    for structure, theta, covariance in fits:
        T, unknown = structure.within(common), ~np.isfinite(np.diag(covariance))
        variance = np.diag(T @ np.where(np.isfinite(covariance), covariance, 0.0) @ T.T)
        values.append(T @ theta)
        std.append(np.sqrt(np.where(np.any(T[:, unknown] != 0.0, axis=1), np.inf,
                                    np.maximum(variance, 0.0))))
    return ComparedFits(tuple(names), common, np.array(values), np.array(std))


def consistency(
    parts: Sequence[AnyRecording], fit_alone: Callable[[int, str], Fit]
) -> ComparedFits:
    """Return the comparison of fits to single recordings, by number and name."""
    differ = len({part.payload.mass for part in parts}) > 1
    names = [f'{part.name} ({part.payload.mass:.4g} kg)' if differ else part.name
             for part in parts]
    fits = [*map(fit_alone, range(len(parts)), names)]
    return compared(names, [
        (structure_named(fit.structure), fit.parameters, fit.covariance) for fit in fits])
