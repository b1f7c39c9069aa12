"""`bellows summarize`: reduce a recording to what a fit needs of it."""

import argparse

from .commands import OK
from .console import Console
from .options import (
    add_bag_argument,
    add_json_option,
    add_parameter_options,
    given_parameters,
    put_json,
    require_outputs,
    STDOUT,
)

DESCRIPTION = (
    'Reduce a recording to a small file with all that least squares needs of it. Summaries made '
    'anywhere, by any scheduler, are added by bellows merge; together they give the fit of all '
    'recordings at once.'
)
EXAMPLES = (
    ('bellows summarize bags/identification --params bags/package.yaml --out 1.npz',
     'one recording'),
    ('parallel bellows summarize {} --params cell.yaml --out {/}.npz ::: bags/*',
     'many, with GNU parallel'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_bag_argument(parser)
    add_parameter_options(parser)
    parser.add_argument('--out', metavar='FILE', required=True, help='the summary, .npz')
    add_json_option(parser, 'what became of the recording')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Summarise and write."""
    values = given_parameters(arguments.params, arguments.overrides, 'identifier')
    require_outputs(arguments.out, arguments.json)
    from bellows_ros.workflows.batch import summarise_to_file

    written = summarise_to_file(arguments.bag, values, arguments.out)
    summary = written.summary
    content = {'file': arguments.out, 'structure': summary.structure.name,
               'samples_used': summary.used, 'samples_rejected': summary.rejected,
               'recording': written.report}  # fmt: skip
    put_json(arguments.json, content, console)
    with console.results_to_stderr(arguments.json == STDOUT):
        console.say(
            f'Wrote {arguments.out}: {summary.used} samples used, {summary.rejected} rejected, '
            f'{summary.structure.name}.'
        )
    return OK
