"""
Write a page on a fit: one HTML file that needs no network.

It shows the cup with its intervals, measured and simulated motion, residuals and their spectra,
excitation, lost samples, and the provenance of all numbers. The recordings of the fit are read
again. Needs matplotlib (extra plot).
"""

import argparse
from pathlib import Path

from bellows_ros.errors import BellowsError
from bellows_ros.extras import require_pictures

from . import options
from .console import Console, OK

EXAMPLES = (
    ('bellows report fit.json --out report.html', 'a page on a fit written with --json fit.json'),
    ('bellows report fit.json --validation bags/validation --out report.html',
     'with another recording, not used in the fit'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'fit', metavar='FIT', type=Path,
        help='result file, written by bellows identify --json')
    options.add_output(parser, '--out', 'the page to write', required=True)
    parser.add_argument(
        '--validation', metavar='BAG', action='append', default=[], type=Path,
        help='recording of the same cup and package, not used in the fit; may be repeated',
    )
    options.add_json_option(parser, 'the result of the validations')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Read the result and its recordings again, write the page, report."""
    from bellows_ros.files.atomic import write_text
    from bellows_ros.files.results import content_of, read_result
    from bellows_ros.report.build import identification_report
    from bellows_ros.workflows.report import changed_recordings, read_again

    require_pictures()
    content = read_result(arguments.fit)
    settings = content.get('settings')
    if not isinstance(settings, dict) or not settings.get('bags'):
        raise BellowsError(
            f"Result '{arguments.fit}' does not name its recordings. Identify the cup again with "
            '--json.')
    with content_of(arguments.fit), console.progress() as progress:
        bags = [str(recording['bag']) for recording in content['recordings']]
        options.require_named_outputs(arguments, bags)
        recordings, validations = read_again(content, arguments.validation, progress)
        write_text(arguments.out, identification_report(content, recordings, validations))
        others = changed_recordings(content)
    options.put_json(arguments.json, {
        'file': arguments.out, 'changed_recordings': others,
        'validations': [validation.as_json() for validation in validations]})
    console.warn(*(f'{bag} has changed since the cup was identified from it.' for bag in others))
    console.warn(*(f'{validation.bag}: {warning}' for validation in validations
                   for warning in validation.warnings))
    console.wrote(arguments.out)
    return OK
