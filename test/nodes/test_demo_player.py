"""The player of the demonstration, before a predictor that answers late; real DDS."""

from threading import Event, Thread
from typing import Any

from bellows_ros.files.bag_folder import Channel, Message
from bellows_ros.files.messages import encode, LAYOUTS
from bellows_ros.nodes import bag_player
from bellows_ros.nodes.bag_player import converse, POSES
from geometry_msgs.msg import PoseStamped
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from std_srvs.srv import Trigger

from .conftest import MS, Peer, stamp_ns, START

COUNT = 10
LATE = 2 * COUNT


class Late:
    """Answers one probe at once and again during the recording, and poses only after the last."""

    def __init__(self, ros):
        """Make the topics and the service of a predictor."""
        peer = Peer(ros, 'predictor')
        self._held: list[Any] = []
        self._probe: Any = None
        self._writer = peer.writes(PoseStamped, 'package/pose')
        peer.hears(PoseStamped, 'tool_arm/pose', decode=self._take)
        peer.node.create_service(Trigger, 'predictor/reset', lambda _, response: response)

    def _take(self, pose):
        """Answer a pose of the tool, or hold it back."""
        if stamp_ns(pose) < START:
            self._probe = self._probe or pose
            self._writer.publish(self._probe)
            return
        if not self._held:
            for _ in range(LATE):
                self._writer.publish(self._probe)
        self._held.append(pose)
        if len(self._held) == COUNT:
            for held in self._held:
                self._writer.publish(held)


@pytest.fixture
def late(ros):
    """Give a predictor that is spun beside the test."""
    late, stop = Late(ros), Event()

    def work():
        while not stop.is_set():
            ros.executor.spin_once(timeout_sec=0.05)

    thread = Thread(target=work, daemon=True)
    thread.start()
    yield late
    stop.set()
    thread.join(60.0)
    assert not thread.is_alive()


def test_late_answers_to_probes_are_no_predictions(late, monkeypatch):
    """Wait for the answers to the recording, however many to probes come during it."""
    monkeypatch.setattr(bag_player, 'ANSWER_TIMEOUT', 60.0)
    stamps = START + 20 * MS * np.arange(COUNT)
    topic = Channel('/arm', 'geometry_msgs/msg/PoseStamped', 'cdr')
    rows = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    poses = [Message(topic, *each) for each in zip(
        stamps.tolist(), map(bytes, encode(stamps, rows, ['world'], LAYOUTS[topic.type_name])),
        strict=True)]
    exchange = converse(poses, {'/arm': POSES}, lambda: None)

    assert_array_equal(exchange.predicted.stamps_ns, stamps)
    assert exchange.sent == {POSES: COUNT} and (exchange.latency > 0.0).all()
