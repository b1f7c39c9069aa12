"""`bellows plot`: pictures of recordings, fits and replays."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from .commands import OK
from .console import Console
from .options import add_parameter_options, given_parameters, require_outputs

DESCRIPTION = (
    'Draw a picture of a recording (motion, spectra, path), of how a cup fits it (deflection, '
    'residuals), or of how it is predicted (prediction, animation).'
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
)  # fmt: skip

WHAT = {
    'motion': 'tool and package against time, all axes',
    'spectra': "spectra of the package's motion seen from the tool; with a cup, of the error too",
    'path': 'paths of tool and package in space',
    'deflection': "load on the cup against its deflection, with the cup's stiffness",
    'residuals': 'load on the cup against time, and what the cup leaves unexplained',
    'prediction': 'predicted and measured pose of the package, and their difference',
    'animation': 'tool, cup and package moving (.gif; .mp4 with ffmpeg)',
}

Settings = Mapping[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'what', metavar='WHAT', choices=WHAT,
        help='; '.join(f'{name}: {text}' for name, text in WHAT.items()),
    )  # fmt: skip
    parser.add_argument(
        'bag', metavar='BAG', type=Path,
        help='recording: a rosbag2 folder, or a .mcap or .db3 file',
    )  # fmt: skip
    add_parameter_options(parser)
    parser.add_argument(
        '--out', metavar='FILE', required=True,
        help='picture to write: .png, .svg or .pdf; of an animation .gif or .mp4',
    )  # fmt: skip
    parser.add_argument(
        '--theme', choices=('light', 'dark'), default='light', help='for paper, or for the dark'
    )
    parser.add_argument(
        '--from', metavar='SECONDS', type=float, dest='first', default=float('-inf'),
        help='where an animation begins',
    )  # fmt: skip
    parser.add_argument(
        '--to', metavar='SECONDS', type=float, dest='last', default=float('inf'),
        help='where an animation ends',
    )  # fmt: skip


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Read, draw, write."""
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve

    values = given_parameters(arguments.params, arguments.overrides)
    settings = resolve(values, PACKAGE_PARAMETERS)
    require_outputs(arguments.out)
    _require_ending(arguments.what, arguments.out)
    given = 'cup.stiffness' in values
    note = f'{arguments.bag}' + ('' if given else '; cup of the thesis')
    with console.progress() as progress:
        progress(f'reading {arguments.bag}')
        if arguments.what == 'animation':
            _animate(arguments, settings, note, progress)
        else:
            _draw(arguments, settings, note, given)
    if not given and arguments.what in ('deflection', 'residuals', 'prediction', 'animation'):
        console.warn('cup.stiffness is not set: this is the cup of the thesis, (4.78, 4.79).')
    console.say(f'Wrote {arguments.out}.')
    return OK


def _require_ending(what: str, out: str) -> None:
    """Refuse a name that does not suit what is drawn, before any work."""
    from bellows_ros.errors import BellowsError

    endings = ('.gif', '.mp4') if what == 'animation' else ('.png', '.svg', '.pdf')
    if not out.lower().endswith(endings):
        raise BellowsError(
            f"--out '{out}' must end in {', '.join(endings[:-1])} or {endings[-1]} "
            f'for {what}.'
        )


def _draw(arguments: argparse.Namespace, settings: Settings, note: str, given: bool) -> None:
    """Draw a picture and write it."""
    from bellows_ros.plots.style import write_figure

    figure = _FIGURES[arguments.what](arguments.bag, settings, note, arguments.theme, given)
    write_figure(arguments.out, figure)


def _motion(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of motions."""
    from bellows_ros.plots.recording import motion_figure
    from bellows_ros.workflows.plot import motion

    return motion_figure(motion(bag, settings), str(bag), theme)


def _path(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of paths."""
    from bellows_ros.plots.recording import path_figure
    from bellows_ros.workflows.plot import motion

    return path_figure(motion(bag, settings), str(bag), theme)


def _spectra(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of spectra."""
    from bellows_ros.plots.recording import spectra_figure
    from bellows_ros.workflows.plot import spectra

    return spectra_figure(spectra(bag, settings, given), str(bag), theme)


def _deflection(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of loads against deflections."""
    from bellows_ros.plots.loads import deflection_figure
    from bellows_ros.workflows.plot import loads

    return deflection_figure(loads(bag, settings), note, theme)


def _residuals(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of what is unexplained."""
    from bellows_ros.plots.loads import residual_figure
    from bellows_ros.workflows.plot import loads

    return residual_figure(loads(bag, settings), note, theme)


def _prediction(bag: Path, settings: Settings, note: str, theme: str, given: bool) -> Any:
    """Return the picture of a replay."""
    from bellows_ros.plots.prediction import Comparison, prediction_figure
    from bellows_ros.workflows.plot import replayed

    shown = replayed(bag, settings)
    compared = Comparison(
        shown.seconds, shown.replay.measured, shown.replay.predicted, shown.replay.scores)
    title = 'Held package: predicted, and measured'
    return prediction_figure(compared, title, f'relative to the tool; {note}', theme)


def _animate(
    arguments: argparse.Namespace, settings: Settings, note: str, progress: Any
) -> None:
    """Draw an animation and write it."""
    from bellows_ros.plots.animation import write_animation
    from bellows_ros.workflows.plot import replayed

    write_animation(
        arguments.out, replayed(arguments.bag, settings), note, arguments.theme,
        (arguments.first, arguments.last), progress,
    )  # fmt: skip


_FIGURES: Mapping[str, Callable[..., Any]] = {
    'motion': _motion,
    'spectra': _spectra,
    'path': _path,
    'deflection': _deflection,
    'residuals': _residuals,
    'prediction': _prediction,
}
