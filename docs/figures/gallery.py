"""Draw the results of commands, from recordings and plans in bags/, as users get them."""

from collections.abc import Callable
from contextlib import chdir
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bellows_ros import plan, read_parameters, steer
from bellows_ros.cli import main as bellows
from bellows_ros.files.safe_yaml import load
from bellows_ros.plots.animation import write_steering
from bellows_ros.plots.style import Theme, THEMES
from bellows_ros.workflows.excite import excite
from bellows_ros.workflows.toss import toss_plan

ROOT = Path(__file__).resolve().parents[2]
CUP = ('--params', 'bags/package.yaml', '--params', 'bags/cup.yaml')
SPEED = 0.25
"""Seconds of the transport per second of its film."""


def drawn(work: Callable[[], Any]) -> Callable[[Theme], Any]:
    """Return a function that draws a result in a theme; the result is computed once."""
    @cache
    def once() -> Any:
        with chdir(ROOT):  # so that the pictures name recordings as a reader would
            return work()
    return lambda theme: once().plot('light' if theme is THEMES['light'] else 'dark')


def parameters() -> dict[str, Any]:
    """Return the parameters of transport and throw."""
    return read_parameters('bags/tossing.yaml')


@cache
def steered() -> Any:
    """Return the transport, steered by the inverse."""
    return steer('bags/transport.yaml', parameters(), method='inverse')


def designed() -> Any:
    """Return a motion of 20 s that identifies the cup of bags/."""
    return excite(read_parameters('bags/cup.yaml'),
                  load('config/limits_example.yaml'), 20.0)


def minute() -> Any:
    """Return the prediction of a recorded motion with a cup that was not identified."""
    known = {**read_parameters('config/cup_thesis.yaml'), **read_parameters('bags/package.yaml'),
             'cup.lip_radius': 0.03, 'vacuum.holding': 4e4}
    return plan('bags/validation', known)


FIGURES = {
    'minute.png': drawn(minute),
    'plan.png': drawn(lambda: plan('bags/transport.yaml', parameters())),
    'steer.png': drawn(steered),
    'toss.png': drawn(
        lambda: toss_plan('bags/throw.yaml', parameters(), 2.95, monte_carlo=500)),
    'exciting.png': drawn(designed),
}


def plotted(*arguments: str) -> Callable[[Path, str], None]:
    """Return a function that lets `bellows plot` write a file in a theme."""
    def write(path: Path, theme: str) -> None:
        with chdir(ROOT):
            assert bellows(['plot', *arguments, *CUP, '--theme', theme, '--out', str(path)]) == 0
    return write


def tutorial(path: Path, theme: str) -> None:
    """Write the prediction of the second recording with the cup that the tutorial identifies."""
    with chdir(ROOT), TemporaryDirectory() as folder:
        cup, known = f'{folder}/cup.yaml', ('--params', 'bags/package.yaml')
        assert bellows(['identify', 'bags/identification', *known, '--out', cup]) == 0
        assert bellows(['plot', 'prediction', 'bags/validation', *known, '--params', cup,
                        '--theme', theme, '--out', str(path)]) == 0


def tag(path: Path, theme: str) -> None:
    """Write the prediction beside the poses of a tag, with the cup identified from its corners."""
    with chdir(ROOT), TemporaryDirectory() as folder:
        cell, cup, known = (f'{folder}/{name}.yaml' for name in ('cell', 'cup', 'known'))
        assert bellows(['info', 'bags/tag', '--write-params', known]) == 0
        assert bellows(['identify', '--params', 'bags/package.yaml', '--params', known, '--set',
                        'measured.tag_size=0.048', '--out', cup, '--out-cell', cell]) == 0
        assert bellows(['plot', 'prediction', 'bags/tag_validation', '--params', cell,
                        '--params', cup, '--theme', theme, '--out', str(path)]) == 0


def filmed(path: Path, theme: str) -> None:
    """Write the film of the transport as planned and as steered."""
    with chdir(ROOT):
        report = steered()
    write_steering(path, report, '0.6 m in 0.5 s, with 1.84 kg', SPEED, theme)


FILES = {
    'prediction.png': tutorial,
    'tag.png': tag,
    'deflection.png': plotted('deflection', 'bags/identification'),
    'replay.gif': plotted('animation', 'bags/validation', '--from', '3', '--to', '4'),
    'steer.gif': filmed,
}
