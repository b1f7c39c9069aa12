"""Draw recordings, fits and predictions."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files import Values
from bellows_ros.plots import animation, plan_pictures, style
from bellows_ros.plots import recording_pictures as pictures
from bellows_ros.workflows.plot import data_json, loads, margins, motion, replayed, spectra, within

from . import options
from .console import Console, Progress

WITHOUT_CUP = ('motion', 'spectra', 'path')
FULL_RANGE = (float('-inf'), float('inf'))  # s
MAX_SPEED = 100.0  # times real time


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Read, draw, write."""
    needs_cup = arguments.what not in WITHOUT_CUP
    values = options.read_settings(arguments, cup_for=console if needs_cup else None)
    has_cup = 'cup.stiffness' in values
    settings = resolve(values, PACKAGE_PARAMETERS if needs_cup or (
        arguments.what == 'spectra' and has_cup) else ())
    style.require_picture(
        arguments.out, style.FILMS if arguments.what == 'animation' else style.PICTURES)
    if arguments.what == 'spectra' and (arguments.first, arguments.last) != FULL_RANGE:
        raise BellowsError('Spectra use the whole recording. Leave out --from and --to.')
    if arguments.last <= max(arguments.first, 0.0):
        raise BellowsError(
            f'--to must be above {max(arguments.first, 0.0):g} s, got {arguments.last:g}.')
    if not 0.0 < arguments.speed <= MAX_SPEED:
        raise BellowsError(
            f'--speed must be above 0 and at most {MAX_SPEED:g}, got {arguments.speed:g}.')
    note = f'{arguments.bag}{"; cup of the thesis" if needs_cup and not has_cup else ""}'
    if arguments.what == 'animation':
        note += f'; {arguments.speed:g} times real time'
    console.progress(f'reading {arguments.bag}')
    content = _draw(arguments, settings, has_cup, note, console.progress)
    return options.Outcome(None, content={
        'what': arguments.what, 'bag': str(arguments.bag), 'file': arguments.out,
        **(data_json(content) if arguments.json else {})})


def print_result(result: None, console: Console) -> None:
    """Print nothing: the picture is all."""


def _draw(
    arguments: argparse.Namespace, settings: Values, has_cup: bool, note: str, progress: Progress,
) -> Any:
    """Read, draw and write; return what the picture shows."""
    replay = partial(replayed, progress=progress)
    kinds: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        'motion': (motion, pictures.motion_figure), 'path': (motion, pictures.path_figure),
        'deflection': (loads, pictures.deflection_figure),
        'residuals': (loads, pictures.residual_figure),
        'margin': (margins, plan_pictures.margin_figure),
        'spectra': (partial(spectra, cup=has_cup), pictures.spectra_figure),
        'prediction': (replay, lambda content, note, theme: pictures.prediction_figure(
            content.seconds, content.live, 'Package: predicted, and measured',
            f'relative to the tool; {note}', theme)),
        'animation': (replay, partial(
            animation.write_animation, arguments.out, progress=progress, speed=arguments.speed))}
    read, draw = kinds[arguments.what]
    content = read(arguments.bag, settings)
    if arguments.what != 'spectra':
        content = within(content, arguments.first, arguments.last)
    if figure := draw(content, note, arguments.theme):
        style.write_figure(arguments.out, figure)
    return content
