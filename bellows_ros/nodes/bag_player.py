"""
Play recorded messages to ROS when they are due, with rclpy but without `ros2 bag`.

`converse` plays to a running predictor, and keeps its answers.
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
from bellows_ros.files.bag_folder import Batch, Channel, Message
from bellows_ros.files.messages import decode, LAYOUTS
from bellows_ros.workflows.recordings import Progress, silent
from geometry_msgs.msg import PoseStamped
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

QUEUE = 1000
"""Queue size, for subscriptions that are briefly slow."""

LISTENER_TIMEOUT = 5.0
"""How long (s) to wait for a subscriber."""

LOOK_EVERY = 0.05

LAST_MOMENT = 200e-6
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
    stamps_now: bool = False, say: Progress = silent
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
        Whether headers are stamped with the current time; else as recorded.
    say : callable
        Called with what is being done and the part (0 to 1) that is done.

    """
    first_ns = messages[0].log_time_ns
    with playing('bellows_player') as (node, executor):
        qos = QoSProfile(depth=QUEUE)
        out = {topic: publisher(node, topic, names[topic.name], qos)
               for topic in dict.fromkeys(m.topic for m in messages)}
        say('waiting for a subscriber', 0.0)
        has_subscriber = spin_until(
            executor, lambda: any(p.get_subscription_count() for p in out.values()),
            LISTENER_TIMEOUT)
        begin_ns = time.time_ns() + round(LEAD_TIME * NS_PER_S)

        def send(message: Message) -> None:
            """Send a message, stamped anew where that is wanted."""
            data = message.data
            if stamps_now:
                data = stamped(data, lambda ns: begin_ns + round((ns - first_ns) / rate))
            out[message.topic].publish(data)

        latest = send_all(executor, messages, send, say, rate)
        for each in out.values():  # let what is on its way arrive before the topics vanish
            each.wait_for_all_acked(Duration(seconds=LISTENER_TIMEOUT))
    return Played(
        Counter(names[message.topic.name] for message in messages),
        (messages[-1].log_time_ns - first_ns) / NS_PER_S / rate, latest, has_subscriber)


def send_all(
    executor: SingleThreadedExecutor, messages: Sequence[Message],
    send: Callable[[Message], None], say: Progress, rate: float = 1.0,
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
    say : callable
        Called once a second with what is being done and the part (0 to 1) that is done.
    rate : float
        Seconds of the recording per second.

    Returns
    -------
    float
        By how much a message was sent later than due, at most, s.

    """
    latest = shown = 0.0
    first_ns = messages[0].log_time_ns
    duration = (messages[-1].log_time_ns - first_ns) / NS_PER_S / rate
    start = time.monotonic() + LEAD_TIME
    gc.collect()
    gc.disable()
    try:
        for message in messages:
            due = (message.log_time_ns - first_ns) / NS_PER_S / rate
            if due > shown:
                say('playing the recording', due / duration)
                shown += 1.0
            while (left := start + due - time.monotonic()) > LAST_MOMENT:
                executor.spin_once(timeout_sec=left - LAST_MOMENT)
            while (late := time.monotonic() - start - due) < 0.0:
                pass
            latest = max(latest, late)
            send(message)
    finally:
        gc.enable()
    return latest


@contextmanager
def playing(name: str) -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """Provide a node in a ROS context of its own, and the executor that spins it."""
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
        executor.spin_once(timeout_sec=LOOK_EVERY)
    return is_done


def publisher(node: Node, topic: Channel, name: str, qos: QoSProfile) -> Any:
    """Return a publisher of a recorded topic's messages under some name; it takes their bytes."""
    package, _, kind = topic.type_name.partition('/msg/')
    return node.create_publisher(
        getattr(importlib.import_module(f'{package}.msg'), kind), name, qos)


def stamped(data: bytes, new_ns: Callable[[int], int]) -> bytes:
    """Return a CDR message that begins with its header, with the stamp that a function makes."""
    layout = '<iI' if data[1] & 1 else '>iI'
    seconds, nanoseconds = struct.unpack(layout, data[STAMP])
    new = divmod(new_ns(seconds * 10**9 + nanoseconds), 10**9)
    return data[:STAMP.start] + struct.pack(layout, *new) + data[STAMP.stop:]


LONG_QUEUE = 10_000
"""Length of the queues: nothing is lost while this process is busy."""

DISCOVERY_TIMEOUT = 90.0
"""Longest wait (s) for the predictor to start; without a cache it compiles first."""

ANSWER_TIMEOUT = 5.0
"""Longest wait (s) for an answer, or for the last predictions."""

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
    say: Progress = silent,
) -> Exchange:
    """
    Wait for the predictor, play at recorded speed, and wait for its last answer.

    The first answer to a probe shows that messages go all the way. Twists are announced before
    poses, and announcements arrive in order: then the predictor has heard of both. The reset
    makes it forget the probes.

    Parameters
    ----------
    messages : sequence of Message
        Poses and twists of the tool in the order they were recorded in.
    names : mapping of str to str
        `POSES` or `TWISTS`, by the topic of a message.
    require_alive : callable
        Raises BellowsError when the predictor has ended; asked while it is waited for.
    say : callable
        As `send_all` takes it.

    Raises
    ------
    BellowsError
        If the predictor ends, does not appear or does not answer.

    """
    sent_ns: dict[bytes, int] = {}
    heard: dict[bytes, tuple[int, bytes]] = {}  # when it came, and the answer, by its stamp
    firsts = {names[message.topic.name]: message for message in reversed(messages)}
    stamps = count(messages[0].log_time_ns - PROBE_LEAD_NS, round(LOOK_EVERY * 1e9))

    def wait(
        timeout: float, failure: str, done: Callable[[], bool],
        meanwhile: Callable[[], None] = require_alive,
    ) -> None:
        if not spin_until(executor, done, timeout, meanwhile):
            raise BellowsError(
                f'The predictor {failure} ({timeout:g} s waited). See its log, and whether '
                'DDS may use the loopback interface of this machine.')

    def send(message: Message) -> None:
        name = names[message.topic.name]
        if name == POSES:
            sent_ns[message.data[STAMP]] = time.monotonic_ns()
        out[name].publish(message.data)

    def receive(data: bytes) -> None:
        heard.setdefault(data[STAMP], (time.monotonic_ns(), data))

    def probe() -> None:
        require_alive()
        stamp_ns = next(stamps)
        for name, message in firsts.items():
            out[name].publish(stamped(message.data, lambda _: stamp_ns))

    with playing('demo_player') as (node, executor):
        qos = QoSProfile(depth=LONG_QUEUE)
        node.create_subscription(PoseStamped, 'package/pose', receive, qos, raw=True)
        out = {name: publisher(node, firsts[name].topic, name, qos)
               for name in (TWISTS, POSES) if name in firsts}
        reset = node.create_client(Trigger, 'predictor/reset')
        wait(DISCOVERY_TIMEOUT, 'does not appear', lambda: reset.service_is_ready() and all(
            topic.get_subscription_count() for topic in out.values()))
        wait(ANSWER_TIMEOUT, 'does not answer', lambda: bool(heard), probe)
        future = reset.call_async(Trigger.Request())
        wait(ANSWER_TIMEOUT, 'does not answer its reset', future.done)
        send_all(executor, messages, send, say)
        spin_until(executor, lambda: sent_ns.keys() <= heard.keys(), ANSWER_TIMEOUT)
    counts = Counter(names[message.topic.name] for message in messages)
    return _exchange(counts, sent_ns, heard)


def _exchange(
    counts: Mapping[str, int], sent_ns: Mapping[bytes, int],
    heard: Mapping[bytes, tuple[int, bytes]],
) -> Exchange:
    """Return the outcome, from when (ns) poses were sent and answers arrived, by stamp."""
    answered = [stamp for stamp in sent_ns if stamp in heard]
    if not answered:
        raise BellowsError('The predictor did not answer. See its log.')
    answers = Batch.of(
        Channel('package/pose', 'geometry_msgs/msg/PoseStamped', 'cdr'),
        [heard[stamp][0] for stamp in answered], [heard[stamp][1] for stamp in answered])
    found = decode(answers, LAYOUTS[answers.topic.type_name], slice(0, 7))
    order = np.argsort(found.stamps_ns)
    values = found.values[order]
    return Exchange(
        counts,
        Trajectory(found.stamps_ns[order], values[:, :3], quaternion_to_rotation(values[:, 3:])),
        1e-9 * np.array([heard[stamp][0] - sent_ns[stamp] for stamp in answered]))
