"""Rehearse a recording: its information on the cup, and the checks that fire."""

import argparse

from bellows_ros.files.safe_yaml import load
from bellows_ros.report.text import with_error
from bellows_ros.workflows.rehearse import Rehearsal, rehearse

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    values = options.read_settings(arguments, cup_for=console)
    motion = load(arguments.motion) if arguments.motion else None
    result = rehearse(values, motion, arguments.runs, console.progress)
    return options.Outcome(result, result.passed)


def print_result(result: Rehearsal, console: Console) -> None:
    """Print the expected errors, the checks that fire, and what to change."""
    console.line(f'{result.runs - len(result.refused)} of {result.runs} simulated recordings '
                 'identified', 'bold')
    console.table([('number', 'expected', 'std. error', 'truth within 2 std. errors'), *(
        (each.name, with_error(each.expected, each.expected_std, each.unit),
         f'{each.expected_std / abs(each.expected):.1%}' if each.expected else '',
         f'{each.inside} of {each.runs}') for each in result.numbers)])
    for text, count in result.checks.items():
        console.paragraph(f'{count} of {result.runs}: {text}')
    for text in result.refused:
        console.paragraph(f'Not identified: {text}')
    console.warn(*result.advice)
    if not result.advice and result.passed:
        console.line('Nothing to change: all errors are below 10 %.')
