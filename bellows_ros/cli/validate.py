"""`bellows validate`: judge a cup by a recording that it was not identified from."""

import argparse
from typing import TYPE_CHECKING

from .commands import NOT_USABLE, OK
from .console import Console
from .options import (
    add_bag_argument,
    add_json_option,
    add_parameter_options,
    given_parameters,
    put_json,
    require_outputs,
    STDOUT,
    THESIS_CUP,
)

if TYPE_CHECKING:
    from bellows_ros.workflows.validate import Validated

DESCRIPTION = (
    'Simulate a recording freely with a cup, from its start to its end: the model sees how the '
    'tool moves, and nothing of the package. Say how far the package is off per axis, how much of '
    'that is measurement noise, and whether what is left looks like noise. Take a recording that '
    'the cup was not identified from. Ends with 1 if an axis that moves is above --limit.'
)
EXAMPLES = (
    ('bellows validate bags/validation --params cup.yaml',
     'what the cup identified before is worth'),
    ('bellows validate bags/validation --params cup.yaml --report validation.html',
     'the same as a page with plots, which needs no network'),
    ('bellows validate second --params cup.yaml --limit 5 --json validation.json',
     'in a script: exit code 1 unless every axis that moves is within 5 %'),
)  # fmt: skip
PERCENT = 100.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_bag_argument(parser)
    add_parameter_options(parser)
    add_json_option(parser, 'the figures')
    parser.add_argument(
        '--report', metavar='FILE', default='', help='write a page with plots (HTML)'
    )
    parser.add_argument(
        '--limit', metavar='PERCENT', type=float, default=None,
        help='end with 1 if the NRMSE of an axis that moves is above this',
    )  # fmt: skip


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Validate, write, report."""
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve

    values = given_parameters(arguments.params, arguments.overrides)
    settings = resolve(values, PACKAGE_PARAMETERS)
    require_outputs(arguments.json, arguments.report)
    from bellows_ros.core.identification.judgement.validation import LIMIT
    from bellows_ros.workflows.validate import validate

    with console.progress() as progress:
        result = validate(arguments.bag, settings, progress)
    limit = LIMIT if arguments.limit is None else arguments.limit / PERCENT
    content = result.as_json(limit, arguments.params)
    put_json(arguments.json, content, console)
    if arguments.report:
        _write_report(result, arguments)
    with console.results_to_stderr(arguments.json == STDOUT):
        if 'cup.stiffness' not in values:
            console.warn(THESIS_CUP)
        _say(result, limit, arguments, console)
    failing = result.validation.failing(limit)
    return NOT_USABLE if failing and arguments.limit is not None else OK


def _write_report(result: 'Validated', arguments: argparse.Namespace) -> None:
    """Write the page."""
    from bellows_ros.files.atomic import write_text
    from bellows_ros.report.build import validation_report

    write_text(arguments.report, validation_report(result, arguments.params))


def _say(
    result: 'Validated', limit: float, arguments: argparse.Namespace, console: Console
) -> None:
    """Print the errors per axis and what they mean."""
    from bellows_ros.workflows.recordings import offset_sentence

    found = result.validation
    console.say(f'Free simulation of {arguments.bag}', 'bold')
    start = 'static equilibrium' if found.start == 'equilibrium' else 'the measured state'
    console.say(f'(package relative to the tool, predicted minus measured; from {start})', 'dim')
    console.say()
    for line in validation_table(result):
        console.say(f'  {line}')
    console.say()
    console.paragraph(f'{found.scores.samples} samples compared.')
    for line in (*offset_sentence(arguments.bag, result.time_offset),
                 *verdict_lines(result, limit)):
        console.paragraph(line)
    for warning in result.warnings:
        console.warn(warning)
    for path in (arguments.json, arguments.report):
        if path not in ('', STDOUT):
            console.say(f'Wrote {path}.')


def validation_table(result: 'Validated') -> list[str]:
    """Return errors, what noise makes of them, and whether they are white, a line per axis."""
    from bellows_ros.core.score import AXES

    from .words import aligned, MILLI, percent

    found = result.validation
    one_step = found.one_step.whiteness.words if found.one_step else ('-',) * 6
    rows = [('axis', 'RMS error', 'of noise', 'largest', 'NRMSE', 'one-step errors')]
    for i, name in enumerate(AXES):
        unit = 'mm' if i < 3 else 'mrad'
        rows.append(
            (
                name,
                f'{found.scores.rms[i] * MILLI:.3g} {unit}',
                f'{found.noise[i] * MILLI:.3g} {unit}',
                f'{found.scores.largest[i] * MILLI:.3g} {unit}',
                percent(found.scores.nrmse[i]) + (' ' if found.moves[i] else '*'),
                one_step[i],
            )
        )
    return aligned(rows, right=True)


def verdict_lines(result: 'Validated', limit: float) -> list[str]:
    """Return what the figures mean, in sentences."""
    from bellows_ros.core.score import AXES

    from .words import listed

    found = result.validation
    moving = [name for name, moves in zip(AXES, found.moves, strict=True) if moves]
    still = [name for name in AXES if name not in moving]
    lines = []
    if still:
        lines.append(
            f'* {listed(still)} moves too little to be judged: noise alone would be more than '
            '5 % of its motion.'
        )
    failing = found.failing(limit)
    if moving and not failing:
        lines.append(f'All axes that move are within {PERCENT * limit:g} %: {listed(moving)}.')
    if failing:
        lines.append(f'Above {PERCENT * limit:g} % of the motion: {listed(failing)}.')
    if not moving:
        lines.append('No axis moves enough to be judged: record a larger motion.')
    if found.one_step:
        lines.append(
            f'One-step prediction errors: chi^2 per degree of freedom '
            f'{found.one_step.chi2:.3f}; 1 where model and noise explain all.'
        )
    return lines
