"""Hostile messages to the real node over DDS: finite answers, every pose counted, recovery."""

from contextlib import contextmanager
import math
import re
import time

from bellows_ros.nodes.predictor_node import PredictorNode
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.serialization import serialize_message
from visualization_msgs.msg import MarkerArray

from .frame import CLEAN, COUNTED, Failed
from .readers import ATTEMPTS
from ..conftest import private_ros
from ..nodes.conftest import MS, overrides_of, PACKAGE, Partner, pose_at, stamp_ns, START, UPRIGHT

BURST = 100  # messages of an attempt
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
        self.poses = 0

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
        return values

    def _quaternion(self):
        """Return a quaternion, mostly upright."""
        rng = self._rng
        return UPRIGHT if rng.random() < 0.8 else rng.choice((*ODD, 0.5, -0.5), size=4)


def require_good(partner, heard):
    """Fail on callbacks that failed and on numbers that are not finite; forget what came."""
    if partner.predictor.failures:
        raise Failed(f'callbacks failed: {dict(partner.predictor.failures)}')
    for messages_ in (partner.poses, partner.twists, partner.wrenches, heard):
        if re.search(r'\b(nan|inf)\b', repr(messages_)):
            raise Failed('a number that is not finite was published')
        messages_.clear()


@contextmanager
def connected(given):
    """Give a predictor of its own, and what sends messages to it."""
    with private_ros('--ros-args', '--log-level', 'fatal') as ros:
        predictor = PredictorNode(
            context=ros.context, parameter_overrides=overrides_of({**given, **RELIABLE}))
        ros.executor.add_node(predictor)
        yield Partner(ros, predictor)


def messages(rng, folder):
    """Send bursts of what nobody should send, and then good poses, which must be answered."""
    with connected(PACKAGE) as partner:
        heard = []
        for kind, topic in ((PoseStamped, 'cup/deflection'), (Odometry, 'package/odometry'),
                            (MarkerArray, 'package/markers')):
            partner.hears(kind, topic, decode=heard.append)
        partner.connect()
        attacker = Attacker(partner, int(rng.integers(2**31)))
        for number in range(ATTEMPTS):
            yield burst(partner, attacker, heard, number)


def burst(partner, attacker, heard, number):
    """Send hostile messages, then good ones, and return what became of the hostile ones."""
    live = partner.predictor.pipeline.live
    before, sent = sum(live.refused.values()), attacker.poses

    def is_answered():
        return any(stamp_ns(pose) >= good for pose in partner.poses)

    for _ in range(BURST):
        attacker.send()
    good = time.time_ns()
    if not partner.ros.spin_until(lambda: live.poses_in >= attacker.poses, 10.0):
        raise Failed(f'{live.poses_in} of {attacker.poses} poses were taken')
    attacker.poses = live.poses_in  # bytes that could be read as a pose are poses
    for k in range(200):
        partner.send_pose(good + k * 2 * MS, frame_id='base')
        attacker.poses += 1
        partner.ros.spin_until(lambda: False, 0.002)
        if is_answered():
            break
    if not partner.ros.spin_until(is_answered, 5.0):
        raise Failed('good poses were not answered')
    require_good(partner, heard)
    return COUNTED if sum(live.refused.values()) > before or sent == attacker.poses else CLEAN
