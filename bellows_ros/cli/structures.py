"""
Report, before a fit, what of K and P is identifiable, and which motion is missing.

Then compare the structures of K and P (fit.structure) by AIC, BIC and the held-out error: how well
a cup fitted without a part of the recordings simulates that part. Recommend one.
"""

import argparse
from typing import Any, TYPE_CHECKING

from . import options
from .console import Console, NOT_USABLE, OK
from .identify import print_relaxation

if TYPE_CHECKING:
    from bellows_ros.workflows.identify import StructureAdvice

EXAMPLES = (
    ('bellows structures bags/identification --params bags/package.yaml',
     'what is identifiable from a recording, and which fit.structure to take'),
    ('bellows structures first second --params my_cell.yaml --json structures.json',
     'for two recordings together, with all figures in a file'),
)

FOUND = 'no structure fits'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    options.add_bags_argument(parser)
    options.add_parameter_options(parser)
    options.add_json_option(parser, 'all figures')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Look, compare, report."""
    settings: dict[str, Any] = options.given_parameters(arguments, 'identifier')
    if arguments.bags:
        settings['bags'] = [str(bag) for bag in arguments.bags]
    from bellows_ros.workflows.identify import structures

    with console.progress() as progress:
        result = structures(settings, progress)
    options.put_json(arguments.json, result)
    _print_result(result, console)
    console.wrote(arguments.json)
    return OK if result.selection.fits else NOT_USABLE


def _print_result(result: 'StructureAdvice', console: Console) -> None:
    """Print the excitation, the candidates and the advice."""
    from bellows_ros.report.cup import excitation_rows, parameter_rows, structure_rows
    from bellows_ros.workflows.identification import excitation_json, selection_json

    excitation, selection = result.excitation, result.selection
    found = excitation_json(excitation)
    console.table(excitation_rows(found), right=True,
                  title='Excitation of the lip, relative to the tool')
    console.table([row for row in parameter_rows(found) if '-' not in row[0]], right=True,
                  title='Identifiability of the diagonal, by least squares')
    console.paragraph(
        f'Rank {excitation.rank} of {excitation.size}, scaled condition number '
        f'{excitation.condition_number:.3g}.'
    )
    console.table(structure_rows(selection_json(selection)), right=True, title='Structures')
    console.paragraph(
        f'{selection.samples} samples, equivalent to {selection.effective_samples:.0f} '
        'independent ones.'
    )
    console.line()
    relaxation = result.recordings[0].relaxation
    print_relaxation(relaxation.strengths, relaxation.std, console)
    console.paragraph(*selection.advice)
    console.warn(*result.warnings)
