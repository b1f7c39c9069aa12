"""Simulate a recording of a given cup."""

import argparse
from collections import Counter
import math

from bellows_ros.files.safe_yaml import load
from bellows_ros.report.findings import text
from bellows_ros.report.sentences import many
from bellows_ros.workflows.simulate import simulate_recording, SimulationReport

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Simulate a recording, and write it."""
    values = options.read_settings(arguments, cup_for=console)
    report = simulate_recording(
        values, load(arguments.motion), arguments.out, console.progress, arguments.force,
        arguments.plan or '')
    return options.Outcome(report)


def print_result(report: SimulationReport, console: Console) -> None:
    """Print the numbers of messages and of faults."""
    console.line(f'Recorded {report.duration_s:g} s to {report.bag}', 'bold')
    width = max(map(len, report.messages))
    for topic, count in report.messages.items():
        kinds = Counter(event.kind for event in report.events if event.topic == topic)
        put_in = [many(count, kind) for kind, count in kinds.items()]
        console.line(f'  {topic:{width}}  {count:6} messages'
                     + (f', with {" and ".join(put_in)}' if put_in else ''))
    console.line(f'The cup bends by up to {math.degrees(report.largest_bending_rad):.1f} degrees, '
                 f'at {report.largest_bending_time_s:.2f} s.')
    if report.margin:
        console.paragraph(text(report.margin.finding))
    if report.truth:
        console.line(f'The true motion: {report.truth}')
    console.warn(*report.warnings)
