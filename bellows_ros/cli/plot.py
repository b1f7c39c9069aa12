"""`bellows plot`: draw pictures of recordings, fits and replays."""

import argparse
from collections.abc import Callable, Mapping
from typing import Any

from bellows_ros.errors import BellowsError

from . import options
from .console import Console, OK

DESCRIPTION = (
    'Draw a picture of a recording (motion, spectra, path), of the fit of a cup (deflection, '
    'residuals), or of its prediction (margin, prediction, animation).'
)
EXAMPLES = (
    ('bellows plot motion bags/identification --params bags/package.yaml --out motion.png',
     'tool and package on all axes against time'),
    ('bellows plot deflection bags/identification --params cup.yaml --out deflection.svg',
     "load against deflection, and the cup's stiffness"),
    ('bellows plot prediction bags/validation --params cup.yaml --out prediction.png --theme dark',
     'measured and predicted pose of the package'),
    ('bellows plot animation bags/validation --params cup.yaml --out replay.gif --from 3 --to 6',
     'tool, cup and package moving'),
    ('bellows plot spectra recording --out spectra.svg --json spectra.json',
     'with the numbers, for pictures of your own'),
)

WHAT = {
    'motion': 'tool and package against time, all axes',
    'spectra': "spectra of the package's motion relative to the tool; with a cup, also of the "
               'error',
    'path': 'paths of tool and package in space',
    'deflection': "load on the cup against its deflection, with the cup's stiffness",
    'margin': 'safety factors of the grip against time, with two standard deviations',
    'residuals': 'load on the cup against time, and the part the cup does not explain',
    'prediction': 'predicted and measured pose of the package, and their difference',
    'animation': 'tool, cup and package moving (.gif; .mp4 with ffmpeg)',
}

OF_THE_RECORDING = ('motion', 'spectra', 'path')  # pictures that need no cup
FASTEST = 100.0
WHOLE = (float('-inf'), float('inf'))  # s

Settings = Mapping[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'what', metavar='WHAT', choices=WHAT,
        help='; '.join(f'{name}: {text}' for name, text in WHAT.items()),
    )
    options.add_bag_argument(parser)
    options.add_parameter_options(parser)
    parser.add_argument(
        '--out', metavar='FILE', required=True, type=options.Binary,
        help='picture to write: .png, .svg or .pdf; of an animation .gif or .mp4',
    )
    options.add_json_option(parser, 'the numbers that are drawn, in SI units,')
    parser.add_argument(
        '--theme', choices=('light', 'dark'), default='light', help='colours on a light or dark '
                                                                    'background'
    )
    parser.add_argument(
        '--speed', metavar='S', type=float, default=0.25,
        help='speed of an animation: seconds of the recording per second (default: %(default)g)',
    )
    parser.add_argument(
        '--from', metavar='S', type=float, dest='first', default=WHOLE[0],
        help="start of the picture, in s after the recording's first stamp; not for spectra",
    )
    parser.add_argument(
        '--to', metavar='S', type=float, dest='last', default=WHOLE[1],
        help='end of the picture',
    )


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Read, draw, write."""
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
    from bellows_ros.workflows.plot import data_json

    values = options.given_parameters(arguments)
    given = 'cup.stiffness' in values
    recorded = arguments.what in OF_THE_RECORDING and not (arguments.what == 'spectra' and given)
    settings = resolve(values, () if recorded else PACKAGE_PARAMETERS)
    _require_possible(arguments)
    with console.progress() as progress:
        progress(f'reading {arguments.bag}')
        shown = _shown(arguments, settings, given, progress)
        note = f'{arguments.bag}' + ('' if given or arguments.what in OF_THE_RECORDING
                                     else '; cup of the thesis')
        if arguments.what == 'animation':
            from bellows_ros.plots.animation import write_animation

            note = f'{note}; {arguments.speed:g} times real time'
            write_animation(
                arguments.out, shown, note, arguments.theme, progress, arguments.speed)
        else:
            _draw(arguments, shown, note)
    about = {'what': arguments.what, 'bag': str(arguments.bag), 'file': arguments.out}
    options.put_json(arguments.json, {**about, **data_json(shown)})
    if arguments.what not in OF_THE_RECORDING:
        options.warn_of_thesis_cup(values, console)
    console.say(f'Wrote {arguments.out}.')
    return OK


def _require_possible(arguments: argparse.Namespace) -> None:
    """Refuse an ending, a part of the time or a speed that does not suit, before any work."""
    what, out, span = arguments.what, arguments.out, (arguments.first, arguments.last)
    endings = ('.gif', '.mp4') if what == 'animation' else ('.png', '.svg', '.pdf')
    if not out.lower().endswith(endings):
        raise BellowsError(
            f"--out '{out}' must end in {', '.join(endings[:-1])} or {endings[-1]} for {what}.")
    if what == 'spectra' and span != WHOLE:
        raise BellowsError('Spectra use the whole recording. Leave out --from and --to.')
    if not 0.0 < arguments.speed <= FASTEST:
        raise BellowsError(
            f'--speed must be above 0 and at most {FASTEST:g}, got {arguments.speed:g}.')


def _shown(
    arguments: argparse.Namespace, settings: Settings, given: bool, progress: Any
) -> Any:
    """Return what a picture shows."""
    from bellows_ros.workflows.plot import loads, margins, motion, replayed, spectra, within

    what, bag = arguments.what, arguments.bag
    if what == 'spectra':
        return spectra(bag, settings, given)
    if what in ('motion', 'path'):
        found: Any = motion(bag, settings)
    elif what in ('deflection', 'residuals'):
        found = loads(bag, settings)
    elif what == 'margin':
        found = margins(bag, settings)
    else:
        found = replayed(bag, settings, progress)
    return within(found, arguments.first, arguments.last)


def _draw(arguments: argparse.Namespace, shown: Any, note: str) -> None:
    """Draw a picture and write it."""
    from bellows_ros.plots.loads import deflection_figure, residual_figure
    from bellows_ros.plots.plan import margin_figure
    from bellows_ros.plots.recording import motion_figure, path_figure, spectra_figure
    from bellows_ros.plots.style import write_figure

    figures: Mapping[str, Callable[..., Any]] = {
        'motion': motion_figure,
        'spectra': spectra_figure,
        'path': path_figure,
        'deflection': deflection_figure,
        'margin': margin_figure,
        'residuals': residual_figure,
        'prediction': _prediction,
    }
    write_figure(arguments.out, figures[arguments.what](shown, note, arguments.theme))


def _prediction(shown: Any, note: str, theme: str) -> Any:
    """Return the picture of a replay."""
    from bellows_ros.plots.prediction import prediction_figure

    title = 'Package: predicted, and measured'
    note = f'relative to the tool; {note}'
    return prediction_figure(shown.seconds, shown.live, title, note, theme)
