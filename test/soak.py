"""
Run a predictor for minutes at 1 kHz over DDS, and measure its memory and its losses.

    python -m test.soak [--seconds 300] [--rate 1000]

Ends with 1 if a prediction was lost, or if the memory of the predictor grew by 1 MB or more after
its warm-up.
"""

import argparse
from contextlib import contextmanager
import math
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from threading import Thread
import time

from bellows_ros.demo.domain import isolate

PACKAGE = [
    '-p', 'package.mass:=2.17', '-p', 'package.inertia:=[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]',
    '-p', 'package.com:=[0.0, 0.0, -0.03]',
]
RELIABLE = [
    word for topic in ('/tool_arm/pose', '/tool_arm/twist') for word in (
        '-p', f'qos_overrides.{topic}.subscription.reliability:=reliable',
        '-p', f'qos_overrides.{topic}.subscription.depth:=1000')
]
QUEUE = 5000
ANSWERS = 200_000
"""Answers kept until they are counted: what is lost was lost by the predictor."""

WARM_UP = 0.1
"""Part of the time after which the memory is to stay as it is; at least 20 s."""

LARGEST_GROWTH = 1_000_000
AMPLITUDE, FREQUENCY = 0.05, 1.0
NS = 1_000_000_000


@contextmanager
def predictor():
    """Run the node; its log goes to the screen if it does not end well."""
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [sys.executable, '-m', 'bellows_ros.nodes.predictor', '--ros-args', *PACKAGE,
             *RELIABLE], stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.terminate()
            if process.wait(20) != 0:
                log.seek(0)
                print(log.read().decode(errors='replace'), file=sys.stderr)


def resident(process):
    """Return the memory (bytes) of a process."""
    pages = int(Path(f'/proc/{process.pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


class Driver:
    """Sends poses and twists of a swinging tool, and counts the answers."""

    def __init__(self, node, seconds, rate):
        """Make the topics."""
        from geometry_msgs.msg import PoseStamped, TwistStamped

        self._pose, self._twist = PoseStamped(), TwistStamped()
        self._pose.header.frame_id = 'world'
        self._pose.pose.orientation.w = 1.0
        self._count, self._rate = round(seconds * rate), rate
        self.sent = self.answered = self.wrong = self.late = 0
        self._last_ns = 0
        self._reader = node.create_subscription(
            PoseStamped, 'package/pose', self._take, ANSWERS)
        self._twist_out = node.create_publisher(TwistStamped, 'tool_arm/twist', QUEUE)
        self._pose_out = node.create_publisher(PoseStamped, 'tool_arm/pose', QUEUE)

    def is_connected(self):
        """Tell whether the predictor is there."""
        return bool(
            self._reader.get_publisher_count() and self._twist_out.get_subscription_count()
            and self._pose_out.get_subscription_count())

    def _take(self, message):
        """Count an answer; it must be finite and newer than the one before."""
        stamp_ns = message.header.stamp.sec * NS + message.header.stamp.nanosec
        p = message.pose.position
        self.wrong += stamp_ns <= self._last_ns or not math.isfinite(p.x + p.y + p.z)
        self._last_ns = stamp_ns
        self.answered += 1

    def run(self):
        """Send all messages at their times."""
        begin, begin_ns = time.monotonic(), time.time_ns()
        for k in range(self._count):
            t = k / self._rate
            if (left := begin + t - time.monotonic()) > 0.0:
                time.sleep(left)
            else:
                self.late += left < -0.1
            self._send(t, begin_ns + round(t * NS))

    def _send(self, t, stamp_ns):
        """Send the pose and the twist of one instant."""
        phase, rate = 2.0 * math.pi * FREQUENCY * t, 2.0 * math.pi * FREQUENCY
        for message in (self._pose, self._twist):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS)
        self._pose.pose.position.x = AMPLITUDE * math.sin(phase)
        self._twist.twist.linear.x = AMPLITUDE * rate * math.cos(phase)
        self._pose_out.publish(self._pose)
        self._twist_out.publish(self._twist)
        self.sent += 1


def soak(seconds, rate):
    """Run, report, and return whether all is well."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    rclpy.init(args=[])
    node, executor = Node('soak'), SingleThreadedExecutor()
    executor.add_node(node)
    with predictor() as process:
        driver = Driver(node, seconds, rate)
        deadline = time.monotonic() + 90.0
        while not driver.is_connected() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        sending = Thread(target=driver.run, daemon=True)
        begin, warm, base, said = time.monotonic(), max(20.0, WARM_UP * seconds), 0, 0.0
        sending.start()
        while sending.is_alive() and process.poll() is None:
            executor.spin_once(timeout_sec=0.1)
            elapsed = time.monotonic() - begin
            if not base and elapsed > warm:
                base = resident(process)
            if elapsed > said:
                said += 10.0
                print(f'{elapsed:5.0f} s  sent {driver.sent}  answered {driver.answered}  '
                      f'memory {resident(process) / 1e6:.2f} MB', flush=True)
        deadline = time.monotonic() + 5.0
        while driver.answered < driver.sent and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        growth = resident(process) - base if base else 0
    rclpy.try_shutdown()
    lost = driver.sent - driver.answered
    print(f'sent {driver.sent}, lost {lost}, not finite or out of order {driver.wrong}, sent more '
          f'than 0.1 s late {driver.late}, memory grew by {growth / 1e6:.3f} MB '
          f'after {warm:.0f} s')
    return driver.sent > 0 and lost == 0 and driver.wrong == 0 and growth < LARGEST_GROWTH


def main():
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=300.0)
    parser.add_argument('--rate', type=float, default=1000.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as logs:
        isolate(logs)
        return 0 if soak(given.seconds, given.rate) else 1


if __name__ == '__main__':
    sys.exit(main())
