"""The predictor node fed a recording with known truth over DDS, at the speed it was recorded."""

from itertools import islice
from threading import Event, Thread
import time

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from .conftest import stamp_ns

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


def test_predictions_meet_the_truth_and_none_is_lost(recording, truth, make_partner):
    """Publish as many poses, each near the true one, at twice the speed."""
    partner = make_partner()
    Thread(target=play, args=(partner, recording, 2.0), daemon=True).start()
    partner.ros.spin_until(lambda: len(partner.poses) >= COUNT)
    expected = [stamp_ns(message) for _, topic, message in recording if topic == POSE]
    assert [stamp_ns(m) for m in partner.poses] == expected
    assert len(expected) == len(truth) == COUNT
    found = [message.pose for message in partner.poses]
    position = [[p.position.x, p.position.y, p.position.z] for p in found]
    assert np.linalg.norm(position - truth[:, :3, 3], axis=1).max() < 0.2e-6
    turns = Rotation.from_quat([
        [q.x, q.y, q.z, q.w] for q in (p.orientation for p in found)])
    assert (turns.inv() * Rotation.from_matrix(truth[:, :3, :3])).magnitude().max() < 3e-6
    live = partner.predictor._live
    assert sum(live.refused.values()) == 0
    assert live.twists_estimated == 0
