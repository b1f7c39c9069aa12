"""`bellows ladder`: what recordings can tell of a cup, and which structure to take."""

import argparse
import math
from typing import Any, TYPE_CHECKING

from .commands import OK
from .console import Console
from .options import (
    add_json_option,
    add_parameter_options,
    given_parameters,
    put_json,
    require_outputs,
    STDOUT,
)

if TYPE_CHECKING:
    from bellows_ros.workflows.ladder import Climb

DESCRIPTION = (
    'Say, before a cup is identified, what recordings can tell of its stiffness and damping, and '
    'what motion is missing. Then compare the structures of K and P (axisymmetric, diagonal, '
    'full) by AIC, BIC and by how well a cup found without parts of the recordings simulates '
    'those parts, and advise which to take.'
)
EXAMPLES = (
    ('bellows ladder bags/identification --params bags/package.yaml',
     'what a recording can tell, and which fit.structure to take'),
    ('bellows ladder first second --params my_cell.yaml --json ladder.json',
     'of two recordings together, with all figures in a file'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'bags', metavar='BAG', nargs='*',
        help="recording: a rosbag2 folder, or a .mcap or .db3 file; over the parameter 'bags'",
    )  # fmt: skip
    add_parameter_options(parser)
    add_json_option(parser, 'all figures')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Look, compare, report."""
    settings: dict[str, Any] = given_parameters(
        arguments.params, arguments.overrides, 'identifier'
    )
    if arguments.bags:
        settings['bags'] = arguments.bags
    require_outputs(arguments.json)
    from bellows_ros.workflows.ladder import climb

    with console.progress() as progress:
        result = climb(settings, progress)
    put_json(arguments.json, result.as_json(), console)
    with console.results_to_stderr(arguments.json == STDOUT):
        _say(result, console)
        if arguments.json not in ('', STDOUT):
            console.say(f'Wrote {arguments.json}.')
    return OK


def _say(result: 'Climb', console: Console) -> None:
    """Print the excitation, the ladder and the advice."""
    from .words import aligned

    excitation, ladder = result.excitation, result.ladder
    console.say('Excitation of the lip, relative to the tool', 'bold')
    for line in aligned(_axis_rows(result), right=True):
        console.say(f'  {line}')
    console.say()
    console.say('What least squares can tell', 'bold')
    for line in aligned(_told_rows(result), right=True):
        console.say(f'  {line}')
    console.paragraph(
        f'Rank {excitation.rank} of {excitation.size}, scaled condition number '
        f'{excitation.condition_number:.3g}.'
    )
    console.say()
    console.say('Structures', 'bold')
    for line in aligned(_rung_rows(result), right=True):
        console.say(f'  {line}')
    console.paragraph(
        f'{ladder.samples} samples, as good as {ladder.effective_samples:.0f} independent ones.'
    )
    console.say()
    for sentence in ladder.advice:
        console.paragraph(sentence)
    for warning in result.warnings:
        console.warn(warning)


def _axis_rows(result: 'Climb') -> list[tuple[str, ...]]:
    """Return a row of the table for every direction."""
    rows = [('axis', 'deflection', 'moving', 'noise', 'velocity', 'noise', 'most of it')]
    for axis in result.excitation.axes:
        unit, rate = ('mm', 'mm/s') if not axis.name.startswith('r') else ('mrad', 'mrad/s')
        rows.append((
            axis.name, _milli(axis.strain, unit), _milli(axis.motion, unit),
            _milli(axis.strain_noise, unit), _milli(axis.twist, rate),
            _milli(axis.twist_noise, rate), _band(*axis.band_hz),
        ))  # fmt: skip
    return rows


def _told_rows(result: 'Climb') -> list[tuple[str, ...]]:
    """Return a row for every parameter; of a full structure for those of the diagonal only."""
    rows = [('parameter', 'first estimate', 'signal to noise', 'expected bias')]
    for told in result.excitation.parameters:
        if '-' in told.label:
            continue
        ratio = told.signal_to_noise
        rows.append((
            told.label, 'not told' if math.isnan(told.value) else f'{told.value:.4g}',
            '-' if not math.isfinite(ratio) else f'{ratio:.3g}',
            '-' if not math.isfinite(told.bias) else f'{told.bias:+.1%}',
        ))  # fmt: skip
    return rows


def _rung_rows(result: 'Climb') -> list[tuple[str, ...]]:
    """Return a row for every structure."""
    rows = [('structure', 'parameters', 'AIC', 'BIC', 'held-out error', 'usable')]
    for rung in result.ladder.rungs:
        error = rung.held_out
        rows.append((
            rung.structure, str(rung.parameters), f'+{rung.aic:.1f}', f'+{rung.bic:.1f}',
            f'{error:.2%}' if math.isfinite(error) else '-', 'yes' if rung.usable else 'no',
        ))  # fmt: skip
    return rows


def _band(low: float, high: float) -> str:
    """Return a band of frequencies, or a dash where nothing moves."""
    return f'{low:.1f}-{high:.1f} Hz' if math.isfinite(low) else '-'


def _milli(value: float, unit: str) -> str:
    """Return a value in thousandths of its SI unit, or a dash."""
    return f'{value * 1e3:.3g} {unit}' if math.isfinite(value) else '-'
