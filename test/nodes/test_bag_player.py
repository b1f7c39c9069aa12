"""Playing recordings to ROS: real messages over DDS, in their time."""

import threading
import time
from typing import Any

from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_messages
from bellows_ros.nodes.bag_player import play
from geometry_msgs.msg import PoseStamped, TwistStamped
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock

from .conftest import stamp_ns, START

NAMES = {'/tool/pose': '/a', '/tool/twist': '/b'}
COUNT, PERIOD_NS, LATER_NS = 30, 20_000_000, 3_000_000
POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Give a recording of poses and twists with the same stamps, received some ms later."""
    stamps = START + PERIOD_NS * np.arange(COUNT)
    poses = np.column_stack([np.arange(COUNT), np.zeros((COUNT, 5)), np.ones(COUNT)])
    path = tmp_path_factory.mktemp('played') / 'bag'
    write_bag(path, [
        as_messages('/tool/pose', POSE, stamps, poses, log_times_ns=stamps + LATER_NS),
        as_messages('/tool/twist', TWIST, stamps, poses[:, :6], log_times_ns=stamps + LATER_NS),
    ])
    return path


@pytest.fixture
def heard(peer):
    """Give a function that listens while something is played, and returns what came and when."""
    def listen(work):
        got: dict[str, list[tuple[float, Any]]] = {name: [] for name in NAMES.values()}
        for name, kind in zip(got, (PoseStamped, TwistStamped), strict=True):
            peer.node.create_subscription(
                kind, name, lambda m, info, to=got[name]: to.append(
                    (1e-9 * info['source_timestamp'], m)), 1000)
        done: list[Any] = []
        player = threading.Thread(target=lambda: done.append(work()), daemon=True)
        player.start()
        peer.wait(lambda: not player.is_alive() and all(len(x) >= COUNT for x in got.values()))
        return done[0], *got.values()

    return listen


def test_messages_come_as_recorded_and_in_time(bag, heard):
    """Send the very stamps and numbers, at twice the speed, under another name."""
    messages, notes = read_messages(bag)
    begun = time.time()
    played, poses, twists = heard(lambda: play(messages, NAMES, 2.0))
    assert notes == [] and played.messages == {'/a': COUNT, '/b': COUNT} and played.has_subscriber
    assert [stamp_ns(m) for _, m in poses] == [START + PERIOD_NS * k for k in range(COUNT)]
    assert [m.pose.position.x for _, m in poses] == list(map(float, range(COUNT)))
    assert [m.twist.linear.x for _, m in twists] == list(map(float, range(COUNT)))
    duration = 1e-9 * PERIOD_NS * (COUNT - 1) / 2.0
    assert played.duration == pytest.approx(duration)
    due = 1e-9 * PERIOD_NS * np.arange(COUNT) / 2.0
    sent = np.array([at for at, _ in poses])
    assert np.all(sent - begun >= due)  # a busy machine makes some late, and none early


def test_the_clock_of_the_recording_is_published(bag, heard, peer):
    """Let nodes with use_sim_time follow the recording, each message after its time."""
    clock = peer.hears(Clock, '/clock')
    messages, _ = read_messages(bag)
    heard(lambda: play(messages, NAMES, 2.0, clock=True))
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in clock]
    assert times == [START + LATER_NS + PERIOD_NS * k for k in range(COUNT)]
