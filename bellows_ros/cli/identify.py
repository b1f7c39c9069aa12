"""`bellows identify`: find a cup's stiffness and damping in recordings."""

import argparse
from typing import Any, TYPE_CHECKING

from .commands import NOT_USABLE, OK
from .console import Console, Progress
from .options import (
    add_json_option,
    add_parameter_options,
    given_parameters,
    require_outputs,
    STDOUT,
    uninterrupted,
)

if TYPE_CHECKING:
    from bellows_ros.workflows.identify import Identification

DESCRIPTION = (
    'Find the stiffness K and the damping P of a cup in recordings of the tool arm and of the '
    "package it holds. The parameter file says what is known (the package, the cup's length, the "
    'topics), how to fit, and what else to look at: recordings at rest, other recordings to '
    'validate on, the structures compared.'
)
EXAMPLES = (
    ('bellows identify bags/identification --params bags/package.yaml \\\n'
     '      --out cup.yaml --json fit.json',
     'identify a cup; cup.yaml is what the predictor takes, fit.json has all figures'),
    ('bellows identify first second --params my_cell.yaml --set fit.structure=full',
     'from two recordings, without the symmetry of a round cup; only show the result'),
    ('bellows identify recordings/* --params my_cell.yaml --jobs -1 --out cup.yaml',
     'from hundreds of recordings, on all cores'),
    ('bellows identify recording --params my_cell.yaml --set static.bags=m05,m10,m15 \\\n'
     '      --set static.files=m05.yaml,m10.yaml,m15.yaml --set static.length=true',
     'with standstills under three masses, from which the nominal length is found, too'),
    ('bellows identify recording --params my_cell.yaml --json - | jq .stiffness',
     'use the result in a script'),
)  # fmt: skip


MOST_ON_A_PAGE = 20
"""Recordings of which one page is still read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'bags', metavar='BAG', nargs='*',
        help="recording: a rosbag2 folder, or a .mcap or .db3 file; over the parameter 'bags'",
    )  # fmt: skip
    add_parameter_options(parser)
    parser.add_argument(
        '--out', metavar='FILE', default='',
        help='write the cup as a parameter file, for the predictor and bellows replay',
    )  # fmt: skip
    add_json_option(parser, 'the result with its uncertainties')
    parser.add_argument(
        '--report', metavar='FILE', default='', help='write a page with plots (HTML)'
    )
    parser.add_argument(
        '--jobs', metavar='N', type=int, default=None,
        help='read N recordings at a time, -1 for one per core (extra parallel); one that cannot '
        'be used is then reported and left out',
    )  # fmt: skip
    parser.add_argument(
        '--dask', metavar='ADDRESS', default='',
        help='let the workers of a Dask scheduler read them instead (extra dask), for example '
        'tcp://host:8786; they must see the recordings under the same paths',
    )  # fmt: skip


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Identify, write, report."""
    settings = _settings(arguments)
    cup_file, json_file, page = (
        str(settings[f'output.{name}']) for name in ('parameters', 'json', 'report'))
    require_outputs(cup_file, json_file, page)
    with console.progress() as progress:
        result = _identified(arguments, settings, progress)
    usable = result.fit.usable
    _write(result, cup_file if usable else '', json_file, console)
    if page:
        from bellows_ros.report.build import write_page

        write_page(result, page)
    with console.results_to_stderr(json_file == STDOUT):
        _say(result, settings, console)
        _say_files(usable, cup_file, json_file, console)
        if page:
            console.say(f'Wrote {page}.')
    return OK if usable else NOT_USABLE


def _identified(
    arguments: argparse.Namespace, settings: dict[str, Any], progress: Progress
) -> 'Identification':
    """Return the result, of one process or of many."""
    from bellows_ros.errors import BellowsError

    if arguments.jobs is None and not arguments.dask:
        from bellows_ros.workflows.identify import identify

        return identify(settings, progress, arguments.params)
    from bellows_ros.workflows.batch import identify_many

    if settings['output.report'] and len(settings['bags']) > MOST_ON_A_PAGE:
        raise BellowsError(
            f'A report shows every recording: of at most {MOST_ON_A_PAGE}, not of '
            f'{len(settings["bags"])} as with --jobs and --dask. Leave the report out.'
        )
    return identify_many(settings, arguments.jobs or 1, arguments.dask, progress, arguments.params)


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what is set: by files, --set, and always what has an argument of its own."""
    values = given_parameters(arguments.params, arguments.overrides, 'identifier')
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
    from bellows_ros.errors import BellowsError

    named = {
        'bags': arguments.bags,
        'output.parameters': arguments.out,
        'output.json': arguments.json,
        'output.report': arguments.report,
    }
    required = () if values.get('package.files') else PACKAGE_PARAMETERS
    settings = {**values, **{name: value for name, value in named.items() if value}}
    checked = resolve(settings, required)
    if not checked['bags']:
        raise BellowsError(
            'No recording is given. Name one or more: bellows identify BAG ... --params FILE, '
            "or set the parameter 'bags'."
        )
    return {**settings, **{name: checked[name] for name in named}}


def _write(result: 'Identification', cup_file: str, json_file: str, console: Console) -> None:
    """Write what is wanted, all of it even when Ctrl-C comes in between."""
    from bellows_ros.files.results import format_json
    from bellows_ros.workflows.identify import save

    with uninterrupted():
        save(result, cup_file, '' if json_file == STDOUT else json_file)
    if json_file == STDOUT:
        console.raw(format_json(result.as_json()))


def _say(result: 'Identification', settings: dict[str, Any], console: Console) -> None:
    """Print the cup and what it rests on."""
    from .words import cup_table, listed, sample_lines

    fit = result.fit
    bags = listed([str(bag) for bag in result.values['bags']])
    console.say(f'Cup identified from {bags}', 'bold')
    console.say(f'({fit.method.replace("_", " ")}, {fit.structure})', 'dim')
    console.say()
    for line in cup_table(fit):
        console.say(f'  {line}'.rstrip())
    console.say()
    for line in sample_lines(fit, result.reports):
        console.paragraph(line)
    console.paragraph(f'Condition number of the fit: {fit.condition_number:.3g}.')
    for line in result.findings:
        console.paragraph(line)
    for warning in result.warnings:
        console.warn(warning)


def _say_files(usable: bool, cup_file: str, json_file: str, console: Console) -> None:
    """Print what was written and what comes next."""
    console.say()
    if json_file not in ('', STDOUT):
        console.say(f'Wrote {json_file}.')
    if not usable:
        kept = f'{cup_file} was not written' if cup_file else 'do not use it'
        console.paragraph(f'This is no cup that can hold a package: {kept}.', 'red')
    elif cup_file:
        console.say(f'Wrote {cup_file}. Next, see how well it predicts another recording:')
        console.say(f'  bellows replay BAG --params {cup_file}')
    else:
        console.say('The cup was not written to a file; give --out cup.yaml to keep it.')
