"""
Report, before a fit, what of K and P is identifiable, and which motion is missing.

Then compare the structures of K and P (fit.structure) by AIC, BIC and the held-out error: how well
a cup fitted without a part of the recordings simulates that part. Recommend one.

Examples
--------
bellows structures bags/identification --params bags/package.yaml
    what is identifiable from a recording, and which fit.structure to take
bellows structures first second --params my_cell.yaml --json structures.json
    for two recordings together, with all figures in a file

"""

import argparse
from collections.abc import Mapping
import math
from typing import Any, TYPE_CHECKING

from bellows_ros.report import percent

from . import options
from .console import Console, NOT_USABLE, OK

if TYPE_CHECKING:
    from bellows_ros.workflows.identify import StructureAdvice


NEGATIVE_RESULT = 'no structure fits'


ARGUMENTS = (
    options.bags(), *options.PARAMETERS, *options.interval(), options.json_output('all figures'))


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Look, compare, report."""
    settings: dict[str, Any] = options.read_settings(arguments, 'identifier')
    if arguments.bags:
        settings['bags'] = [str(bag) for bag in arguments.bags]
    from bellows_ros.workflows.identify import structures

    with console.progress() as progress:
        result = structures(settings, progress)
    options.write_result(arguments.json, result)
    print_result(result, console)
    console.wrote(arguments.json)
    return OK if result.selection.fits else NOT_USABLE


def print_result(result: 'StructureAdvice', console: Console) -> None:
    """Print the excitation, the candidates and the advice."""
    from bellows_ros.report.text import print_relaxation
    from bellows_ros.workflows.identification import excitation_json, selection_json

    excitation, selection = result.excitation, result.selection
    found = excitation_json(excitation)
    console.table(_excitation_rows(found), right=True,
                  title='Excitation of the lip, relative to the tool')
    console.table([row for row in _parameter_rows(found) if '-' not in row[0]], right=True,
                  title='Identifiability of the diagonal, by least squares')
    console.paragraph(
        f'Rank {excitation.rank} of {excitation.size}, scaled condition number '
        f'{excitation.condition_number:.3g}.')
    console.table(_structure_rows(selection_json(selection)), right=True, title='Structures')
    console.paragraph(
        f'{selection.samples} samples, equivalent to {selection.effective_samples:.0f} '
        'independent ones.')
    console.line()
    relaxation = result.recordings[0].relaxation
    print_relaxation(relaxation.strengths, relaxation.std, console)
    console.paragraph(*selection.advice)
    console.warn(*result.warnings)


def _excitation_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the motion of the lip in each axis of the tool."""
    from bellows_ros.core.signals.residuals import MILLI_UNITS

    def milli(value: Any, unit: str) -> str:
        return f'{1e3 * value:.3g} {unit}' if _known(value) else '-'

    rows: list[tuple[str, ...]] = [
        ('axis', 'deflection', 'moving', 'noise', 'velocity', 'noise', 'main band')]
    for (name, axis), unit in zip(found['axes'].items(), MILLI_UNITS, strict=True):
        low, high = axis['band_hz']
        rows.append((
            name, *(milli(axis[key], unit) for key in ('strain', 'motion', 'strain_noise')),
            *(milli(axis[key], f'{unit}/s') for key in ('twist', 'twist_noise')),
            f'{low:.1f}-{high:.1f} Hz' if _known(low) else '-'))
    return rows


def _known(value: float | None) -> bool:
    """Return whether a number of a result is known."""
    return value is not None and math.isfinite(value)


def _parameter_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of what is known of each entry of K and P."""
    formats = {'value': '.4g', 'signal_to_noise': '.3g', 'bias': '+.1%'}
    return [('parameter', 'first estimate', 'signal to noise', 'expected bias', 'identifiable'), *(
        (label, *(format(p[key], how) if _known(p[key]) else '-' for key, how in formats.items()),
         'no' if not p['identifiable'] else 'weakly' if p['weak'] else 'well')
        for label, p in found['parameters'].items())]


def _structure_rows(selection: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the structures that were compared."""
    return [('structure', 'parameters', 'AIC', 'BIC', 'held-out error', 'usable'), *(
        (own['structure'], str(own['parameters']), f'+{own["aic"]:.1f}', f'+{own["bic"]:.1f}',
         percent(math.nan if own['held_out'] is None else own['held_out']),
         'yes' if own['usable'] else 'no') for own in selection['candidates'])]
