"""The steps of the demonstration, with the node predictor in another process."""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, TYPE_CHECKING

from bellows_ros import plots
from bellows_ros.cli.console import Console, NOT_USABLE, OK, Progress, run_guarded
from bellows_ros.core.geometry.jit import IS_NEW
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.files import bags, parameter_files
from bellows_ros.nodes.command import require_ros
from bellows_ros.report.text import percent, print_cup
from bellows_ros.workflows import identification, identify, warm_up
from bellows_ros.workflows.recordings import load as load_recording
import numpy as np

from . import isolate

if TYPE_CHECKING:
    from bellows_ros.nodes.bag_player import Exchange

IDENTIFICATION, VALIDATION = 'identification', 'validation'
PACKAGE = 'package.yaml'
MILLI, MICRO = 1e3, 1e6

MAX_ERROR = 2.0
"""Largest RMS error of a prediction relative to the measured noise; 1.0 for a perfect cup."""

RELIABLE = tuple(
    word for topic in ('pose', 'twist')
    for setting in ('reliability:=reliable', 'depth:=10000')  # it may be paused
    for word in ('-p', f'qos_overrides./tool_arm/{topic}.subscription.{setting}'))
"""Arguments with which the predictor takes part in an exchange without loss."""

PICTURE = 'demo.png'


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code; 0 only if all went well."""
    parser = argparse.ArgumentParser(
        prog='python -m bellows_ros.demo',
        description='Identify a cup, predict another recording live over DDS, and compare.')
    parser.add_argument(
        '--bags', metavar='FOLDER', type=Path, default=Path('bags'),
        help=f'has {IDENTIFICATION}, {VALIDATION} and {PACKAGE} (default: %(default)s)')
    parser.add_argument(
        '--out', metavar='FOLDER', type=Path, default=Path('demo_output'),
        help='gets the pictures, the cup, the fit and the log (default: %(default)s)')
    arguments = parser.parse_args(args)
    return run_guarded(lambda console: run(arguments.bags, arguments.out, console))


def run(bags: Path, out: Path, console: Console) -> int:
    """Identify, predict live, compare, and print the result."""
    start = time.monotonic()
    require_ros()
    require_pictures()
    if missing := [bags / name for name in (PACKAGE, IDENTIFICATION, VALIDATION)
                   if not (bags / name).exists()]:
        raise BellowsError(
            f"'{missing[0]}' does not exist. Start in the folder that contains bags, or give it "
            "with --bags; 'make bags' simulates the recordings again.")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BellowsError(
            f"Output folder '{out}' cannot be created: {error.strerror}. Give another with --out."
        ) from None
    package, bag = parameter_files.read_parameters(bags / PACKAGE), bags / IDENTIFICATION
    if IS_NEW:
        with console.progress as progress:
            warm_up.warm_up(('fit', 'prediction'), ((0.0, 0.0),), progress)
    console.line(f'1. Identify the cup from {bag}', 'bold')
    with console.progress as progress:
        result = identify.identify(
            resolve({**package, 'bags': [str(bag)]}, PACKAGE_PARAMETERS), progress)
    identification.save(result, out / 'cup.yaml', out / 'fit.json')
    settings = resolve({**package, **result.parameters()}, PACKAGE_PARAMETERS)
    bag = bags / VALIDATION
    console.line(f'2. Start the node predictor with it, and play {bag} to it over DDS', 'bold')
    recorded = load_recording(bag, settings)
    with console.progress as progress:
        exchange = _predict_live(bag, settings, [out / 'cup.yaml', bags / PACKAGE], out, progress)
    console.line('3. Compare its poses with the measured ones', 'bold')
    comparison = residuals.compare_recorded(
        exchange.predicted, recorded.measured_tool, recorded.measured_package)
    seconds = recorded.since_start(comparison.stamps_ns)
    plots.write_figure(out / PICTURE, plots.comparison_figure(
        seconds, comparison, 'Package: predicted live, and measured',
        'relative to the tool; the cup was identified from another recording'))
    accurate = _print_result(
        result.fit, comparison.scores, exchange, recorded.noise.package, console)
    console.line()
    console.line(f'Wrote {PICTURE}, cup.yaml and fit.json to {out}, after '
                 f'{time.monotonic() - start:.0f} s.')
    console.line('Next, look at a recording of yours: bellows info BAG')
    return OK if accurate else NOT_USABLE


def _predict_live(
    bag: Path, settings: Mapping[str, Any], parameters: Sequence[Path], out: Path,
    progress: Progress,
) -> 'Exchange':
    """
    Play a recording's tool-arm messages to the node predictor at recorded speed.

    From here on this process uses an unused ROS domain on this machine only.
    """
    with tempfile.TemporaryDirectory(prefix='bellows_log_') as logs:
        isolate(logs)
        from bellows_ros.nodes.bag_player import converse, POSES, TWISTS

        names = {settings['topics.tool_pose']: POSES, settings['topics.tool_twist']: TWISTS}
        messages, _ = bags.read_messages(bag, names)
        with predictor(parameters, out / 'predictor.log') as require_alive:
            return converse(messages, names, require_alive, progress)


def _print_result(
    fit: Fit, scores: residuals.Scores, exchange: 'Exchange', noise: Noise, console: Console
) -> bool:
    """Print cup, errors, latency and messages; return whether the prediction is accurate."""
    print_cup(fit.exactly_given, console, 'The cup, with standard errors from the recording')
    console.table(
        [('axis', 'error', 'of the motion'), *(
            (name, f'{rms:.3f} {unit}', percent(part)) for name, unit, rms, part in zip(
                residuals.AXES, residuals.DISPLAY_UNITS, residuals.DISPLAY_FACTORS * scores.rms,
                scores.nrmse, strict=True))],
        right=True, title='The package relative to the tool, predicted live minus measured (RMS)')
    console.line(f'  (the measured poses themselves have noise: {MILLI * noise.position:.2g} mm, '
                 f'{np.degrees(noise.rotation):.2g} deg)')
    console.line()
    median, high = np.percentile(exchange.latency, (50, 99)) * MICRO
    console.line(f'Latency, from sending a pose to receiving its prediction: p50 {median:.0f} us, '
                 f'p99 {high:.0f} us')
    poses, twists = exchange.sent['tool_arm/pose'], exchange.sent['tool_arm/twist']
    answers = exchange.predicted.stamps_ns
    lost = poses - len(answers)
    console.line(f'Messages in {np.ptp(answers) / NS_PER_S:.0f} s: {poses} poses and {twists} '
                 f'twists to the node, {len(answers)} predictions back, {lost or "none"} lost')
    if lost or high > 10e-3 * MICRO:  # s
        load, cores = os.getloadavg()[0], os.cpu_count()
        console.line(f'The machine was busy (load {load:.1f} on {cores} cores), so latencies here '
                     'are mostly waiting.')
    limits = MAX_ERROR * np.repeat([noise.position, noise.rotation], 3)
    accurate = bool(np.all(scores.rms <= limits))
    if not accurate:
        console.line(f'Errors exceed {MAX_ERROR:g} times the noise: the prediction is not usable.')
    return accurate


@contextmanager
def predictor(parameters: Sequence[Path], log: Path) -> Iterator[Callable[[], None]]:
    """
    Run the node within the context.

    Parameters
    ----------
    parameters : sequence of Path
        Files for --params-file.
    log : Path
        File for the node's output.

    Yields
    ------
    callable
        Function that raises BellowsError, with the end of the log, if the node has ended by
        itself.

    """
    command = [sys.executable, '-m', 'bellows_ros.nodes.command', 'predictor', '--ros-args',
               *(word for file in parameters for word in ('--params-file', str(file))), *RELIABLE]
    with log.open('wb') as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)

    def require_alive() -> None:
        if process.poll() is not None:
            lines = log.read_text(errors='replace').splitlines()[-15:]
            end = '\n'.join(f'  {line}' for line in lines) or '  (it is empty)'
            raise BellowsError(
                f'The predictor exited with code {process.returncode}. The end of its log, '
                f'{log}:\n{end}')

    try:
        yield require_alive
        require_alive()
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)  # like Ctrl-C
        try:
            process.wait(10.0)  # s
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
