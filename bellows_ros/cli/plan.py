"""Predict the motion of the package during a plan, and the safety of the grip."""

import argparse
import math

from bellows_ros.errors import BellowsError
from bellows_ros.report.text import display_unit, formatted, with_error
from bellows_ros.workflows.plan import plan, PlanReport, write_prediction
from bellows_ros.workflows.steer import steer_plan, SteerReport

from .console import Console
from .options import Outcome, read_settings


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Predict a plan."""
    values = read_settings(arguments, cup_for=console)
    console.progress('planning')
    limits, where = arguments.limits or '', (str(arguments.urdf or ''), arguments.topic)
    if arguments.steer:
        return _steered(arguments, steer_plan(
            arguments.plan, values, arguments.steer, limits, *where))
    report = plan(arguments.plan, values, *where, arguments.fastest, limits)
    if arguments.out:
        write_prediction(arguments.out, report.source, *report.driven[:2], arguments.force)
    return Outcome(report, report.holds, inputs=[arguments.plan], draw=arguments.plot)


def _steered(arguments: argparse.Namespace, report: SteerReport) -> Outcome:
    """Write a steered motion."""
    if arguments.fastest:
        raise BellowsError('--fastest is of the plan, not of --steer. Give one of both.')
    motion = report.motions[report.method]
    if arguments.out:
        write_prediction(
            arguments.out, report.source, motion.tool, motion.prediction.states, arguments.force)
    return Outcome(report, inputs=[arguments.plan], draw=arguments.plot)


def _print_steered(report: SteerReport, console: Console) -> None:
    """Print the effects of the motions."""
    degrees = 'deg', math.degrees(1.0)
    console.line(f'Plan {report.source.path}, steered by {report.method}', 'bold')
    rows: list[tuple[str, ...]] = [
        ('motion', 'duration', 'longer by', 'bending', 'residual', 'expected', 'settled',
         'safety')]
    for name, motion in report.motions.items():
        figures = motion.summary()
        expected = figures['expected_swing'] if report.uncertain else math.nan
        rows.append((
            name, f'{figures["duration"]:.3f} s', f'{1e3 * figures["added_time"]:.0f} ms',
            *(formatted(angle, '.1f' if angle >= math.radians(10.0) else '.3f', *degrees)
              for angle in (figures['peak_bending'], figures['swing_left'], expected)),
            formatted(figures['settled_after'], '.2f', 's'),
            formatted(figures['smallest_safety_factor'], '.2f')))
    console.table(rows, right=True)
    figures = report.motions[report.method].summary()
    console.paragraph(
        f'The tool moves at up to {figures["speed"]:.3g} m/s, {figures["acceleration"]:.3g} '
        f'm/s^2, {math.degrees(1.0) * figures["angular_speed"]:.3g} deg/s and '
        f'{math.degrees(1.0) * figures["angular_acceleration"]:.0f} deg/s^2.',
        *report.notes)


def print_result(report: PlanReport | SteerReport, console: Console) -> None:
    """Print the numbers and their meaning."""
    if isinstance(report, SteerReport):
        return _print_steered(report, console)
    source = report.source
    where = f", in frame '{source.frame_id}'" if source.frame_id else ''
    console.line(f'Plan {source.path}', 'bold')
    console.line(f'({len(source.tool)} points, {source.duration:.3f} s{where})', 'dim')
    console.table(_figure_rows(report))
    if report.used:
        console.table([('limit', 'used'), *(
            (name, f'{100.0 * part:.0f} %') for name, part in report.used.items())], right=True)
    console.warn(*report.warnings)
    if report.fastest and report.driven[2]:
        console.paragraph(
            f'The limit {report.driven[2]} of the arm needs '
            f'{report.driven[0].seconds[-1]:.3f} s; --out writes that motion.')
    if not (report.warnings or console.asked):
        console.line('The grip holds' + (
            ', within the validity range.' if any(source.values.envelope.rates) else
            '. The validity range of the cup is unknown.'), 'green')


def _figure_rows(report: PlanReport) -> list[tuple[str, str, str]]:
    """Return rows to print: name, value with its standard deviation, and a remark."""
    prediction, degrees = report.prediction, display_unit('rad')
    figures = prediction.summary()

    def value(name: str, factor: float, unit: str) -> str:
        return with_error(factor * figures[name], factor * report.std[name], unit)

    rows = [
        ('largest bending', value('peak_bending', *degrees), ''),
        ('largest deflection', value('peak_deflection', 1e3, 'mm'), ''),
        ('largest force', value('peak_force', 1.0, 'N'), ''),
        ('largest moment', value('peak_moment', 1.0, 'N m'),
         f'{value("rigid_peak_moment", 1.0, "N m")} of the rigid load')]
    if prediction.grip:
        factor, mode, time = prediction.smallest_safety
        rows.insert(0, ('smallest safety factor', 'none', 'the package presses on the cup')
                    if math.isinf(factor) else (
                        'smallest safety factor', value('smallest_safety_factor', 1.0, ''),
                        f'{mode}, at {time:.3f} s'))
    if prediction.ends_at_rest:
        after = figures['settled_after']
        still = 'below 0.5 degrees' + (f' after {after:.2f} s' if after > 0.0 else '')
        rows.append(('residual swing', value('swing_left', *degrees), still if
                     math.isfinite(after) else 'not below 0.5 degrees within 30 s'))
    if fastest := report.fastest:
        duration = report.source.duration
        rows.append(('shortest safe time', with_error(
            fastest.scale * duration, fastest.scale_std * duration, 's'),
            f"{fastest.scale:.3f} of the plan's"))
    elif report.sought:
        rows.append(('shortest safe time', 'none', ''))
    return rows
