"""List the topics of a recording, and guess their roles."""

import argparse
from collections.abc import Iterator
import math

from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.recording.alignment import MIN_REST
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.files.atomic import write_text
from bellows_ros.report.sentences import many
from bellows_ros.workflows.info import Info, info, TopicInfo

from . import options
from .console import Console
from .parameters import template_with

UNKNOWN = ('package.mass', 'package.inertia', 'package.com', 'recording.package_frame',
           'cup.length')
"""Quantities that a recording does not contain: comments of the file, to fill in."""


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Examine a recording, and write its parameter file if requested."""
    options.require_absent(arguments.write_params, arguments.force)
    console.progress(f'reading {arguments.bag}')
    result = info(arguments.bag, options.interval_settings(arguments))
    if arguments.write_params:
        settings = dict(result.settings)
        if result.is_tag and 'fit.free' in settings:
            settings['fit.free'] = (*settings['fit.free'], 'scale')  # a tag of another size
        unknown = UNKNOWN + ('measured.tag_size',) * result.is_tag
        write_text(arguments.write_params, template_with(
            [PARAMETERS[name] for name in unknown if name not in settings], settings,
            [f'How to read {result.path}, as found by bellows info; check it.']))
    cell = ' --out-cell cell.yaml' if 'recording.package_world' in result.settings else ''
    return options.Outcome(result, then=(
        'Fill in the package there, then:',
        f'  bellows identify --params {arguments.write_params} --out cup.yaml{cell}',
    ) if arguments.write_params else ())


def print_result(result: Info, console: Console) -> None:
    """Print the topics, their roles and notes."""
    console.table(_topic_rows(result), title=f'Recording {result.path}')
    for topic in result.topics:
        for line in _facts(topic):
            console.paragraph(f'  {topic.name}: {line}')
    console.line()
    for role in ('tool', 'package', 'twist'):
        guess = getattr(result, role)
        why = f': {"; ".join(guess.why)}' if guess and guess.why else ''
        name = f'probably {guess.topic}' if guess else 'not found'
        console.paragraph(f'{role.capitalize():8} {name}{why}.')
    if result.valve:
        console.paragraph(
            f'Valve    probably {result.valve}: the only std_msgs/Bool (topics.valve).')
    if signal := result.settings.get('vacuum.signal'):
        console.paragraph(
            f'Vacuum   recorded: with vacuum.signal: {signal} only the holds are used.')
    if world := result.settings.get('recording.world'):
        axes = 'z up' if world == 'z_up' else "Motive's, y up"
        console.line(f'World    probably {axes} (recording.world: {world}).')
    if result.rest_s is not None and result.rest_s >= MIN_REST:
        console.line(f'Both stand still for the first {result.rest_s:.1f} s.')
    console.paragraph(*result.notes)


def _topic_rows(result: Info) -> list[tuple[str, ...]]:
    """Return a row per topic."""
    first_ns = min((topic.start_ns for topic in result.topics if topic.kind), default=0)
    rows: list[tuple[str, ...]] = [
        ('topic', 'type', 'messages', 'rate', 'jitter', 'from', 'to', 'gaps')]
    for topic in result.topics:
        begin = (topic.start_ns - first_ns) / NS_PER_S
        timing = [  # a single message has no rate
            form.format(value) if topic.kind and math.isfinite(value) else ''
            for form, value in (
                ('{:.1f} Hz', topic.rate_hz), ('{:.2f} ms', topic.jitter_s * 1e3),
                ('{:.2f} s', begin), ('{:.2f} s', begin + topic.duration_s),
                ('{}', len(topic.gaps)))]
        rows.append((
            topic.name, topic.type_name.replace('/msg/', '/'), str(topic.messages), *timing))
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
