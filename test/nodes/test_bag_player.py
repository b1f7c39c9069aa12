"""Playing recordings to ROS: real messages over DDS, in their time."""

import threading
import time
from typing import Any

from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_messages
from bellows_ros.nodes.bag_player import play, stamped
from geometry_msgs.msg import PoseStamped, TwistStamped
import numpy as np
import pytest

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


def test_stamps_of_now_keep_pairs_and_intervals(bag, heard):
    """Move all stamps to the time of playing, closer by the rate; twists grow by it."""
    messages, _ = read_messages(bag)
    before = time.time_ns()
    _, poses, twists = heard(lambda: play(messages, NAMES, 2.0, stamps_now=True))
    stamps = [stamp_ns(m) for _, m in poses]
    assert stamps == [stamp_ns(m) for _, m in twists]
    assert set(np.diff(stamps)) == {PERIOD_NS // 2}
    assert before - LATER_NS < stamps[0] < 1e9 * poses[0][0]
    assert [m.twist.linear.x for _, m in twists] == [2.0 * k for k in range(COUNT)]


def test_a_stamp_is_replaced_in_either_order_of_bytes():
    """Change eight bytes, and read the old ones first."""
    for order, name in ((b'\x00\x00\x00\x00', 'big'), (b'\x00\x01\x00\x00', 'little')):
        data = order + (7).to_bytes(4, name) + (5).to_bytes(4, name) + b'rest'
        seen: list[int] = []
        new = stamped(data, lambda ns, seen=seen: seen.append(ns) or 9_000_000_008)
        assert seen == [7_000_000_005]
        assert new == order + (9).to_bytes(4, name) + (8).to_bytes(4, name) + b'rest'
