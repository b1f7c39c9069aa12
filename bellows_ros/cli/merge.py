"""`bellows merge`: fit a cup to the summaries of recordings."""

import argparse
from typing import TYPE_CHECKING

from .commands import NOT_USABLE, OK
from .console import Console
from .options import add_json_option, require_outputs, STDOUT, uninterrupted

if TYPE_CHECKING:
    from bellows_ros.workflows.batch import Merged

DESCRIPTION = (
    'Fit a cup to all recordings that bellows summarize has made summaries of: the same result as '
    'of bellows identify with all of them.'
)
EXAMPLES = (
    ('bellows merge *.npz --out cup.yaml --json fit.json',
     'identify a cup from summaries'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument('summaries', metavar='SUMMARY', nargs='+', help='files of summarize, .npz')
    parser.add_argument(
        '--out', metavar='FILE', default='',
        help='write the cup as a parameter file, for the predictor and bellows replay',
    )  # fmt: skip
    add_json_option(parser, 'the result with its uncertainties')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Merge, write, report."""
    require_outputs(arguments.out, arguments.json)
    from bellows_ros.files.results import format_json
    from bellows_ros.workflows.batch import merge, save_merged

    result = merge(arguments.summaries)
    usable = result.fit.usable
    json_file = '' if arguments.json == STDOUT else arguments.json
    with uninterrupted():
        save_merged(result, arguments.out if usable else '', json_file)
    if arguments.json == STDOUT:
        console.raw(format_json(result.as_json()))
    with console.results_to_stderr(arguments.json == STDOUT):
        _say(result, console)
        if arguments.out and usable:
            console.say(f'Wrote {arguments.out}.')
        elif arguments.out:
            console.paragraph(
                f'This is no cup that can hold a package: {arguments.out} was not written.', 'red'
            )
    return OK if usable else NOT_USABLE


def _say(result: 'Merged', console: Console) -> None:
    """Print the cup and what it rests on."""
    from .words import cup_table

    fit = result.fit
    console.say(f'Cup identified from {len(result.files)} summaries', 'bold')
    console.say(f'({fit.method.replace("_", " ")}, {fit.structure})', 'dim')
    console.say()
    for line in cup_table(fit):
        console.say(f'  {line}'.rstrip())
    console.say()
    console.paragraph(
        f'{fit.samples_used} samples used, {fit.samples_rejected} rejected. Condition number of '
        f'the fit: {fit.condition_number:.3g}.'
    )
    for warning in result.warnings:
        console.warn(warning)
