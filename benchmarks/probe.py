"""
Send tool poses and twists at a rate and measure the time until each answer.

`python -m benchmarks.probe RATE SECONDS PID` prints JSON: latencies and processor time (s) of the
process that answers. `python -m benchmarks.probe echo` is a bare node that sends every tool pose
back, spun as the commands of this package: the floor for the latency of the predictor.
"""

from collections.abc import Callable
import gc
import json
import math
from pathlib import Path
import sys
import time

from bellows_ros.nodes.command import run
from bellows_ros.nodes.conversions import stamp_to_ns
from geometry_msgs.msg import PoseStamped, TwistStamped
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future

QUEUE = 10_000
FIRST_NS = 1_000_000_000
WARM_SECONDS = 1.0
"""Duration at the start without measurement, s."""
DISCOVERY, TWISTS_DISCOVERY = 60.0, 1.0
LAST_ANSWER = 2.0
BUSY = 300e-6
"""Duration of busy waiting before each message, s."""
WAY = 0.02
"""Amplitude of the tool, m."""

TURNS = 2.0 * math.pi
"""Angular frequency of the tool, rad/s."""


class Probe(Node):
    """Sender of tool poses, with the times of each message and its answer."""

    def __init__(self, rate_hz: float, seconds: float) -> None:
        """Make the topics and all messages."""
        super().__init__('probe')
        self.sent: dict[int, int] = {}
        self.answered: dict[int, int] = {}
        self._pose_out = self.create_publisher(PoseStamped, 'tool_arm/pose', QUEUE)
        self._twist_out = self.create_publisher(TwistStamped, 'tool_arm/twist', QUEUE)
        self.create_subscription(PoseStamped, 'package/pose', self._on_answer, QUEUE)
        self._period = 1.0 / rate_hz
        self._messages = [_messages(k * self._period) for k in range(round(seconds * rate_hz))]
        self.executor_ = SingleThreadedExecutor()
        self.executor_.add_node(self)

    def _on_answer(self, message: PoseStamped) -> None:
        self.answered[stamp_to_ns(message.header.stamp)] = time.perf_counter_ns()

    def connected(self) -> bool:
        """Wait until both ends know each other; the bare node does not listen to twists."""
        both = self._spin_until(
            lambda: self._pose_out.get_subscription_count() > 0
            and self.count_publishers('package/pose') > 0, DISCOVERY)
        self._spin_until(
            lambda: self._twist_out.get_subscription_count() > 0, TWISTS_DISCOVERY)
        return both

    def _spin_until(self, true: Callable[[], bool], seconds: float) -> bool:
        """Process answers until a condition holds; return whether it held within seconds."""
        end = time.monotonic() + seconds
        while not true():
            if time.monotonic() > end:
                return False
            self.executor_.spin_once(timeout_sec=0.05)
        return True

    def play(self) -> None:
        """Send each message at its time, and wait for the last answer."""
        self.sent, self.answered = {}, {}
        for k, pair in enumerate(self._messages):
            stamp_ns = FIRST_NS + round(k * self._period * 1e9)
            for message in pair:
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        start = time.perf_counter() + 0.2
        for k, (pose, twist) in enumerate(self._messages):
            self._wait_until(start + k * self._period)
            self.sent[stamp_to_ns(pose.header.stamp)] = time.perf_counter_ns()
            self._pose_out.publish(pose)
            self._twist_out.publish(twist)
        self._spin_until(lambda: len(self.answered) == len(self.sent), LAST_ANSWER)

    def _wait_until(self, due: float) -> None:
        """Process answers until the next message is due."""
        while (remaining := due - time.perf_counter()) > 0.0:
            self.executor_.spin_once(timeout_sec=max(remaining - BUSY, 0.0))


def _messages(seconds: float) -> tuple[PoseStamped, TwistStamped]:
    """Return pose and twist of a tool that moves to and fro."""
    pose, twist = PoseStamped(), TwistStamped()
    pose.header.frame_id = twist.header.frame_id = 'world'
    pose.pose.position.x = WAY * (1.0 - math.cos(TURNS * seconds))
    pose.pose.orientation.w = 1.0
    twist.twist.linear.x = WAY * TURNS * math.sin(TURNS * seconds)
    return pose, twist


def used(pid: int) -> float:
    """Return the processor time (s) of a process."""
    return 1e-9 * sum(
        int(path.read_text().split()[0]) for path in Path(f'/proc/{pid}/task').glob('*/schedstat'))


class Echo(Node):
    """Send `tool_arm/pose` on as `package/pose`; never finished."""

    def __init__(self) -> None:
        """Make the topics."""
        super().__init__('echo')
        self.finished = Future()
        publisher = self.create_publisher(PoseStamped, 'package/pose', 100)
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(PoseStamped, 'tool_arm/pose', publisher.publish, qos)

    def close(self) -> None:
        """Take the node down."""
        self.destroy_node()


def main() -> None:
    """Measure and print."""
    rate, seconds, pid = sys.argv[1:]
    rclpy.init()
    probe = Probe(float(rate), float(seconds) + WARM_SECONDS)
    if not probe.connected():
        sys.exit('no answer: the node that is measured was not found')
    gc.freeze()
    before = used(int(pid))
    probe.play()
    print(json.dumps({
        'answered': len(probe.answered), 'processor_seconds': used(int(pid)) - before,
        'latency': [
            (probe.answered[stamp] - sent) * 1e-9 for stamp, sent in probe.sent.items()
            if stamp >= FIRST_NS + WARM_SECONDS * 1e9 and stamp in probe.answered]}))


if __name__ == '__main__':
    if sys.argv[1:] == ['echo']:
        sys.exit(run('echo', (), 'benchmarks.probe:Echo'))
    main()
