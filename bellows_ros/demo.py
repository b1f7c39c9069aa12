"""
The demonstration on the recordings in bags/: `python -m bellows_ros.demo`.

Identifies a cup, starts the node predictor with it, plays another recording to it over DDS at
recorded speed, and reports the errors of the predicted poses.
"""

import argparse
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from bellows_ros import plots
from bellows_ros.core import configure_process
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.exits import guarded
from bellows_ros.files import bags, messages, parameter_files
from bellows_ros.nodes.command import require_ros
from bellows_ros.nodes.domain import isolate
from bellows_ros.workflows import identification, identify
from bellows_ros.workflows.recordings import load as load_recording
import numpy as np

MAX_ERROR = 2.0
"""Largest RMS error of a prediction relative to the measured noise; 1.0 for a perfect cup."""

TIMEOUT = 300.0
"""Longest wait for an answer of the predictor, s; without a cache it compiles for a minute."""

TWIST_TOPIC, POSE_TOPIC = 'tool_arm/twist', 'tool_arm/pose'

TOPICS = {'topics.tool_twist': TWIST_TOPIC, 'topics.tool_pose': POSE_TOPIC}
"""Played topics by the parameters with their recorded names."""

PERIOD = 0.05
"""Time between two messages before the recording, and of their stamps, s."""

QUEUE = 10_000
"""Length of the queues, messages, so that none is lost while a process is busy."""

STILL_BEFORE_NS = 3600 * NS_PER_S
"""Time by which the stamps of the tool at rest are before the recording, ns."""

STAMP = slice(4, 12)
"""Place of the stamp of the header in the bytes of a message."""

Rows = Sequence[tuple[str, int, bytes]]
"""Messages to play: topic, time of recording (ns) and bytes."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the demonstration and return the exit code; 0 only if all went well."""
    parser = argparse.ArgumentParser(
        prog='python -m bellows_ros.demo',
        description='Identify a cup, predict another recording live over DDS, and compare.')
    for name, default, what in (('bags', 'bags', 'has identification, validation, package.yaml'),
                                ('out', 'demo_output', 'gets picture, cup, fit and log')):
        parser.add_argument(f'--{name}', metavar='FOLDER', type=Path, default=Path(default),
                            help=f'{what} (default: %(default)s)')
    arguments = parser.parse_args(args)
    return guarded(lambda: run(arguments.bags, arguments.out))


def run(folder: Path, out: Path) -> int:
    """Identify, predict live, compare, and print the result."""
    require_ros()
    require_pictures()
    fitted, validated, package = (
        folder / name for name in ('identification', 'validation', 'package.yaml'))
    given = resolve({**parameter_files.read_parameters(package), 'bags': [str(fitted)]},
                    PACKAGE_PARAMETERS)
    topics = {bags.absolute(given[each]): topic for each, topic in TOPICS.items()}
    rows = [(topics[name], log_ns, data)
            for name, log_ns, data in bags.read_messages(validated, topics)]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BellowsError(f"Output folder '{out}' cannot be created: {error.strerror}. Give "
                           'another with --out.') from None
    print(f'1. Identify the cup from {fitted} (compiles once a version, about a minute)',
          flush=True)
    result = identify.identify(given)
    identification.save(result, out / 'cup.yaml', out / 'fit.json')
    print(f'2. Start the node predictor with it, and play {validated} to it over DDS', flush=True)
    predicted, latency = _predict_live(
        rows, (out / 'cup.yaml', package), out / 'predictor.log')
    print('3. Compare its poses with the measured ones\n')
    is_accurate = _compare(
        validated, given.replaced(result.parameters()), predicted, out / 'demo.png')
    median, high = 1e6 * np.percentile(latency, (50, 99))
    print(f'\nLatency, from sending a pose to receiving its prediction: p50 {median:.0f} us, '
          f'p99 {high:.0f} us\nAll of {len(latency)} poses were answered.\n\n'
          f'Wrote demo.png, cup.yaml and fit.json to {out}.\n'
          'Next, look at a recording of yours: bellows info BAG')
    if not is_accurate:
        print(f'Errors exceed {MAX_ERROR:g} times the noise: the prediction is not usable.')
    return 0 if is_accurate else 1


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
    limits = np.repeat(recorded.noise[1], 3)
    for axis, unit, factor, rms, part, noise in zip(
            residuals.AXES, residuals.DISPLAY_UNITS, residuals.DISPLAY_FACTORS, found.scores.rms,
            found.scores.nrmse, limits, strict=True):
        print(f'  {axis:2}  {factor * rms:.3f} {unit:3}  {100.0 * part:5.2f} % of the motion  '
              f'(noise {factor * noise:.2g} {unit})')
    return bool(np.all(found.scores.rms <= MAX_ERROR * limits))


def _predict_live(
    rows: Rows, parameters: Sequence[Path], log: Path
) -> tuple[Trajectory, Array]:
    """Play messages to the node; return its poses, and their latencies (s)."""
    from rclpy.context import Context

    words = [word for file in parameters for word in ('--params-file', str(file))]
    for topic in TOPICS.values():  # no message is lost
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
                answers = _play(rows, context, lambda: process.poll() is None)
            finally:
                context.try_shutdown()
                process.send_signal(signal.SIGINT)  # like Ctrl-C
    if not answers:
        raise BellowsError(f'The predictor does not answer all poses. See its log, {log}, and '
                           'whether DDS may use the loopback interface.')
    decode = messages.Decoder(messages.POSE)
    stamps, _, poses = zip(*(decode(answer.data) for answer in answers), strict=True)
    numbers = np.array(poses)
    return (Trajectory(np.array(stamps), numbers[:, :3], quaternion_to_rotation(numbers[:, 3:])),
            np.array([each.arrived_ns - each.sent_ns for each in answers]) / NS_PER_S)


class Answer(NamedTuple):
    """An answer of the predictor: times of sending and arrival (ns), and the message."""

    sent_ns: int
    arrived_ns: int
    data: bytes


def _play(rows: Rows, context: Any, is_running: Callable[[], bool]) -> list[Answer]:
    """
    Play messages in time; return the answers to all poses, none if an answer is missing.

    Before, the tool stands still, an hour earlier, until the predictor answers: messages arrive in
    both directions then, and kernels are compiled. A reset discards these poses.
    """
    player = Player(context, is_running)
    if not (player.waits_until(player.is_connected)
            and player.stands_until_answered(rows[0][1] - STILL_BEFORE_NS)
            and player.resets()):
        return []
    sent_ns = player.send(rows)
    if not player.waits_until(lambda: sent_ns.keys() <= player.answers.keys()):
        return []
    return [Answer(sent_ns[stamp], *player.answers[stamp]) for stamp in sent_ns]


class Player:
    """
    A node that sends messages of the tool to the predictor and collects its answers.

    Attributes
    ----------
    answers : dict
        Time of arrival (ns) and message of the first answer, by the bytes of its stamp.

    """

    def __init__(self, context: Any, is_running: Callable[[], bool]) -> None:
        """Connect to a predictor that runs as long as a function says."""
        from geometry_msgs.msg import PoseStamped, TwistStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import Trigger

        node = Node('demo', context=context)
        self.answers = dict[bytes, tuple[int, bytes]]()
        self._is_running = is_running
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(node)
        self._publishers = {
            topic: node.create_publisher(kind, topic, QUEUE)
            for topic, kind in ((TWIST_TOPIC, TwistStamped), (POSE_TOPIC, PoseStamped))}
        self._reset = node.create_client(Trigger, 'predictor/reset')
        self._reset_request = Trigger.Request()
        node.create_subscription(PoseStamped, 'package/pose', self._receive, QUEUE, raw=True)

    def _receive(self, data: Any) -> None:
        """Keep the first answer with a stamp."""
        self.answers.setdefault(data[STAMP], (time.monotonic_ns(), data))

    def waits_until(self, is_done: Callable[[], bool]) -> bool:
        """Receive until something is done; return whether it is before the time is over."""
        deadline = time.monotonic() + TIMEOUT
        while not (done := is_done()) and self._is_running() and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=PERIOD)
        return done

    def is_connected(self) -> bool:
        """Return whether the predictor subscribes to all topics and offers its service."""
        return self._reset.service_is_ready() and all(
            each.get_subscription_count() for each in self._publishers.values())

    def stands_until_answered(self, begin_ns: int) -> bool:
        """Send poses of a tool at rest, stamped from a time on; return whether one is answered."""
        stamps_ns = count(begin_ns, round(PERIOD * NS_PER_S))

        def stand_still() -> bool:
            stamp_ns = next(stamps_ns)
            for topic, kind, numbers in ((TWIST_TOPIC, messages.TWIST, 6 * [0.0]),
                                         (POSE_TOPIC, messages.POSE, [*(6 * [0.0]), 1.0])):
                self._publishers[topic].publish(
                    messages.pack(kind, ('world',), stamp_ns, *numbers))
            return bool(self.answers)

        return self.waits_until(stand_still)

    def resets(self) -> bool:
        """Reset the prediction; return whether the predictor has confirmed it."""
        return self.waits_until(self._reset.call_async(self._reset_request).done)

    def send(self, rows: Rows) -> dict[bytes, int]:
        """Send messages in time; return the times (ns) at which the poses were sent, by stamp."""
        sent_ns = dict[bytes, int]()
        ahead_ns = time.monotonic_ns() - rows[0][1]
        for topic, log_ns, data in rows:
            while (left_ns := log_ns + ahead_ns - time.monotonic_ns()) > 0:
                self._executor.spin_once(timeout_sec=left_ns / NS_PER_S)
            if topic == POSE_TOPIC:
                sent_ns[data[STAMP]] = time.monotonic_ns()
            self._publishers[topic].publish(data)
        return sent_ns


if __name__ == '__main__':
    configure_process()
    sys.exit(main())
