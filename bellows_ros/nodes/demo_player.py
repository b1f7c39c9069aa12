"""Play a recording's tool-arm messages to a running predictor, and keep its answers."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
import time

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Batch, Channel, Message
from bellows_ros.files.messages import decode, LAYOUTS
from geometry_msgs.msg import PoseStamped
import numpy as np
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from .bag_player import LOOK_EVERY, playing, publisher, Say, send_all, spin_until, STAMP, stamped

QUEUE = 10_000
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
    say: Say = lambda stage, fraction: None,
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
        qos = QoSProfile(depth=QUEUE)
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
        Counter(names[message.topic.name] for message in messages),
        Trajectory(found.stamps_ns[order], values[:, :3], quaternion_to_rotation(values[:, 3:])),
        1e-9 * np.array([heard[stamp][0] - sent_ns[stamp] for stamp in answered]))
