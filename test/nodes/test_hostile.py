"""Whatever is sent to the real node, in whatever order: finite answers, counts, recovery."""

import math
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.serialization import serialize_message
from visualization_msgs.msg import MarkerArray

from .conftest import MS, PACKAGE, pose_at, stamp_ns, START

MESSAGES = 3000
BURST = 40
RECOVERED_WITHIN_NS = 200 * MS
ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e150, 0.0, 3.0)
LEAPS = (2 * MS,) * 8 + (0, 1, -1, -2 * MS, 50 * MS, 600 * MS, -10**10, 10**10, -40 * MS)
FRAMES = ('base',) * 6 + ('map', '', 'ü' * 300)
RELIABLE = {
    f'qos_overrides.{topic}.subscription.{policy}': value
    for topic in ('/tool_arm/pose', '/tool_arm/twist')
    for policy, value in (('reliability', 'reliable'), ('depth', 5000))
}


class Attacker:
    """Sends what nobody should send, and what cannot even be read."""

    def __init__(self, partner, seed):
        """Begin in order."""
        self._partner, self._rng, self._stamp = partner, np.random.default_rng(seed), START
        self.poses = self.raw = 0

    def send(self):
        """Send one message of any kind."""
        rng = self._rng
        chance = rng.random()
        if chance < 0.03:
            self._send_bytes()
            return
        stamp = max(0, self._stamp + int(rng.choice(LEAPS)))
        self._stamp = max(START, stamp)
        if chance < 0.6:
            self.poses += 1
            self._partner.send_pose(
                stamp, self._vector(), self._quaternion(), str(rng.choice(FRAMES)))
        else:
            self._partner.send_twist(stamp, self._vector(), self._vector())

    def _send_bytes(self):
        """Send bytes that are no message, or one whose text is none."""
        self.raw += 1
        whole = serialize_message(pose_at(0, frame_id='base'))
        broken = (
            whole[:int(self._rng.integers(len(whole)))],
            whole[:12] + b'\xff' * 4 + whole[16:],  # a text that is longer than all
            whole.replace(b'base', b'\xff\xfe\xfd\xfc'),
            self._rng.bytes(100),
        )
        self._partner.pose_writer.publish(broken[self._rng.integers(len(broken))])

    def _vector(self):
        """Return a vector, mostly of an arm at rest."""
        values = 1e-4 * self._rng.standard_normal(3)
        if self._rng.random() < 0.25:
            values[self._rng.integers(3)] = self._rng.choice(ODD)
        return [float(x) for x in values]

    def _quaternion(self):
        """Return a quaternion, mostly upright."""
        if self._rng.random() < 0.8:
            return [0.0, 0.0, 0.0, 1.0]
        return [float(x) for x in self._rng.choice((*ODD, 0.5, -0.5), size=4)]


def numbers(part):
    """Yield all numbers with a fraction in a message."""
    if isinstance(part, float):
        yield part
    elif hasattr(part, 'get_fields_and_field_types'):
        for name in part.get_fields_and_field_types():
            yield from numbers(getattr(part, name))
    elif isinstance(part, list | tuple | np.ndarray) or hasattr(part, 'typecode'):
        for item in part:
            yield from numbers(item)


def stamps_from(begin, poses):
    """Return the stamps (ns) that are not before a time, in the order in which they came."""
    return [stamp for stamp in map(stamp_ns, poses) if stamp >= begin]


def listen(partner):
    """Return what will hold everything the predictor publishes beside poses and twists."""
    heard: list[Any] = []
    for kind, topic in ((PoseStamped, 'cup/deflection'), (Odometry, 'package/odometry'),
                        (MarkerArray, 'package/markers')):
        partner.hears(kind, topic, decode=heard.append)
    partner.connect()
    return heard


def test_nothing_breaks_the_node_and_it_comes_back(make_partner):
    """Count every message, publish one finite prediction for each pose taken, and recover."""
    partner = make_partner({**PACKAGE, **RELIABLE})
    heard, attacker = listen(partner), Attacker(partner, 1)
    for k in range(MESSAGES):
        attacker.send()
        if k % BURST == 0:
            partner.ros.executor.spin_once(timeout_sec=0.0)
    live = partner.predictor._live
    partner.wait_for_inputs(attacker.poses)
    assert partner.ros.spin_until(lambda: live.pairing.waiting == 0)
    assert attacker.raw and attacker.poses <= live.poses_in <= attacker.poses + attacker.raw
    partner.wait_for_poses(live.predictions)
    refused = sum(n for name, n in live.refused.items() if not name.startswith('twist'))
    assert refused > MESSAGES / 20 and live.predictions > MESSAGES / 20
    assert live.predictions + refused <= live.poses_in

    begin = time.time_ns()
    for k in range(120):  # good poses of a tool that stands still
        partner.send_pose(begin + k * 2 * MS, frame_id='base')
        partner.ros.spin_until(lambda: False, 0.002)
    assert partner.ros.spin_until(lambda: len(stamps_from(begin, partner.poses)) > 10)
    assert stamps_from(begin, partner.poses)[0] - begin <= RECOVERED_WITHIN_NS
    everything = [*partner.poses, *partner.twists, *partner.wrenches, *heard]
    assert len(heard) > len(partner.poses)
    assert all(math.isfinite(x) for message in everything for x in numbers(message))
