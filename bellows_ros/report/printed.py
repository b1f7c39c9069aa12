"""Results of the commands as text: recordings, plans, tosses, simulations, parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math
from typing import Any, TYPE_CHECKING

from bellows_ros.core.findings import Level
from bellows_ros.core.parameters.table import Parameter, PARAMETERS
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.files.parameter_files import format_parameters
from bellows_ros.workflows.info import Info, TopicInfo
from bellows_ros.workflows.toss import RELEASE_UNITS
import numpy as np

from .findings import listed, many, sets
from .findings import text as text_of
from .text import DISPLAYED, formatted, quantity

if TYPE_CHECKING:
    from bellows_ros.core.planning.effect import Effect
    from bellows_ros.workflows.convert import Conversion
    from bellows_ros.workflows.plan import PlanReport
    from bellows_ros.workflows.simulate import SimulationReport
    from bellows_ros.workflows.toss import ReleaseResult, TossResult

MILLI = 1e3

UNKNOWN = ('package.mass', 'package.inertia', 'package.com', 'recording.package_frame',
           'cup.length')
"""Quantities that a recording does not contain: comments of the file, to fill in."""

FIGURES = {
    'duration': ('duration', 's'),
    'smallest_safety_factor': ('smallest safety factor', ''),
    'peak_bending': ('largest bending', 'deg'), 'peak_deflection': ('largest deflection', 'mm'),
    'peak_force': ('largest force', 'N'), 'peak_moment': ('largest moment', 'N m'),
    'swing_left': ('residual swing', 'deg'), 'settled_after': ('settled after the stop', 's')}
"""Printed names and units of the numbers of a plan."""


def print_info(result: Info, out: Any, file: str = '') -> None:
    """Print the topics, their roles, the settings in the file of --write-params, and notes."""
    out.table(_topic_rows(result.topics), title=f'Recording {result.path}')
    head = ('topic', 'left out', 'outliers', 'longest gap', 'noise mm (x y z)', 'deg')
    out.table([head, *(_quality_row(topic) for topic in result.topics if topic.kind)])
    for role in ('tool', 'package', 'twist'):
        guess = getattr(result, role)
        why = f': {"; ".join(guess.why)}' if guess and guess.why else ''
        name = f'probably {guess.topic}' if guess else 'not found'
        out.paragraph(f'{role.capitalize():8} {name}{why}.')
    found = {name: list(value) if isinstance(value, tuple) else value
             for name, value in result.settings.items() if name != 'bags'}
    chosen = [f'{name}: {value or repr(value)}' for name, value in found.items()]
    to_do = list[str]()
    for each in result.findings:
        if found.keys().isdisjoint(sets(each)):
            to_do.append(text_of(each))
        else:
            chosen.append(text_of(each._replace(level=Level.OK)))
    _print_section(f'Set in {file}:' if file else 'Settings for --write-params:', chosen, out)
    _print_section('To do:', to_do, out)


def _print_section(title: str, lines: Sequence[str], out: Any) -> None:
    """Print indented lines below a title; nothing without lines."""
    if lines:
        out.line()
        out.line(title)
        out.paragraph(*(f'  {line}' for line in lines))


def _quality_row(topic: TopicInfo) -> tuple[str, ...]:
    """Return the row of a topic with poses: omitted messages, outliers, gaps and noise."""
    def noise(name: str, factor: float) -> str:
        return ' '.join(f'{factor * x:.3f}' for x in topic.noise.get(name, ()))

    refused = ', '.join(f'{count} {reason}' for reason, count in topic.refused.items())
    longest = max((gap for _, gap in topic.gaps), default=0.0)
    return (topic.name, refused, f'{topic.outliers}', f'{MILLI * longest:.0f} ms',
            noise('position', MILLI), noise('rotation', math.degrees(1.0)))


def _topic_rows(topics: Sequence[TopicInfo]) -> list[tuple[str, ...]]:
    """Return a row per topic."""
    first_ns = min((topic.start_ns for topic in topics if topic.kind), default=0)
    rows: list[tuple[str, ...]] = [
        ('topic', 'type', 'messages', 'rate', 'jitter', 'from', 'to', 'gaps')]
    for topic in topics:
        begin, timing = (topic.start_ns - first_ns) / NS_PER_S, ('',) * 5
        if topic.kind:
            timing = (
                formatted(topic.rate_hz, '.1f', 'Hz', unknown=''),
                formatted(topic.jitter_s, '.2f', 'ms', MILLI, ''), f'{begin:.2f} s',
                f'{begin + topic.duration_s:.2f} s', f'{len(topic.gaps)}')
        rows.append((
            topic.name, topic.type_name.rpartition('/')[2], str(topic.messages), *timing))
    return rows


def cell_file(result: Info) -> str:
    """Return the text of a parameter file of a recording, with comments on what to fill in."""
    unknown = (*UNKNOWN, 'measured.tag_size') if result.is_tag else UNKNOWN
    return format_parameters(result.settings, [
        f'How to read {result.path}, as found by bellows info; check it.',
        *(text_of(each) for each in result.findings if each.code == 'freed')],
        [PARAMETERS[name] for name in unknown if name not in result.settings])


def template(parameters: Iterable[Parameter]) -> str:
    """
    Return a parameter file with the defaults.

    A parameter without a default, or with an empty list, which ROS files lack, is a comment.
    """
    parameters = list(parameters)
    required = [p for p in parameters if p.default in (None, ())]
    values = {p.name: p.default for p in parameters if p not in required}
    return format_parameters(
        values, ['Parameters of bellows_ros at their defaults.'], required)


def print_parameters(parameters: list[Parameter], out: Any) -> None:
    """Print the table."""
    for parameter in parameters:
        out.line(parameter.name, 'bold')
        users = ' and '.join(parameter.used_by)
        facts = f'{parameter.constraint}; {parameter.default_text}; {users}'
        for text in (facts, parameter.description):
            out.paragraph(f'  {text}')


def print_release(result: ReleaseResult, out: Any) -> None:
    """Print the law with its errors, and its residuals for the drops of each mass."""
    fit = result.fit
    out.line(f'Release identified from {many(len(fit.drops), "drop")} in '
             f'{listed(result.inputs)}', 'bold')
    out.table([('parameter', 'value'), *(
        (name, quantity(fit.law[k], math.inf if k in fit.not_identifiable else float(fit.std[k]),
                        DISPLAYED.get(unit, unit)))
        for k, (name, unit) in enumerate(RELEASE_UNITS.items()))])
    out.table([('mass', 'drops', 'lets go after', 'position', 'velocity'), *(
        (f'{mass:.3g} kg', f'{count}', formatted(released, '.1f', 'ms', MILLI, 'later'),
         f'{MILLI * position:.2f} mm', f'{MILLI * velocity:.1f} mm/s')
        for mass, count, released, position, velocity in result.masses())], right=True)
    speed = max(drop.speed for drop in fit.drops)
    out.paragraph(
        f'The instant scatters by {MILLI * fit.scatter:.2f} ms from drop to drop: '
        f'{MILLI * fit.scatter * speed:.1f} mm at {speed:.2f} m/s, the fastest release.',
        f'RMS residual of the positions: {MILLI * fit.position:.2f} mm; chi² per pose: '
        f'{fit.chi2:.3g} (1: model and noise are right).')
    out.warn(*result.warnings)


def print_plan(report: PlanReport, out: Any) -> None:
    """Print the effects of the motions, the moves, the used parts of limits, and findings."""
    source, motions, result = report.source, report.motions, report.result
    where = f", in frame '{source.frame_id}'" if source.frame_id else ''
    out.line(f'Plan {source.path}', 'bold')
    out.line(f'({len(source.tool)} points, {source.duration:.3f} s{where})', 'dim')
    rows = [('', *motions)]
    for name, (label, unit) in FIGURES.items():
        if not all(math.isnan(motion.summary()[name]) for motion in motions.values()):
            rows.append((label, *(_figure(motion, name, unit) for motion in motions.values())))
    out.table(rows)
    if len(result.moves) > 1:
        out.table([('move', 'from', 'to', 'least safety factor'), *(
            (f'{number}', f'{move.begin:.2f} s', f'{move.end:.2f} s',
             f'{move.smallest_safety_factor:.2f}')
            for number, move in enumerate(result.moves, 1))], right=True)
    if report.used:
        out.table([('limit', 'used'), *(
            (name, f'{100.0 * part:.0f} %') for name, part in report.used.items())], right=True)
    out.paragraph(*(text_of(each) for each in report.findings if each.level == Level.OK))
    out.warn(*report.warnings)
    if not (report.warnings or out.asked):
        out.line('The grip holds' + (
            ', within the validity range.' if any(source.values.cup.valid_high[:12]) else
            '. The validity range of the cup is unknown.'), 'green')


def _figure(motion: Effect, name: str, unit: str) -> str:
    """Return a number of a motion with its standard deviation; of the grip, when and how."""
    found = quantity(motion.summary()[name], motion.std[name], unit)
    if name != 'smallest_safety_factor':
        return found
    _, mode, time = motion.prediction.smallest_safety
    return f'{found} ({mode}, at {motion.begin + time:.3f} s)'


def print_toss(result: TossResult, out: Any) -> None:
    """Print release, landing, its uncertainty, and the largest contribution."""
    toss, case, aim = result.toss, result.case, result.aim
    std = np.sqrt(np.diag(result.covariance))
    lost = result.scatter.failed
    if result.mode == 'peel':
        mode = 'its lip peels'
    elif case.release.law[3]:
        mode = 'its suction is blown off'
    else:
        mode = 'an assumed delay' if result.assumed else 'after the delay'
    failed = f'{lost} of {lost + len(result.scatter.errors)} drawn tosses fail' if lost else ''
    rows = [
        ('valve', f'{case.switched:.4f} s', ''),
        ('lets go later by', quantity(toss.release_time - case.switched, 0.0, 'ms'),
         f'{mode}, at {math.hypot(*toss.release[2]):.2f} m/s'),
        ('landing', f'{toss.landing_time:.4f} s', failed),
        ('at x', quantity(toss.landing[0][0], std[0], 'm'), ''),
        ('at y', quantity(toss.landing[0][1], std[1], 'm'), ''),
        ('turned by', f'± {math.degrees(float(np.linalg.norm(std[3:]))):.2g} deg', ''),
        ('tumbling at', quantity(toss.tumbling, 0.0, 'deg/s'), '')]
    if aim:
        rows.append(('target away', quantity(aim.distance, 0.0, 'mm'), ''))
    out.table(rows, title='Toss')
    _print_budget(result, out)
    out.warn(*result.warnings)


def _print_budget(result: TossResult, out: Any) -> None:
    """Print the contributions to the uncertainty, and the first to reduce."""
    groups = result.groups()
    if not groups:
        out.paragraph(
            'The uncertainty of the landing is unknown: no standard deviation is given. Set '
            "release.std, package.mass_std and package.com_std; 'bellows "
            "identify' writes cup.*_std.")
        return
    rows = [('uncertain quantity', 'std. dev.', 'at landing', 'turned')]
    for group in groups:
        unit = PARAMETERS[group.name].unit if group.name in PARAMETERS else ''
        name = 'release.std' if group.name == 'release' else f'{group.name}_std'
        rows.append((
            group.name, f'see {name}' if math.isnan(group.std) else quantity(
                group.std, 0.0, DISPLAYED.get(unit, unit)),
            f'{MILLI * group.metres:.2f} mm', f'{math.degrees(group.radians):.3f} deg'))
    out.table(rows, right=True)
    first, *others = (MILLI * group.metres for group in groups)
    text = (
        f'Reduce first: {groups[0].name}, {first:.1f} of {math.hypot(first, *others):.1f} mm '
        '(root of the sum of squares). If it were known exactly, '
        f'{math.hypot(*others):.1f} mm would remain.')
    if result.per_millisecond:
        text += (' Each millisecond of the valve moves the landing by '
                 f'{MILLI * result.per_millisecond:.1f} mm.')
    out.paragraph(text)


def print_simulation(report: SimulationReport, out: Any) -> None:
    """Print the numbers of messages, the largest bending, and the margin of the grip."""
    out.table([('topic', 'messages'), *(
        (topic, f'{count}') for topic, count in report.messages.items())], right=True,
        title=f'Recorded {report.duration_s:g} s to {report.bag}')
    out.line(f'The cup bends by up to {math.degrees(report.largest_bending_rad):.1f} degrees, '
             f'at {report.largest_bending_time_s:.2f} s.')
    if report.margin:
        out.paragraph(text_of(report.margin.finding))
    if report.truth:
        out.line(f'The true motion: {report.truth}')
    out.warn(*report.warnings)


def print_conversion(done: Conversion, out: Any) -> None:
    """Print the numbers of converted and of rejected poses."""
    for body in done.bodies:
        rejected = ', '.join(f'{count} {reason}' for reason, count in body.left_out.items())
        out.line(f'{body.topic}: {body.poses} poses of {body.source}'
                 + (f'; left out: {rejected}' if rejected else ''))
    if done.world != 'z_up':
        out.line(f'Its world has y up: set recording.world to {done.world}.')
    out.warn(*done.notes)
