"""Plans over DDS: answered from rest, steered if asked, refused when bad; the landing."""

import time

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import plan_of, plan_of_joints
from bellows_ros.core.planning.steering import steer
from bellows_ros.files.plans import encode, MULTI_DOF, Plan, plans_of
from bellows_ros.nodes.conversions import vector
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
import numpy as np
from numpy.testing import assert_allclose
import pytest
from std_msgs.msg import Bool, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory

from .conftest import LATCHED, MS, set_on, stamp_ns, START
from ..cell.cup import CUP, GRIP, PACKAGE, VALUES
from ..cell.motion import Move
from ..core.planning.arms import UR5E, UR5E_START

VALUES = VALUES.replaced({
    'cup.lip_radius': 0.02, 'vacuum.holding': 60e3, 'tool_twist.frame': 'tool'})
MODEL = model_tuple(CUP, PACKAGE, 9.81)
MOVE = Move([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0)
ARM = read_arm(UR5E, 'tool')
TIMES = np.linspace(0.0, 0.8, 81)
S = TIMES / 0.8
JOINTS = np.array(UR5E_START) + np.outer(
    S**3 * (10 - 15 * S + 6 * S**2), [0.3, -0.2, 0.2, 0.1, 0.2, -0.3])


def message(move=MOVE, **changes):
    """Return a move as a message."""
    return Plan(MULTI_DOF, 0, 'world', ('tool',), *move.points(500))._replace(**changes)


def only_plan(received):
    """Return the plan in a message."""
    found, = plans_of(received)
    return found


def joint_plan(position=JOINTS):
    """Return joint positions as a message."""
    return JointTrajectory(joint_names=ARM.moving, points=[
        JointTrajectoryPoint(
            positions=q.tolist(), time_from_start=Duration(nanosec=round(1e9 * t)))
        for t, q in zip(TIMES, position, strict=True)])


def residual_swing(times_ns, poses, twists=None):
    """Return the swing (degrees) at rest after a motion of the tool, by the model alone."""
    tool = plan_of(times_ns, poses, twists, twist_frame='tool').trajectory()
    return float(np.degrees(PlanSimulation(MODEL, None, tool).predict().summary()['swing_left']))


class Planner:
    """A partner that also sends plans and keeps the answers."""

    def __init__(self, partner):
        """Connect all topics of plans."""
        self.partner, self.wait = partner, partner.wait
        plan, hears = MultiDOFJointTrajectory, partner.hears
        self.plans = hears(plan, 'package/plan', decode=only_plan)
        self.paths = hears(Path, 'package/plan_path')
        self.steered = hears(plan, 'tool_arm/steered', decode=only_plan)
        self.steered_joints = hears(JointTrajectory, 'tool_arm/steered_joints')
        self.health = hears(DiagnosticArray, '/diagnostics')
        self.plan_out = partner.writes(plan, 'tool_arm/plan')
        self.joints_out = partner.writes(JointTrajectory, 'tool_arm/plan_joints')
        partner.writes(String, 'robot_description', LATCHED).publish(String(
            data=UR5E.replace(f'"{ARM.root}"', '"world"')))
        partner.connect()
        self.planning = planning = partner.predictor.pipeline.planning
        self.wait(lambda: planning._urdf and self.is_idle() and all(
            topic.subscribed for topic in (
                planning._plan_out, planning._path_out, planning._steered,
                planning._steered_joints)))

    def send(self, plan):
        """Send a plan of the tool."""
        self.plan_out.publish(encode(plan))

    def is_idle(self):
        """Tell whether nothing is being answered."""
        return self.planning._answering.done() or not self.planning._answering.running()

    def status(self):
        """Return the diagnostics of the plan, once there are some."""
        self.wait(lambda: self.planning.status)
        return self.planning.status


@pytest.fixture
def planner(make_partner):
    """Give a predictor and a sender of plans to it."""
    return Planner(make_partner(VALUES.replaced({'tool_link': 'tool'})))


def test_a_plan_is_answered_from_rest_and_steered(planner):
    """Before any pose has come, with a summary."""
    planner.send(message())
    planner.wait(lambda: planner.plans and planner.paths and planner.steered)
    (found,), (path,), (steered,) = planner.plans, planner.paths, planner.steered
    truth = PlanSimulation(MODEL, GRIP, MOVE.plan(500)).predict()
    assert found.names == ('package',) and len(path.poses) == len(found.times_ns) == 501
    assert_allclose(found.points[:, :3], truth.states[:, :3], atol=0.2e-6)
    assert_allclose(found.rates, truth.states[:, 7:], atol=1e-4)
    assert_allclose(vector(path.poses[-1].pose.position), truth.states[-1, :3], atol=0.2e-6)
    assert residual_swing(steered.times_ns, steered.points, steered.rates) < 0.1
    assert_allclose(float(planner.status().values['smallest_safety_factor']),
                    truth.smallest_safety[0], rtol=1e-3)
    planner.wait(lambda: any(
        line.name.endswith('plan') for m in planner.health for line in m.status))
    planner.send(message(Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)))
    planner.wait(lambda: len(planner.plans) == 2)
    status = planner.status()
    assert status.level == 2 and 'the cup lets go' in status.message and 'peel' in status.message


def test_a_plan_of_joints_is_answered_and_steered_in_them(planner):
    """The package along the plan, and joints that move the tool as the steered plan does."""
    planner.joints_out.publish(joint_plan())
    planner.wait(lambda: planner.plans and planner.steered_joints)
    (answer,) = planner.steered_joints
    assert tuple(answer.joint_names) == ARM.moving
    plan, _ = plan_of_joints(ARM, ARM.moving, np.round(1e9 * TIMES).astype(np.int64), JOINTS)
    wanted = steer(MODEL, plan, 'zvd').tool
    seconds = np.array([
        p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in answer.points])
    rows = np.searchsorted(wanted.seconds, seconds - 1e-6)
    found, _ = ARM.tool(np.array([p.positions for p in answer.points]))
    off = lie.log_se3(np.linalg.inv(
        lie.transform(wanted.rotation[rows], wanted.position[rows])) @ found)
    assert np.abs(off[:, :3]).max() < 0.05e-3 and np.abs(off[:, 3:]).max() < 0.1e-3
    assert len(answer.points[1].velocities) == len(answer.points[1].accelerations) == 6


@pytest.mark.parametrize(('bad', 'named'), [
    (message(frame_id='elsewhere'), "'elsewhere'"),
    (message(times_ns=np.array([0, 61 * 10**9]), points=np.eye(1, 7, 6).repeat(2, 0),
             rates=np.zeros((2, 6))), '61 s'),
    (joint_plan(np.full((81, 6), np.nan)), 'nan'),
], ids=['frame', 'too long to steer', 'NaN joints'])
def test_a_bad_plan_is_rejected_and_the_next_is_answered(planner, bad, named):
    """Say why on /diagnostics; the prediction continues."""
    planner.partner.send_twist(START)
    planner.partner.predict(START)
    if isinstance(bad, JointTrajectory):
        planner.joints_out.publish(bad)
    else:
        planner.plan_out.publish(encode(bad))
    planner.wait(lambda: (status := planner.planning.status) and status.level)
    assert planner.status().level == 1 and named.lower() in planner.status().message.lower()
    assert not planner.steered and not planner.steered_joints
    planner.partner.send_twist(START + MS)
    planner.partner.predict(START + MS)
    assert not planner.partner.predictor.failures
    planner.send(message())
    planner.wait(lambda: planner.steered and planner.status().level == 0)


def test_a_newer_plan_replaces_one_that_takes_long(planner):
    """Stop what is not wanted any more: for a newer plan, for the end of the active state."""
    predictor = planner.partner.predictor
    times = np.arange(0, 600 * 10**9 + 1, 10 * MS)
    long = message(times_ns=times, points=np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (len(times), 1)),
                   rates=np.zeros((len(times), 6)))
    for _ in range(3):
        planner.send(long)
    planner.send(message())
    begun = time.process_time()
    planner.wait(lambda: any(len(plan.times_ns) == 501 for plan in planner.plans))
    assert time.process_time() - begun < 5.0
    planner.send(long)
    predictor.trigger_deactivate()
    planner.wait(planner.is_idle)
    assert planner.planning.status is None and not predictor.failures


@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_a_package_too_heavy_for_its_cup_does_not_fail_the_warm_up(partner):
    """Refuse its plan, and answer as soon as the package can be held."""
    predictor = partner.predictor
    usual = predictor.values.package.mass
    set_on(predictor, 'package.mass', 1000.0 * usual)
    planner = Planner(partner)
    planner.send(message())
    planner.wait(lambda: (status := predictor.pipeline.planning.status) and status.level)
    assert not predictor.failures
    set_on(predictor, 'package.mass', usual)
    planner.send(message())
    planner.wait(lambda: planner.plans)


def test_the_landing_is_published_once_at_the_release(make_partner):
    """And the package is detached until the valve is on again."""
    partner = make_partner(VALUES.replaced({
        'package.size': (0.3, 0.3, 0.02), 'landing.height': -0.5, 'release.delay': 0.02,
        'release.std': (0.002, 0.0, 0.0, 0.0, 0.0, 0.0)}))
    landings = partner.hears(PoseWithCovarianceStamped, 'package/landing')
    valve, live = partner.writes(Bool, 'vacuum/valve'), partner.predictor.pipeline.live
    partner.connect()
    topic = partner.predictor.pipeline.outputs.landing
    partner.wait(lambda: topic.subscribed)
    partner.send_twist(START)
    partner.predict(START)
    valve.publish(Bool(data=False))
    partner.wait(lambda: landings and live.state == 'released' and not live.attached)
    (landing,) = landings
    assert landing.pose.pose.position.z == pytest.approx(-0.49, abs=0.01)
    assert 0.2e9 < stamp_ns(landing) - START < 0.4e9
    assert np.isfinite(landing.pose.covariance).all() and landing.pose.covariance[0] > 0.0
    valve.publish(Bool(data=True))
    partner.wait(lambda: live.state == 'gripped')
    partner.send_twist(START + 4 * MS)
    partner.predict(START + 4 * MS)
