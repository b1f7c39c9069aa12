"""`bellows replay`: predict a recording with a cup, and score the prediction."""

import argparse
from typing import TYPE_CHECKING

from .commands import OK
from .console import Console
from .options import (
    add_bag_argument,
    add_json_option,
    add_parameter_options,
    given_parameters,
    put_json,
    require_outputs,
    STDOUT,
    THESIS_CUP,
)

if TYPE_CHECKING:
    from bellows_ros.workflows.replay import Replay

DESCRIPTION = (
    "Send a recording's tool-arm messages through the prediction code of the node predictor, at "
    'full speed and without ROS, and compare its poses with the measured ones, as seen from the '
    'tool.'
)
EXAMPLES = (
    ('bellows replay bags/validation --params cup.yaml',
     'how well the cup identified before predicts another recording'),
    ('bellows replay bags/validation --params cup.yaml \\\n'
     '      --set topics.tool_twist= --json replay.json',
     'the same without twists, with all figures in a file'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_bag_argument(parser)
    add_parameter_options(parser)
    add_json_option(parser, 'the scores')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Replay, write, report."""
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve

    values = given_parameters(arguments.params, arguments.overrides)
    settings = resolve(values, PACKAGE_PARAMETERS)
    require_outputs(arguments.json)
    from bellows_ros.workflows.replay import replay

    with console.progress() as progress:
        result = replay(arguments.bag, settings, progress)
    put_json(arguments.json, result.as_json(), console)
    with console.results_to_stderr(arguments.json == STDOUT):
        if 'cup.stiffness' not in values:
            console.warn(THESIS_CUP)
        _say(result, arguments, console)
    return OK


def _say(result: 'Replay', arguments: argparse.Namespace, console: Console) -> None:
    """Print the scores and the counts."""
    from bellows_ros.workflows.recordings import offset_sentence

    from .words import count_lines, score_table

    console.say(f'Prediction of {arguments.bag}', 'bold')
    console.say('(package relative to the tool, predicted minus measured)', 'dim')
    console.say()
    for line in score_table(result.scores):
        console.say(f'  {line}')
    console.say()
    for line in (*offset_sentence(arguments.bag, result.time_offset),
                 *count_lines(result.counts)):
        console.paragraph(line)
    took = result.took
    console.paragraph(
        f'Predicting took {took["predicting"]:.2f} s, {result.real_time_factor:.0f} times '
        f'faster than real time; reading and preparing took {took["preparing"]:.2f} s, '
        f'comparing {took["comparing"]:.2f} s.'
    )
    if arguments.json not in ('', STDOUT):
        console.say(f'Wrote {arguments.json}.')
