"""Play the topics of a recording to ROS, with rclpy but without `ros2 bag`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
import importlib
import struct
import time
from typing import Any

from bellows_ros.core.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Message, Topic
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from .player import ros, Send, send_all

QUEUE = 1000
"""Messages kept on the way, for subscriptions that are slow for a moment."""

LISTENER_TIMEOUT = 5.0
"""How long (s) somebody is waited for who listens."""

LOOK_EVERY = 0.05
STAMP_AT = 4
"""Bytes of CDR before the stamp of a message that begins with its header."""


@dataclass(frozen=True)
class Played:
    """
    What was sent.

    Parameters
    ----------
    messages : mapping of str to int
        Sent on each topic, under the name it was played with.
    duration : float
        Of one round, s.
    rounds : int
    latest : float
        Largest lateness of a message, s.
    heard : bool
        Whether somebody listened when it began.

    """

    messages: Mapping[str, int]
    duration: float
    rounds: int
    latest: float
    heard: bool


def play(
    messages: Sequence[Message],
    names: Mapping[str, str],
    rate: float = 1.0,
    stamps_now: bool = False,
    loop: bool = False,
    say: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Played:
    """
    Send recorded messages, byte by byte as they were recorded, in their time.

    Parameters
    ----------
    messages : sequence of Message
        In the order they were recorded in; at least one.
    names : mapping of str to str
        The names under which topics are played, by those under which they were recorded.
    rate : float
        Seconds of the recording per second.
    stamps_now : bool
        Whether headers are stamped as if everything happened now; else as it was recorded.
    loop : bool
        Whether it begins again at its end, for ever.
    say : callable
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a message type is not installed.

    """
    types = {topic: _type(topic) for topic in dict.fromkeys(m.topic for m in messages)}
    first_ns = messages[0].log_time_ns
    latest, rounds = 0.0, 0
    with ros() as (context, executor):
        node = Node('bellows_player', context=context)
        executor.add_node(node)
        qos = QoSProfile(depth=QUEUE)
        out = {topic: node.create_publisher(kind, names[topic.name], qos)
               for topic, kind in types.items()}
        say('waiting for somebody who listens', 0.0)
        heard = _await_listener(executor, list(out.values()))
        restamped = {topic for topic, kind in types.items() if stamps_now and _has_header(kind)}
        while loop or not rounds:
            clock = _Clock(first_ns, rate)
            plan: list[Send] = [
                (clock.due(message), partial(
                    _send, out[message.topic].publish, message.data,
                    clock if message.topic in restamped else None))
                for message in messages
            ]
            latest = max(latest, *send_all(executor, plan, say))
            rounds += 1
        _await_acknowledged(list(out.values()))
        node.destroy_node()
    counts: dict[str, int] = {}
    for message in messages:
        name = names[message.topic.name]
        counts[name] = counts.get(name, 0) + rounds
    return Played(counts, plan[-1][0], rounds, latest, heard)


class _Clock:
    """The time at which what was recorded happens once more."""

    def __init__(self, first_ns: int, rate: float) -> None:
        """Begin with the first message that is stamped."""
        self._first_ns, self._rate = first_ns, rate
        self._begin_ns = 0

    def due(self, message: Message) -> float:
        """Return when a message is due, s after the first."""
        return (message.log_time_ns - self._first_ns) / NS_PER_S / self._rate

    def now_ns(self, stamp_ns: int) -> int:
        """Return the stamp of what was stamped so when it was recorded."""
        self._begin_ns = self._begin_ns or time.time_ns()
        return self._begin_ns + round((stamp_ns - self._first_ns) / self._rate)


def _send(publish: Callable[[bytes], None], data: bytes, clock: _Clock | None) -> None:
    """Send a message, stamped anew where there is a clock."""
    publish(stamped(data, clock.now_ns) if clock else data)


def stamped(data: bytes, new_ns: Callable[[int], int]) -> bytes:
    """Return a CDR message that begins with its header, with the stamp that a function makes."""
    layout = '<iI' if data[1] & 1 else '>iI'
    seconds, nanoseconds = struct.unpack_from(layout, data, STAMP_AT)
    new = divmod(new_ns(seconds * 10**9 + nanoseconds), 10**9)
    return data[:STAMP_AT] + struct.pack(layout, *new) + data[STAMP_AT + 8:]


def _type(topic: Topic) -> Any:
    """Return the class of a topic's messages."""
    package, _, name = topic.type_name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError, ValueError):
        raise BellowsError(
            f"Topic '{topic.name}' cannot be played, because its type {topic.type_name} is not "
            'installed. Name the topics to play with --topic.'
        ) from None


def _has_header(kind: Any) -> bool:
    """Return whether messages of a type begin with a header, and so with a stamp."""
    first = next(iter(kind.get_fields_and_field_types().values()), '')
    return bool(first == 'std_msgs/Header')


def _await_listener(executor: SingleThreadedExecutor, publishers: Sequence[Any]) -> bool:
    """Wait a while for somebody to listen to one of the topics; return whether anybody does."""
    deadline = time.monotonic() + LISTENER_TIMEOUT
    while not (heard := any(p.get_subscription_count() for p in publishers)):
        if time.monotonic() > deadline:
            break
        executor.spin_once(timeout_sec=LOOK_EVERY)
    return heard


def _await_acknowledged(publishers: Sequence[Any]) -> None:
    """Let what is on its way arrive before the topics vanish."""
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=LISTENER_TIMEOUT))
