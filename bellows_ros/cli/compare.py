"""Report the z-scores of the differences of two fits, and whether both are of one cup."""

import argparse

from bellows_ros.report.text import formatted, with_error
from bellows_ros.workflows.compare import compare_files, ComparedFits

from .console import Console
from .options import Outcome


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Compare two identified cups; not successful if they differ."""
    result = compare_files(arguments.before, arguments.after)
    return Outcome(result, not result.differs)


def print_result(result: ComparedFits, console: Console) -> None:
    """Print the table and the verdict."""
    console.line(f'{result.names[0]} (A) and {result.names[1]} (B)', 'bold')
    console.table([('', 'A', 'B', 'unit', 'change', 'z'), *(
        (name, with_error(before, before_std), with_error(after, after_std), unit,
         formatted(after / before - 1.0 if before else None, '+.2f', '%', 100.0),
         formatted(difference, '+.1f'))
        for name, unit, before, before_std, after, after_std, difference in result.rows())])
    console.paragraph(*result.sentences)
