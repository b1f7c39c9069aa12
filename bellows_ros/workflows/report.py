"""An existing fit, with its recordings read again for a page."""

from collections.abc import Mapping, Sequence
import os
from typing import Any

from bellows_ros.core.model.validity_range import Envelope, FIELDS
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Recording
from bellows_ros.files.bag_folder import digests
from bellows_ros.workflows.recordings import load, Progress, values_of_each
from bellows_ros.workflows.replay import Replay, validated

INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of package.inertia in the tensor."""


def read_again(
    content: Mapping[str, Any], validation: Sequence[str | os.PathLike[str]], progress: Progress
) -> tuple[list[Recording], list[Replay]]:
    """
    Return the recordings of a fit, read again, and others simulated with its cup.

    Parameters
    ----------
    content : mapping
        The result as its JSON file holds it.
    validation : sequence of path
        Recordings of the same cup and package that the fit has not seen.
    progress : callable
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a recording cannot be read.

    """
    bags = [str(recording['bag']) for recording in content['recordings']]
    steps = len(bags) + len(validation) + 1
    recordings = []
    for number, (bag, own) in enumerate(zip(bags, values_of_recordings(content), strict=True)):
        progress(f'reading {bag}', number / steps)
        recordings.append(load(bag, resolve(own)))
    values = resolve(cup_values(content), PACKAGE_PARAMETERS if validation else ())
    validations = []
    for number, other in enumerate(validation, len(bags)):
        progress(f'simulating {other}', number / steps)
        validations.append(validated(values, load(other, values)))
    return recordings, validations


def changed_recordings(content: Mapping[str, Any]) -> list[str]:
    """Return the recordings that have changed since the fit."""
    known = (content.get('provenance') or {}).get('recordings', ())
    return [entry['path'] for entry in known if digests(entry['path']) != entry['files']]


def cup_values(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a result with its cup and its validity range in them."""
    flat = {f'cup.{key}': tuple(x for row in content[key] for x in row)
            for key in ('stiffness', 'damping')}
    known = Envelope(**{name: content['envelope'][name] for name in FIELDS}).parameters()
    return {**content['settings'], **flat, **known, 'cup.length': content['cup_length']}


def values_of_recordings(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the settings of a result for each of its recordings, with cup and package."""
    values, each = cup_values(content), []
    own = dict(zip(map(str, values['bags']), values_of_each(values), strict=True))
    for recording in content['recordings']:
        payload = recording['package']
        each.append({
            **own[str(recording['bag'])],
            'package.mass': payload['mass'],
            'package.inertia': tuple(payload['inertia'][i][j] for i, j in INERTIA),
            'package.com': tuple(payload['com']),
        })
    return each
