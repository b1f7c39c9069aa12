"""A flood of messages at 20 kHz, valid or not, at a predictor in a process of its own."""

import math
import os
from pathlib import Path
import time

from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message

from .conftest import MS, Peer, pose_at, stamp_ns, START

RATE, COUNT = 20_000, 12_000
LARGEST_GROWTH = 1_000_000  # bytes
KINDS = ('valid', 'valid', 'not finite', 'standing stamp', 'not readable')
"""Kinds of floods; the first two warm up what a flood needs."""


class Victim(Peer):
    """A predictor in another process, and what is sent to it."""

    def __init__(self, ros, process):
        """Join the graph and wait for the other."""
        super().__init__(ros, 'driver')
        self.process = process
        self._pose = pose_at(START, frame_id='base')
        self._ns = START
        self.answers = self.hears(PoseStamped, 'package/pose', 3 * COUNT, self._stamp)
        self._writer = self.writes(PoseStamped, 'tool_arm/pose', 10)
        self.connect()

    @staticmethod
    def _stamp(message):
        """Return the stamp of an answer, which must be finite."""
        assert math.isfinite(message.pose.position.x + message.pose.orientation.w)
        return stamp_ns(message)

    def send(self, after_ns, x=0.0):
        """Send a pose with a stamp so much later than the last."""
        self._ns += after_ns
        self._pose.header.stamp.sec, self._pose.header.stamp.nanosec = divmod(self._ns, 10**9)
        self._pose.pose.position.x = x
        self._writer.publish(self._pose)

    def flood(self, kind):
        """Send many messages of a kind."""
        unreadable = serialize_message(self._pose)[:-20]
        begin = time.monotonic()
        for k in range(COUNT):
            if k % 100 == 0:
                time.sleep(max(0.0, begin + k / RATE - time.monotonic()))
            if kind == 'not readable':
                self._writer.publish(unreadable)
            else:
                self.send(0 if kind == 'standing stamp' else 50_000,
                          math.nan if kind == 'not finite' else 0.0)

    def is_back(self):
        """Send poses at 500 Hz, and tell whether each is answered from 0.2 s on."""
        self.ros.spin_until(lambda: False, 0.3)  # what is in the queues is worked off
        sent = []
        for _ in range(150):
            self.send(2 * MS)
            sent.append(self._ns)
            self.ros.executor.spin_once(timeout_sec=0.002)
        expected = set(sent[100:])
        return bool(self.ros.spin_until(lambda: expected <= set(self.answers[-200:]), 10.0))

    def memory(self):
        """Return how many bytes of memory the predictor has."""
        pages = int(Path(f'/proc/{self.process.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE')


def test_a_flood_neither_kills_nor_grows_nor_leaves_a_trace(ros, run_predictor):
    """Survive each flood with the memory it had, and answer each pose afterwards."""
    victim, memory = Victim(ros, run_predictor()), []
    for kind in KINDS:
        victim.flood(kind)
        assert victim.process.poll() is None, kind
        assert any(victim.is_back() for _ in range(3)), kind  # messages are best effort
        memory.append(victim.memory())
    assert max(memory[2:]) - memory[1] < LARGEST_GROWTH, memory
    victim.process.terminate()
    _, log = victim.process.communicate(timeout=200)
    assert victim.process.returncode == 0 and 'Traceback' not in log, log
