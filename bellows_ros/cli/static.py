"""
Find the standstills in recordings.

From two or more known masses held vertically, find the cup's nominal length: its length without
load. With a stiffness in the parameter file, check in every pose whether the package hangs where
the spring model predicts.
"""

import argparse
from collections.abc import Mapping
import math
from pathlib import Path
from typing import TYPE_CHECKING

from bellows_ros.errors import BellowsError

from . import options
from .console import Console, NOT_USABLE, OK

if TYPE_CHECKING:
    from bellows_ros.core.parameters.table import Value
    from bellows_ros.workflows.static import StaticBag, StaticResult

EXAMPLES = (
    ('bellows static m05 m10 m15 m20 --params my_cell.yaml \\\n'
     '      --mass 0.5 --mass 1.0 --mass 1.5 --mass 2.0 --out my_cell_l0.yaml',
     'the nominal length from four masses, written to a copy of the parameters'),
    ('bellows static --params my_cell.yaml',
     'with recordings and masses from parameter files: static.bags, static.files'),
    ('bellows static bags/static --params bags/cup.yaml',
     'check the spring of a cup in several orientations of the tool'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    options.add_bags_argument(parser, 'static.bags')
    parser.add_argument(
        '--mass', metavar='KG', action='append', type=float, default=[], dest='masses',
        help='mass in a recording, once for each BAG in the same order; overrides package.mass',
    )
    options.add_parameter_options(parser)
    options.add_output(
        parser, '--out', 'write the parameters of --params and --set with the new nominal length')
    options.add_json_option(parser, 'all results')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Find, write, report."""
    settings = options.given_parameters(arguments)
    from bellows_ros import __version__
    from bellows_ros.workflows.static import save_length, static_check

    bags = _bags(arguments, settings)
    options.require_named_outputs(arguments, [bag for bag, _ in bags])
    with console.progress() as progress:
        result = static_check(bags, settings, progress)
    with options.naming_written() as written:
        if arguments.out:
            save_length(result, arguments.out)
            written += [arguments.out]
        options.put_json(
            arguments.json, {**result.as_json(), 'settings': settings, 'version': __version__})
    _say(result, console)
    console.wrote(arguments.out, arguments.json)
    return OK if result.spring is None or result.spring.passed else NOT_USABLE


def _bags(
    arguments: argparse.Namespace, settings: Mapping[str, 'Value']
) -> 'list[StaticBag]':
    """Return the recordings with their masses; those of static.bags if none is named."""
    from bellows_ros.core.parameters.checks import resolve
    from bellows_ros.workflows.static import static_bags

    bags, masses = arguments.bags, arguments.masses
    if masses and len(masses) != len(bags):
        raise BellowsError(
            f'{len(masses)} masses are given for {len(bags)} recordings. Give --mass once for '
            'each BAG, in the same order, or not at all.')
    each = [{'package.mass': mass} for mass in masses] or [{}] * len(bags)
    return list(zip(map(str, bags), each, strict=True)) or static_bags(resolve(settings))


def _say(result: 'StaticResult', console: Console) -> None:
    """Print standstills, length and spring."""
    console.table(_standstill_rows(result), right=True, title='Standstills')
    if result.creep:
        console.paragraph(result.creep)
        console.say()
    _say_length(result, console)
    if result.spring is not None:
        console.say()
        console.say(f'Spring, with a nominal length of {result.cup_length * 1e3:.2f} mm', 'bold')
        for number, pose in enumerate(result.spring.poses, 1):
            console.paragraph(f'  {number}: {pose.sentence}')
        console.paragraph(
            result.spring.sentence, style='' if result.spring.passed else 'red')
    console.warn(*result.warnings)


def _standstill_rows(result: 'StaticResult') -> list[tuple[str, ...]]:
    """Return the standstills as rows of a table: the lip as seen from the tool."""
    from bellows_ros.workflows.static import standstills_in

    rows: list[tuple[str, ...]] = [
        ('pose', 'recording', 'mass', 'for', 'tilt', 'x', 'y', 'length', 'bending', 'turn')]
    for recording in result.recordings:
        for still in standstills_in(recording)[0]:
            x, y, z, rx, ry, rz = still.lip.tolist()
            rows.append((
                str(len(rows)), Path(recording.name).name, f'{recording.payload.mass:.4g} kg',
                f'{still.duration:.1f} s', f'{math.degrees(still.tilt):.1f} deg',
                f'{x * 1e3:.2f} mm', f'{y * 1e3:.2f} mm', f'{-z * 1e3:.3f} mm',
                f'{math.degrees(math.hypot(rx, ry)):.2f} deg', f'{math.degrees(rz):.2f} deg',
            ))
    return rows


def _say_length(result: 'StaticResult', console: Console) -> None:
    """Print the nominal length, or why it is not identifiable."""
    length = result.length
    if length is None:
        console.paragraph(f'No nominal length: {result.no_length}')
        return
    console.say('Nominal length', 'bold')
    console.say(f'  l0 {length.text}')
    console.paragraph(
        f'  {"straight line" if len(length.coefficients) == 2 else "cubic"} through '
        f'{len(length.loads)} standstills.')
    if math.isfinite(length.pick_std):
        console.say(f'  scatter from pick to pick {1e3 * length.pick_std:.2f} mm')
    beyond = length.linear_load < float(length.loads.max())
    console.paragraph(
        f'  Axial stiffness {length.stiffness:.0f} N/m; linear up to '
        f'{length.linear_load:.1f} N{"" if beyond else ", the largest load, at least"}.'
    )
