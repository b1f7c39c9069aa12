"""Play a recording's tool-arm messages to a running predictor, and keep its answers."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
import time
from typing import Any

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from geometry_msgs.msg import PoseStamped, TwistStamped
import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from .conversions import (
    quaternion_xyzw,
    stamp_to_ns,
    vector,
    write_quaternion,
    write_stamp,
    write_vector,
)
from .player import ros, send_all

QUEUE = 10_000
"""Messages kept on the way: nothing is lost because this process was busy."""

DISCOVERY_TIMEOUT = 90.0
"""How long (s) the predictor may take to start; without a cache it compiles first."""

ANSWER_TIMEOUT = 5.0
"""How long (s) an answer, or the last predictions, may take."""

PROBE_PERIOD = 0.05
PROBE_LEAD_NS = 3_600_000_000_000
"""Probes are stamped an hour before the recording, so that they differ from it."""


@dataclass(frozen=True, eq=False)
class Exchange:
    """
    What went to the predictor and what came back.

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
    lateness : array (sent_poses,)
        By how much each pose was sent later than due, s.

    """

    sent_poses: int
    sent_twists: int
    stamps_ns: Stamps
    position: Array
    rotation: Array
    latency: Array
    lateness: Array


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
        """Prepare all messages, so that nothing but sending is left for later."""
        self._alive = alive
        self._poses = pose_messages(poses)
        self._twists = twist_messages(twists) if twists else []
        self._plan = _plan(poses, twists, self._poses, self._twists)
        self._first_ns = int(poses.stamps_ns[0])
        self._is_answered = False
        self._sent_ns: dict[int, int] = {}
        self._received: list[tuple[int, int, PoseStamped]] = []

    def play(self, progress: Callable[[str, float], None] | None = None) -> Exchange:
        """
        Wait for the predictor, play at recorded speed, and wait for its last answer.

        Raises
        ------
        BellowsError
            If the predictor ends, does not appear or does not answer.

        """
        say = progress or (lambda stage, fraction: None)
        with ros() as (context, executor):
            node = Node('demo_player', context=context)
            executor.add_node(node)
            try:
                self._connect(node, executor)
                lateness = self._send_all(executor, say)
                self._await_last(executor)
            finally:
                executor.remove_node(node)
                node.destroy_node()
        return self._exchange(lateness)

    # ------------------------------------------------------------------ start

    def _connect(self, node: Node, executor: SingleThreadedExecutor) -> None:
        """
        Make the topics and wait until the predictor listens to both and has answered.

        The first answer to a probe shows that messages go all the way. Twists are announced
        before poses, and announcements arrive in order: then it has heard of both. The reset
        makes it forget the probes.
        """
        qos = QoSProfile(depth=QUEUE)
        node.create_subscription(PoseStamped, 'package/pose', self._receive, qos)
        self._twist_out = node.create_publisher(TwistStamped, 'tool_arm/twist', qos)
        self._pose_out = node.create_publisher(PoseStamped, 'tool_arm/pose', qos)
        reset = node.create_client(Trigger, 'predictor/reset')
        wanted = [self._pose_out, *([self._twist_out] if self._twists else [])]
        self._wait(
            executor, DISCOVERY_TIMEOUT, 'does not appear',
            lambda: reset.service_is_ready()
            and all(out.get_subscription_count() for out in wanted),
        )
        probe = self._probes()
        self._wait(
            executor, ANSWER_TIMEOUT, 'does not answer', lambda: self._is_answered,
            lambda: next(probe),
        )
        future = reset.call_async(Trigger.Request())
        self._wait(executor, ANSWER_TIMEOUT, 'does not answer its reset', future.done)

    def _probes(self) -> Iterator[None]:
        """Send the first pose and twist with stamps of long ago, one pair at each step."""
        stamp_ns = self._first_ns - PROBE_LEAD_NS
        while True:
            stamp_ns += round(PROBE_PERIOD * 1e9)
            for out, messages in ((self._twist_out, self._twists), (self._pose_out, self._poses)):
                for message in messages[:1]:
                    original = stamp_to_ns(message.header.stamp)
                    write_stamp(message.header.stamp, stamp_ns)
                    out.publish(message)
                    write_stamp(message.header.stamp, original)
            yield

    def _wait(
        self,
        executor: SingleThreadedExecutor,
        timeout: float,
        failure: str,
        done: Callable[[], bool],
        meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """Spin until something is done; raise BellowsError when it takes too long."""
        deadline = time.monotonic() + timeout
        while not done():
            self._alive()
            if time.monotonic() > deadline:
                raise BellowsError(
                    f'The predictor {failure} ({timeout:g} s waited). See its log, and whether '
                    'DDS may use the loopback interface of this machine.'
                )
            meanwhile()
            executor.spin_once(timeout_sec=PROBE_PERIOD)

    # ------------------------------------------------------------------- play

    def _send_all(
        self, executor: SingleThreadedExecutor, say: Callable[[str, float], None]
    ) -> list[float]:
        """Send every message when it is due; note when each pose was sent, return how late."""
        lateness = send_all(
            executor, [(due, partial(self._send, stamp_ns, message))
                       for due, stamp_ns, message in self._plan], say)
        return [late for late, (_, _, message) in zip(lateness, self._plan, strict=True)
                if isinstance(message, PoseStamped)]

    def _send(self, stamp_ns: int, message: PoseStamped | TwistStamped) -> None:
        """Send a message; note when each pose was sent."""
        if isinstance(message, PoseStamped):
            self._sent_ns[stamp_ns] = time.monotonic_ns()
            self._pose_out.publish(message)
        else:
            self._twist_out.publish(message)

    def _receive(self, message: PoseStamped) -> None:
        """Keep a prediction and when it came, unless it answers a probe, however late."""
        came_ns = time.monotonic_ns()
        self._is_answered = True
        stamp_ns = stamp_to_ns(message.header.stamp)
        if stamp_ns in self._sent_ns:
            self._received.append((stamp_ns, came_ns, message))

    def _await_last(self, executor: SingleThreadedExecutor) -> None:
        """Wait for predictions that are still on their way; what does not come is lost."""
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while len(self._received) < len(self._sent_ns) and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=PROBE_PERIOD)

    def _exchange(self, lateness: list[float]) -> Exchange:
        """Return the outcome as arrays."""
        answers, sent_ns = self._received, self._sent_ns
        quaternions = [quaternion_xyzw(m.pose.orientation) for _, _, m in answers]
        return Exchange(
            sent_poses=len(self._poses),
            sent_twists=len(self._twists),
            stamps_ns=np.array([stamp for stamp, _, _ in answers], dtype=np.int64),
            position=np.array([vector(m.pose.position) for _, _, m in answers]).reshape(-1, 3),
            rotation=quaternion_to_rotation(np.array(quaternions).reshape(-1, 4)),
            latency=np.array([(came - sent_ns[stamp]) * 1e-9 for stamp, came, _ in answers]),
            lateness=np.array(lateness),
        )


def pose_messages(poses: PoseStream) -> list[PoseStamped]:
    """Return a stream's messages."""
    messages = []
    quaternions = rotation_to_quaternion(poses.rotation).tolist()
    for stamp_ns, position, xyzw in zip(
        poses.stamps_ns.tolist(), poses.position.tolist(), quaternions, strict=True
    ):
        message = PoseStamped()
        message.header.frame_id = poses.frame_id
        write_stamp(message.header.stamp, stamp_ns)
        write_vector(message.pose.position, position)
        write_quaternion(message.pose.orientation, xyzw)
        messages.append(message)
    return messages


def twist_messages(twists: TwistStream) -> list[TwistStamped]:
    """Return a stream's messages."""
    messages = []
    for stamp_ns, linear, angular in zip(
        twists.stamps_ns.tolist(), twists.linear.tolist(), twists.angular.tolist(), strict=True
    ):
        message = TwistStamped()
        message.header.frame_id = twists.frame_id
        write_stamp(message.header.stamp, stamp_ns)
        write_vector(message.twist.linear, linear)
        write_vector(message.twist.angular, angular)
        messages.append(message)
    return messages


def _plan(
    poses: PoseStream, twists: TwistStream | None, pose_list: Sequence[Any],
    twist_list: Sequence[Any],
) -> list[tuple[float, int, Any]]:
    """Return when (s after the first), with which stamp and what is sent; poses before twists."""
    sends = list(zip(poses.stamps_ns.tolist(), pose_list, strict=True))
    if twists:
        sends += zip(twists.stamps_ns.tolist(), twist_list, strict=True)
    sends.sort(key=lambda send: send[0])  # stable
    first_ns = sends[0][0]
    return [((stamp_ns - first_ns) * 1e-9, stamp_ns, message) for stamp_ns, message in sends]
