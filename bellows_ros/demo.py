"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and reports the errors of the predicted poses.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
import signal
import struct
import subprocess
import sys
import tempfile
import time
from typing import Any

from bellows_ros import plots
from bellows_ros.core import configure_process
from bellows_ros.core.geometry.jit import compile_aside, IS_NEW
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.live import warm_up
from bellows_ros.core.model.cup_package import Cup, STANDARD_GRAVITY
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.files import bags, parameter_files
from bellows_ros.nodes.command import require_ros
from bellows_ros.nodes.domain import isolate
from bellows_ros.workflows import identification, identify
from bellows_ros.workflows.recordings import load as load_recording
import numpy as np

BAGS = 'identification', 'validation', 'package.yaml'
"""What the folder of recordings holds."""

MAX_ERROR = 2.0
"""Largest RMS error of a prediction relative to the measured noise; 1.0 for a perfect cup."""

TIMEOUT = 120.0
"""Longest wait for an answer of the predictor, s; without a cache it compiles first."""

STAMP = slice(4, 12)
"""Slice of the stamp in a CDR message with a header, bytes."""

POSES, TWISTS = 'tool_arm/pose', 'tool_arm/twist'

PROBE_PERIOD = 0.05
"""Time between two probes, and of their stamps, s."""

PROBES = 20
"""Number of answered probes after which messages arrive in both directions."""

QUEUE = 10_000
"""Length of the queues, messages, so that none is lost while a process is busy."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code; 0 only if all went well."""
    parser = argparse.ArgumentParser(
        prog='python -m bellows_ros.demo',
        description='Identify a cup, predict another recording live over DDS, and compare.')
    parser.add_argument('--bags', metavar='FOLDER', type=Path, default=Path('bags'),
                        help=f'has {", ".join(BAGS)} (default: %(default)s)')
    parser.add_argument('--out', metavar='FOLDER', type=Path, default=Path('demo_output'),
                        help='gets picture, cup, fit and log (default: %(default)s)')
    arguments = parser.parse_args(args)
    try:
        return run(arguments.bags, arguments.out)
    except BellowsError as error:
        print(f'demo: {error}', file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _require(folder: Path, out: Path) -> None:
    """Make the output folder; raise BellowsError if anything is missing."""
    require_ros()
    require_pictures()
    if missing := [folder / name for name in BAGS if not (folder / name).exists()]:
        raise BellowsError(
            f"'{missing[0]}' does not exist. Start in the folder that contains bags, or give it "
            "with --bags; 'make bags' simulates the recordings again.")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BellowsError(f"Output folder '{out}' cannot be created: {error.strerror}. Give "
                           'another with --out.') from None


def run(folder: Path, out: Path) -> int:
    """Identify, predict live, compare, and print the result."""
    begun = time.monotonic()
    _require(folder, out)
    fitted, validated, package = (folder / name for name in BAGS)
    compiler = None
    given = parameter_files.read_parameters(package)
    if IS_NEW:
        print('Compiling (once a version): about 30 s.', flush=True)
        compiler = compile_aside(warm_up, Cup.thesis(), package_of(
            resolve(given, PACKAGE_PARAMETERS)), STANDARD_GRAVITY, 'world')
    print(f'1. Identify the cup from {fitted}', flush=True)
    result = identify.identify(
        resolve({**given, 'bags': [str(fitted)]}, PACKAGE_PARAMETERS), show_progress)
    identification.save(result, out / 'cup.yaml', out / 'fit.json')
    settings = resolve({**given, **result.parameters()}, PACKAGE_PARAMETERS)
    print(f'2. Start the node predictor with it, and play {validated} to it over DDS', flush=True)
    if compiler:
        compiler.wait()
    recorded = load_recording(validated, settings)
    with tempfile.TemporaryDirectory(prefix='bellows_log_') as logs:
        isolate(logs)
        predicted, latency = _predict_live(
            validated, settings, (out / 'cup.yaml', package), out / 'predictor.log')
    print('3. Compare its poses with the measured ones\n')
    comparison = residuals.compare_recorded(
        predicted, recorded.measured_tool, recorded.measured_package)
    plots.write_figure(out / 'demo.png', plots.comparison_figure(
        recorded.since_start(comparison.stamps_ns), comparison,
        'Package: predicted live, and measured',
        'relative to the tool; the cup was identified from another recording'))
    noise = recorded.noise.package
    limits = np.repeat([noise.position, noise.rotation], 3)
    _print_result(settings, comparison.scores, limits, latency)
    print(f'\nWrote demo.png, cup.yaml and fit.json to {out}, after '
          f'{time.monotonic() - begun:.0f} s.\n'
          'Next, look at a recording of yours: bellows info BAG')
    is_accurate = bool(np.all(comparison.scores.rms <= MAX_ERROR * limits))
    if not is_accurate:
        print(f'Errors exceed {MAX_ERROR:g} times the noise: the prediction is not usable.')
    return 0 if is_accurate else 1


def show_progress(stage: str, fraction: float | None = None) -> None:
    """Show a step and its completed fraction on a terminal."""
    if sys.stderr.isatty():
        part = '' if fraction is None else f' {100.0 * fraction:3.0f} %'
        print(f'\r\x1b[K{stage}{part}', end='', file=sys.stderr, flush=True)


def _print_result(
    values: Mapping[str, Any], scores: residuals.Scores, limits: np.ndarray, latency: np.ndarray
) -> None:
    """Print the diagonals of K and P, errors with the noise of the measured poses, latencies."""
    for name in ('cup.stiffness', 'cup.damping'):
        print(f'\n{name}:', ', '.join(f'{x:.4g} ± {std:.2g}' for x, std in zip(
            values[name][::7], values[f'{name}_std'][::7], strict=True)), end='')
    print('\n\nThe package relative to the tool, predicted live minus measured (RMS):')
    for axis, unit, factor, rms, part, noise in zip(
            residuals.AXES, residuals.DISPLAY_UNITS, residuals.DISPLAY_FACTORS, scores.rms,
            scores.nrmse, limits, strict=True):
        print(f'  {axis:2}  {factor * rms:.3f} {unit:3}  {100.0 * part:5.2f} % of the motion  '
              f'(noise {factor * noise:.2g} {unit})')
    median, high = 1e6 * np.percentile(latency, (50, 99))
    print(f'\nLatency, from sending a pose to receiving its prediction: p50 {median:.0f} us, '
          f'p99 {high:.0f} us\nAll of {len(latency)} poses were answered.')


@contextmanager
def _predictor(parameters: Sequence[Path], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node, whose subscriptions lose no message."""
    words = [word for file in parameters for word in ('--params-file', str(file))]
    for topic in (POSES, TWISTS):
        for setting in ('reliability:=reliable', f'depth:={QUEUE}'):
            words += ['-p', f'qos_overrides./{topic}.subscription.{setting}']
    with log.open('wb') as output, subprocess.Popen(
            [sys.executable, '-m', 'bellows_ros.nodes.command', 'predictor', '--ros-args', *words],
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)  # like Ctrl-C


def _predict_live(
    bag: Path, settings: Mapping[str, Any], parameters: Sequence[Path], log: Path
) -> tuple[Trajectory, np.ndarray]:
    """Play a recording to the predictor; return its poses, and their latencies (s)."""
    from bellows_ros.nodes.conversions import reader
    from geometry_msgs.msg import PoseStamped
    import rclpy
    from rclpy.context import Context

    topics = {settings['topics.tool_pose']: POSES, settings['topics.tool_twist']: TWISTS}
    messages = bags.read_messages(bag, topics)
    context = Context()
    rclpy.init(args=[], context=context)
    try:
        with _predictor(parameters, log) as process:
            player = _Player(context, [
                (topics[each.topic], each.log_time_ns, each.data) for each in messages],
                lambda: process.poll() is not None, log)
            sent = player.play()
    finally:
        context.try_shutdown()
    arrivals_ns, data = zip(*map(player.answers.__getitem__, sent), strict=True)
    stamps, _, poses = zip(*map(reader(PoseStamped), data), strict=True)
    numbers = np.array(poses)
    return (Trajectory(np.array(stamps), numbers[:, :3], quaternion_to_rotation(numbers[:, 3:])),
            np.subtract(arrivals_ns, list(sent.values())) / NS_PER_S)


class _Player:
    """Messages of the tool played to the predictor, and its answers by their stamps."""

    def __init__(
        self, context: Any, rows: Sequence[tuple[str, int, bytes]],
        has_ended: Callable[[], bool], log: Path,
    ) -> None:
        from geometry_msgs.msg import PoseStamped, TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import Trigger

        self._rows, self._has_ended, self._log = rows, has_ended, log
        node, self._executor = Node('demo', context=context), SingleThreadedExecutor(
            context=context)
        self._executor.add_node(node)
        self._writers = {name: node.create_publisher(kind, name, QUEUE) for name, kind in (
            (TWISTS, TwistStamped), (POSES, PoseStamped))}  # a pose then has its twist
        self.answers: dict[bytes, tuple[int, bytes]] = {}
        node.create_subscription(PoseStamped, 'package/pose', self._receive, QUEUE, raw=True)
        self._reset = node.create_client(Trigger, 'predictor/reset')
        self._request: Any = Trigger.Request()
        self._stamps = count(  # of probes, an hour earlier
            rows[0][1] - 3600 * NS_PER_S, round(PROBE_PERIOD * NS_PER_S))

    def _receive(self, data: Any) -> None:
        """Store an answer with its arrival (ns)."""
        self.answers.setdefault(data[STAMP], (time.monotonic_ns(), data))

    def _wait(self, failure: str, done: Callable[[], bool]) -> None:
        """Spin until a condition holds; raise BellowsError after `TIMEOUT`."""
        deadline = time.monotonic() + TIMEOUT
        while not done():
            if self._has_ended() or time.monotonic() > deadline:
                raise BellowsError(
                    f'The predictor {failure} (at most {TIMEOUT:g} s waited). See its log, '
                    f'{self._log}, and whether DDS may use the loopback interface.')
            self._executor.spin_once(timeout_sec=PROBE_PERIOD)

    def _is_answered(self) -> bool:
        """Return whether enough probes were answered; send another one."""
        stamp = divmod(next(self._stamps), NS_PER_S)
        for name, writer in self._writers.items():
            data = next(data for topic, _, data in self._rows if topic == name)
            writer.publish(data[:4] + struct.pack('<iI', *stamp) + data[12:])
        return len(self.answers) >= PROBES

    def play(self) -> dict[bytes, int]:
        """
        Play all messages in time; return the times (ns) of the poses by their stamps.

        Before, the predictor answers probes: messages arrive in both directions then, and kernels
        are compiled. Its reset discards the probes.
        """
        self._wait('does not appear', lambda: self._reset.service_is_ready() and all(
            each.get_subscription_count() for each in self._writers.values()))
        self._wait('does not answer', self._is_answered)
        self._wait('does not answer its reset', self._reset.call_async(self._request).done)
        sent: dict[bytes, int] = {}
        ahead_ns = time.monotonic_ns() - self._rows[0][1]
        for name, log_ns, data in self._rows:
            while (left_ns := log_ns + ahead_ns - time.monotonic_ns()) > 0:
                self._executor.spin_once(timeout_sec=left_ns / NS_PER_S)
            if name == POSES:
                sent[data[STAMP]] = time.monotonic_ns()
            self._writers[name].publish(data)
        self._wait('does not answer all poses', lambda: sent.keys() <= self.answers.keys())
        return sent


if __name__ == '__main__':
    configure_process()
    sys.exit(main())
