"""Hostile plans, measured poses, valves, requests and parameters to the real node over DDS."""

import time

from bellows_ros.core.parameters.table import parameters_for
from bellows_ros.files.plan_messages import encode_multi_dof, PlanMessage
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.parameter import Parameter
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool, Header
from trajectory_msgs.msg import MultiDOFJointTrajectory

from .frame import CLEAN, COUNTED, damaged, Failed
from .messages import connected, ODD, require_good
from .readers import ATTEMPTS
from ..nodes.conftest import pose_at, UPRIGHT
from ..nodes.test_node_parameters import ends

EACH = 20  # messages of an attempt
PATIENCE = 20.0
GIVEN = {
    'package.mass': 1.8, 'package.com': [0.0, 0.0, -0.03], 'package.size': [0.2, 0.2, 0.1],
    'package.inertia': [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0], 'landing.height': -1.0,
    'landing.aim': True, 'cup.lip_radius': 0.03, 'vacuum.holding': 60e3,
    'vacuum.signal': 'pressure', 'payload.estimate': True,
}
AWAY_NS = (0, 1, -1, 10**6, 10**8, -10**9, 10**10, 86_400 * 10**9, 3 * 10**17, -10**18)


class Requester:
    """Sends to all topics beside those of poses what nobody should send."""

    def __init__(self, partner, rng):
        """Connect all topics."""
        self.partner, self.rng = partner, rng
        self.heard = []
        for kind, topic in (
                (Odometry, 'package/odometry'), (Odometry, 'package/predicted_at'),
                (PoseWithCovarianceStamped, 'package/landing'), (Header, 'release/at'),
                (MultiDOFJointTrajectory, 'package/plan'),
                (MultiDOFJointTrajectory, 'tool_arm/steered')):
            partner.hears(kind, topic, decode=self.heard.append)
        self.plan, self.steer, self.request, self.measured, self.valve, self.pressure = (
            partner.writes(kind, topic) for kind, topic in (
                (MultiDOFJointTrajectory, 'tool_arm/plan'),
                (MultiDOFJointTrajectory, 'tool_arm/steer'), (Header, 'package/predict_at'),
                (PoseStamped, 'package/measured'), (Bool, 'vacuum/valve'),
                (FluidPressure, 'vacuum/pressure')))
        self.wait('the topics', partner.is_connected)

    def wait(self, what, condition):
        """Spin until something is so."""
        if not self.partner.ros.spin_until(condition, PATIENCE):
            raise Failed(f'waited in vain for {what}')

    def odd(self, value):
        """Return a number, now and then one that nobody should send."""
        return float(self.rng.choice(ODD)) if self.rng.random() < 0.02 else value

    def stamp(self, header, stamp_ns):
        """Stamp a header somewhere about a time, and return it."""
        stamp_ns = max(0, stamp_ns + int(self.rng.choice(AWAY_NS)))
        header.stamp.sec, header.stamp.nanosec = divmod(stamp_ns, 10**9)
        header.frame_id = str(self.rng.choice(('base', 'base', 'base', '', 'elsewhere')))
        return header

    def plan_bytes(self, stamp_ns, is_good=False):
        """Return a plan from the origin, whole or damaged."""
        rng = self.rng
        count = 100 if is_good else int(rng.choice((1, 2, 3, 100, 3000)))
        duration = 1.0 if is_good else float(rng.choice((1e-9, 0.01, 1.0, 60.0, 599.0, 1e9)))
        times = np.round(np.linspace(0.0, duration * 1e9, count)).astype(np.int64)
        s = np.linspace(0.0, 1.0, count)
        poses, twists = np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (count, 1)), np.zeros((count, 6))
        poses[:, 0] = 0.1 * s**3 * (10 - 15 * s + 6 * s * s)
        twists[:, 0] = 3.0 / duration * s * s * (1 - s) ** 2
        if not is_good and rng.random() < 0.3:
            part = (poses, twists)[rng.integers(2)]
            part[rng.integers(count), rng.integers(part.shape[1])] = rng.choice(ODD)
        away = 0 if is_good else int(rng.choice(AWAY_NS))
        whole = encode_multi_dof(PlanMessage(
            min(2 * 10**18, max(0, stamp_ns + away)), 'base', ('tool',), times, poses,
            twists if is_good or rng.random() < 0.7 else None))
        return damaged(rng, whole) if not is_good and rng.random() < 0.2 else whole

    def attack(self, stamp_ns):
        """Send or set one thing of any kind."""
        kind, rng = self.rng.integers(6), self.rng
        if kind == 0:
            (self.plan, self.steer)[rng.integers(2)].publish(self.plan_bytes(stamp_ns))
        elif kind == 1:
            self.request.publish(self.stamp(Header(), stamp_ns))
        elif kind == 2:
            message = pose_at(0, map(self.odd, (0.0, 0.0, -0.08)), map(self.odd, UPRIGHT))
            self.stamp(message.header, stamp_ns)
            self.measured.publish(message)
        elif kind == 3:
            self.valve.publish(Bool(data=bool(rng.random() < 0.5)))
        elif kind == 4:
            message = FluidPressure(fluid_pressure=self.odd(float(rng.choice((40e3, 100e3)))))
            self.stamp(message.header, stamp_ns)
            self.pressure.publish(message)
        else:
            self.set_one()

    def set_one(self):
        """Set a parameter to an end of its range or to what is none of its values, and back."""
        node = self.partner.predictor
        chosen = [p for p in parameters_for('predictor')
                  if p.kind.startswith('double') and not p.read_only]
        parameter = chosen[self.rng.integers(len(chosen))]
        before, values = node.get_parameter(parameter.name), ends(parameter)
        value = values[self.rng.integers(len(values))]
        if self.rng.random() < 0.3:
            odd = float(self.rng.choice(ODD))
            value = odd if parameter.kind == 'double' else [odd] * len(before.value)
        node.set_parameters([Parameter(parameter.name, value=value)])
        self.send_poses(2)
        if not all(result.successful for result in node.set_parameters([before])):
            raise Failed(f'{parameter.name} cannot be set back from {value}')

    def send_poses(self, count):
        """Send poses of a tool that stands; return the last stamp."""
        live = self.partner.predictor.pipeline.live
        for _ in range(count):
            stamp_ns, before = time.time_ns(), live.poses_in
            self.partner.send_pose(stamp_ns, frame_id='base')
            self.partner.send_twist(stamp_ns)
            # An executor that is called with another time each time serves the first topic first.
            self.partner.ros.spin_until(lambda: live.poses_in > before, 1.0)  # noqa: B023
            self.partner.ros.spin_until(lambda: False, 0.01)
        return stamp_ns


def requests(rng, folder):
    """Send hostile requests of all kinds; then the node must answer good ones as before."""
    with connected(GIVEN) as partner:
        requester = Requester(partner, rng)
        for number in range(ATTEMPTS):
            yield attempt(requester, deactivate=number % 5 == 4)


def attempt(requester, deactivate):
    """Attack, then ask for what must be answered; return what became of it."""
    partner, heard = requester.partner, requester.heard
    predictor, refused = partner.predictor, COUNTED
    for _ in range(EACH):
        requester.attack(requester.send_poses(1))
    if deactivate:
        begun = time.monotonic()
        predictor.trigger_deactivate()
        if time.monotonic() - begun > 5.0:  # 1 s, on a machine that does nothing else
            raise Failed('deactivating took more than 5 s')
        predictor.trigger_activate()
    else:
        refused = COUNTED if predictor.pipeline.planning._outcome is None else CLEAN
    requester.wait('the end of all work', lambda: not any(
        worker.is_busy for worker in predictor.workers))

    def predicts():
        requester.pressure.publish(FluidPressure(fluid_pressure=40e3))  # of best effort
        requester.valve.publish(Bool(data=True))
        requester.send_poses(1)
        return predictor.pipeline.held is not None

    requester.wait('a prediction', predicts)
    require_good(partner, heard)
    requester.plan.publish(requester.plan_bytes(0, is_good=True))
    requester.wait('an answer to a plan', lambda: any(
        isinstance(message, MultiDOFJointTrajectory) for message in heard))
    require_good(partner, heard)
    return refused
