"""Make recordings from files of Motive or TUM."""

import argparse

from bellows_ros.workflows import convert
from bellows_ros.workflows.convert import Conversion

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Convert trajectories to a recording."""
    console.progress('converting')
    done = convert.convert(
        arguments.sources, arguments.out, arguments.topic, arguments.markers, arguments.storage,
        arguments.force, options.interval_settings(arguments))
    return options.Outcome(done, content=done.as_json(), then=(
        'Next, check the recording:', f'  bellows info {done.out} --write-params my_cell.yaml'))


def print_result(done: Conversion, console: Console) -> None:
    """Print the numbers of converted and of rejected poses."""
    for body in done.bodies:
        rejected = ', '.join(f'{count} {reason}' for reason, count in body.left_out.items())
        console.line(f'{body.topic}: {body.poses} poses of {body.source}'
                     + (f'; left out: {rejected}' if rejected else ''))
    if done.world != 'z_up':
        console.line(f'Its world has y up: set recording.world to {done.world}.')
    console.warn(*done.notes)
