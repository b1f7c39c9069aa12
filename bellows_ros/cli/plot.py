r"""
Draw a picture of a recording, of the fit of a cup, or of its prediction.

Of a recording: motion, spectra, path; of a fit: deflection, residuals; of a prediction: margin,
prediction, animation.

Examples
--------
bellows plot motion bags/identification --params bags/package.yaml --out motion.png
    tool and package on all axes against time
bellows plot deflection bags/identification --params bags/cup.yaml --out deflection.svg
    load against deflection, and the cup's stiffness
bellows plot prediction bags/validation --params bags/cup.yaml --out prediction.png \
    --theme dark
    measured and predicted pose of the package
bellows plot animation bags/validation --params bags/cup.yaml --out replay.gif \
    --from 3 --to 6
    tool, cup and package moving
bellows plot spectra recording --out spectra.svg --json spectra.json
    with the numbers, for pictures of your own

"""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from bellows_ros.errors import BellowsError

from . import options
from .console import Console, OK, Progress

WHAT = {
    'motion': 'tool and package against time, all axes',
    'spectra': "spectra of the package's motion relative to the tool; with a cup, also of the "
               'error',
    'path': 'paths of tool and package in space',
    'deflection': "load on the cup against its deflection, with the cup's stiffness",
    'margin': 'safety factors of the grip against time, with two standard deviations',
    'residuals': 'load on the cup against time, and the part the cup does not explain',
    'prediction': 'predicted and measured pose of the package, and their difference',
    'animation': 'tool, cup and package moving (.gif; .mp4 with ffmpeg)'}

OF_THE_RECORDING = ('motion', 'spectra', 'path')  # pictures that need no cup
FASTEST = 100.0
FULL_RANGE = (float('-inf'), float('inf'))  # s


ARGUMENTS = (
    options.argument('what WHAT', '; '.join(f'{name}: {text}' for name, text in WHAT.items()),
                     choices=WHAT),
    options.BAG, *options.PARAMETERS,
    options.output('--out FILE', 'picture to write: .png, .svg or .pdf; of an animation .gif or '
                   '.mp4', options.Binary, required=True),
    options.json_output('the numbers that are drawn, in SI units,'),
    options.argument('--theme', 'colours on a light or dark background', 'light',
                     choices=('light', 'dark')),
    options.argument('--speed S', 'speed of an animation: seconds of the recording per second '
                     '(default: %(default)s)', 0.25),
    options.argument('--from S', "start of the picture, in s after the recording's first stamp; "
                     'not for spectra', FULL_RANGE[0], dest='first'),
    options.argument('--to S', 'end of the picture', FULL_RANGE[1], dest='last'))


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Read, draw, write."""
    from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
    from bellows_ros.plots.style import FILMS, PICTURES, require_picture
    from bellows_ros.workflows.plot import data_json

    tracked = arguments.what in OF_THE_RECORDING
    values = options.read_settings(arguments, cup_for=None if tracked else console)
    given = 'cup.stiffness' in values
    settings = resolve(values, () if tracked and not (arguments.what == 'spectra' and given)
                       else PACKAGE_PARAMETERS)
    require_picture(arguments.out, FILMS if arguments.what == 'animation' else PICTURES)
    if arguments.what == 'spectra' and (arguments.first, arguments.last) != FULL_RANGE:
        raise BellowsError('Spectra use the whole recording. Leave out --from and --to.')
    if arguments.last <= max(arguments.first, 0.0):
        raise BellowsError(
            f'--to must be above {max(arguments.first, 0.0):g} s, got {arguments.last:g}.')
    if not 0.0 < arguments.speed <= FASTEST:
        raise BellowsError(
            f'--speed must be above 0 and at most {FASTEST:g}, got {arguments.speed:g}.')
    note = f'{arguments.bag}{"" if given or tracked else "; cup of the thesis"}'
    if arguments.what == 'animation':
        note += f'; {arguments.speed:g} times real time'
    with console.progress() as progress:
        progress(f'reading {arguments.bag}')
        shown = _drawn(arguments, settings, given, note, progress)
    about = {'what': arguments.what, 'bag': str(arguments.bag), 'file': arguments.out}
    options.write_result(arguments.json, {**about, **data_json(shown)})
    console.wrote(arguments.out, arguments.json)
    return OK


def _drawn(
    arguments: argparse.Namespace, settings: Mapping[str, Any], given: bool, note: str,
    progress: Progress,
) -> Any:
    """Read, draw and write; return what the picture shows."""
    from bellows_ros.plots import recording
    from bellows_ros.plots.animation import write_animation
    from bellows_ros.plots.plan import margin_figure
    from bellows_ros.plots.recording import prediction_figure
    from bellows_ros.plots.style import write_figure
    from bellows_ros.workflows.plot import loads, margins, motion, replayed, spectra, within

    replay = partial(replayed, progress=progress)
    kinds: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        'motion': (motion, recording.motion_figure), 'path': (motion, recording.path_figure),
        'deflection': (loads, recording.deflection_figure),
        'residuals': (loads, recording.residual_figure),
        'margin': (margins, margin_figure), 'spectra': (spectra, recording.spectra_figure),
        'prediction': (replay, lambda shown, note, theme: prediction_figure(
            shown.seconds, shown.live, 'Package: predicted, and measured',
            f'relative to the tool; {note}', theme)),
        'animation': (replay, partial(
            write_animation, arguments.out, progress=progress, speed=arguments.speed))}
    read, draw = kinds[arguments.what]
    if arguments.what == 'spectra':
        shown: Any = read(arguments.bag, settings, given)
    else:
        shown = within(read(arguments.bag, settings), arguments.first, arguments.last)
    if figure := draw(shown, note, arguments.theme):
        write_figure(arguments.out, figure)
    return shown
