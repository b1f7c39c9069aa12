"""Whole pages: of an identification, and of a replay."""

from collections.abc import Mapping, Sequence
import json
import os
from typing import Any

from bellows_ros.core.identification.reduction import SEED as EXCITATION_SEED
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.validation import SEED
from bellows_ros.core.model.validity_range import Envelope, FIELDS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import UnstableError
from bellows_ros.files.atomic import write_text
from bellows_ros.files.results import format_json, provenance
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.recordings import offset_sentence, values_of_each
from bellows_ros.workflows.replay import Replay, validated

from .cup import (
    cup_content,
    envelope_content,
    excitation_content,
    iteration_content,
    selection_content,
    standstill_content,
)
from .motion import motion_content, observed_content, samples_content
from .page import bullets, folded, page, paragraph, section, table, warnings

INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of package.inertia in the tensor."""


def identification_report(
    content: Mapping[str, Any],
    recordings: Sequence[Recording],
    validations: Sequence[Replay] = (),
) -> str:
    """
    Return the page of a fit.

    Parameters
    ----------
    content : mapping
        The result as its JSON file holds it (plain lists and numbers, None for not known).
    recordings : sequence of Recording
        The recordings of the fit, in their order in the result.
    validations : sequence of Replay
        Recordings that the fit has not seen, simulated with its cup.

    Raises
    ------
    BellowsError
        If the content lacks something, or a file of its provenance cannot be read.

    """
    settings = content['settings']
    bags = [recording.name for recording in recordings]
    spectra = {own.name: samples_of(own).twist_spectrum for own in recordings}
    refusals = ' '.join(content.get('refusals', ()))
    method = str(content['method']).replace('_', ' ')
    origin = dict(content['provenance'])  # and of what the fit has not seen
    origin['recordings'] = [*origin['recordings'],
                            *provenance([v.bag for v in validations])['recordings']]
    sections = [
        section('Cup', paragraph('The fit can be used.' if content['usable'] else
                                 f'The fit cannot be used: {refusals or "the warnings say why."}'),
                *(paragraph(v.sentence) for v in validations),
                warnings(content['warnings']), bullets(content.get('findings', ())),
                *cup_content(content)),
        section('Validity range', *envelope_content(content)),
        *(section(f'Not used in the fit: {v.bag}', *motion_content(v)) for v in validations),
        *(section(f'Used in the fit: {recording.name}', *_simulated(own, recording))
          for own, recording in zip(values_of_recordings(content), recordings, strict=True)),
        section('Excitation', *excitation_content(content['excitation'], spectra)),
        *([section('Iteration', *iteration_content(content['iterations']))]
          if content.get('iterations') else []),
        *(section(f'Samples of {bag}', *samples_content(recording))
          for bag, recording in zip(bags, recordings, strict=True)),
        *(section(f'Samples of {v.bag}', *samples_content(v.recording)) for v in validations),
        *([section('Standstills', *standstill_content(content))] if content.get('static') else []),
        *([section('Structures', *selection_content(content['structures']))]
          if content.get('structures') else []),
        section('Where this comes from', *_origin(origin, settings)),
    ]
    title = f'Cup identified from {", ".join(bags)}'
    return page(title, f'{method}, {content["structure"]}', sections)


def replay_report(
    found: Replay, parameter_files: Sequence[str | os.PathLike[str]] = ()
) -> str:
    """Return the page of a replay."""
    sections = [
        section(
            'Free simulation', bullets(offset_sentence(found.bag, found.time_offset)),
            *motion_content(found)),
        *([section(f'With {found.observed.topic}', *observed_content(found.observed))]
          if found.observed else []),
        section('Samples', *samples_content(found.recording)),
        section('Where this comes from', *_origin(
            provenance([found.bag], parameter_files), found.values)),
    ]
    return page(f'Replay of {found.bag}', 'free simulation from start to end', sections)


def write_page(result: Identification, path: str | os.PathLike[str]) -> None:
    """
    Write the page of an identification for which the parameter output.report was set.

    Raises
    ------
    BellowsError
        If the file cannot be written.

    """
    content = json.loads(format_json(result.as_json()))
    write_text(path, identification_report(content, result.recordings, result.validations))


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


def _simulated(values: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return how a recording of the fit is simulated, or why it cannot be."""
    try:
        return motion_content(validated(values, recording))
    except UnstableError as error:
        return [paragraph(f'This cup cannot be simulated: {error}', 'quiet')]


def _origin(provenance: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return tables of digests, versions and settings."""
    files = [
        (kind, entry['path'], file['name'], str(file['bytes']), file['sha256'])
        for kind, key in (('recording', 'recordings'), ('parameters', 'parameter_files'))
        for entry in provenance.get(key, ())
        for file in entry['files']
    ]
    versions = [(name, version or 'not there') for name, version in provenance['versions'].items()]
    seeds = f'{SEED} (validation), {EXCITATION_SEED} (excitation)'
    versions.append(('seeds of made-up noise', seeds))
    rows = [(name, _setting(value)) for name, value in settings.items()]
    return [
        table(('', 'path', 'file', 'bytes', 'SHA-256'), files, (0, 1, 2, 4)),
        table(('', 'version or seed'), versions, (0, 1)),
        folded('All settings', table(('parameter', 'value'), rows, (0, 1))),
    ]


def _setting(value: Any) -> str:
    """Return a setting; of a matrix its rows."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(_setting(item) for item in value) + ']'
    if isinstance(value, float):
        return f'{value:.8g}'
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"
