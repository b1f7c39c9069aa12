"""Rehearse a recording: errors of the cup to expect, checks that fire, and what to change."""

import argparse
import math

from bellows_ros.files.safe_yaml import load
from bellows_ros.report.text import with_error
from bellows_ros.workflows.rehearse import counted, Rehearsal, rehearse

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Identify simulated recordings."""
    values = options.read_settings(arguments, cup_for=console)
    motion = load(arguments.motion) if arguments.motion else None
    result = rehearse(values, motion, arguments.runs, console.progress)
    return options.Outcome(result, result.passed)


def print_result(result: Rehearsal, console: Console) -> None:
    """Print the expected errors, the checks that fire, and what to change."""
    console.line(f'{result.runs - len(result.refused)} of {result.runs} simulated recordings '
                 'identified; medians of cups drawn near the given one:', 'bold')
    if result.numbers:
        console.table([('number', 'truth ± std. error', 'relative', 'truth within 2 errors'), *(
            (each.name, with_error(each.expected, each.expected_std, each.unit),
             f'{each.error:.1%}' if math.isfinite(each.error) else '',
             f'{each.inside} of {each.runs}') for each in result.numbers)])
    for text, count in {
            **result.checks, **counted(f'not identified: {reason}' for reason in result.refused),
    }.items():
        console.paragraph(f'{count} of {result.runs}: {text}')
    console.warn(*result.advice)
    if not result.advice and not result.checks and result.passed:
        console.line('Nothing to change: all standard errors are below 10 %.')
