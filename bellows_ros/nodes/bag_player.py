"""
Play recorded messages to ROS when they are due, with rclpy but without `ros2 bag`.

`converse` plays to a running predictor, and returns its answers.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import gc
import importlib
from itertools import count
import struct
import time
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Channel, Message
from bellows_ros.workflows.recordings import no_progress, Progress
from geometry_msgs.msg import PoseStamped
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name
from std_srvs.srv import Trigger

from .conversions import reader

SEND_QUEUE = 10_000
"""Length of the queues: nothing is lost while a process is busy."""

TIMEOUT = 5.0
"""Longest wait (s) for a subscriber, for an answer, or for the last predictions."""

POLL_PERIOD = 0.05
"""Longest wait (s) for a callback before a condition is checked again."""

BUSY_WAIT = 200e-6
"""Nothing else is done within this time (s) before a message is due."""

LEAD_TIME = 0.2
"""Time (s) from the start to the first message."""

STAMP = slice(4, 12)
"""Where the stamp is in a CDR message that begins with its header."""


@dataclass(frozen=True)
class Played:
    """
    What was sent.

    Parameters
    ----------
    messages : mapping of str to int
        Sent on each topic, under the name it was played with.
    duration : float
        s.
    latest : float
        Largest lateness of a message, s.
    has_subscriber : bool
        Whether there was a subscriber at the start.

    """

    messages: Mapping[str, int]
    duration: float
    latest: float
    has_subscriber: bool


def play(
    messages: Sequence[Message], names: Mapping[str, str], rate: float = 1.0,
    stamps_now: bool = False, progress: Progress = no_progress
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
    stamps_now : bool
        Whether headers are stamped with the current time, and twists are those at this rate; else
        both are as recorded.
    progress : callable
        Called with what is being done and the part (0 to 1) that is done.

    """
    first_ns = messages[0].log_time_ns
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
        progress('waiting for a subscriber', 0.0)
        has_subscriber = spin_until(
            executor, lambda: any(p.get_subscription_count() for p in publishers.values()),
            TIMEOUT)
        begin_ns = time.time_ns() + round(LEAD_TIME * NS_PER_S)

        def send(message: Message) -> None:
            """Send a message, stamped anew where that is wanted."""
            data = message.data
            if stamps_now:
                data = stamped(data, lambda ns: begin_ns + round((ns - first_ns) / rate))
                if message.topic.type_name.endswith('/TwistStamped'):
                    data = with_twist_times(data, rate)
            publishers[message.topic].publish(data)

        latest = send_all(executor, messages, send, progress, rate)
        for each in publishers.values():  # let what is on its way arrive before the topics vanish
            each.wait_for_all_acked(Duration(seconds=TIMEOUT))
    return Played(
        Counter(names[message.topic.name] for message in messages),
        (messages[-1].log_time_ns - first_ns) / NS_PER_S / rate, latest, has_subscriber)


def send_all(
    executor: SingleThreadedExecutor, messages: Sequence[Message],
    send: Callable[[Message], None], progress: Progress, rate: float = 1.0,
) -> float:
    """
    Send messages when they are due, with no garbage collected between them.

    Parameters
    ----------
    executor : SingleThreadedExecutor
        Spun while nothing is due.
    messages : sequence of Message
        In the order of their times.
    send : callable
        Takes each.
    progress : callable
        Called once a second with what is being done and the part (0 to 1) that is done.
    rate : float
        Seconds of the recording per second.

    Returns
    -------
    float
        By how much a message was sent later than due, at most, s.

    """
    max_delay = reported = 0.0
    first_ns = messages[0].log_time_ns
    duration = (messages[-1].log_time_ns - first_ns) / NS_PER_S / rate
    start = time.monotonic() + LEAD_TIME
    gc.collect()
    gc.disable()
    try:
        for message in messages:
            due = (message.log_time_ns - first_ns) / NS_PER_S / rate
            if due > reported:
                progress('playing the recording', due / duration)
                reported += 1.0
            while (remaining := start + due - time.monotonic()) > BUSY_WAIT:
                executor.spin_once(timeout_sec=remaining - BUSY_WAIT)
            while (delay := time.monotonic() - start - due) < 0.0:
                pass
            max_delay = max(max_delay, delay)
            send(message)
    finally:
        gc.enable()
    return max_delay


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
    """Receive until something is done, or for a time (s) at most; return whether it is done."""
    deadline = time.monotonic() + timeout
    while not (is_done := done()) and time.monotonic() < deadline:
        meanwhile()
        executor.spin_once(timeout_sec=POLL_PERIOD)
    return is_done


def publisher(node: Node, topic: Channel, name: str) -> Any:
    """Return a publisher of a recorded topic's messages under some name; it takes their bytes."""
    package, _, kind = topic.type_name.partition('/msg/')
    return node.create_publisher(
        getattr(importlib.import_module(f'{package}.msg'), kind), name, SEND_QUEUE)


def stamped(data: bytes, new_ns: Callable[[int], int]) -> bytes:
    """Return a CDR message that begins with its header, with the stamp that a function makes."""
    layout = '<iI' if data[1] & 1 else '>iI'
    seconds, nanoseconds = struct.unpack(layout, data[STAMP])
    new = divmod(new_ns(seconds * NS_PER_S + nanoseconds), NS_PER_S)
    return data[:STAMP.start] + struct.pack(layout, *new) + data[STAMP.stop:]


def with_twist_times(data: bytes, factor: float) -> bytes:
    """Return a TwistStamped in CDR with its six last numbers times a factor."""
    layout = '<6d' if data[1] & 1 else '>6d'
    return data[:-48] + struct.pack(layout, *(
        factor * x for x in struct.unpack(layout, data[-48:])))


DISCOVERY_TIMEOUT = 90.0
"""Longest wait (s) for the predictor to start; without a cache it compiles first."""

PROBE_LEAD_NS = 3_600_000_000_000
"""Probes are stamped an hour before the recording, so that they can be recognised."""

POSES, TWISTS = 'tool_arm/pose', 'tool_arm/twist'


@dataclass(frozen=True, eq=False)
class Exchange:
    """
    Messages sent to the predictor and received from it.

    Parameters
    ----------
    sent : mapping of str to int
        How many on `POSES` and `TWISTS`.
    predicted : Trajectory
        Of the package B in the world, by the stamps that were answered.
    latency : array (N,)
        From the moment before the tool's pose was handed to ROS until the prediction was here, s.

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
        As of `send_all`.

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
        _connect(node, executor, publishers, first, lambda: bool(answers), require_alive)
        send_all(executor, messages, send, progress)
        spin_until(executor, lambda: sent_ns.keys() <= answers.keys(), TIMEOUT)
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
    first: Mapping[str, Message], is_answered: Callable[[], bool],
    require_alive: Callable[[], None],
) -> None:
    """
    Wait until the predictor answers messages of some topics, and reset it.

    The first answer to a probe shows that messages go all the way. Twists are announced before
    poses, and announcements arrive in order: then the predictor has heard of both. The reset
    makes it forget the probes.
    """
    probe_stamps = count(first[POSES].log_time_ns - PROBE_LEAD_NS, round(POLL_PERIOD * NS_PER_S))

    def wait(
        timeout: float, failure: str, done: Callable[[], bool],
        meanwhile: Callable[[], None] = require_alive,
    ) -> None:
        if not spin_until(executor, done, timeout, meanwhile):
            raise BellowsError(
                f'The predictor {failure} ({timeout:g} s waited). See its log, and whether '
                'DDS may use the loopback interface of this machine.')

    def probe() -> None:
        require_alive()
        stamp_ns = next(probe_stamps)
        for name, message in first.items():
            publishers[name].publish(stamped(message.data, lambda _: stamp_ns))

    reset = node.create_client(Trigger, 'predictor/reset')
    wait(DISCOVERY_TIMEOUT, 'does not appear', lambda: reset.service_is_ready() and all(
        each.get_subscription_count() for each in publishers.values()))
    wait(TIMEOUT, 'does not answer', is_answered, probe)
    wait(TIMEOUT, 'does not answer its reset', reset.call_async(Trigger.Request()).done)
