"""Comparison of fits: of two result files, and of the recordings of one fit."""

from collections.abc import Callable, Mapping, Sequence
import os
from typing import Any, NamedTuple

from bellows_ros.core.identification.comparison import Consistency, Estimates, same_cup
from bellows_ros.core.identification.reduction import AnyRecording
from bellows_ros.core.identification.result import Fit, parameter_units
from bellows_ros.core.model.structure import structure_named
from bellows_ros.files import File, results
from bellows_ros.report.sentences import sentence
import numpy as np


class ComparedFits(NamedTuple):
    """
    Comparison of two or more fits.

    Parameters
    ----------
    names : tuple of str
        Names of the fits.
    consistency : Consistency
        Test for one cup.
    shared : tuple of str
        Recordings used by both of two fits, which are then not independent.

    """

    names: tuple[str, ...]
    consistency: Consistency
    shared: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether the fits are of different cups."""
        return self.consistency.differs

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict, after a warning of shared recordings."""
        numbers = self.consistency.numbers
        return (
            *([sentence('comparison', 'shared', recordings=self.shared)] if self.shared else ()),
            sentence('comparison', self.consistency.code, names=self.names,
                     name=self.names[numbers['fit']], **numbers))

    def rows(self) -> list[tuple[str, str, float, float, float, float, float]]:
        """Return label, unit, values, standard errors, and the difference in standard errors."""
        found = self.consistency
        (before, after), (before_std, after_std) = found.values, found.std
        with np.errstate(divide='ignore', invalid='ignore'):
            difference = (after - before) / np.hypot(before_std, after_std)
        return list(zip(
            found.structure.labels, parameter_units(found.structure), before.tolist(),
            before_std.tolist(), after.tolist(), after_std.tolist(), difference.tolist(),
            strict=True))

    def verdict_json(self) -> dict[str, Any]:
        """Return the test for one cup."""
        return {
            'one_cup': not self.differs, 'verdict': self.sentences[-1],
            **results.attributes(self.consistency, 'probability', 'probability_stiffness',
                                 'probability_damping', 'deviations')}

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file of two fits, in SI units."""
        names = ('name', 'unit', 'before', 'before_std', 'after', 'after_std', 'standard_errors')
        return results.with_units({
            'before': self.names[0], 'after': self.names[1], **self.verdict_json(),
            'parameters': [dict(zip(names, row, strict=True)) for row in self.rows()],
            'shared_recordings': self.shared})


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
        return ComparedFits(
            (os.fspath(before), os.fspath(after)), same_cup([*map(_estimates, contents)]), shared)


def _estimates(content: Mapping[str, Any]) -> Estimates:
    structure = structure_named(content['structure'])
    labels, rows = (content['parameters'][key] for key in ('labels', 'covariance'))
    covariance = np.array([[np.inf if x is None else float(x) for x in row] for row in rows])
    order = [labels.index(label) for label in structure.labels]
    K, P = (np.array(content[key], dtype=float) for key in ('stiffness', 'damping'))
    for name, matrix in (('stiffness', K), ('damping', P)):
        if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
            raise ValueError(f'{name} is no matrix of shape (6, 6) of finite numbers')
    return Estimates(structure, structure.parameters(K, P), covariance[np.ix_(order, order)])


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
    return ComparedFits(tuple(names), same_cup([
        Estimates(structure_named(fit.structure), fit.parameters, fit.covariance)
        for fit in fits]))
