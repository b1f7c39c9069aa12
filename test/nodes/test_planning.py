"""Plans over DDS: answered before they are driven, followed while they are, refused when bad."""

from dataclasses import replace
import time

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import plan_of
from bellows_ros.core.planning.steering import hanging
from bellows_ros.files.plan_messages import decode_multi_dof, encode_multi_dof, PlanMessage
from bellows_ros.nodes.conversions import vector
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry, Path
import numpy as np
from numpy.testing import assert_allclose
import pytest
from std_msgs.msg import Header
from trajectory_msgs.msg import MultiDOFJointTrajectory

from .conftest import MS, overrides_of, pose_at, set_on, stamp_ns, START
from ..core import plans
from ..core.planning.test_steering import Smooth
from ..core.plans import CUP, GRIP, Move, PACKAGE

VALUES = plans.VALUES.replaced({
    'cup.lip_radius': 0.02, 'vacuum.holding': 60e3, 'tool_twist.frame': 'tool',
    'coast.limit': 0.0})
MODEL = model_tuple(CUP, PACKAGE, 9.81)
MOVE = Move([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0)


def message(move=MOVE, **changes):
    """Return a move as a message."""
    return replace(PlanMessage(0, 'world', ('tool',), *move.points(500)), **changes)


def swing_left(times_ns, poses, twists=None):
    """Return the swing (degrees) at rest after a motion of the tool, by the model alone."""
    tool = plan_of(times_ns, poses, twists, twist_frame='tool').trajectory()
    return float(np.degrees(PlanSimulation(MODEL, None, tool).predict().summary()['swing_left']))


def in_frame(poses, T):
    """Return poses of a frame that lies in theirs."""
    moved = lie.transform(lie.quaternion_to_rotation(poses[:, 3:]), poses[:, :3]) @ T
    return np.hstack([moved[:, :3, 3], lie.rotation_to_quaternion(moved[:, :3, :3])])


class Planner:
    """A partner that also sends plans and keeps the answers."""

    def __init__(self, partner):
        """Connect all topics of plans."""
        self.partner, self.wait = partner, partner.wait
        plan, hears = MultiDOFJointTrajectory, partner.hears
        self.plans = hears(plan, 'package/plan', decode=decode_multi_dof, raw=True)
        self.heard = {
            'path': hears(Path, 'package/plan_path'),
            'at': hears(Odometry, 'package/predicted_at'),
            'steered': hears(plan, 'tool_arm/steered', decode=decode_multi_dof, raw=True),
            'health': hears(DiagnosticArray, '/diagnostics')}
        self.plan_out, self.steer_out = (
            partner.writes(plan, f'tool_arm/{name}') for name in ('plan', 'steer'))
        self.request_out = partner.writes(Header, 'package/predict_at')
        partner.connect()
        planning = partner.predictor.pipeline.planning
        self.wait(lambda: (
            planning.plans.is_warm and planning.steering.is_warm and self.is_idle()
            and planning._plan_out.subscribed and planning._path_out.subscribed))

    def send(self, plan):
        """Send a plan of the tool."""
        self.plan_out.publish(encode_multi_dof(plan))

    def drive(self, stamp_ns, seconds, speed=1.0):
        """Send where the tool is so many seconds after it began to move."""
        o, R, v = MOVE.at(np.array([max(0.0, seconds * speed)]))
        self.partner.send_pose(stamp_ns, o[0], lie.rotation_to_quaternion(R)[0])
        self.partner.send_twist(stamp_ns, speed * v[0, :3], speed * v[0, 3:])

    def is_idle(self):
        """Tell whether nothing is being answered."""
        return not any(worker.is_busy for worker in self.partner.predictor.workers)

    def status(self):
        """Return what is said of a plan, once it is."""
        planning = self.partner.predictor.pipeline.planning
        self.wait(lambda: planning.status)
        return planning.status


@pytest.fixture
def planner(make_partner):
    """Give a predictor and what sends plans to it."""
    return Planner(make_partner(VALUES))


def test_a_plan_is_answered_before_the_tool_moves(planner):
    """Before any pose has come: from rest at its first point, with a summary."""
    planner.send(message())
    planner.wait(lambda: planner.plans and planner.heard['path'])
    (found,), (path,) = planner.plans, planner.heard['path']
    truth = PlanSimulation(MODEL, GRIP, MOVE.plan(500)).predict()
    assert found.names == ('package',) and len(path.poses) == len(found.times_ns) == 101
    assert_allclose(found.poses[:, :3], truth.states[::5, :3], atol=0.2e-6)
    assert_allclose(found.twists, truth.states[::5, 7:], atol=1e-4)
    assert_allclose(vector(path.poses[-1].pose.position), truth.states[-1, :3], atol=0.2e-6)
    status = planner.status()
    assert_allclose(float(status.values['smallest_safety_factor']), truth.smallest_safety[0],
                    rtol=1e-3)
    planner.wait(lambda: any(
        line.name.endswith('plan') for m in planner.heard['health'] for line in m.status))


def test_a_plan_that_lets_go_is_warned_of_before_it_moves(planner):
    """With level ERROR, the mode and the time."""
    planner.send(message(Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)))
    planner.wait(lambda: planner.plans)
    status = planner.status()
    assert status.level == 2 and 'the cup lets go' in status.message and 'peel' in status.message


@pytest.mark.parametrize(('speed', 'late'), [(1.0, 0.3), (0.5, 0.0)])
def test_the_rest_is_anchored_to_a_tool_that_is_late_or_slow(planner, speed, late):
    """Where tool and package will be, though the clock of the plan says otherwise."""
    step_ns, sent = 4 * MS, 0
    planner.drive(START, 0.0)
    planner.partner.wait_for_poses(1)
    planner.send(message(stamp_ns=START))
    end = late + 1.0 / speed
    while sent * step_ns < (end + 0.2) * 1e9:
        sent += 1
        before, since = len(planner.partner.poses), time.monotonic()
        planner.drive(START + sent * step_ns, sent * step_ns * 1e-9 - late, speed)
        planner.wait(lambda: len(planner.partner.poses) > before)  # noqa: B023
        time.sleep(max(0.0, 2e-3 - (time.monotonic() - since)))
    poses = {stamp_ns(pose): pose.pose.position for pose in planner.partner.poses}
    running = [plan for plan in planner.plans[1:]
               if 0.3 < ((plan.stamp_ns - START) * 1e-9 - late) * speed < 0.8]
    assert len(running) >= 3
    for plan in running:
        for k in range(0, len(plan.times_ns), 10):
            stamp = plan.stamp_ns + round(int(plan.times_ns[k]) / step_ns) * step_ns
            if stamp in poses:
                assert abs(poses[stamp].x - plan.poses[k, 0]) < 6e-3
    assert planner.partner.predictor.pipeline.planning._tracker is None  # it has arrived


def test_a_request_is_answered(planner):
    """By the plan where one is driven, else with the tool going on steadily; not in the past."""

    def ask(after_ns):
        planner.request_out.publish(pose_at(START + after_ns).header)

    planner.drive(START, 0.0)
    planner.partner.wait_for_poses(1)
    ask(500 * MS)
    planner.wait(lambda: len(planner.heard['at']) == 1)
    assert_allclose(planner.heard['at'][0].pose.pose.position.x, 0.0, atol=1e-9)
    planner.send(message(stamp_ns=START))
    planner.wait(lambda: planner.plans)
    ask(-5 * MS)
    ask(500 * MS)
    planner.wait(lambda: len(planner.heard['at']) == 2)
    truth = PlanSimulation(MODEL, None, MOVE.plan(500)).predict().states[250]
    answer = planner.heard['at'][1]
    assert answer.header.stamp.nanosec == 500 * MS and answer.child_frame_id == 'package'
    assert_allclose(answer.pose.pose.position.x, truth[0], atol=2e-5)
    assert 1e-5 < answer.pose.covariance[0] ** 0.5 < 0.02  # by the progress on the plan
    assert planner.heard['at'][0].pose.covariance[0] ** 0.5 > 0.3  # without a plan


@pytest.mark.parametrize('of_package', [False, True])
def test_a_motion_is_steered(planner, of_package):
    """The answer leaves the package without swing, whichever of the two was wanted to move."""
    move = Smooth([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.6)
    wanted = message(move)
    if of_package:
        motion = hanging(MODEL, move.plan(500))
        poses = np.hstack([motion.position, lie.rotation_to_quaternion(motion.rotation)])
        wanted = message(move, names=('package',), twists=np.asarray(motion.twist), poses=poses)
    planner.steer_out.publish(encode_multi_dof(wanted))
    planner.wait(lambda: planner.heard['steered'])
    found = planner.heard['steered'][0]
    assert swing_left(found.times_ns, found.poses, found.twists) < 0.01


def test_plans_of_a_flange_are_predicted_and_steered_in_it(make_partner):
    """With E turned and beside the frame that poses, plans and answers are of."""
    T_flange_E = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x
    T_flange_E[:3, 3] = 0.02, -0.03, 0.1
    planner = Planner(make_partner(
        VALUES.replaced({'tool_pose.offset': '0.02 -0.03 0.1 1 0 0 0'})))
    move = Smooth([0.3, 0.0, 0.0], [0.0, 0.2, 0.0], 0.6)
    plan = message(move)
    of_flange = message(move, twists=None, poses=in_frame(plan.poses, np.linalg.inv(T_flange_E)))
    planner.partner.send_twist(START)
    planner.partner.predict(START, of_flange.poses[0, :3], of_flange.poses[0, 3:])
    truth = PlanSimulation(MODEL, GRIP, move.plan(500)).predict()
    assert_allclose(
        vector(planner.partner.poses[0].pose.position), truth.states[0, :3], atol=1e-6)
    planner.send(of_flange)
    planner.wait(lambda: planner.plans)
    rows = planner.plans[0].times_ns // (2 * MS)
    assert_allclose(planner.plans[0].poses[:, :3], truth.states[rows, :3], atol=2e-6)
    planner.steer_out.publish(encode_multi_dof(of_flange))
    planner.wait(lambda: planner.heard['steered'])
    found = planner.heard['steered'][0]
    poses = in_frame(found.poses, T_flange_E)
    assert_allclose(poses[0], plan.poses[0], atol=1e-6)
    assert swing_left(found.times_ns, poses) < 0.02


@pytest.mark.parametrize(('data', 'coarse', 'named'), [
    (encode_multi_dof(message(frame_id='elsewhere')), None, "'elsewhere'"),
    (encode_multi_dof(message(poses=np.full((501, 7), np.nan))), None, 'NaN'),
    (b'\0\1\0\0' + bytes(range(60)), None, ''), (encode_multi_dof(message()), 1e-9, '1e+09'),
], ids=['frame', 'NaN', 'bytes', 'steps'])
def test_a_bad_plan_is_rejected_and_the_prediction_continues(planner, data, coarse, named):
    """Say why on /diagnostics; answer nothing; answer the next good one."""
    planner.drive(START, 0.0)
    planner.partner.wait_for_poses(1)
    planning = planner.partner.predictor.pipeline.planning
    usual = planning._coarse
    planning._coarse = coarse or usual
    planner.plan_out.publish(data)
    status = planner.status()
    assert status.level == 1 and not planner.plans and named in status.message
    planning._coarse = usual
    planner.drive(START + 4 * MS, 0.0)
    planner.partner.wait_for_poses(2)
    assert not planner.partner.predictor.failures
    planner.send(message())
    planner.wait(lambda: planner.plans and planning.status.level == 0)


def test_a_plan_of_another_clock_does_not_end_the_prediction(planner):
    """Refuse what begins in ten years, and answer the next plan; know what begins later too."""
    predictor = planner.partner.predictor
    predictor.set_parameters(overrides_of({
        'package.size': [0.1, 0.1, 0.1], 'landing.height': -1.0, 'landing.aim': True}))
    planning, tossing = predictor.pipeline.planning, predictor.pipeline.tossing
    planner.wait(lambda: tossing.flight.has_size)  # once it is compiled
    flight = tossing.flight
    planner.send(message(stamp_ns=START + 300_000_000 * 10**9))  # before any pose
    planner.wait(lambda: planner.plans)
    planner.drive(START, 0.0)
    planner.partner.wait_for_poses(1)
    for ahead_ns in (300_000_000 * 10**9, 86_400 * 10**9, 60 * 10**9, 2 * 10**9):
        now, before = predictor.pipeline.latest, len(planner.plans)
        assert flight.landing(MODEL, now, lambda _: np.zeros((12, 12))) is not None
        flight.time_to_target(MODEL, now)
        assert_allclose(flight.later(MODEL, now, 0.5)[0], now.position, atol=1e-3)
        planner.send(message(stamp_ns=START + ahead_ns))
        if ahead_ns > 3600 * 10**9:
            planner.wait(lambda: planning.status and 'one clock' in planning.status.message)
        else:
            planner.wait(lambda: len(planner.plans) > before)  # noqa: B023
    assert not predictor.failures


def test_a_newer_plan_replaces_one_that_takes_long(planner):
    """Stop what is not wanted any more: for a newer plan, for the end of the active state."""
    predictor = planner.partner.predictor
    planning = predictor.pipeline.planning
    planner.send(message())
    planner.wait(lambda: planner.plans and planner.is_idle())
    planning._coarse = 1e-4  # 10 minutes of a plan take seconds then, or hours without numba
    times = np.arange(0, 600 * 10**9 + 1, 10 * MS)
    long = message(times_ns=times, poses=np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (len(times), 1)),
                   twists=np.zeros((len(times), 6)))
    for _ in range(3):
        planner.send(long)
        planner.wait(lambda: planning.plans.worker._running == 'plan')
    planner.plans.clear()
    planner.send(message())
    begun = time.process_time()
    planner.wait(lambda: planner.plans)
    assert time.process_time() - begun < 2.0 and len(planner.plans[0].times_ns) == 101
    planner.send(long)
    planner.wait(lambda: planning.plans.worker._running == 'plan')
    begun = time.process_time()
    predictor.trigger_deactivate()
    planner.wait(planner.is_idle)
    assert time.process_time() - begun < 1.0
    assert planning.status is None and not predictor.failures


def test_a_motion_that_takes_too_long_is_not_steered_live(planner):
    """Name the longest, and go on."""
    still = message(times_ns=np.array([0, 61 * 10**9]), poses=np.eye(1, 7, 6).repeat(2, 0),
                    twists=np.zeros((2, 6)))
    planner.steer_out.publish(encode_multi_dof(still))
    status = planner.status()
    assert status.level == 1 and '61 s' in status.message


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
