"""Draw recordings, fits and predictions."""

import argparse
from collections.abc import Callable
from functools import partial
import math
from typing import Any

from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError
from bellows_ros.plots import animation, pictures, style
from bellows_ros.workflows import plot, replay

from . import options
from .console import Console, Progress

MAX_SPEED = 100.0  # times real time


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Draw a picture of recordings or predictions."""
    needs_cup = arguments.what not in ('motion', 'spectra', 'path')
    values = options.read_settings(arguments, cup_for=console if needs_cup else None)
    has_cup = 'cup.stiffness' in values
    style.require_picture(
        arguments.out, style.FILMS if arguments.what == 'animation' else style.PICTURES)
    if arguments.what == 'spectra' and (arguments.first > -math.inf or arguments.last < math.inf):
        raise BellowsError('Spectra use the whole recording. Leave out --from and --to.')
    if not 0.0 < arguments.speed <= MAX_SPEED:
        raise BellowsError(
            f'--speed must be above 0 and at most {MAX_SPEED:g}, got {arguments.speed:g}.')
    note = f'{arguments.bag}{"; cup of the thesis" if needs_cup and not has_cup else ""}'
    if arguments.what == 'animation':
        note += f'; {arguments.speed:g} times real time'
    console.progress(f'reading {arguments.bag}')
    settings, recording = plot.recorded(
        arguments.bag, values, needs_cup or arguments.what == 'spectra' and has_cup)
    content = _draw(arguments, settings, recording, has_cup, note, console.progress)
    return options.Outcome(None, content={
        'what': arguments.what, 'bag': str(arguments.bag), 'file': arguments.out,
        **(plot.data_json(content) if arguments.json else {})})


def print_result(result: None, console: Console) -> None:
    """Print nothing, as the picture is the result."""


def _draw(
    arguments: argparse.Namespace, values: Values, recording: Recording, has_cup: bool, note: str,
    progress: Progress,
) -> Any:
    """Draw and write; return the drawn data."""
    def bodies() -> plot.Replayed:
        live = replay.predicted_live(recording, values, progress)
        return plot.with_bodies(values, recording, live)

    motion, loads = partial(plot.motion, recording), partial(plot.loads, values, recording)
    kinds: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
        'motion': (motion, pictures.motion_figure), 'path': (motion, pictures.path_figure),
        'deflection': (loads, pictures.deflection_figure),
        'residuals': (loads, pictures.residual_figure),
        'margin': (lambda: replay.validated(values, recording).margins, pictures.margin_figure),
        'spectra': (partial(plot.spectra, values, recording, has_cup), pictures.spectra_figure),
        'prediction': (bodies, lambda content, note, theme: pictures.prediction_figure(
            content.seconds, content.live, 'Package: predicted, and measured',
            f'relative to the tool; {note}', theme)),
        'animation': (bodies, partial(
            animation.write_animation, arguments.out, progress=progress, speed=arguments.speed))}
    read, draw = kinds[arguments.what]
    content = read()
    if arguments.what != 'spectra':
        content = plot.within(content, arguments.first, arguments.last)
    if figure := draw(content, note, arguments.theme):
        style.write_figure(arguments.out, figure)
    return content
