"""Change a planned motion so that the package does not swing."""

import argparse
import math

from bellows_ros.report.text import formatted
from bellows_ros.workflows import plan, steer

from .console import Console
from .options import Outcome, read_settings

DEGREES = math.degrees(1.0)


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Steer a plan, and write it."""
    values = read_settings(arguments, cup_for=console)
    console.progress('planning')
    report = steer.steer_plan(
        arguments.plan, values, arguments.method, arguments.limits or '',
        str(arguments.urdf or ''), arguments.topic)
    motion = report.motions[report.method]
    if arguments.out:
        plan.write_prediction(
            arguments.out, report.source, motion.tool, motion.prediction.states, arguments.force)
    return Outcome(report, inputs=[arguments.plan], draw=arguments.plot)


def print_result(report: steer.SteerReport, console: Console) -> None:
    """Print the effects of the motions."""
    console.line(f'Plan {report.source.path}, steered by {report.method}', 'bold')
    rows: list[tuple[str, ...]] = [
        ('motion', 'duration', 'longer by', 'bending', 'residual', 'expected', 'settled',
         'safety')]
    for name, motion in report.motions.items():
        figures = motion.summary()
        expected = figures['expected_swing'] if report.uncertain else math.nan
        rows.append((
            name, f'{figures["duration"]:.3f} s', f'{1e3 * figures["added_time"]:.0f} ms',
            *(formatted(angle, '.1f' if angle >= math.radians(10.0) else '.3f', 'deg', DEGREES)
              for angle in (figures['peak_bending'], figures['swing_left'], expected)),
            formatted(figures['settled_after'], '.2f', 's'),
            formatted(figures['smallest_safety_factor'], '.2f')))
    console.table(rows, right=True)
    figures = report.motions[report.method].summary()
    console.paragraph(
        f'The tool moves at up to {figures["speed"]:.3g} m/s, {figures["acceleration"]:.3g} '
        f'm/s^2, {DEGREES * figures["angular_speed"]:.3g} deg/s and '
        f'{DEGREES * figures["angular_acceleration"]:.0f} deg/s^2.',
        *report.notes)
