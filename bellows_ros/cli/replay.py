"""Predict a recording with a cup, and report the errors."""

import argparse
from collections.abc import Mapping
from typing import Any

from bellows_ros.core.identification.validation import MAX_NRMSE
from bellows_ros.errors import require_pictures
from bellows_ros.files import atomic
from bellows_ros.report.text import print_replay
from bellows_ros.workflows import replay

from . import options
from .console import Console


def _check(arguments: argparse.Namespace, settings: Mapping[str, Any]) -> None:
    """Raise for drawings or files that cannot be made, before any work."""
    if arguments.report:
        require_pictures()


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Predict a recording, and compare the prediction with the measured poses."""
    settings = options.read_settings(arguments, cup_for=console)
    _check(arguments, settings)
    result = replay.replay(
        arguments.bag, settings, console.progress, arguments.observe)
    limit = MAX_NRMSE if arguments.limit is None else arguments.limit / 100.0
    if arguments.report:
        from bellows_ros.report.build import replay_page

        atomic.write_text(arguments.report, replay_page(result, arguments.params))
    failing = result.validation.failing(limit)
    worse = failing if arguments.limit is not None else result.validation.worse_than_noise
    return options.Outcome(
        (result, limit), not worse, draw=arguments.plot,
        content=result.as_json(limit, arguments.params) if arguments.json else {})


def print_result(shown: tuple[replay.Replay, float], console: Console) -> None:
    """Print the errors with their limit, and the speed of the live prediction."""
    result, limit = shown
    print_replay(result, console, limit)
    if result.live:
        console.paragraph(
            f'The live prediction took {result.live.took:.2f} s, '
            f'{result.live.real_time_factor:.0f} times faster than real time.')
