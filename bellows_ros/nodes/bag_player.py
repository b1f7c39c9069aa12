"""
Play recorded poses and twists to ROS in time, with rclpy but without `ros2 bag`.

`converse` plays to a running predictor, and returns its answers.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import importlib
from itertools import count
import struct
import time
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Message
from bellows_ros.workflows.recordings import no_progress, Progress
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from .conversions import reader

QUEUE_LENGTH = 10_000
"""Length of the queues, messages, so that none is lost while a process is busy."""

TIMEOUT = 5.0
"""Longest wait for a subscriber, and for the delivery of the last messages, s."""

POLL_PERIOD = 0.05
"""Longest wait for a callback before a condition is checked again, s."""

START_TIMEOUT = 90.0
"""Longest wait for each step of the predictor's start; without a cache it compiles first, s."""

STAMP = slice(4, 12)
"""Slice of the stamp in a CDR message with a header, bytes."""

POSES, TWISTS = 'tool_arm/pose', 'tool_arm/twist'


class Player:
    """Publishers of recorded messages, byte by byte, by the names of the played topics."""

    def __init__(
        self, node: Node, executor: SingleThreadedExecutor, messages: Sequence[Message],
        names: Mapping[str, str],
    ) -> None:
        self.node, self.executor, self.messages, self.names = node, executor, messages, names
        self.counts = Counter(names[message.topic.name] for message in messages)
        self.first_ns = messages[0].log_time_ns
        self.duration = (messages[-1].log_time_ns - self.first_ns) / NS_PER_S
        self.first = {names[message.topic.name]: message for message in reversed(messages)}
        self.publishers: dict[str, Any] = {}
        for name in sorted(self.first, reverse=True):  # twists before poses
            package, _, kind = self.first[name].topic.type_name.partition('/msg/')
            try:
                self.publishers[name] = node.create_publisher(
                    getattr(importlib.import_module(f'{package}.msg'), kind), name, QUEUE_LENGTH)
            except ModuleNotFoundError:
                raise BellowsError(
                    f"The messages of '{name}' are of {package}, which is not installed. Install "
                    f'it (apt: ros-jazzy-{package.replace("_", "-")}).') from None
            except InvalidTopicNameException:
                raise BellowsError(
                    f"'{name}' is not a ROS topic name: expected letters, digits, _ and /, no "
                    'digit after a slash and none at the end.') from None

    def spin_until(
        self, done: Callable[[], bool], timeout: float,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> bool:
        """Spin until a condition holds, or until a timeout (s); return whether it holds."""
        deadline = time.monotonic() + timeout
        while not (is_done := done()) and time.monotonic() < deadline:
            meanwhile()
            self.executor.spin_once(timeout_sec=POLL_PERIOD)
        return is_done

    def send_all(
        self, progress: Progress, announce: Callable[[str, Message], None], rate: float = 1.0
    ) -> None:
        """Publish each message at its time, after a call of a function with the topic."""
        start = time.monotonic() + 0.2  # s
        for message in self.messages:
            elapsed = (message.log_time_ns - self.first_ns) / NS_PER_S
            while (remaining := start + elapsed / rate - time.monotonic()) > 0.0:
                self.executor.spin_once(timeout_sec=remaining)
            progress('playing the recording', elapsed / max(self.duration, 1e-9))
            name = self.names[message.topic.name]
            announce(name, message)
            self.publishers[name].publish(message.data)


@contextmanager
def _player(
    node_name: str, messages: Sequence[Message], names: Mapping[str, str]
) -> Iterator[Player]:
    """Provide a player with a node in a separate ROS context."""
    context = Context()
    rclpy.init(args=[], context=context)
    executor = SingleThreadedExecutor(context=context)
    node = Node(node_name, context=context)
    executor.add_node(node)
    try:
        yield Player(node, executor, messages, names)
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


class Played(NamedTuple):
    """
    Played messages, and the answers of a predictor.

    Parameters
    ----------
    messages : mapping of str to int
        Number of messages by topic.
    duration : float
        Duration, s.
    has_subscriber : bool
        Whether there was a subscriber at the start.
    predicted : Trajectory or None
        Poses received on package/pose, if there are at least two.

    """

    messages: Mapping[str, int]
    duration: float
    has_subscriber: bool
    predicted: Trajectory | None


def play(
    messages: Sequence[Message], names: Mapping[str, str], rate: float = 1.0, clock: bool = False,
    progress: Progress = no_progress
) -> Played:
    """
    Publish recorded poses and twists in time.

    Parameters
    ----------
    messages : sequence of Message
        Messages in the order of their recording; at least one.
    names : mapping of str to str
        Names of the played topics by the recorded names.
    rate : float
        Seconds of the recording per second.
    clock : bool
        Whether the time of the recording is published on /clock.
    progress : callable
        Callback with the current step and its completed fraction (0 to 1).

    """
    with _player('bellows_player', messages, names) as player:
        clock_out = player.node.create_publisher(Clock, '/clock', QUEUE_LENGTH) if clock else None
        clock_ns, answers = 0, dict[bytes, bytes]()

        def receive(data: bytes) -> None:
            answers.setdefault(data[STAMP], data)

        player.node.create_subscription(
            PoseStamped, 'package/pose', receive, QUEUE_LENGTH, raw=True)

        def tell_time(_: str, message: Message) -> None:
            nonlocal clock_ns
            if clock_out and message.log_time_ns - clock_ns >= 10_000_000:
                clock_ns = message.log_time_ns
                seconds, nanoseconds = divmod(clock_ns, NS_PER_S)
                clock_out.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))

        outlets = player.publishers.values()
        progress('waiting for a subscriber', 0.0)
        has_subscriber = player.spin_until(
            lambda: any(each.get_subscription_count() for each in outlets), TIMEOUT)
        player.send_all(progress, tell_time, rate)
        for each in outlets:  # a message in transit is lost if its topic vanishes
            each.wait_for_all_acked(Duration(seconds=TIMEOUT))
        count = -1
        while answers and count != len(answers):  # until no more follow
            count = len(answers)
            player.spin_until(lambda: False, 0.3)
        return Played(player.counts, player.duration / rate, has_subscriber,
                      _trajectory(answers.values()) if len(answers) > 1 else None)


def _trajectory(data: Iterable[bytes]) -> Trajectory:
    """Return poses of the package in the world from messages, in the order of their stamps."""
    stamps_ns, _, numbers = zip(*sorted(map(reader(PoseStamped), data)), strict=True)
    poses = np.array(numbers)
    return Trajectory(
        np.array(stamps_ns), poses[:, :3], quaternion_to_rotation(poses[:, 3:]))


class Exchange(NamedTuple):
    """
    Messages sent to the predictor and received from it.

    Parameters
    ----------
    sent : mapping of str to int
        Numbers of messages on `POSES` and `TWISTS`.
    predicted : Trajectory
        Poses of the package B in the world, at the stamps of the answers.
    latency : array (N,)
        Time from handing the tool's pose to ROS until the arrival of the prediction, s.

    """

    sent: Mapping[str, int]
    predicted: Trajectory
    latency: Array


def converse(
    messages: Sequence[Message], names: Mapping[str, str], require_alive: Callable[[], None],
    progress: Progress = no_progress,
) -> Exchange:
    """
    Wait for the predictor, play at recorded speed, and wait for its last answer.

    Parameters
    ----------
    messages : sequence of Message
        Poses and twists of the tool in the order of their recording.
    names : mapping of str to str
        `POSES` or `TWISTS`, by the topic of a message.
    require_alive : callable
        Function that raises BellowsError when the predictor has ended.
    progress : callable
        Callback as in `play`.

    Raises
    ------
    BellowsError
        If the predictor ends, does not appear or does not answer.

    """
    sent_ns: dict[bytes, int] = {}
    answers: dict[bytes, tuple[int, bytes]] = {}  # arrival (ns) and message, by stamp

    def note_time(name: str, message: Message) -> None:
        if name == POSES:
            sent_ns[message.data[STAMP]] = time.monotonic_ns()

    def receive(data: bytes) -> None:
        answers.setdefault(data[STAMP], (time.monotonic_ns(), data))

    with _player('demo_player', messages, names) as player:
        player.node.create_subscription(
            PoseStamped, 'package/pose', receive, QUEUE_LENGTH, raw=True)
        progress('waiting for the predictor; on a new machine it compiles first', 0.0)
        _connect(player, answers, require_alive)
        player.send_all(progress, note_time)
        player.spin_until(
            lambda: sent_ns.keys() <= answers.keys(), START_TIMEOUT, require_alive)
    answered = [(*answers[stamp], sent) for stamp, sent in sent_ns.items() if stamp in answers]
    if not answered:
        raise BellowsError('The predictor did not answer. See its log.')
    arrived_ns, data, poses_ns = zip(*answered, strict=True)
    return Exchange(player.counts, _trajectory(data),
                    np.subtract(arrived_ns, poses_ns) / NS_PER_S)


def _connect(
    player: Player, answers: Mapping[bytes, object], require_alive: Callable[[], None]
) -> None:
    """
    Wait until the predictor answers a stream of probes, and reset it.

    Answers show that messages arrive in both directions, and that kernels are compiled. The
    publisher of twists is announced first, so the predictor that answers a pose also receives
    twists. The reset discards the probes.
    """
    # an hour earlier
    probe_stamps = count(player.first_ns - 3_600 * NS_PER_S, round(POLL_PERIOD * NS_PER_S))

    def wait(
        failure: str, done: Callable[[], bool], meanwhile: Callable[[], None] = require_alive,
    ) -> None:
        if not player.spin_until(done, START_TIMEOUT, meanwhile):
            raise BellowsError(
                f'The predictor {failure} ({START_TIMEOUT:g} s waited). See its log, and whether '
                'DDS may use the loopback interface of this machine.')

    def probe() -> None:
        require_alive()
        stamp = divmod(next(probe_stamps), NS_PER_S)
        for name, message in player.first.items():
            order = '<' if message.data[1] & 1 else '>'
            player.publishers[name].publish(
                message.data[:STAMP.start] + struct.pack(f'{order}iI', *stamp)
                + message.data[STAMP.stop:])

    reset = player.node.create_client(Trigger, 'predictor/reset')
    wait('does not appear', lambda: reset.service_is_ready() and all(
        each.get_subscription_count() for each in player.publishers.values()))
    wait('does not answer', lambda: len(answers) >= 20, probe)
    wait('does not answer its reset', reset.call_async(Trigger.Request()).done)
