"""Find the cup's length from standstills, and check its spring alone."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from bellows_ros.core.identification.statics import PoseCheck
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.errors import BellowsError
from bellows_ros.report.text import column, display_unit
from bellows_ros.version import __version__
from bellows_ros.workflows import static
from bellows_ros.workflows.pressed import pressed_check, PressedResult, save_stiffness
from bellows_ros.workflows.static import StaticBag, StaticResult
import numpy as np

from . import options
from .console import Console

MILLIMETRES = (*display_unit('m'), 'position')
"""Factor from m and name of its unit, and the standard error of a position at rest."""

DEGREES = (*display_unit('rad'), 'rotation')
"""Factor from rad and name of its unit, and the standard error of a rotation at rest."""


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Evaluate the standstills of recordings."""
    settings = options.read_settings(arguments)
    named, masses = arguments.bags, arguments.masses
    if masses and len(masses) != len(named):
        raise BellowsError(
            f'{len(masses)} masses are given for {len(named)} recordings. Give --mass once for '
            'each BAG, in the same order, or not at all.')
    each = [{'package.mass': mass} for mass in masses] or [{}] * len(named)
    bags: list[StaticBag] = [*zip(map(str, named), each, strict=True)] or [
        *static.static_bags(resolve(settings))]
    options.require_named_outputs(arguments, [bag for bag, _ in bags])
    if arguments.wrench:
        return _pressed(arguments, [bag for bag, _ in bags], settings, console)
    result = static.static_check(bags, settings, console.progress)
    if arguments.out:
        static.save_length(result, arguments.out)
    return options.Outcome(
        result, result.passed,
        content={**result.as_json(), 'settings': settings, 'version': __version__})


def _pressed(
    arguments: argparse.Namespace, bags: Sequence[str], settings: Mapping[str, Any],
    console: Console,
) -> options.Outcome:
    """Return K from wrenches, and write it."""
    result = pressed_check(bags, settings, console.progress)
    if arguments.out:
        save_stiffness(result, arguments.out)
    return options.Outcome(result, content={
        **result.as_json(), 'settings': settings, 'version': __version__})


def _print_pressed(result: PressedResult, console: Console) -> None:
    """Print K and the residuals."""
    cup = result.cup
    console.table([('', *'xyz', 'rx', 'ry', 'rz'), *(
        (name, *(f'{x:.4g}' for x in np.diag(matrix)))
        for name, matrix in (('K', cup.stiffness), ('±', cup.stiffness_std)))], right=True,
        title=f'K from {cup.standstills} standstills with wrenches, N/m and N m/rad')
    force, moment = cup.residuals
    console.paragraph(f'Residuals: {force:.2g} N and {moment:.2g} N m.')


def print_result(result: StaticResult | PressedResult, console: Console) -> None:
    """Print standstills, length and spring, or K."""
    if isinstance(result, PressedResult):
        _print_pressed(result, console)
        return
    console.table(_standstill_rows(result), right=True, title='Standstills')
    if result.creep:
        console.paragraph(result.creep)
        console.line()
    _print_length(result, console)
    if result.spring is not None:
        console.table(
            _spring_rows(result.spring), right=True,
            title=f'Spring, with a cup length of {result.cup_length * 1e3:.2f} mm')
        console.paragraph(result.verdict, style='' if result.passed else 'red')
    console.warn(*result.warnings)


def _standstill_rows(result: StaticResult) -> list[tuple[str, ...]]:
    """Return the standstills as rows of a table: the lip in the tool frame."""
    names = [Path(recording.name).name for recording in result.recordings
             for _ in static.standstills_in(recording)[0]]
    stills = result.standstills
    x, y, z, rx, ry, rz = zip(*(still.lip.tolist() for still in stills), strict=True)
    columns = {
        'pose': map(str, range(1, len(stills) + 1)), 'recording': names,
        'mass': [f'{still.payload.mass:.4g} kg' for still in stills],
        'for': [f'{still.duration:.1f} s' for still in stills],
        'tilt': _column(DEGREES, [still.tilt for still in stills], stills),
        'x': _column(MILLIMETRES, x, stills), 'y': _column(MILLIMETRES, y, stills),
        'length': _column(MILLIMETRES, [-value for value in z], stills),
        'bending': _column(DEGREES, map(math.hypot, rx, ry), stills),
        'torsion': _column(DEGREES, rz, stills)}
    return [tuple(columns), *zip(*columns.values(), strict=True)]


def _spring_rows(spring: Sequence[PoseCheck]) -> list[tuple[str, ...]]:
    """Return each pose's deflection, and the error of its prediction, as rows of a table."""
    stills = [pose.standstill for pose in spring]
    columns = []
    for unit, part in ((MILLIMETRES, slice(0, 3)), (DEGREES, slice(3, 6))):
        measured = [pose.measured[part].tolist() for pose in spring]
        predicted = [pose.predicted[part].tolist() for pose in spring]
        columns += [_column(unit, [math.hypot(*each) for each in measured], stills),
                    _column(unit, map(math.dist, predicted, measured), stills)]
    return [('pose', 'moved', 'off', 'turned', 'off', 'verdict'),
            *zip(map(str, range(1, len(stills) + 1)), *columns,
                 (pose.verdict for pose in spring), strict=True)]


def _column(
    unit: tuple[float, str, str], values: Iterable[float], stills: Sequence[Standstill]
) -> list[str]:
    """Return a column of numbers with the decimals of the largest standard error, and the unit."""
    factor, name, kind = unit
    error = max(getattr(still.error, kind) for still in stills)
    texts = column([factor * value for value in values], factor * error)
    return ['-' if text == 'nan' else f'{text} {name}' for text in texts]


def _print_length(result: StaticResult, console: Console) -> None:
    """Print the cup length, or the reason why it is not identifiable."""
    length = result.length
    if length is None:
        console.paragraph(f'No cup length: {result.no_length}')
        return
    console.line('Cup length', 'bold')
    console.line(f'  l0 {static.length_sentence(length)}')
    console.paragraph(
        f'  {"straight line" if len(length.coefficients) == 2 else "cubic"} through '
        f'{len(length.loads)} standstills.')
    if math.isfinite(length.pick_std):
        console.line(f'  scatter from pick to pick {1e3 * length.pick_std:.2f} mm')
    beyond = length.linear_load < float(length.loads.max())
    console.paragraph(
        f'  Axial stiffness {length.stiffness:.3g} N/m; linear up to '
        f'{length.linear_load:.1f} N{"" if beyond else ", the largest load, at least"}.')
