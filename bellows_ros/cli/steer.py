r"""
Change a planned motion of the tool so that the package does not swing.

The inverse moves the package as planned, in no more time. ZV and ZVD shape the motion; they take
longer and are less sensitive to errors in cup and package.

Examples
--------
bellows steer bags/transport.yaml --method inverse --params bags/tossing.yaml --out steered
    the tool motion with which the package moves as planned
bellows steer plan_bag --method zvd --params bags/cup.yaml --limits limits.yaml \
    --out steered --json steer.json
    a shaped motion within limits, with all figures
bellows steer plan_bag --method inverse --params bags/cup.yaml --plot steer.gif
    planned and steered motion side by side, at a quarter of the speed

"""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from .console import Console
from .options import argument, plan_arguments, run_plan_command

if TYPE_CHECKING:
    from bellows_ros.workflows.steer import SteerReport


SLOWER = 4.0


ARGUMENTS = (
    *plan_arguments(
        'all figures', '.png, .svg or .pdf: tilt of the package over time; .gif or .mp4: planned '
        'and steered motion', 'the steered motion, and the package along it'),
    argument('--method', 'the inverse of cup and package, or input shaping for their '
             'modes at rest', None, required=True, choices=('inverse', 'zv', 'zvd')),
    argument('--limits FILE', 'limits of the arm: the motion is slowed down until it meets all '
             'of them; config/limits_example.yaml explains every setting', None, type=Path))


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Read, steer, write, report."""
    from bellows_ros.workflows.plan import write_prediction
    from bellows_ros.workflows.steer import steer_plan

    def film(report: 'SteerReport') -> None:
        from bellows_ros.plots.animation import write_steering

        write_steering(arguments.plot, report, f'{arguments.plan}', speed=1.0 / SLOWER)

    def write(report: 'SteerReport') -> None:
        motion = report.motions[report.method]
        write_prediction(
            arguments.out, report.source, motion.tool, motion.prediction.states, arguments.force)

    return run_plan_command(
        arguments, console, lambda values, progress: steer_plan(
            arguments.plan, values, arguments.method, arguments.limits or '',
            str(arguments.urdf or ''), arguments.topic),
        print_result, write, film)


def print_result(report: 'SteerReport', console: Console) -> None:
    """Print the effects of the motions, and which one to use."""
    console.line(f'Plan {report.source.path}, steered by {report.method}', 'bold')
    rows = [('motion', 'takes', 'later by', 'tilt', 'swing left', 'expected', 'settled', 'safety')]
    for name, motion in report.motions.items():
        found = motion.figures()
        factor = found['smallest_safety_factor']
        rows.append((
            name, f'{found["duration"]:.3f} s', f'{1e3 * found["added_time"]:.0f} ms',
            _degrees(found['largest_tilt']), _degrees(found['swing_left']),
            _degrees(found['expected_swing']) if report.uncertain else '-',
            f'{found["settled_after"]:.2f} s' if math.isfinite(found['settled_after']) else '-',
            f'{factor:.2f}' if math.isfinite(factor) else '-'))
    console.table(rows, right=True)
    own = report.motions[report.method].figures()
    console.paragraph(
        f'The tool moves at up to {own["speed"]:.3g} m/s, {own["acceleration"]:.3g} m/s^2, '
        f'{own["angular_speed"]:.3g} rad/s and {own["angular_acceleration"]:.3g} rad/s^2; the '
        f'package is at most {1e3 * own["path_error"]:.2g} mm from its desired path.')
    console.paragraph(*report.notes)
    if report.advice:
        console.paragraph(report.advice)


def _degrees(angle: float) -> str:
    """Return an angle (rad) as text."""
    degrees = math.degrees(angle)
    return f'{degrees:.1f} deg' if degrees >= 10.0 else f'{degrees:.3f} deg'
