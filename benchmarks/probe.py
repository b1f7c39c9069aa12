"""
Send tool poses and twists at a rate and measure the time until each answer.

`python -m benchmarks.probe RATE SECONDS PID [poses]` prints JSON: latencies in s, and the
processor time and memory of the process that answers. With `poses` no twists are sent.
"""

from collections.abc import Callable
import gc
import json
import math
from pathlib import Path
import sys
import time
from typing import Any

from bellows_ros.nodes.conversions import stamp_to_ns
from geometry_msgs.msg import PoseStamped, TwistStamped
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

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

    def __init__(self, rate_hz: float, seconds: float, with_twists: bool = True) -> None:
        """Make the topics and all messages."""
        super().__init__('probe')
        self.sent: dict[int, int] = {}
        self.answered: dict[int, int] = {}
        self._pose_out = self.create_publisher(PoseStamped, 'tool_arm/pose', QUEUE)
        self._twist_out = with_twists and self.create_publisher(
            TwistStamped, 'tool_arm/twist', QUEUE)
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
        if twists := self._twist_out:
            self._spin_until(lambda: twists.get_subscription_count() > 0, TWISTS_DISCOVERY)
        return both

    def _spin_until(self, true: Callable[[], bool], seconds: float) -> bool:
        """Process answers until a condition holds; return whether it held within seconds."""
        end = time.monotonic() + seconds
        while not true():
            if time.monotonic() > end:
                return False
            self.executor_.spin_once(timeout_sec=0.05)
        return True

    def play(self, after: float = 0.0) -> None:
        """Send each message at its time, stamped from a time (s) on; wait for the last answer."""
        self.sent, self.answered = {}, {}
        for k, pair in enumerate(self._messages):
            stamp_ns = FIRST_NS + round((after + k * self._period) * 1e9)
            for message in pair:
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        start = time.perf_counter() + 0.2
        for k, (pose, twist) in enumerate(self._messages):
            self._wait_until(start + k * self._period)
            self.sent[stamp_to_ns(pose.header.stamp)] = time.perf_counter_ns()
            self._pose_out.publish(pose)
            if self._twist_out:
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


def used(pid: int) -> dict[str, float]:
    """Return the processor time (s) and the memory (bytes) of a process."""
    nanoseconds = sum(
        int(path.read_text().split()[0]) for path in Path(f'/proc/{pid}/task').glob('*/schedstat'))
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    memory = next(1024 * int(line.split()[1]) for line in lines if line.startswith('VmRSS'))
    return {'seconds': nanoseconds * 1e-9, 'memory': memory}


def main() -> None:
    """Measure and print."""
    rate, seconds, pid, *only = sys.argv[1:]
    rclpy.init()
    probe = Probe(float(rate), float(seconds) + WARM_SECONDS, not only)
    if not probe.connected():
        sys.exit('no answer: the node that is measured was not found')
    gc.freeze()
    before = used(int(pid))
    probe.play()
    print(json.dumps(_result(probe, before, used(int(pid)))))


def _result(probe: Probe, before: dict[str, float], after: dict[str, float]) -> dict[str, Any]:
    """Return the figures of a measurement."""
    counted = [stamp for stamp in probe.sent if stamp >= FIRST_NS + WARM_SECONDS * 1e9]
    return {
        'sent': len(probe.sent),
        'answered': len(probe.answered),
        'latency': [
            (probe.answered[stamp] - probe.sent[stamp]) * 1e-9
            for stamp in counted if stamp in probe.answered],
        'processor_seconds': after['seconds'] - before['seconds'],
        'memory': after['memory']}


if __name__ == '__main__':
    main()
