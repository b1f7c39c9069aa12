"""`bellows report`: write a page with plots of an existing fit."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import options
from .console import Console, OK

DESCRIPTION = (
    'Write one HTML file that needs no network: the cup with its intervals, measured and '
    'simulated motion, residuals and their spectra, excitation, lost samples, and the '
    'provenance of all numbers. The recordings of the fit are read again.'
)
EXAMPLES = (
    ('bellows report fit.json --out report.html', 'a page on a fit written with --json fit.json'),
    ('bellows report fit.json --validation bags/validation --out report.html',
     'with another recording, not used in the fit'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'fit', metavar='FIT', type=Path, help='result file, written by bellows identify --json'
    )
    parser.add_argument(
        '--out', metavar='FILE', required=True, type=options.Output, help='the page to write'
    )
    parser.add_argument(
        '--validation', metavar='BAG', action='append', default=[], type=Path,
        help='recording of the same cup and package, not used in the fit; may be repeated',
    )
    options.add_json_option(parser, 'the result of the validations')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Write the page, or say what is wrong with the result."""
    from bellows_ros.files.results import content_of, read_result

    content = read_result(arguments.fit)
    _require_settings(arguments.fit, content)
    with content_of(arguments.fit):
        return _report(arguments, content, console)


def _report(arguments: argparse.Namespace, content: dict[str, Any], console: Console) -> int:
    """Read, simulate, write."""
    from bellows_ros.core.identification.identifiability import excitation_of
    from bellows_ros.core.identification.reduction import reduced
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
    from bellows_ros.core.structure import structure_named
    from bellows_ros.files.atomic import write_text
    from bellows_ros.report.build import (
        cup_values,
        identification_report,
        values_of_recordings,
    )
    from bellows_ros.workflows.recordings import load
    from bellows_ros.workflows.replay import validated
    import numpy as np

    bags = [str(recording['bag']) for recording in content['recordings']]
    options.require_named_outputs(arguments, bags)
    with console.progress() as progress:
        recordings, parts = [], []
        for number, (bag, own) in enumerate(zip(bags, values_of_recordings(content), strict=True)):
            progress(f'reading {bag}', number / (len(bags) + len(arguments.validation) + 1))
            each = resolve(own)
            recordings.append(load(bag, each))
            parts.append(reduced(recordings[-1], each).information)
        required = PACKAGE_PARAMETERS if arguments.validation else ()
        values = resolve(cup_values(content), required)
        validations = []
        for number, bag in enumerate(arguments.validation, len(bags)):
            progress(f'simulating {bag}', number / (len(bags) + len(arguments.validation) + 1))
            validations.append(validated(values, load(bag, values)))
        structure = structure_named(content['structure'])
        covariance = content['parameters']['covariance']
        excitation = excitation_of(parts, structure, content['method'], (
            structure.parameters(*(np.array(content[name]) for name in ('stiffness', 'damping'))),
            np.array([[np.inf if x is None else x for x in row] for row in covariance])))
        write_text(arguments.out, identification_report(
            content, recordings, excitation, validations))
    others = changed(content)
    options.put_json(arguments.json, {
        'file': arguments.out, 'changed_recordings': others,
        'validations': [validation.as_json() for validation in validations],
    }, console)
    for bag in others:
        console.warn(f'{bag} has changed since the cup was identified from it.')
    for validation in validations:
        for warning in validation.warnings:
            console.warn(f'{validation.bag}: {warning}')
    console.say(f'Wrote {arguments.out}.')
    return OK


def changed(content: Mapping[str, Any]) -> list[str]:
    """Return the recordings whose content is not that of the time of the fit."""
    from bellows_ros.files.bag_folder import digests

    known = (content.get('provenance') or {}).get('recordings', ())
    return [entry['path'] for entry in known if digests(entry['path']) != entry['files']]


def _require_settings(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse a result that does not say how it was made."""
    from bellows_ros.errors import BellowsError

    settings = content.get('settings')
    if not isinstance(settings, dict) or not settings.get('bags'):
        raise BellowsError(
            f"Result '{path}' does not name its recordings. Identify the cup again with --json."
        )
