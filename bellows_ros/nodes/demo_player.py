"""Play a recording's tool-arm messages to a running predictor, and keep its answers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import Message, Topic
from bellows_ros.files.messages import decode, encode, LAYOUTS
from geometry_msgs.msg import PoseStamped
import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
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

TWISTS = Topic('tool_arm/twist', 'geometry_msgs/msg/TwistStamped', 'cdr')
POSES = Topic('tool_arm/pose', 'geometry_msgs/msg/PoseStamped', 'cdr')


@dataclass(frozen=True, eq=False)
class Exchange:
    """
    Messages sent to the predictor and received from it.

    Parameters
    ----------
    sent_poses, sent_twists : int
    stamps_ns : int array (N,)
        Stamps of the predictions, in the order in which they came.
    position : array (N, 3)
        Predicted origin of B in the world, m.
    rotation : array (N, 3, 3)
        Predicted R_world_B.
    latency : array (N,)
        From the moment before the tool's pose was handed to ROS until the prediction was here, s.

    """

    sent_poses: int
    sent_twists: int
    stamps_ns: Stamps
    position: Array
    rotation: Array
    latency: Array


class Player:
    """
    A partner of the predictor: sends the tool arm's messages, receives the package's poses.

    Parameters
    ----------
    poses : PoseStream
        Of the tool.
    twists : TwistStream or None
        Of the tool.
    alive : callable
        Raises BellowsError when the predictor has ended; asked while it is waited for.

    """

    def __init__(
        self, poses: PoseStream, twists: TwistStream | None, alive: Callable[[], None]
    ) -> None:
        """Encode all messages, so that nothing but sending is left for later."""
        self._alive = alive
        rows = np.hstack([poses.position, rotation_to_quaternion(poses.rotation)])
        self._poses = _messages(POSES, poses.stamps_ns, rows, poses.frame_id)
        self._twists = [] if twists is None else _messages(
            TWISTS, twists.stamps_ns, np.hstack([twists.linear, twists.angular]), twists.frame_id)
        self._sent_ns: dict[bytes, int] = {}
        self._received: list[tuple[int, bytes]] = []
        self._is_answered = False

    def play(self, say: Say = lambda stage, fraction: None) -> Exchange:
        """
        Wait for the predictor, play at recorded speed, and wait for its last answer.

        Raises
        ------
        BellowsError
            If the predictor ends, does not appear or does not answer.

        """
        messages = sorted([*self._poses, *self._twists], key=lambda m: m.log_time_ns)  # stable
        with playing('demo_player') as (node, executor):
            self._connect(node, executor)
            send_all(executor, messages, self._send, say)
            spin_until(
                executor, lambda: len(self._received) >= len(self._sent_ns), ANSWER_TIMEOUT)
        answers = decode(
            [data for _, data in self._received], LAYOUTS[POSES.type_name], slice(0, 7))
        latency = [came_ns - self._sent_ns[data[STAMP]] for came_ns, data in self._received]
        return Exchange(
            len(self._poses), len(self._twists), answers.stamps_ns, answers.values[:, :3],
            quaternion_to_rotation(answers.values[:, 3:]), 1e-9 * np.array(latency))

    def _connect(self, node: Node, executor: SingleThreadedExecutor) -> None:
        """
        Make the topics and wait until the predictor listens to both and has answered.

        The first answer to a probe shows that messages go all the way. Twists are announced
        before poses, and announcements arrive in order: then it has heard of both. The reset
        makes it forget the probes.
        """
        qos = QoSProfile(depth=QUEUE)
        node.create_subscription(PoseStamped, 'package/pose', self._receive, qos, raw=True)
        self._out = {topic: publisher(node, topic, topic.name, qos) for topic in (TWISTS, POSES)}
        reset = node.create_client(Trigger, 'predictor/reset')
        firsts = [*self._twists[:1], *self._poses[:1]]
        self._wait(
            executor, DISCOVERY_TIMEOUT, 'does not appear',
            lambda: reset.service_is_ready()
            and all(self._out[m.topic].get_subscription_count() for m in firsts))
        probed_ns = firsts[-1].log_time_ns - PROBE_LEAD_NS

        def probe() -> None:
            """Send the first twist and pose with the next stamp from long ago."""
            nonlocal probed_ns
            probed_ns += round(LOOK_EVERY * 1e9)
            for message in firsts:
                self._out[message.topic].publish(stamped(message.data, lambda _: probed_ns))

        self._wait(
            executor, ANSWER_TIMEOUT, 'does not answer', lambda: self._is_answered, probe)
        future = reset.call_async(Trigger.Request())
        self._wait(executor, ANSWER_TIMEOUT, 'does not answer its reset', future.done)

    def _wait(
        self, executor: SingleThreadedExecutor, timeout: float, failure: str,
        done: Callable[[], bool], meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """Receive until something is done; raise BellowsError when it takes too long."""
        def is_done() -> bool:
            self._alive()
            return done()

        if not spin_until(executor, is_done, timeout, meanwhile):
            raise BellowsError(
                f'The predictor {failure} ({timeout:g} s waited). See its log, and whether '
                'DDS may use the loopback interface of this machine.')

    def _send(self, message: Message) -> None:
        """Send a message; note when each pose was sent."""
        if message.topic == POSES:
            self._sent_ns[message.data[STAMP]] = time.monotonic_ns()
        self._out[message.topic].publish(message.data)

    def _receive(self, data: bytes) -> None:
        """Keep a prediction and when it came, unless it answers a probe, however late."""
        came_ns = time.monotonic_ns()
        self._is_answered = True
        if data[STAMP] in self._sent_ns:
            self._received.append((came_ns, data))


def _messages(topic: Topic, stamps_ns: Stamps, values: Array, frame_id: str) -> Sequence[Message]:
    """Return a stream's messages as ROS sends them."""
    encoded = encode(stamps_ns, values, [frame_id], LAYOUTS[topic.type_name])
    return [Message(topic, *each) for each in zip(stamps_ns.tolist(), encoded, strict=True)]
