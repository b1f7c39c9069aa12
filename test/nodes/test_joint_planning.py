"""Plans of an arm's joints over DDS: predicted, steered in the same joints, refused."""

from bellows_ros.core.geometry.lie import log_se3, rotation_to_quaternion, transform
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.core.planning.points import plan_of_joints
from bellows_ros.core.planning.steering import steer
from bellows_ros.files.plan_messages import decode_multi_dof
from builtin_interfaces.msg import Duration
import numpy as np
import pytest
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory

from .conftest import LATCHED, ORIGIN
from .test_planning import in_frame, MODEL, swing_left, VALUES
from ..core.planning.arms import UR5E, UR5E_START

ARM = read_arm(UR5E, 'tool')
T = np.linspace(0.0, 0.8, 81)
S = T / 0.8
POSITION = np.array(UR5E_START) + np.outer(
    S**3 * (10 - 15 * S + 6 * S**2), [0.3, -0.2, 0.2, 0.1, 0.2, -0.3])


class JointPlanner:
    """A partner that sends plans of joints and keeps the answers."""

    def __init__(self, partner, urdf):
        """Connect the topics."""
        self.partner, self.wait = partner, partner.wait
        self.plans = partner.hears(
            MultiDOFJointTrajectory, 'package/plan', decode=decode_multi_dof, raw=True)
        self.steered = partner.hears(JointTrajectory, 'tool_arm/steered_joints')
        self.plan_out, self.steer_out = (
            partner.writes(JointTrajectory, f'tool_arm/{name}_joints')
            for name in ('plan', 'steer'))
        partner.writes(String, 'robot_description', LATCHED).publish(String(data=urdf))
        partner.connect()
        planning = partner.predictor.pipeline.planning
        self.wait(lambda: planning.reader._urdf and planning._plan_out.subscribed)


def seconds_of(point):
    """Return the time of a point."""
    return point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec


def message(position=POSITION, names=ARM.moving):
    """Return joint positions as a message."""
    return JointTrajectory(joint_names=names, points=[
        JointTrajectoryPoint(
            positions=q.tolist(), time_from_start=Duration(nanosec=round(1e9 * t)))
        for t, q in zip(T, position, strict=True)])


@pytest.fixture
def planner(make_partner):
    """Give a predictor that knows the arm."""
    return JointPlanner(make_partner(VALUES.replaced({'tool_link': 'tool'})), UR5E)


def test_a_plan_of_joints_is_answered_and_steered_in_them(planner):
    """The package along the plan, and joints that move the tool as the inverse wants it."""
    planner.plan_out.publish(message())
    planner.wait(lambda: planner.plans)
    planner.steer_out.publish(message())
    planner.wait(lambda: planner.steered)

    (answer,) = planner.steered
    assert tuple(answer.joint_names) == ARM.moving
    plan, _ = plan_of_joints(ARM, ARM.moving, np.round(1e9 * T).astype(np.int64), POSITION)
    wanted = steer(MODEL, plan, 'inverse').tool
    rows = np.searchsorted(wanted.seconds, np.array(list(map(seconds_of, answer.points))) - 1e-6)
    found, _ = ARM.tool(np.array([p.positions for p in answer.points]))
    off = log_se3(np.linalg.inv(
        transform(wanted.rotation[rows], wanted.position[rows])) @ found)
    assert np.abs(off[:, :3]).max() < 0.05e-3 and np.abs(off[:, 3:]).max() < 0.1e-3
    assert len(answer.points[1].velocities) == len(answer.points[1].accelerations) == 6


def test_joints_lead_to_a_flange_with_the_tip_beside_it(make_partner):
    """The package hangs where the tip is, not where the link is, and steering moves the tip."""
    planner = JointPlanner(make_partner({
        **VALUES, 'tool_link': 'tool', 'tool_pose.offset': '0.01 -0.02 -0.05 0 0 0 1'}), UR5E)
    planner.plan_out.publish(message())
    planner.wait(lambda: planner.plans)
    (at_start,), _ = ARM.tool(POSITION[:1])
    tip = transform(np.eye(3), np.array([0.01, -0.02, -0.05]))
    tool = at_start @ tip
    still = (tuple(tool[:3, 3]), tuple(rotation_to_quaternion(tool[:3, :3])), ORIGIN, ORIGIN)
    np.testing.assert_allclose(
        planner.plans[0].poses[0, :3], static_equilibrium(MODEL, still)[0], atol=1e-5)

    planner.steer_out.publish(message())
    planner.wait(lambda: planner.steered)
    points = planner.steered[0].points
    times = np.array([round(1e9 * seconds_of(point)) for point in points])
    flange, _ = ARM.tool(np.array([p.positions for p in points]))
    ends = ARM.tool(POSITION[[0, -1]])[0]
    np.testing.assert_allclose(flange[[0, -1]], ends, atol=1e-4)
    poses = np.hstack([flange[:, :3, 3], rotation_to_quaternion(flange[:, :3, :3])])
    of_tip = swing_left(times, in_frame(poses, tip))
    assert of_tip < 0.05
    assert swing_left(times, poses) > 3.0 * of_tip


@pytest.mark.parametrize(('change', 'named'), [
    ({'names': ('a', 'b', 'c', 'd', 'e', 'f')}, 'shoulder_pan'),
    ({'position': np.full((81, 6), np.nan)}, 'nan')])
def test_a_bad_plan_of_joints_is_refused(planner, change, named):
    planner.plan_out.publish(message(**change))
    planning = planner.partner.predictor.pipeline.planning
    planner.wait(lambda: planning.status)
    assert planning.status.level == 1 and named in planning.status.message.lower()
    assert not planner.plans
