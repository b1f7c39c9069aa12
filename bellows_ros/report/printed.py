"""Results of the commands as text: recordings, plans, tosses, simulations, parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
import math
import textwrap
from typing import Any, TYPE_CHECKING

from bellows_ros.core.findings import Level
from bellows_ros.core.parameters.table import Parameter, PARAMETERS
from bellows_ros.core.recording.alignment import MIN_REST
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.files.parameter_files import format_parameters
from bellows_ros.workflows.info import Info, TopicInfo
from bellows_ros.workflows.toss import RELEASE_UNITS
import numpy as np

from .findings import sets
from .findings import text as text_of
from .sentences import listed, many
from .text import column, display_unit, formatted, with_error

if TYPE_CHECKING:
    from bellows_ros.workflows.convert import Conversion
    from bellows_ros.workflows.plan import PlanReport, SteerReport
    from bellows_ros.workflows.simulate import SimulationReport
    from bellows_ros.workflows.toss import ReleaseResult, TossResult

MILLI = 1e3
SECTION = 'ros__parameters:\n'
INDENT = '    '

UNKNOWN = ('package.mass', 'package.inertia', 'package.com', 'recording.package_frame',
           'cup.length')
"""Quantities that a recording does not contain: comments of the file, to fill in."""


def print_info(result: Info, out: Any, file: str = '') -> None:
    """Print the topics, their roles, the settings in the file of --write-params, and notes."""
    out.table(_topic_rows(result), title=f'Recording {result.path}')
    for topic in result.topics:
        for line in _facts(topic):
            out.paragraph(f'  {topic.name}: {line}')
    out.line()
    for role in ('tool', 'package', 'twist'):
        guess = getattr(result, role)
        why = f': {"; ".join(guess.why)}' if guess and guess.why else ''
        name = f'probably {guess.topic}' if guess else 'not found'
        out.paragraph(f'{role.capitalize():8} {name}{why}.')
    if result.valve:
        out.paragraph(
            f'Valve    probably {result.valve}: the only std_msgs/Bool (topics.valve).')
    if signal := result.settings.get('vacuum.signal'):
        out.paragraph(
            f'Vacuum   recorded: with vacuum.signal: {signal} only the holds are used.')
    if world := result.settings.get('recording.world'):
        axes = 'z up' if world == 'z_up' else "Motive's, y up"
        out.line(f'World    probably {axes} (recording.world: {world}).')
    if result.rest_s is not None and result.rest_s >= MIN_REST:
        out.line(f'Both stand still for the first {result.rest_s:.1f} s.')
    found = {name: list(value) if isinstance(value, tuple) else value
             for name, value in result.settings.items() if name != 'bags'}
    settled, open_ones = ([each for each in result.findings if found.keys().isdisjoint(
        sets(each)) == is_open] for is_open in (False, True))
    for title, lines in (
            (f'Set in {file}:' if file else 'Settings for --write-params:', [
                *(f'{name}: {value or repr(value)}' for name, value in found.items()),
                *(text_of(each._replace(level=Level.OK)) for each in settled)]),
            ('To do:', [*map(text_of, open_ones)])):
        out.line()
        out.line(title * bool(lines))
        out.paragraph(*(f'  {line}' for line in lines))


def _topic_rows(result: Info) -> list[tuple[str, ...]]:
    """Return a row per topic."""
    first_ns = min((topic.start_ns for topic in result.topics if topic.kind), default=0)
    rows: list[tuple[str, ...]] = [
        ('topic', 'type', 'messages', 'rate', 'jitter', 'from', 'to', 'gaps')]
    for topic in result.topics:
        begin = (topic.start_ns - first_ns) / NS_PER_S
        rows.append((topic.name, topic.type_name.rpartition('/')[2], str(topic.messages), *(
            formatted(size, form, unit, unknown='') if topic.kind else '' for size, form, unit in (
                (topic.rate_hz, '.1f', 'Hz'), (1e3 * topic.jitter_s, '.2f', 'ms'),
                (begin, '.2f', 's'), (begin + topic.duration_s, '.2f', 's'),
                (len(topic.gaps), '.0f', '')))))
    return rows


def _facts(topic: TopicInfo) -> Iterator[str]:
    """Yield the faults in a topic's messages, and the noise of its poses."""
    result = [f'{count} {reason.replace("_", " ")}' for reason, count in topic.refused.items()]
    if result:
        yield f'messages left out: {", ".join(result)}'
    if topic.outliers:
        yield f'{many(topic.outliers, "outlier")}, as where tracking is lost'
    if topic.gaps:
        longest = max(length for _, length in topic.gaps)
        yield f'{many(len(topic.gaps), "gap")}, the longest {longest * 1e3:.0f} ms'
    if topic.noise:
        position, rotation = (
            ' '.join(f'{factor * x:.3f}' for x in topic.noise[name])
            for name, factor in (('position', 1e3), ('rotation', math.degrees(1.0))))
        yield f'noise of {position} mm, {rotation} deg (x y z)'


def cell_file(result: Info) -> str:
    """Return the text of a parameter file of a recording, with comments on what to fill in."""
    unknown = UNKNOWN + ('measured.tag_size',) * result.is_tag
    return template_with(
        [PARAMETERS[name] for name in unknown if name not in result.settings], result.settings, [
            f'How to read {result.path}, as found by bellows info; check it.',
            *(text_of(each) for each in result.findings if each.code.startswith('free_'))])


def template(parameters: Iterable[Parameter]) -> str:
    """
    Return a parameter file with the defaults.

    A parameter without a default, or with an empty list, which ROS files lack, is a comment.
    """
    parameters = list(parameters)
    required = [p for p in parameters if p.default in (None, ())]
    values = {p.name: p.default for p in parameters if p not in required}
    return template_with(required, values, ['Parameters of bellows_ros at their defaults.'])


def template_with(
    required: list[Parameter], values: Mapping[str, Any], header: Sequence[str],
) -> str:
    """Return a parameter file with values; required ones as comments to fill in."""
    text = format_parameters(values, header)
    head, body = text.split(SECTION, 1)
    lines = [f"{INDENT}# SET THESE where they apply: remove the '#', and change the example."]
    for parameter in required:
        comment = f'{INDENT}# '
        lines += textwrap.wrap(
            parameter.description, 97, initial_indent=comment, subsequent_indent=comment)
        unit = f'  # {parameter.unit}' if parameter.unit else ''
        example = parameter.example or parameter.default
        lines.append(f'{INDENT}#{parameter.name}: {example}{unit}')
    to_fill_in = ''.join(f'{line}\n' for line in lines if required)
    return head + SECTION + to_fill_in + (body if values else '')


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
    rows = [('parameter', 'value')]
    for k, (name, of_law) in enumerate(RELEASE_UNITS.items()):
        factor, unit = display_unit(of_law)
        std = math.inf if k in fit.not_identifiable else float(fit.std[k])
        rows.append((name, with_error(factor * fit.law[k], factor * std, unit)))
    out.table(rows)
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
    """Print the numbers and their meaning."""
    source = report.source
    where = f", in frame '{source.frame_id}'" if source.frame_id else ''
    out.line(f'Plan {source.path}', 'bold')
    out.line(f'({len(source.tool)} points, {source.duration:.3f} s{where})', 'dim')
    out.table(_figure_rows(report))
    if report.moves[1:]:
        out.table([('move', 'from', 'to', 'least safety factor'), *(
            (f'{number}', f'{begin:.2f} s', f'{end:.2f} s', f'{factor:.2f}')
            for number, (begin, end, factor) in enumerate(report.moves, 1))], right=True)
    if report.used:
        out.table([('limit', 'used'), *(
            (name, f'{100.0 * part:.0f} %') for name, part in report.used.items())], right=True)
    out.paragraph(*(text_of(each) for each in report.findings if each.level == Level.OK))
    out.warn(*report.warnings)
    if not (report.warnings or out.asked):
        out.line('The grip holds' + (
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
         f'with a rigid cup {value("rigid_peak_moment", 1.0, "N m")}')]
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


def print_steered(report: SteerReport, out: Any) -> None:
    """Print the effects of the motions."""
    out.line(f'Plan {report.source.path}, steered by {report.method}', 'bold')
    rows: list[tuple[str, ...]] = [
        ('motion', 'duration s', 'longer s', 'bending deg', 'residual deg', 'expected deg',
         'settled s', 'safety')]
    for name, motion in report.motions.items():
        figures = motion.summary()
        rows.append((
            name, f'{figures["duration"]:.3f}', f'{figures["added_time"]:.3f}',
            *(formatted(angle, '.3f', factor=math.degrees(1.0))
              for angle in (figures['peak_bending'], figures['swing_left'],
                            figures['expected_swing'])),
            formatted(figures['settled_after'], '.2f'),
            formatted(figures['smallest_safety_factor'], '.2f')))
    out.table(rows, right=True)
    figures = report.motions[report.method].summary()
    out.paragraph(
        f'The tool moves at up to {figures["speed"]:.3g} m/s, {figures["acceleration"]:.3g} '
        f'm/s^2, {math.degrees(1.0) * figures["angular_speed"]:.3g} deg/s and '
        f'{math.degrees(1.0) * figures["angular_acceleration"]:.0f} deg/s^2.',
        *map(text_of, report.findings))


def print_toss(result: TossResult, out: Any) -> None:
    """Print release, landing, its uncertainty, and the largest contribution."""
    toss, case = result.toss, result.case
    delay = MILLI * (toss.release_time - case.switched)
    x, y, _ = toss.landing[0]
    std = np.sqrt(np.diag(result.covariance))
    rotation_std = math.degrees(float(np.linalg.norm(std[3:])))
    mode = 'its lip peels' if result.mode == 'peel' else (
        'its suction is blown off' if case.release.law[3] else 'an assumed delay' if (
            result.assumed) else 'after the delay')
    out.line('Toss', 'bold')
    out.line(
        f'  valve     {case.switched:.4f} s; lets go {delay:.1f} ms later ({mode}) at '
        f'{math.hypot(*toss.release[2]):.2f} m/s')
    out.line(f'  landing   {toss.landing_time:.4f} s at x {with_error(x, std[0], "m")}, '
             f'y {with_error(y, std[1], "m")}')
    turned = f'turned ± {rotation_std:.2g} deg, ' if rotation_std else ''
    out.line(f'            {turned}tumbling at {math.degrees(toss.tumbling):.2g} deg/s')
    if aim := result.aim:
        asked = result.distance_as_asked
        gain = '' if asked is None else f', instead of {MILLI * asked:.1f} mm with --release'
        angle = f', {math.degrees(aim.angle):.1f} deg' if aim.angle else ''
        out.line(f'  target    {MILLI * aim.distance:.2f} mm{angle} away{gain}')
    if failed := result.scatter.failed:
        out.line(f'  failed    {failed} of {failed + len(result.scatter.errors)} drawn tosses')
    out.line()
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
    out.table(rows, right=True)
    total, first = math.hypot(*shifts), groups[0].name
    text = (
        f'Reduce first: {first}, {shifts[0]:.1f} of {total:.1f} mm. If it were known exactly, '
        f'{math.hypot(*shifts[1:]):.1f} mm would remain.')
    if result.per_millisecond:
        text += (' Each millisecond of the valve moves the landing by '
                 f'{MILLI * result.per_millisecond:.1f} mm.')
    out.paragraph(text)


def print_simulation(report: SimulationReport, out: Any) -> None:
    """Print the numbers of messages and of faults."""
    out.line(f'Recorded {report.duration_s:g} s to {report.bag}', 'bold')
    width = max(map(len, report.messages))
    for topic, count in report.messages.items():
        kinds = Counter(event.kind for event in report.events if event.topic == topic)
        put_in = [many(count, kind) for kind, count in kinds.items()]
        out.line(f'  {topic:{width}}  {count:6} messages'
                 + (f', with {" and ".join(put_in)}' if put_in else ''))
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
