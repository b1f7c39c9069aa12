"""Compare two fits of a cup by their result files."""

from collections.abc import Mapping
from dataclasses import dataclass
import os
from typing import Any, NamedTuple

from bellows_ros.core.identification.comparison import compare_fits, FitComparison, Fitted
from bellows_ros.core.model.cup_package import Cup, package_of
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.results import attributes, content_of, read_result, with_units
import numpy as np

NOT_COMPARED = ('output.', 'predictor', 'exit_when_done', 'envelope.', 'cup.stiffness',
                'cup.damping')
"""Settings that do not affect the fit."""


class Difference(NamedTuple):
    """A setting or a version that differs; None if a fit lacks it."""

    name: str
    before: Any
    after: Any


@dataclass(frozen=True, eq=False)
class ResultComparison:
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
    fits: FitComparison
    settings: tuple[Difference, ...]
    shared: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        derived = ('percent', 'standard_errors', 'p_value', 'significant')
        return with_units({
            'before': self.paths[0],
            'after': self.paths[1],
            **attributes(self.fits, 'matters', 'significant', 'p_value', 'shake_rms'),
            **{name: [{**vars(change), **attributes(change, *derived)} for change in changes]
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
    contents = read_result(before), read_result(after)
    fitted = []
    for path, content in zip((before, after), contents, strict=True):
        with content_of(path):
            fitted.append(_fitted(content))
    with content_of(before):
        settings = contents[0].get('settings')
        if not isinstance(settings, dict):
            raise BellowsError('The result has no settings, so the package is unknown. Identify '
                               'the cup again with this version.')
        values: dict[str, Any] = dict(resolve(settings, PACKAGE_PARAMETERS))
    with content_of(before, after):
        old, new = map(_described, contents)
        return ResultComparison(
            paths=(os.fspath(before), os.fspath(after)),
            fits=compare_fits(
                fitted[0], fitted[1], package_of(values), values['gravity.magnitude']),
            settings=tuple(
                Difference(name, old.get(name), new.get(name))
                for name in sorted({*old, *new}) if old.get(name) != new.get(name)),
            shared=tuple(name for name, content in _contents(contents[1]).items()
                         if content in _contents(contents[0]).values()))


def _fitted(content: Mapping[str, Any]) -> Fitted:
    """Return structure, cup and covariance of a result."""
    structure = structure_named(content['structure'])
    labels = list(content['parameters']['labels'])
    rows = content['parameters']['covariance']
    covariance = np.array(
        [[np.inf if x is None else float(x) for x in row] for row in rows], dtype=float)
    order = [labels.index(label) for label in structure.labels]
    cup = Cup(
        np.array(content['stiffness'], dtype=float), np.array(content['damping'], dtype=float),
        float(content['cup_length']), tuple(content.get('relaxation', (0.0, 0.0))))
    return Fitted(structure, cup, covariance[np.ix_(order, order)])


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
