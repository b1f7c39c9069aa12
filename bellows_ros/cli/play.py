"""Play the poses and twists of a recording to ROS."""

import argparse
import math
from typing import TYPE_CHECKING

from bellows_ros.core.parameters.checks import RECORDING_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import compare_recorded
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_messages
from bellows_ros.files.results import with_units
from bellows_ros.nodes.command import require_ros
from bellows_ros.workflows.recordings import interval_masks, load
import numpy as np

from . import options
from .console import Console

if TYPE_CHECKING:
    from bellows_ros.nodes.bag_player import Played


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Play a recording to ROS."""
    if not (math.isfinite(arguments.rate) and arguments.rate > 0.0):
        raise BellowsError(f'--rate must be a number above 0, got {arguments.rate:g}.')
    require_ros()
    from bellows_ros.nodes.bag_player import play

    pairs = [f'/{text.lstrip("/")}'.partition(':=') for text in arguments.topics]
    renamed = {topic: name or topic for topic, _, name in pairs}
    console.progress(f'reading {arguments.bag}')
    messages, notes = read_messages(arguments.bag, renamed)
    stamps_ns = np.array([message.log_time_ns for message in messages])
    chosen, = interval_masks([stamps_ns], options.interval_settings(arguments))
    messages = [messages[k] for k in np.flatnonzero(chosen)]
    names = {m.topic.name: m.topic.name for m in messages} | renamed
    console.warn(*notes)
    recorded = load(arguments.bag, resolve(
        options.read_settings(arguments), RECORDING_PARAMETERS)) if arguments.plot else None
    played = play(messages, names, arguments.rate, arguments.clock, console.progress)
    if recorded:
        _draw(arguments.plot, recorded, played)
    return options.Outcome(played, content=with_units({
        'bag': str(arguments.bag), 'messages': played.messages, 'duration': played.duration,
        'has_subscriber': played.has_subscriber}))


def _draw(file: str, recorded: Recording, played: 'Played') -> None:
    """Draw the poses that the predictor answered, and the recorded ones of the package."""
    from bellows_ros import plots

    if played.predicted is None:
        raise BellowsError(
            'No poses came on package/pose, so there is nothing to draw. Start the predictor '
            'first, in the same ROS_DOMAIN_ID, and see its log.')
    compared = compare_recorded(
        played.predicted, recorded.measured_tool, recorded.measured_package)
    plots.write_figure(file, plots.comparison_figure(
        recorded.since_start(compared.stamps_ns), compared,
        'Package: predicted live, and measured', f'relative to the tool; {recorded.name}'))


def print_result(played: 'Played', console: Console) -> None:
    """Print the numbers of sent messages."""
    width = max(map(len, played.messages))
    for name, count in played.messages.items():
        console.line(f'  {name:{width}}  {count} messages')
    console.line(f'Played in {played.duration:.1f} s.')
    if not played.has_subscriber:
        console.warn(
            'No subscriber was connected at the start. Start the predictor first, in the same '
            'ROS_DOMAIN_ID, and give --topic TOPIC:=NAME if the names differ.')
