"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and reports the errors of the predicted poses.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from bellows_ros import plots
from bellows_ros.core import configure_process
from bellows_ros.core.geometry.jit import is_new
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.files import bags, messages, parameter_files
from bellows_ros.nodes.command import require_ros
from bellows_ros.nodes.domain import isolate
from bellows_ros.workflows import identification, identify
from bellows_ros.workflows.recordings import load as load_recording
import numpy as np

BAGS = 'identification', 'validation', 'package.yaml'
"""What the folder of recordings holds."""

MAX_ERROR = 2.0
"""Largest RMS error of a prediction relative to the measured noise; 1.0 for a perfect cup."""

TIMEOUT = 300.0
"""Longest wait for an answer of the predictor, s; without a cache it compiles for a minute."""

POSES, TWISTS = 'tool_arm/pose', 'tool_arm/twist'

PROBES = 20
"""Number of answered probes after which messages arrive in both directions."""

PROBE_PERIOD = 0.05
"""Time between two probes, and of their stamps, s."""

QUEUE = 10_000
"""Length of the queues, messages, so that none is lost while a process is busy."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code; 0 only if all went well."""
    parser = argparse.ArgumentParser(
        prog='python -m bellows_ros.demo',
        description='Identify a cup, predict another recording live over DDS, and compare.')
    for name, default, what in (('bags', 'bags', f'has {", ".join(BAGS)}'),
                                ('out', 'demo_output', 'gets picture, cup, fit and log')):
        parser.add_argument(f'--{name}', metavar='FOLDER', type=Path, default=Path(default),
                            help=f'{what} (default: %(default)s)')
    arguments = parser.parse_args(args)
    try:
        return run(arguments.bags, arguments.out)
    except BellowsError as error:
        print(f'demo: {error}', file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def run(folder: Path, out: Path) -> int:
    """Identify, predict live, compare, and print the result."""
    begun = time.monotonic()
    require_ros()
    require_pictures()
    fitted, validated, package = (folder / name for name in BAGS)
    if missing := [each for each in (fitted, validated, package) if not each.exists()]:
        raise BellowsError(
            f"'{missing[0]}' does not exist. Start in the folder that contains bags, or give it "
            "with --bags; 'make bags' simulates the recordings again.")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BellowsError(f"Output folder '{out}' cannot be created: {error.strerror}. Give "
                           'another with --out.') from None
    if is_new():
        print('Compiling (once a version): about a minute.', flush=True)
    print(f'1. Identify the cup from {fitted}', flush=True)
    given = parameter_files.read_parameters(package)
    result = identify.identify(
        resolve({**given, 'bags': [str(fitted)]}, PACKAGE_PARAMETERS), show_progress)
    identification.save(result, out / 'cup.yaml', out / 'fit.json')
    print(f'2. Start the node predictor with it, and play {validated} to it over DDS', flush=True)
    settings = resolve({**given, **result.parameters()}, PACKAGE_PARAMETERS)
    predicted, latency = _predict_live(
        validated, settings, (out / 'cup.yaml', package), out / 'predictor.log')
    print('3. Compare its poses with the measured ones\n')
    is_accurate = _compare(validated, settings, predicted, out / 'demo.png')
    median, high = 1e6 * np.percentile(latency, (50, 99))
    print(f'\nLatency, from sending a pose to receiving its prediction: p50 {median:.0f} us, '
          f'p99 {high:.0f} us\nAll of {len(latency)} poses were answered.\n\n'
          f'Wrote demo.png, cup.yaml and fit.json to {out}, after '
          f'{time.monotonic() - begun:.0f} s.\n'
          'Next, look at a recording of yours: bellows info BAG')
    if not is_accurate:
        print(f'Errors exceed {MAX_ERROR:g} times the noise: the prediction is not usable.')
    return 0 if is_accurate else 1


def show_progress(stage: str, fraction: float = 0.0) -> None:
    """Show a step and its completed fraction on a terminal."""
    if sys.stderr.isatty():
        print(f'\r\x1b[K{stage} {100.0 * fraction:3.0f} %', end='', file=sys.stderr, flush=True)


def _compare(bag: Path, values: Values, predicted: Trajectory, picture: Path) -> bool:
    """Draw and print errors with the noise of the measured poses; return whether all are small."""
    recorded = load_recording(bag, values)
    found = residuals.compare_recorded(
        predicted, recorded.measured_tool, recorded.measured_package)
    plots.write_figure(picture, plots.comparison_figure(
        recorded.since_start(found.stamps_ns), found, 'Package: predicted live, and measured',
        'relative to the tool; the cup was identified from another recording'))
    for name in ('cup.stiffness', 'cup.damping'):
        print(f'{name}:', ', '.join(f'{x:.4g} ± {std:.2g}' for x, std in zip(
            values[name][::7], values[f'{name}_std'][::7], strict=True)))
    print('\nThe package relative to the tool, predicted live minus measured (RMS):')
    limits = np.repeat([recorded.noise.package.position, recorded.noise.package.rotation], 3)
    for axis, unit, factor, rms, part, noise in zip(
            residuals.AXES, residuals.DISPLAY_UNITS, residuals.DISPLAY_FACTORS, found.scores.rms,
            found.scores.nrmse, limits, strict=True):
        print(f'  {axis:2}  {factor * rms:.3f} {unit:3}  {100.0 * part:5.2f} % of the motion  '
              f'(noise {factor * noise:.2g} {unit})')
    return bool(np.all(found.scores.rms <= MAX_ERROR * limits))


def _predict_live(
    bag: Path, settings: Values, parameters: Sequence[Path], log: Path
) -> tuple[Trajectory, np.ndarray]:
    """Play a recording to the node; return its poses, and their latencies (s)."""
    from rclpy.context import Context

    topics = {settings['topics.tool_pose']: POSES, settings['topics.tool_twist']: TWISTS}
    rows = [(topics[each.topic], each.log_time_ns, each.data)
            for each in bags.read_messages(bag, topics)]
    words = [word for file in parameters for word in ('--params-file', str(file))]
    for topic in topics.values():  # no message is lost
        for setting in ('reliability:=reliable', f'depth:={QUEUE}'):
            words += ['-p', f'qos_overrides./{topic}.subscription.{setting}']
    with tempfile.TemporaryDirectory(prefix='bellows_log_') as logs, log.open('wb') as output:
        isolate(logs)
        with subprocess.Popen(
                [sys.executable, '-m', 'bellows_ros.nodes.command', 'predictor', '--ros-args',
                 *words], stdin=subprocess.DEVNULL, stdout=output,
                stderr=subprocess.STDOUT) as process:
            context = Context()
            context.init(args=[])
            try:
                answers = _Player(context, process, log).play(rows)
            finally:
                context.try_shutdown()
                process.send_signal(signal.SIGINT)  # like Ctrl-C
    sent, arrived, data = zip(*answers, strict=True)
    stamps, _, poses = zip(*map(messages.Decoder(messages.POSE), data), strict=True)
    numbers = np.array(poses)
    return (Trajectory(np.array(stamps), numbers[:, :3], quaternion_to_rotation(numbers[:, 3:])),
            np.subtract(arrived, sent) / NS_PER_S)


class _Player:
    """Messages of the tool played to the node, and its answers by their stamps."""

    def __init__(self, context: Any, process: subprocess.Popen[bytes], log: Path) -> None:
        from geometry_msgs.msg import PoseStamped, TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import Trigger

        self._process, self._log = process, log
        self._answers: dict[bytes, tuple[int, bytes]] = {}
        node = Node('demo', context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._writers = {name: node.create_publisher(kind, name, QUEUE) for name, kind in (
            (TWISTS, TwistStamped), (POSES, PoseStamped))}  # a pose then has its twist
        node.create_subscription(PoseStamped, 'package/pose', self._receive, QUEUE, raw=True)
        self._reset, self._request = node.create_client(
            Trigger, 'predictor/reset'), Trigger.Request()

    def _receive(self, data: Any) -> None:
        """Store an answer with its arrival (ns)."""
        self._answers.setdefault(data[4:12], (time.monotonic_ns(), data))

    def _wait(self, failure: str, done: Callable[[], bool]) -> None:
        """Spin until a condition holds; raise BellowsError after `TIMEOUT`."""
        deadline = time.monotonic() + TIMEOUT
        while not done():
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise BellowsError(
                    f'The predictor {failure} (at most {TIMEOUT:g} s waited). See its log, '
                    f'{self._log}, and whether DDS may use the loopback interface.')
            self._executor.spin_once(timeout_sec=PROBE_PERIOD)

    def play(self, rows: Sequence[tuple[str, int, bytes]]) -> list[tuple[int, int, bytes]]:
        """
        Play messages (topic, time, data) in time; return times of sending and arrival, and answer.

        Before, the predictor answers probes, an hour earlier: messages arrive in both directions
        then, and kernels are compiled. Its reset discards the probes.
        """
        self._wait('does not appear', lambda: self._reset.service_is_ready() and all(
            each.get_subscription_count() for each in self._writers.values()))
        probe_ns = rows[0][1] - 3600 * NS_PER_S

        def is_answered() -> bool:
            nonlocal probe_ns
            probe_ns += round(PROBE_PERIOD * NS_PER_S)
            still = 6 * [0.0]
            for name, kind, numbers in ((TWISTS, messages.TWIST, still),
                                        (POSES, messages.POSE, [*still, 1.0])):
                self._writers[name].publish(messages.pack(kind, ('world',), probe_ns, *numbers))
            return len(self._answers) >= PROBES

        self._wait('does not answer', is_answered)
        self._wait('does not answer its reset', self._reset.call_async(self._request).done)
        sent, ahead_ns = dict[bytes, int](), time.monotonic_ns() - rows[0][1]
        for name, log_ns, data in rows:
            while (left_ns := log_ns + ahead_ns - time.monotonic_ns()) > 0:
                self._executor.spin_once(timeout_sec=left_ns / NS_PER_S)
            if name == POSES:
                sent[data[4:12]] = time.monotonic_ns()
            self._writers[name].publish(data)
        self._wait('does not answer all poses', lambda: sent.keys() <= self._answers.keys())
        return [(sent_ns, *self._answers[stamp]) for stamp, sent_ns in sent.items()]


if __name__ == '__main__':
    configure_process()
    sys.exit(main())
