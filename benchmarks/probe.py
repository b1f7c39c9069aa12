"""
Send tool poses (and twists) at a rate and take the time until each answer is here.

`python -m benchmarks.probe RATE SECONDS SENT HEARD PID` prints JSON: latencies in s,
and the processor time and memory of the process that answers. SENT is `poses` or `twists` (these
too), HEARD is `pose`, `all` (the package's twist and the cup's wrench too) or `camera,CYCLE` (and
some 30 answers a second are given back as measured poses, in the first half of each CYCLE, s).
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
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

QUEUE = 10_000
FIRST_NS = 1_000_000_000
WARM_SECONDS = 1.0
"""At the beginning, not counted."""
DISCOVERY, TWISTS_DISCOVERY = 60.0, 1.0
LAST_ANSWER = 2.0
SEEN_EVERY_NS = 33_000_000
COMPILED_AFTER = 5.0
BUSY = 300e-6
"""So long (s) before a message is due nothing else is done."""
WAY, TURNS = 0.02, 2.0 * math.pi
"""Amplitude (m) and angular frequency (rad/s) of the tool."""


class Probe(Node):
    """A sender of tool poses that remembers when each was sent and answered."""

    def __init__(self, rate_hz: float, seconds: float, twists: bool, heard: str) -> None:
        """Make the topics and all messages."""
        super().__init__('probe')
        self.sent: dict[int, int] = {}
        self.answered: dict[int, int] = {}
        self._pose_out = self.create_publisher(PoseStamped, 'tool_arm/pose', QUEUE)
        self._twist_out = (
            self.create_publisher(TwistStamped, 'tool_arm/twist', QUEUE) if twists else None
        )
        self.others = 0
        self._heard = {'package/pose': (PoseStamped, self._on_answer)}
        if heard == 'all':
            self._heard['package/twist'] = TwistStamped, self._on_other
            self._heard['cup/wrench'] = WrenchStamped, self._on_other
        for name, (kind, callback) in self._heard.items():
            self.create_subscription(kind, name, callback, QUEUE)
        self._camera = None
        if heard.startswith('camera'):
            self._cycle = float(heard.partition(',')[2])
            self._camera = self.create_publisher(PoseStamped, 'package/measured', QUEUE)
        self._next_seen_ns = 0
        self._period = 1.0 / rate_hz
        self._messages = [_messages(k * self._period) for k in range(round(seconds * rate_hz))]
        self.executor_ = SingleThreadedExecutor()
        self.executor_.add_node(self)

    def _on_answer(self, message: PoseStamped) -> None:
        stamp_ns = stamp_to_ns(message.header.stamp)
        self.answered[stamp_ns] = time.perf_counter_ns()
        if (self._camera and stamp_ns >= self._next_seen_ns
                and in_first_half((stamp_ns - FIRST_NS) * 1e-9, self._cycle)):
            self._next_seen_ns = stamp_ns + SEEN_EVERY_NS
            self._camera.publish(message)

    def _on_other(self, message: Any) -> None:
        self.others += 1

    def connected(self) -> bool:
        """Wait until both ends know each other; the bare node does not listen to twists."""
        both = self._spin_until(
            lambda: self._pose_out.get_subscription_count() > 0
            and all(self.count_publishers(name) > 0 for name in self._heard),
            DISCOVERY,
        )
        camera = self._camera
        if both and camera:  # what is needed is compiled when somebody is there who may send
            both = self._spin_until(lambda: camera.get_subscription_count() > 0, DISCOVERY)
            self._spin_until(lambda: False, COMPILED_AFTER)
        twists = self._twist_out
        if both and twists:
            self._spin_until(lambda: twists.get_subscription_count() > 0, TWISTS_DISCOVERY)
        return both

    def _spin_until(self, true: Callable[[], bool], seconds: float) -> bool:
        """Take answers until something is true, or not in that time."""
        end = time.monotonic() + seconds
        while not true():
            if time.monotonic() > end:
                return False
            self.executor_.spin_once(timeout_sec=0.05)
        return True

    def play(self) -> None:
        """Send everything at its time, and wait for the last answer."""
        start = time.perf_counter() + 0.2
        for k, (pose, twist) in enumerate(self._messages):
            self._wait_until(start + k * self._period)
            self.sent[stamp_to_ns(pose.header.stamp)] = time.perf_counter_ns()
            self._pose_out.publish(pose)
            if self._twist_out:
                self._twist_out.publish(twist)
        self._spin_until(lambda: len(self.answered) == len(self.sent), LAST_ANSWER)

    def _wait_until(self, due: float) -> None:
        """Take answers until a message is due."""
        while (left := due - time.perf_counter()) > 0.0:
            self.executor_.spin_once(timeout_sec=max(left - BUSY, 0.0))


def _messages(seconds: float) -> tuple[PoseStamped, TwistStamped]:
    """Return pose and twist of a tool that moves to and fro."""
    stamp_ns = FIRST_NS + round(seconds * 1e9)
    pose, twist = PoseStamped(), TwistStamped()
    for message in (pose, twist):
        message.header.frame_id = 'world'
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    pose.pose.position.x = WAY * (1.0 - math.cos(TURNS * seconds))
    pose.pose.orientation.w = 1.0
    twist.twist.linear.x = WAY * TURNS * math.sin(TURNS * seconds)
    return pose, twist


def in_first_half(seconds: float, cycle: float) -> bool:
    """Return whether a time since the first message (s) is in the first half of a cycle (s)."""
    return (seconds - WARM_SECONDS) % cycle < 0.5 * cycle


def used(pid: int) -> dict[str, float]:
    """Return the processor time (s) and the memory (bytes) of a process."""
    nanoseconds = sum(
        int(path.read_text().split()[0]) for path in Path(f'/proc/{pid}/task').glob('*/schedstat')
    )
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    memory = next(1024 * int(line.split()[1]) for line in lines if line.startswith('VmRSS'))
    return {'seconds': nanoseconds * 1e-9, 'memory': memory}


def main() -> None:
    """Measure and print."""
    rate, seconds, sent, heard, pid = sys.argv[1:]
    rclpy.init()
    probe = Probe(float(rate), float(seconds) + WARM_SECONDS, sent == 'twists', heard)
    if not probe.connected():
        sys.exit('no answer: the node that is measured was not found')
    gc.freeze()
    before = used(int(pid))
    probe.play()
    print(json.dumps(_result(probe, before, used(int(pid)))))


def _result(probe: Probe, before: dict[str, float], after: dict[str, float]) -> dict[str, Any]:
    """Return what was measured."""
    counted = [stamp for stamp in probe.sent if stamp >= FIRST_NS + WARM_SECONDS * 1e9]
    return {
        'sent': len(probe.sent),
        'answered': len(probe.answered),
        'others': probe.others,
        'latency': [
            (probe.answered[stamp] - probe.sent[stamp]) * 1e-9
            for stamp in counted if stamp in probe.answered
        ],
        'stamps': [(stamp - FIRST_NS) * 1e-9 - WARM_SECONDS for stamp in counted
                   if stamp in probe.answered],
        'processor_seconds': after['seconds'] - before['seconds'],
        'memory': after['memory'],
    }


if __name__ == '__main__':
    main()
