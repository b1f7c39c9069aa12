"""Predict the landing of a tossed package, and the limits of its accuracy."""

import argparse
import math

from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.report.text import column, display_unit, formatted, with_error
from bellows_ros.workflows.toss import toss_plan, TossResult, write_toss
import numpy as np

from .console import Console
from .options import Outcome, read_settings

MILLI = 1e3


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Predict a toss."""
    result = toss_plan(
        arguments.plan, read_settings(arguments, cup_for=console), arguments.release,
        arguments.target, arguments.target_rotation, console.progress,
        str(arguments.urdf or ''), arguments.topic)
    if arguments.out:
        write_toss(arguments.out, result, arguments.force)
    return Outcome(result, result.reached, inputs=[arguments.plan], draw=arguments.plot)


def print_result(result: TossResult, console: Console) -> None:
    """Print release, landing, its uncertainty, and the largest contribution."""
    toss, case = result.toss, result.case
    delay = MILLI * (toss.release_time - case.switched)
    x, y, _ = toss.landing[0]
    std = np.sqrt(np.diag(result.covariance))
    rotation_std = math.degrees(float(np.linalg.norm(std[3:])))
    mode = 'its lip peels' if result.mode == 'peel' else (
        'its suction is blown off' if case.release.law[3] else 'an assumed delay' if (
            result.assumed) else 'after the delay')
    console.line('Toss', 'bold')
    console.line(
        f'  valve     {case.switched:.4f} s; lets go {delay:.1f} ms later ({mode}) at '
        f'{math.hypot(*toss.release[2]):.2f} m/s')
    console.line(f'  landing   {toss.landing_time:.4f} s at x {with_error(x, std[0], "m")}, '
                 f'y {with_error(y, std[1], "m")}')
    turned = f'turned ± {rotation_std:.2g} deg, ' if rotation_std else ''
    console.line(f'            {turned}tumbling at {math.degrees(toss.tumbling):.2g} deg/s')
    if aim := result.aim:
        asked = result.distance_as_asked
        gain = '' if asked is None else f', instead of {MILLI * asked:.1f} mm with --release'
        angle = f', {math.degrees(aim.angle):.1f} deg' if aim.angle else ''
        console.line(f'  target    {MILLI * aim.distance:.2f} mm{angle} away{gain}')
    if failed := result.scatter.failed:
        console.line(f'  failed    {failed} of {failed + len(result.scatter.errors)} drawn tosses')
    console.line()
    _print_budget(result, console)
    console.warn(*result.warnings)


def _print_budget(result: TossResult, console: Console) -> None:
    """Print the contributions to the uncertainty, and the first to reduce."""
    groups = result.groups()
    if not groups:
        console.paragraph(
            'The uncertainty of the landing is unknown: no standard deviation is given. Set '
            "release.std, package.mass_std and package.com_std; 'bellows "
            "identify' writes cup.*_std.")
        return
    shifts = [MILLI * group.metres for group in groups]
    angles = [math.degrees(group.radians) for group in groups]
    rows = [('uncertain quantity', 'std. dev.', 'at landing', 'turned')]
    for group, shift, angle in zip(
            groups, *(column(sizes, 0.1 * max(sizes) or 1.0) for sizes in (shifts, angles)),
            strict=True):
        parameter = PARAMETERS.get(group.name)
        factor, unit = display_unit(parameter.unit if parameter else '')
        unknown = 'see release.std' if group.name == 'release' else f'see {group.name}_std'
        rows.append((group.name, formatted(group.std, '.3g', unit, factor, unknown),
                     f'{shift} mm', f'{angle} deg'))
    console.table(rows, right=True)
    total, first = math.hypot(*shifts), groups[0].name
    text = (
        f'Reduce first: {first}, {shifts[0]:.1f} of {total:.1f} mm. If it were known exactly, '
        f'{math.hypot(*shifts[1:]):.1f} mm would remain.')
    others = math.hypot(*(shift for group, shift in zip(groups, shifts, strict=True)
                          if not group.name.startswith('cup.')))
    if others < total and not first.startswith('cup.'):
        text += f' A perfect K and P would gain {total - others:.2f} mm.'
    if result.per_millisecond:
        text += (' Each millisecond of the valve moves the landing by '
                 f'{MILLI * result.per_millisecond:.1f} mm.')
    console.paragraph(text)
