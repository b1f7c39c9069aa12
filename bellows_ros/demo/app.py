"""The steps of the demonstration."""

import argparse
from collections.abc import Callable, Mapping, Sequence
import importlib.util
from pathlib import Path
import sys
import tempfile
import time
from typing import Any, TYPE_CHECKING

from bellows_ros.cli.console import Console, INTERRUPTED, NOT_USABLE, OK
from bellows_ros.core.live.replay import compare_recorded
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.extras import install
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.plots.prediction import prediction_figure
from bellows_ros.plots.style import write_figure
from bellows_ros.workflows.identification import Identification, save
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.recordings import load as load_recording
import numpy as np

from .domain import isolate
from .predictor_process import predictor
from .summary import Outcome, summary

if TYPE_CHECKING:
    from bellows_ros.nodes.demo_player import Exchange

NEEDS = {
    'rclpy': f'ROS 2 (rclpy). Source an installation, or: {install("ros")}',
    'matplotlib': f'matplotlib. Install it: {install("plot")}',
}
IDENTIFICATION, VALIDATION = 'identification', 'validation'
KNOWN = 'package.yaml'
MOTION = f'{VALIDATION}.yaml'
PICTURES = {'light': 'demo.png', 'dark': 'demo_dark.png'}

Settings = Mapping[str, Any]
Progress = Callable[[str, float], None]


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code; 0 only if all went well."""
    parser = argparse.ArgumentParser(
        prog='python -m bellows_ros.demo',
        description='Identify a cup from one recording, predict another one live over DDS with '
        'the node predictor, and compare with what was measured.',
    )
    parser.add_argument(
        '--bags', metavar='FOLDER', type=Path, default=Path('bags'),
        help=f'has {IDENTIFICATION}, {VALIDATION} and {KNOWN} (default: %(default)s)',
    )
    parser.add_argument(
        '--out', metavar='FOLDER', type=Path, default=Path('demo_output'),
        help='gets the pictures, the cup, the fit and the log (default: %(default)s)',
    )
    arguments = parser.parse_args(args)
    console = Console(sys.stdout, sys.stderr)
    try:
        return run(arguments.bags, arguments.out, console)
    except BellowsError as error:
        console.error(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        console.note('Interrupted.')
        return INTERRUPTED


def run(bags: Path, out: Path, console: Console) -> int:
    """Identify, predict live, compare, and show the outcome."""
    start = time.monotonic()
    _require_all(bags)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BellowsError(
            f"Output folder '{out}' cannot be made: {error.strerror}. Give another with --out."
        ) from None
    known = read_parameters(bags / KNOWN)
    found = _identify(bags / IDENTIFICATION, known, out, console)
    if not found.fit.usable:
        for warning in found.fit.warnings:
            console.warn(warning)
        return NOT_USABLE
    settings = resolve({**known, **found.parameters()}, PACKAGE_PARAMETERS)
    outcome = _predict_and_compare(bags, settings, found, out, console)
    console.say()
    for line in summary(outcome):
        console.say(line)
    console.say()
    names = [*PICTURES.values(), 'cup.yaml', 'fit.json']
    console.say(f'Wrote {", ".join(names)} to {out}, after {time.monotonic() - start:.0f} s.')
    console.say('Next, look at a recording of yours: bellows info BAG')
    return OK if outcome.lost == 0 else NOT_USABLE


def _require_all(bags: Path) -> None:
    """Refuse to start if something is missing."""
    for module, words in NEEDS.items():
        if importlib.util.find_spec(module) is None:
            raise BellowsError(f'The demonstration needs {words}')
    for name in (KNOWN, IDENTIFICATION, VALIDATION):
        if not (bags / name).exists():
            raise BellowsError(
                f"'{bags / name}' does not exist. Start in the folder that contains bags, or "
                "give it with --bags; 'make bags' makes the recordings again."
            )


def _identify(bag: Path, known: Settings, out: Path, console: Console) -> Identification:
    """Identify the cup, and write its file."""
    console.say(f'1. Identify the cup from {bag}', 'bold')
    settings = resolve({**known, 'bags': [str(bag)]}, PACKAGE_PARAMETERS)
    with console.progress() as progress:
        found = identify(settings, progress)
    if found.fit.usable:
        save(found, out / 'cup.yaml', out / 'fit.json')
    return found


def _predict_and_compare(
    bags: Path, settings: Settings, found: Identification, out: Path, console: Console
) -> Outcome:
    """Play the other recording to the node, compare its predictions, and draw them."""
    bag = bags / VALIDATION
    console.say(f'2. Start the node predictor with it, and play {bag} to it over DDS', 'bold')
    recorded = load_recording(bag, settings)
    with console.progress() as progress:
        exchange = _predict_live(recorded, out, progress)
    console.say('3. Compare its poses with the measured ones', 'bold')
    if not len(exchange.stamps_ns):
        raise BellowsError('The predictor did not answer. See its log, predictor.log.')
    stamps, first = np.unique(exchange.stamps_ns, return_index=True)
    live = Trajectory(stamps, exchange.position[first], exchange.rotation[first])
    comparison = compare_recorded(live, recorded.measured_tool, recorded.measured_package)
    seconds = recorded.since_start(comparison.stamps_ns)
    title = 'Package: predicted live, and measured'
    note = 'relative to the tool; the cup was identified from another recording'
    for theme, name in PICTURES.items():
        write_figure(out / name, prediction_figure(seconds, comparison, title, note, theme))
    duration = float(np.ptp(recorded.tool_pose.stamps_ns)) / NS_PER_S
    motion = bags / MOTION
    noise = safe_yaml.load(motion).get('package', {}).get('noise', {}) if motion.exists() else {}
    return Outcome(found.fit, comparison.scores, exchange, duration, noise)


def _predict_live(recorded: Recording, out: Path, progress: Progress) -> 'Exchange':
    """
    Play a recording's tool-arm messages to the node predictor at recorded speed.

    From here on this process has a ROS domain of its own, reached from this machine only.
    """
    with tempfile.TemporaryDirectory(prefix='bellows_log_') as logs:
        isolate(logs)
        from bellows_ros.nodes.demo_player import Player

        with predictor(out / 'cup.yaml', out / 'predictor.log') as require_alive:
            player = Player(recorded.tool_pose, recorded.tool_twist, require_alive)
            return player.play(progress)
