"""Whether two result files, or the recordings of one fit, are of the same cup."""

from collections.abc import Callable, Mapping, Sequence
import os
from typing import Any, NamedTuple

from bellows_ros.core.identification import comparison
from bellows_ros.core.identification.reduction import AnyRecording
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.model import cup_package
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters import checks
from bellows_ros.files import File, results
import numpy as np

NOT_COMPARED = ('output.', 'predictor', 'exit_when_done', 'envelope.', 'cup.stiffness',
                'cup.damping')
"""Settings that do not affect the fit."""


class Difference(NamedTuple):
    """A setting or a version that differs; None if a fit lacks it."""

    name: str
    before: Any
    after: Any


class ResultComparison(NamedTuple):
    """
    Two result files compared.

    Parameters
    ----------
    paths : tuple of two str
        The files.
    fits : FitComparison
        What differs in numbers.
    settings : tuple of Difference
        What differs in settings, method, recordings and versions.
    shared : tuple of str
        Recordings that both fits have used: they are not independent then.

    """

    paths: tuple[str, str]
    fits: comparison.FitComparison
    settings: tuple[Difference, ...]
    shared: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        derived = ('percent', 'standard_errors', 'p_value', 'significant')
        return results.with_units({
            'before': self.paths[0],
            'after': self.paths[1],
            **results.attributes(self.fits, 'matters', 'significant', 'p_value', 'shake_rms'),
            **{name: [{**each._asdict(), **results.attributes(each, *derived)} for each in changes]
               for name, changes in (
                   ('parameters', self.fits.parameters), ('effects', self.fits.effects))},
            'settings': self.settings,
            'shared_recordings': self.shared})


def compare_files(before: File, after: File) -> ResultComparison:
    """
    Compare two result files of identifications.

    Parameters
    ----------
    before, after : path
        JSON files that `bellows identify` has written. The package of the first is held in both
        predictions.

    Raises
    ------
    BellowsError
        If a file is not such a result, or a cup cannot hold the package.

    """
    contents = [results.read_result(path) for path in (before, after)]
    with results.content_of(before, after):
        values = checks.resolve(contents[0]['settings'], checks.PACKAGE_PARAMETERS)
        one, other = map(_fitted, contents)
        (old, new), (used, again) = (list(map(part, contents)) for part in (_described, _contents))
        return ResultComparison(
            (os.fspath(before), os.fspath(after)),
            comparison.compare_fits(
                one, other, cup_package.package_of(values), values.gravity.magnitude),
            tuple(Difference(name, old.get(name), new.get(name))
                  for name in sorted({*old, *new}) if old.get(name) != new.get(name)),
            tuple(name for name, content in again.items() if content in used.values()))


def _fitted(content: Mapping[str, Any]) -> comparison.Fitted:
    """Return structure, cup and covariance of a result."""
    structure = structure_named(content['structure'])
    labels, rows = (content['parameters'][key] for key in ('labels', 'covariance'))
    covariance = np.array([[np.inf if x is None else float(x) for x in row] for row in rows])
    order = [labels.index(label) for label in structure.labels]
    K, P = (np.array(content[key], dtype=float) for key in ('stiffness', 'damping'))
    relaxation, length = content.get('relaxation', (0.0, 0.0)), float(content['cup_length'])
    cup = cup_package.Cup(K, P, length, tuple(relaxation))
    return comparison.Fitted(structure, cup, covariance[np.ix_(order, order)])


def _described(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return, by name, how a fit was made: settings, versions, content of recordings."""
    settings, versions = content['settings'], content['provenance']['versions']
    return {
        **{name: value for name, value in settings.items() if not name.startswith(NOT_COMPARED)},
        **{name: content.get(name) for name in ('method', 'structure', 'samples_used')},
        **{f'version of {name}': version for name, version in versions.items()},
        **{f'content of {path}': ' '.join(digest[:12] for digest in digests)
           for path, digests in _contents(content).items()}}


def _contents(content: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """Return the digests of the files of a fit's recordings, by name."""
    return {
        recording['path']: tuple(file['sha256'] for file in recording['files'])
        for recording in content['provenance']['recordings']}


def consistency(
    parts: Sequence[AnyRecording], fit_alone: Callable[[AnyRecording, str], Fit]
) -> comparison.Consistency:
    """Return whether each recording alone, fitted under its name, gives the same cup."""
    differ = len({part.payload.mass for part in parts}) > 1
    names = [f'{part.name} ({part.payload.mass:.4g} kg)' if differ else part.name
             for part in parts]
    return comparison.same_cup([*map(fit_alone, parts, names)], names)
