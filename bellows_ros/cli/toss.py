"""
Predict a toss: the valve is switched, the cup lets go, the package flies and lands.

Report the uncertainty of the landing and the largest contribution to it; or find the time of
release for a target.

Examples
--------
bellows toss bags/throw.yaml --params bags/tossing.yaml --release 3.0
    the landing if the valve is switched 3.0 s after the beginning of the plan
bellows toss bags/throw.yaml --params bags/tossing.yaml --target 1.8 0.149 --plot toss.png
    the time to switch the valve to land at x = 1.8 m, y = 0.149 m, with a picture

"""

import argparse
import math
from typing import TYPE_CHECKING

from bellows_ros.errors import BellowsError
from bellows_ros.report import column, with_error

from .console import Console
from .options import argument, plan_arguments, run_plan_command

if TYPE_CHECKING:
    from bellows_ros.workflows.toss import TossResult

NEGATIVE_RESULT = 'no release of the plan lands, or none at the target'
MILLI = 1e3
FARTHEST = 100.0
"""Largest coordinate of a target, m."""
UNITS = {
    'package.mass': (1e3, 'g'), 'package.com': (1e3, 'mm'), 'release.delay': (1e3, 'ms'),
    'release.tau': (1e3, 'ms'), 'release.impulse': (1e3, 'mN s'), 'release.closing': (1.0, 'N'),
    'release.opening': (1e3, 'mm'), 'release.damping': (1.0, 'N s/m')}
"""In which units a standard deviation is printed."""


ARGUMENTS = (
    *plan_arguments(
        'the toss', '.png, .svg or .pdf; the toss from the side and from above',
        'tool and package, held, parting and flying until it lands'),
    argument('--release T', 'when to switch the valve, in s from the beginning of the plan', None,
             type=float),
    argument('--target X Y', 'find the time of release whose landing is nearest to this point, m '
             'in the world', None, type=float),
    argument('--target-rotation QX QY QZ QW', 'with --target: also match this orientation '
             '(quaternion); an angle counts as the distance it moves the farthest corner', None,
             type=float),
    argument('--monte-carlo N', 'also draw this many random tosses, beside the linear ellipse',
             0))


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Predict, write, report."""
    _require_numbers(arguments)
    from bellows_ros.workflows.toss import toss_plan, write_toss

    return run_plan_command(
        arguments, console, lambda values, progress: toss_plan(
            arguments.plan, values, arguments.release, arguments.target,
            arguments.target_rotation, arguments.monte_carlo, progress,
            str(arguments.urdf or ''), arguments.topic),
        print_result, lambda result: write_toss(arguments.out, result, arguments.force),
        succeeded=lambda result: result.reached)


def _require_numbers(arguments: argparse.Namespace) -> None:
    """Refuse numbers that are not finite or out of range."""
    if arguments.monte_carlo < 0 or arguments.monte_carlo == 1:
        raise BellowsError(
            f'--monte-carlo is {arguments.monte_carlo}; expected 2 tosses or more, or 0 for none.')
    for name in ('release', 'target', 'target_rotation'):
        given = getattr(arguments, name)
        numbers = given if isinstance(given, list) else [given or 0.0]
        if not all(map(math.isfinite, numbers)) or (
                name == 'target_rotation' and given and math.hypot(*given) < 0.5):
            raise BellowsError(
                f'--{name.replace("_", "-")} is {given}; expected finite numbers'
                f'{", a quaternion of length 1" if name == "target_rotation" else ""}.')
        if name == 'target' and max(map(abs, numbers)) > FARTHEST:
            raise BellowsError(
                f'--target is {given} m; expected at most {FARTHEST:g} m. Is it in mm?')


def print_result(result: 'TossResult', console: Console) -> None:
    """Print release, landing, its uncertainty, and the largest contribution."""
    import numpy as np

    found, case = result.toss, result.case
    late = MILLI * (found.release_time - case.switched)
    speed = math.hypot(*found.release[2])
    x, y, _ = found.landing[0]
    std = np.sqrt(np.diag(result.covariance))
    console.line('Toss', 'bold')
    mode = 'its lip peels' if case.held.mode == 'peel' else (
        'its suction is blown off' if case.release.law[5] else 'after the delay')
    console.line(
        f'  valve     {case.switched:.4f} s; lets go {late:.1f} ms later ({mode}) at '
        f'{speed:.2f} m/s')
    turned = math.degrees(float(np.linalg.norm(std[3:])))
    console.line(f'  landing   {found.landing_time:.4f} s at x {with_error(x, std[0], "m")}, '
                 f'y {with_error(y, std[1], "m")}')
    unsure = f'turned ± {turned:.2g} deg, ' if turned else ''
    console.line(f'            {unsure}tumbling at {found.tumbling:.2f} rad/s')
    if result.aim is not None:
        before = result.distance_as_asked
        gain = '' if before is None else f', instead of {MILLI * before:.1f} mm with --release'
        angle = f', {math.degrees(result.aim.angle):.1f} deg' if result.aim.angle else ''
        console.line(f'  target    {MILLI * result.aim.distance:.2f} mm{angle} away{gain}')
    if result.drawn is not None:
        counted = MILLI * np.sqrt(np.diag(result.drawn.covariance))
        from bellows_ros.core.toss.landing import coverage

        inside = 100.0 * coverage(result.covariance, result.drawn.errors)
        console.line(
            f'  drawn     {len(result.drawn.errors)} tosses: x {counted[0]:.1f} mm, y '
            f'{counted[1]:.1f} mm; {inside:.1f} % in the 95 % ellipse; {result.drawn.failed} '
            'failed')
    console.line()
    _print_budget(result, console)
    console.warn(*result.warnings)


def _print_budget(result: 'TossResult', console: Console) -> None:
    """Print the contributions to the uncertainty, and which to reduce first."""
    groups = result.groups()
    if not groups:
        console.paragraph(
            'The uncertainty of the landing is unknown: no standard deviation is given. Set '
            "release.delay_std, release.tau_std, package.mass_std and package.com_std; 'bellows "
            "identify' writes cup.*_std.")
        return

    rows = [('uncertain quantity', 'by', 'at landing', 'turned')]
    for g, moved, angle in zip(
            groups, _figures([MILLI * g.metres for g in groups]),
            _figures([math.degrees(g.radians) for g in groups]), strict=True):
        factor, unit = UNITS.get(g.name, (1.0, ''))
        rows.append((
            g.name, f'{factor * g.std:.3g} {unit}' if math.isfinite(g.std)
            else 'one fit' if g.name == 'release' else 'per entry', f'{moved} mm', f'{angle} deg'))
    console.table(rows, right=True)
    total, first = math.hypot(*(g.metres for g in groups)), groups[0]
    left = math.sqrt(max(0.0, total**2 - first.metres**2))
    text = (
        f'Reduce first: {first.name}, {MILLI * first.metres:.1f} of {MILLI * total:.1f} mm. If '
        f'it were known exactly, {MILLI * left:.1f} mm would remain.')
    cup = math.hypot(*(g.metres for g in groups if g.name.startswith('cup.')))
    if cup and not first.name.startswith('cup.'):
        gain = total - math.sqrt(max(0.0, total**2 - cup**2))
        text += f' A perfect K and P would gain {MILLI * gain:.2f} mm.'
    if result.per_millisecond:
        text += (' Each millisecond of the valve moves the landing by '
                 f'{MILLI * result.per_millisecond:.1f} mm.')
    console.paragraph(text)


def _figures(sizes: list[float]) -> list[str]:
    """Return sizes with the decimals that show three figures of the largest."""
    return column(sizes, 0.1 * max(sizes) or 1.0)
