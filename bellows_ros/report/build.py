"""Whole pages: of an identification, and of a validation."""

from collections.abc import Mapping, Sequence
import json
import os
from typing import Any

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.excitation import describe_excitation
from bellows_ros.core.identification.envelope import Envelope, FIELDS
from bellows_ros.core.identification.methods import filtered_samples
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import package_of
from bellows_ros.core.recording.preparation import Recording
from bellows_ros.errors import BellowsError
from bellows_ros.files.atomic import write_text
from bellows_ros.files.provenance import provenance
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identify import Identification
from bellows_ros.workflows.recordings import load, offset_sentence, values_of_each
from bellows_ros.workflows.validate import judge, Validated

from .cup import cup_content, envelope_content, excitation_content, iteration_content
from .motion import motion_content
from .origin import origin_content
from .page import bullets, page, paragraph, section, warnings
from .rest import ladder_content, rest_content
from .samples import samples_content

INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of the parameter package.inertia in the tensor."""


def identification_report(
    content: Mapping[str, Any],
    recordings: Sequence[Recording],
    validations: Sequence[Validated] = (),
) -> str:
    """
    Return the page of a fit.

    Parameters
    ----------
    content : mapping
        The result as its JSON file holds it (plain lists and numbers, None for not known).
    recordings : sequence of Recording
        The prepared recordings of the fit, in the order of the setting `bags`.
    validations : sequence of Validated
        Recordings that the fit has not seen, simulated with its cup.

    Raises
    ------
    BellowsError
        If the content lacks something, or a file of its provenance cannot be read.

    """
    settings = content['settings']
    bags = [str(bag) for bag in settings['bags']]
    method = str(content['method']).replace('_', ' ')
    sections = [
        section('Cup', warnings(content['warnings']), bullets(content.get('findings', ())),
                *cup_content(content)),
        *([section('What the fit has seen', *envelope_content(content))]
          if content.get('envelope') else []),
        *(section(f'Not used in the fit: {v.bag}', *motion_content(v)) for v in validations),
        *(section(f'Used in the fit: {bag}', *_simulated(bag, own, recording))
          for bag, own, recording in zip(
              bags, values_of_recordings(content), recordings, strict=True)),
        section('Excitation', *_excitation(content, recordings)),
        *([section('Iteration', *iteration_content(content['iterations']))]
          if content.get('iterations') else []),
        *(section(f'Samples of {bag}', *samples_content(recording))
          for bag, recording in zip(bags, recordings, strict=True)),
        *(section(f'Samples of {v.bag}', *samples_content(v.recording)) for v in validations),
        *([section('At rest', *rest_content(content))] if content.get('at_rest') else []),
        *([section('Structures', *ladder_content(content['ladder']))]
          if content.get('ladder') else []),
        section('Where this comes from', *origin_content(_origin(content, validations), settings)),
    ]  # fmt: skip
    title = f'Cup identified from {", ".join(bags)}'
    return page(title, f'{method}, {content["structure"]}', sections)


def validation_report(
    validated: Validated, parameter_files: Sequence[str | os.PathLike[str]] = ()
) -> str:
    """Return the page of a validation."""
    sections = [
        section(
            'Free simulation', bullets(offset_sentence(validated.bag, validated.time_offset)),
            *motion_content(validated)),
        section('Samples', *samples_content(validated.recording)),
        section('Where this comes from', *origin_content(
            provenance([validated.bag], parameter_files), validated.values)),
    ]  # fmt: skip
    return page(f'Validation on {validated.bag}', 'free simulation from start to end', sections)


def _origin(
    content: Mapping[str, Any], validations: Sequence[Validated]
) -> Mapping[str, Any]:
    """Return the provenance of a result with that of the recordings it was validated on."""
    known = content.get('provenance') or provenance(content['settings']['bags'])
    more = provenance([validated.bag for validated in validations])
    return {**known, 'recordings': [*known['recordings'], *more['recordings']]}


def cup_values(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a result with its cup, and what its fit has seen, in them."""
    flat = {f'cup.{key}': tuple(x for row in content[key] for x in row)
            for key in ('stiffness', 'damping')}  # fmt: skip
    seen = content.get('envelope')
    known = Envelope(**{name: seen[name] for name in FIELDS}).parameters() if seen else {}
    return {**content['settings'], **flat, **known, 'cup.length': content['cup_length']}


def values_of_recordings(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the settings of a result for each of its recordings: its cup, and what was held."""
    each = []
    for recording in content['recordings']:
        held = recording.get('package')
        own = {} if held is None else {
            'package.mass': held['mass'],
            'package.inertia': tuple(held['inertia'][i][j] for i, j in INERTIA),
            'package.com': tuple(held['com']),
        }  # fmt: skip
        each.append({**cup_values(content), **own})
    return each


def write_page(result: Identification, path: str | os.PathLike[str]) -> None:
    """
    Write the page of an identification.

    Recordings that were worked on elsewhere are read again.

    Raises
    ------
    BellowsError
        If the file cannot be written, or a recording cannot be read again.

    """
    content = json.loads(format_json(result.as_json()))
    recordings = result.recordings or [
        load(bag, own).recording
        for bag, own in zip(result.values['bags'], values_of_each(result.values), strict=True)
    ]
    write_text(path, identification_report(content, recordings, result.validations))


def _simulated(bag: str, values: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return how a recording of the fit is simulated, or why it cannot be."""
    try:
        return motion_content(judge(bag, values, recording))
    except BellowsError as error:
        return [paragraph(f'This cup cannot be simulated: {error}', 'quiet')]


def _excitation(content: Mapping[str, Any], recordings: Sequence[Recording]) -> list[str]:
    """Return what the recordings can tell, or why that is not known."""
    values = content['settings']
    samples = [
        filtered_samples(recording, package_of(own), own)
        for own, recording in zip(values_of_recordings(content), recordings, strict=True)
    ]
    noises = [FilterNoise.of(recording) for recording in recordings]
    structure = structure_named(content['structure'])
    try:
        found = describe_excitation(samples, content['cup_length'], structure, noises)
    except BellowsError as error:
        return [paragraph(str(error), 'quiet')]
    return excitation_content(found, [str(bag) for bag in values['bags']])
