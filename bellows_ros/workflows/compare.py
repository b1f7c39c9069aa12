"""Comparison of fits: of two result files, and of the recordings of one fit."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
import os
from statistics import NormalDist
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Fit, parameter_units
from bellows_ros.core.identification.samples import AnyRecording
from bellows_ros.core.model.structure import common_structure, Structure, structure_named
from bellows_ros.files import File, results
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
    shared : tuple of str
        Recordings used by both of two fits, which are then not independent.

    """

    names: tuple[str, ...]
    structure: Structure
    values: Array
    std: Array
    shared: tuple[str, ...] = ()

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
    def sentences(self) -> tuple[str, ...]:
        """The verdict, after a warning of shared recordings."""
        z = np.where(np.isfinite(self.z), self.z, 0.0)
        change = np.where(np.isfinite(self.z), self.values / self.others[0] - 1.0, 0.0)
        is_material = np.abs(change) > MATERIAL_DIFFERENCE
        significant = np.abs(z) * (np.abs(z) > self.limit)
        material = np.any(significant * is_material)
        fit, entry = divmod(int(np.argmax(significant * is_material if material else np.abs(z))),
                            z.shape[1])
        code = ('not_comparable' if not np.isfinite(self.z).any() else 'one_cup'
                if not self.differs else 'other_cups' if material else 'nearly_one_cup')
        return (
            *([sentence('comparison', 'shared', recordings=self.shared)] if self.shared else ()),
            sentence('comparison', code, names=self.names, name=self.names[fit],
                     label=self.structure.labels[entry], difference=float(change[fit, entry]),
                     z=float(z[fit, entry]), limit=self.limit))

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Return label, unit, values with standard errors, and z-score of the second fit."""
        (before, after), (before_std, after_std) = self.values, self.std
        return list(zip(
            self.structure.labels, parameter_units(self.structure), before.tolist(),
            before_std.tolist(), after.tolist(), after_std.tolist(), self.z[1].tolist(),
            strict=True))

    def verdict_json(self) -> dict[str, Any]:
        """Return the test for one cup."""
        return {'one_cup': not self.differs, 'verdict': self.sentences[-1], 'z': self.z}

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file of two fits, in SI units."""
        names = ('name', 'unit', 'before', 'before_std', 'after', 'after_std', 'z')
        return results.with_units({
            'before': self.names[0], 'after': self.names[1], **self.verdict_json(),
            'parameters': [dict(zip(names, row, strict=True)) for row in self.rows()],
            'shared_recordings': self.shared})


def compared(
    names: Sequence[str], fits: Sequence[Estimates], shared: tuple[str, ...] = ()
) -> ComparedFits:
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
    return ComparedFits(tuple(names), common, np.array(values), np.array(std), shared)


def compare_files(before: File, after: File) -> ComparedFits:
    """
    Compare two JSON files written by `bellows identify`.

    Raises
    ------
    BellowsError
        If a file is not the result of a fit.

    """
    contents = [results.read_result(path) for path in (before, after)]
    with results.content_of(before, after):
        used, again = map(_digests, contents)
        shared = tuple(name for name, digests in again.items() if digests in used.values())
        return compared(
            (os.fspath(before), os.fspath(after)), [*map(_estimates, contents)], shared)


def _estimates(content: Mapping[str, Any]) -> Estimates:
    structure = structure_named(content['structure'])
    labels, rows = (content['parameters'][key] for key in ('labels', 'covariance'))
    covariance = np.array([[np.inf if x is None else float(x) for x in row] for row in rows])
    order = [labels.index(label) for label in structure.labels]
    K, P = (np.array(content[key], dtype=float) for key in ('stiffness', 'damping'))
    for name, matrix in (('stiffness', K), ('damping', P)):
        if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
            raise ValueError(f'{name} is no matrix of shape (6, 6) of finite numbers')
    return structure, structure.parameters(K, P), covariance[np.ix_(order, order)]


def _digests(content: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    return {
        recording['path']: tuple(file['sha256'] for file in recording['files'])
        for recording in content['provenance']['recordings']}


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
