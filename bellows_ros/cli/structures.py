"""Report what is identifiable from recordings, and recommend a structure."""

import argparse
from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.core.signals.residuals import DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.report.text import formatted, print_relaxation
from bellows_ros.workflows.identification import excitation_json
from bellows_ros.workflows.structures import StructureAdvice, structures

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Look and compare."""
    settings: dict[str, Any] = options.read_settings(arguments, 'identifier')
    if arguments.bags:
        settings['bags'] = [str(bag) for bag in arguments.bags]
    result = structures(settings, console.progress)
    return options.Outcome(result, bool(result.selection.fits))


def print_result(result: StructureAdvice, console: Console) -> None:
    """Print the excitation, the candidates and the advice."""
    excitation, selection = result.excitation, result.selection
    content = excitation_json(excitation)
    console.table(_excitation_rows(content), right=True,
                  title='Excitation of the lip, relative to the tool')
    formats = {'value': '.4g', 'signal_to_noise': '.3g', 'bias': '+.1%'}
    console.table(
        [('parameter', 'first estimate', 'signal to noise', 'expected bias', 'identifiable'), *(
            (label, *(formatted(entry[key], form) for key, form in formats.items()),
             'no' if not entry['identifiable'] else 'weakly' if entry['weak'] else 'well')
            for label, entry in content['parameters'].items() if '-' not in label)],
        right=True, title='Identifiability of the diagonal, by least squares')
    console.paragraph(
        f'Rank {excitation.rank} of {excitation.size}, scaled condition number '
        f'{excitation.condition_number:.3g}.')
    console.table([('structure', 'parameters', 'held-out error', 'usable'), *(
        (each.structure, str(each.parameters), formatted(each.held_out, '.2f', '%', 100.0),
         'yes' if each.usable else 'no') for each in selection.candidates)],
        right=True, title='Structures')
    console.paragraph(f'{selection.samples} samples.')
    console.line()
    relaxation = result.recordings[0].relaxation
    print_relaxation(relaxation.strengths, relaxation.std, console)
    console.paragraph(*selection.advice)
    console.warn(*result.warnings)


def _excitation_rows(excitation: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the motion of the lip in each axis of the tool."""
    rows: list[tuple[str, ...]] = [
        ('axis', 'deflection', 'moving', 'noise', 'velocity', 'noise', 'main band')]
    for (name, axis), factor, unit in zip(
            excitation['axes'].items(), DISPLAY_FACTORS, DISPLAY_UNITS, strict=True):
        low, high = axis['band_hz']
        rows.append((name, *(formatted(axis[key], '.3g', of_key, factor) for key, of_key in (
            ('strain', unit), ('motion', unit), ('strain_noise', unit),
            ('twist', f'{unit}/s'), ('twist_noise', f'{unit}/s'))),
            f'{low:.1f}-{high:.1f} Hz' if math.isfinite(low) else '-'))
    return rows
