"""
Play recorded poses and twists to ROS when they are due, with rclpy but without `ros2 bag`.

`converse` plays to a running predictor, and returns its answers.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import importlib
from itertools import count
import struct
import time
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Channel, Message
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
from rclpy.validate_topic_name import validate_topic_name
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from .conversions import reader

SEND_QUEUE = 10_000
"""Length of the queues: nothing is lost while a process is busy, messages."""

TIMEOUT = 5.0
"""Longest wait for a subscriber, and for the delivery of the last messages, s."""

POLL_PERIOD = 0.05
"""Longest wait for a callback before a condition is checked again, s."""

LEAD_TIME = 0.2
"""Time from the start to the first message, s."""

CLOCK_PERIOD_NS = 10_000_000
"""Shortest time between two messages on /clock, ns of the recording."""

STAMP = slice(4, 12)
"""Position of the stamp in a CDR message that begins with its header, bytes."""


class Played(NamedTuple):
    """The number of messages by topic, the duration (s), and whether a subscriber was there."""

    messages: Mapping[str, int]
    duration: float
    has_subscriber: bool


def play(
    messages: Sequence[Message], names: Mapping[str, str], rate: float = 1.0, clock: bool = False,
    progress: Progress = no_progress
) -> Played:
    """
    Send recorded messages, byte by byte as they were recorded, in their time.

    Parameters
    ----------
    messages : sequence of Message
        Poses and twists in the order they were recorded in; at least one.
    names : mapping of str to str
        The names under which topics are played, by those under which they were recorded.
    rate : float
        Seconds of the recording per second.
    clock : bool
        Whether the time of the recording is published on /clock.
    progress : callable
        Called with what is being done and the part (0 to 1) that is done.

    """
    for name in names.values():
        try:
            validate_topic_name(name)
        except InvalidTopicNameException:
            raise BellowsError(
                f"'{name}' is not a ROS topic name: expected letters, digits, _ and /, no digit "
                'after a slash and none at the end.') from None
    with player_node('bellows_player') as (node, executor):
        publishers = {topic: publisher(node, topic, names[topic.name])
                      for topic in dict.fromkeys(m.topic for m in messages)}
        clock_out = node.create_publisher(Clock, '/clock', SEND_QUEUE) if clock else None
        progress('waiting for a subscriber', 0.0)
        has_subscriber = spin_until(
            executor, lambda: any(p.get_subscription_count() for p in publishers.values()),
            TIMEOUT)
        clock_ns = 0

        def send(message: Message) -> None:
            nonlocal clock_ns
            if clock_out and message.log_time_ns - clock_ns >= CLOCK_PERIOD_NS:
                clock_ns = message.log_time_ns
                seconds, nanoseconds = divmod(clock_ns, NS_PER_S)
                clock_out.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))
            publishers[message.topic].publish(message.data)

        send_all(executor, messages, send, progress, rate)
        for each in publishers.values():  # let what is on its way arrive before the topics vanish
            each.wait_for_all_acked(Duration(seconds=TIMEOUT))
    return Played(
        Counter(names[message.topic.name] for message in messages),
        (messages[-1].log_time_ns - messages[0].log_time_ns) / NS_PER_S / rate, has_subscriber)


def send_all(
    executor: SingleThreadedExecutor, messages: Sequence[Message],
    send: Callable[[Message], None], progress: Progress, rate: float = 1.0,
) -> None:
    """Send messages when they are due, and spin an executor meanwhile."""
    first_ns = messages[0].log_time_ns
    duration_ns = messages[-1].log_time_ns - first_ns
    start = time.monotonic() + LEAD_TIME
    for message in messages:
        elapsed_ns = message.log_time_ns - first_ns
        while (remaining := start + elapsed_ns / NS_PER_S / rate - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=remaining)
        progress('playing the recording', elapsed_ns / max(duration_ns, 1))
        send(message)


@contextmanager
def player_node(name: str) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Provide a node in a separate ROS context, and the executor that spins it."""
    context = Context()
    rclpy.init(args=[], context=context)
    executor = SingleThreadedExecutor(context=context)
    node = Node(name, context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def spin_until(
    executor: SingleThreadedExecutor, done: Callable[[], bool], timeout: float,
    meanwhile: Callable[[], None] = lambda: None,
) -> bool:
    """Spin until a condition holds, or for a time (s) at most; return whether it holds."""
    deadline = time.monotonic() + timeout
    while not (is_done := done()) and time.monotonic() < deadline:
        meanwhile()
        executor.spin_once(timeout_sec=POLL_PERIOD)
    return is_done


def publisher(node: Node, topic: Channel, name: str) -> Any:
    """Return a publisher of a recorded topic's messages under a name; it takes their bytes."""
    package, _, kind = topic.type_name.partition('/msg/')
    return node.create_publisher(
        getattr(importlib.import_module(f'{package}.msg'), kind), name, SEND_QUEUE)


START_TIMEOUT = 90.0
"""Longest wait for each step of the predictor's start; without a cache it compiles first, s."""

PROBES = 20
"""Number of answers after which the predictor is warm."""

PROBE_LEAD_NS = 3_600_000_000_000
"""Time by which the stamps of probes precede the recording, ns: they differ from all others."""

POSES, TWISTS = 'tool_arm/pose', 'tool_arm/twist'


@dataclass(frozen=True, eq=False)
class Exchange:
    """
    Messages sent to the predictor and received from it.

    Parameters
    ----------
    sent : mapping of str to int
        Numbers of messages on `POSES` and `TWISTS`.
    predicted : Trajectory
        Of the package B in the world, by the stamps that were answered.
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
        Poses and twists of the tool in the order they were recorded in.
    names : mapping of str to str
        `POSES` or `TWISTS`, by the topic of a message.
    require_alive : callable
        Raises BellowsError when the predictor has ended; asked while it is waited for.
    progress : callable
        As of `play`.

    Raises
    ------
    BellowsError
        If the predictor ends, does not appear or does not answer.

    """
    sent_ns: dict[bytes, int] = {}
    answers: dict[bytes, tuple[int, bytes]] = {}  # arrival (ns) and message, by stamp

    def send(message: Message) -> None:
        name = names[message.topic.name]
        if name == POSES:
            sent_ns[message.data[STAMP]] = time.monotonic_ns()
        publishers[name].publish(message.data)

    def receive(data: bytes) -> None:
        answers.setdefault(data[STAMP], (time.monotonic_ns(), data))

    with player_node('demo_player') as (node, executor):
        node.create_subscription(PoseStamped, 'package/pose', receive, SEND_QUEUE, raw=True)
        first = {names[message.topic.name]: message for message in reversed(messages)}
        publishers = {name: publisher(node, first[name].topic, name)
                      for name in (TWISTS, POSES) if name in first}
        progress('waiting for the predictor; on a new machine it compiles first', 0.0)
        _connect(node, executor, publishers, first, answers, require_alive)
        send_all(executor, messages, send, progress)
        spin_until(executor, lambda: sent_ns.keys() <= answers.keys(), START_TIMEOUT,
                   require_alive)
    answered = [(*answers[stamp], sent) for stamp, sent in sent_ns.items() if stamp in answers]
    if not answered:
        raise BellowsError('The predictor did not answer. See its log.')
    arrived_ns, data, poses_ns = zip(*answered, strict=True)
    stamps_ns, _, numbers = zip(*map(reader(PoseStamped), data), strict=True)
    poses = np.array(numbers)
    return Exchange(
        Counter(names[message.topic.name] for message in messages), Trajectory(
            np.array(stamps_ns), poses[:, :3], quaternion_to_rotation(poses[:, 3:])),
        np.subtract(arrived_ns, poses_ns) / NS_PER_S)


def _connect(
    node: Node, executor: SingleThreadedExecutor, publishers: Mapping[str, Any],
    first: Mapping[str, Message], answers: Mapping[bytes, object],
    require_alive: Callable[[], None],
) -> None:
    """
    Wait until the predictor answers a stream of probes, and reset it.

    The answers show that messages go all the way, and that the predictor is warm. Twists are
    announced before poses, and announcements arrive in order: then the predictor has heard of
    both. The reset makes it forget the probes.
    """
    probe_stamps = count(first[POSES].log_time_ns - PROBE_LEAD_NS, round(POLL_PERIOD * NS_PER_S))

    def wait(
        failure: str, done: Callable[[], bool], meanwhile: Callable[[], None] = require_alive,
    ) -> None:
        if not spin_until(executor, done, START_TIMEOUT, meanwhile):
            raise BellowsError(
                f'The predictor {failure} ({START_TIMEOUT:g} s waited). See its log, and whether '
                'DDS may use the loopback interface of this machine.')

    def probe() -> None:
        require_alive()
        stamp = divmod(next(probe_stamps), NS_PER_S)
        for name, message in first.items():
            order = '<' if message.data[1] & 1 else '>'
            publishers[name].publish(
                message.data[:STAMP.start] + struct.pack(f'{order}iI', *stamp)
                + message.data[STAMP.stop:])

    reset = node.create_client(Trigger, 'predictor/reset')
    wait('does not appear', lambda: reset.service_is_ready() and all(
        each.get_subscription_count() for each in publishers.values()))
    wait('does not answer', lambda: len(answers) >= PROBES, probe)
    wait('does not answer its reset', reset.call_async(Trigger.Request()).done)
