"""The predictor node fed a recording with known truth over DDS, at the speed it was recorded."""

from itertools import islice
from threading import Event, Thread
import time

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

COUNT = 2400  # of 7201
IN_FLIGHT = 50
POSE, TWIST = '/tool_arm/pose', '/tool_arm/twist'


@pytest.fixture(scope='module')
def recording(rig):
    """Give the tool arm's messages in the order of their recording."""
    with AnyReader([rig / 'clean']) as reader:
        wanted = [c for c in reader.connections if c.topic in (POSE, TWIST)]
        return list(islice(
            ((when, connection.topic, reader.deserialize(raw, connection.msgtype))
             for connection, when, raw in reader.messages(wanted)), 2 * COUNT))


@pytest.fixture(scope='module')
def truth(rig):
    """Give the package's true poses, (N, 4, 4)."""
    with np.load(rig / 'clean_truth.npz') as file:
        return np.array(file['package'][:COUNT])


def stamp_ns(message):
    """Return the stamp of a message of rosbags or of rclpy."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def play(partner, recording, speed):
    """Send messages at the times of their recording, as a driver does in a thread of its own."""
    clock = Event()  # never set: it only waits
    begin, first, sent = time.monotonic(), recording[0][0], 0
    for when, topic, message in recording:
        clock.wait(begin + (when - first) * 1e-9 / speed - time.monotonic())
        while len(partner.poses) < sent - IN_FLIGHT and not clock.wait(1e-3):
            pass  # best effort: after a pause of this machine the queue must not be flooded
        if topic == POSE:
            sent += 1
            p, q = message.pose.position, message.pose.orientation
            partner.send_pose(stamp_ns(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w),
                              message.header.frame_id)
        else:
            v, w = message.twist.linear, message.twist.angular
            partner.send_twist(stamp_ns(message), (v.x, v.y, v.z), (w.x, w.y, w.z))


def errors(poses, truth):
    """Return the largest distance (m) and angle (rad) between poses and truth."""
    p = np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in poses])
    x, y, z, w = np.array([
        [m.pose.orientation.x, m.pose.orientation.y, m.pose.orientation.z, m.pose.orientation.w]
        for m in poses]).T
    R = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ], axis=-1).reshape(-1, 3, 3)
    chord = np.linalg.norm(R - truth[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)  # 2 sin(angle / 2)
    distance = np.linalg.norm(p - truth[:, :3, 3], axis=1)
    return float(distance.max()), float(2.0 * np.arcsin(chord.max() / 2.0))


@pytest.mark.parametrize(('with_twists', 'speed', 'distance', 'angle'), [
    pytest.param(True, 2.0, 0.2e-6, 3e-6, id='poses_and_twists'),
    # The stamps alone decide: the same messages sent faster give the same predictions.
    pytest.param(False, 3.0, 0.2e-3, 2e-3, id='poses_alone_three_times_as_fast'),
])
def test_predictions_meet_the_truth_and_none_is_lost(
        with_twists, speed, distance, angle, recording, truth, make_partner):
    """Publish as many poses, each near the true one."""
    partner = make_partner(with_twists=with_twists)
    sent = [item for item in recording if with_twists or item[1] == POSE]
    Thread(target=play, args=(partner, sent, speed), daemon=True).start()
    partner.ros.spin_until(lambda: len(partner.poses) >= COUNT)

    expected = [stamp_ns(message) for _, topic, message in recording if topic == POSE]
    assert [stamp_ns(m) for m in partner.poses] == expected
    assert len(expected) == len(truth) == COUNT
    largest_distance, largest_angle = errors(partner.poses, truth)
    assert largest_distance < distance
    assert largest_angle < angle
    live = partner.predictor._live
    assert sum(live.refused.values()) == 0
    assert live.twists_estimated == (0 if with_twists else COUNT)
