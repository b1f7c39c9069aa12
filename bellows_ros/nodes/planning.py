"""Topics of plans of the tool and of joints: prediction before and during the motion; steering."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
import gc
import math
import sys
import time
from typing import Any

from bellows_ros.core.model.equilibrium import largest_step
from builtin_interfaces.msg import Duration
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint, MultiDOFJointTrajectory

from .conversions import stamp_to_ns, write_odometry
from .guarding import Worker
from .outputs import Topic
from ..core.geometry.tuples import ZERO
from ..core.live import LivePredictor, Prediction
from ..core.live.health import Level, number, Status
from ..core.live.plan_tracker import MAX_WAIT, PlanTracker, thin_out
from ..core.live.samples import STILL
from ..core.live.uncertainty import UNKNOWN_ROOT
from ..core.model.grip import Grip, grip_of, safety_sentence
from ..core.model.simulation import tool_rows, ToolRows
from ..core.planning.arm import Arm, read_arm
from ..core.planning.limits import NO_LIMITS, stretched
from ..core.planning.plan import COARSE, PlanPrediction, PlanSimulation
from ..core.planning.points import joint_excess, JointPath, Joints, plan_of_joints, rows_of, timed
from ..core.planning.steering import steer
from ..core.signals.trajectory import at_tip, from_tip, NS_PER_S, tip_of, Trajectory
from ..errors import BellowsError
from ..files import plan_messages
from ..files.plan_messages import JointPlan, PlanMessage

MAX_REQUEST_LEAD = 10.0
"""How far ahead (s) package/predict_at may ask."""

MAX_PLAN_LEAD = 3600.0
"""A plan stamped further ahead (s) has the stamp of another clock."""

MAX_PENDING_REQUESTS = 4
"""Requests that may wait for an answer; more are refused."""

SWITCH_INTERVAL = 5e-5
"""The live prediction gets the interpreter back from an answer within this time (s)."""

TAIL = 2.0
"""Time (s) after the end of a plan that is predicted."""

DELIVERY_TIME = 4e-4
"""Wait (s) after a prediction before a plan is predicted anew: its listeners come first."""

MAX_STEERED_DURATION = 60.0
"""Longest motion (s) that is steered live; its splines hold the interpreter."""

PLAN, STEERING = 'plan', 'steering'
"""Kinds of work of which only the newest is wanted."""


class Planning:
    """
    Subscribers and publishers for plans.

    Answers are made in a thread beside the live prediction: the kernels let go of the interpreter,
    and the rest gives it back soon.

    Parameters
    ----------
    node : PredictorNode
        Publishes, subscribes and logs.
    now : callable
        The newest prediction, of a package that is held or flies, or None.
    grip : callable
        Returns that of the package which is held, as `grip_of` does.

    Attributes
    ----------
    worker, steerer : Worker
        Make the answers; no plan waits for the steering of a motion.

    """

    def __init__(
        self, node: Any, now: Callable[[], Prediction | None], grip: Callable[[], Grip | None]
    ) -> None:
        """Advertise and subscribe; messages with many points are handled as bytes."""
        self._node, self._now, self.grip = node, now, grip
        self._plan_out = Topic(node, MultiDOFJointTrajectory, 'package/plan')
        self._path_out = Topic(node, Path, 'package/plan_path')
        self._steered = Topic(node, MultiDOFJointTrajectory, 'tool_arm/steered')
        self._at = Topic(node, Odometry, 'package/predicted_at')
        self._warmed_up = set[str]()
        self.worker, self.steerer = Worker(node, 'plans'), Worker(node, 'steering')
        self._joints = JointPlanning(node, self)
        plan = partial(self.worker.submit, PLAN, self._on_plan)
        answer = partial(self.steerer.submit, STEERING, self._on_steer)
        sys.setswitchinterval(SWITCH_INTERVAL)
        for kind, topic, callback, work, raw in (
                (MultiDOFJointTrajectory, 'tool_arm/plan', partial(plan, self._read), PLAN, True),
                (MultiDOFJointTrajectory, 'tool_arm/steer', partial(answer, self._steer),
                 STEERING, True),
                (Header, 'package/predict_at', self._on_request, PLAN, False)):
            node.create_subscription(
                kind, topic, callback, QoSProfile(depth=10), raw=raw,
                event_callbacks=SubscriptionEventCallbacks(
                    matched=node.guarded(partial(self._on_publishers, work))))
        for name, callback in (('plan', partial(plan, self._joints.read)),
                               ('steer', partial(answer, self._joints.steer))):
            node.create_subscription(JointTrajectory, f'tool_arm/{name}_joints', callback, 10)
        self.cancel()

    @property
    def held(self) -> Prediction | None:
        """The newest prediction of a held package."""
        now = self._now()
        return None if now is None or now.flies else now

    @property
    def is_busy(self) -> bool:
        """Whether something is being answered."""
        return self.worker.is_busy or self.steerer.is_busy

    def close(self) -> None:
        """End the answers for good."""
        self.worker.close()
        self.steerer.close()

    def cancel(self) -> None:
        """Drop the plan and all answers."""
        self.worker.cancel()
        self.steerer.cancel()
        self._tracker: PlanTracker | None = None
        self._outcome: PlanPrediction | Status | None = None
        self._predicted_ns = 0

    def set_model(self, live: LivePredictor, values: Mapping[str, Any]) -> None:
        """Go on with other values."""
        self._live, self.values = live, values
        self._coarse = COARSE * largest_step(live.model)
        self._period_ns = round(0.9e9 / values['plan.rate'])  # poses come at their rate

    def _on_publishers(self, work: str, matched: Any) -> None:
        """Compile what answers a topic once a possible publisher appears."""
        if matched.current_count and work not in self._warmed_up:
            self._warmed_up.add(work)
            if work == STEERING:
                self.steerer.submit('warm up', self._warm_up_steering)
            else:
                self.worker.submit('warm up', self._warm_up)

    def _warm_up(self) -> None:
        """Compile the answers to a plan and to a request, by making one of each."""
        model, tracker = self._live.model, PlanTracker(_standstill(), 0)
        tracker.follow(STILL)
        PlanSimulation(model, grip_of(self.values), tracker.rest(STILL), tail=0.1).predict()
        thin_out(np.zeros(1, np.int64), np.zeros((1, 13)), 1.0, True)
        assert self._live.flight is not None  # set with the values
        with suppress(BellowsError):  # of a package that has landed
            self._live.flight.later(model, STILL, 0.1)
        gc.freeze()  # the collector need not look through what numba has made

    def _warm_up_steering(self) -> None:
        """Compile the answer to a motion to be steered, by answering one."""
        steer(self._live.model, _standstill().trajectory(), self.values['steer.method'])
        gc.freeze()

    def rest(self, now: Prediction) -> ToolRows | None:
        """Return the tool from a prediction on, by its plan, or None where it drives none."""
        tracker = self._tracker
        return tracker.rest(now) if tracker is not None and tracker.is_driven(now) else None

    # --------------------------------------------------------------- messages

    def _read(self, data: bytes) -> tuple[PlanMessage, ToolRows]:
        """Return a plan as received, and the tool by it."""
        message = plan_messages.decode_multi_dof(data)
        self.require_frame(message.frame_id)
        plan, tip = rows_of(
            message.times_ns, message.poses, message.twists, message.accelerations,
            self.values['tool_twist.frame']), tip_of(self.values)
        if tip is None or message.names[:1] == (self.values['frames.package'],):
            return message, plan
        return message, _rows(at_tip(plan.trajectory(), tip))

    def require_frame(self, frame_id: str) -> None:
        """Refuse a plan in another frame than that of the tool's poses."""
        plan_messages.require_frame(frame_id, self.values)
        frame = self._live.frame_id
        if frame and frame_id not in ('', frame):
            raise BellowsError(
                f"The plan is in frame '{frame_id}'; expected '{frame}', the frame of "
                "the tool's poses. Transform the plan.")

    def _on_plan(
        self, read: Callable[[Any], tuple[PlanMessage | JointPlan, ToolRows]], message: Any
    ) -> None:
        """Predict a plan of the tool, and follow it from now on."""
        try:
            plan, tool = read(message)
            stamp_ns = plan.stamp_ns
            tracker = PlanTracker(tool, stamp_ns)
            now, grip = self.held, grip_of(self.values)
            rest, body = tracker.plan, None
            if now is not None:
                wait = (stamp_ns - now.stamp_ns) / NS_PER_S
                if wait > MAX_PLAN_LEAD:
                    raise BellowsError(
                        f'It begins {wait:.6g} s after the newest pose of the tool; expected at '
                        f'most {MAX_PLAN_LEAD:g} s. Stamp plans and poses with one clock, or '
                        'give the plan the stamp 0.')
                tracker.follow(now)
                grip = self.grip()
                if wait <= MAX_WAIT and not tracker.deviated:
                    rest = tracker.rest(now, self._coarse)  # points as far apart as steps
                    body, stamp_ns = now.body, now.stamp_ns
            self._tracker = tracker
            run = PlanSimulation(
                self._live.model, grip, rest, body, TAIL, self._coarse, self.worker.stop)
            self._answer(run, stamp_ns)
        except BellowsError as error:
            self.refuse('plan', error)
            return
        if (status := self.status) and status.level > Level.OK:
            self._node.get_logger().warning(f'Plan: {status.message}')

    def refuse(self, what: str, error: BellowsError) -> None:
        """Log why a message is refused; the prediction goes on."""
        if (self.worker if what == 'plan' else self.steerer).stop[0]:
            return  # nobody waits for it any more
        self._tracker = self._tracker if what != 'plan' else None
        self._outcome = Status('plan', Level.WARN, f'The last {what} was refused. {error}', {})
        self._node.get_logger().warning(f'A {what} was refused. {error}')

    def follow(self) -> None:
        """Find the tool on its plan; predict the rest of it as often as asked for."""
        tracker, now = self._tracker, self.held
        if tracker is None or now is None or now.coasting:
            return
        tracker.follow(now)
        if tracker.done:
            self._tracker = None
        elif (tracker.progress > 0.0 and tracker.is_driven(now) and not self.worker.is_busy
                and time.monotonic_ns() - self._predicted_ns >= self._period_ns):
            self._predicted_ns = time.monotonic_ns()
            self.worker.submit(PLAN, self._predict_rest, tracker, now)

    def _predict_rest(self, tracker: PlanTracker, now: Prediction) -> None:
        """Predict the rest of a plan from a live state, once that has been delivered."""
        time.sleep(DELIVERY_TIME)
        try:
            self._answer(PlanSimulation(
                self._live.model, self.grip(), tracker.rest(now), now.body, 0.0, self._coarse,
                self.worker.stop), now.stamp_ns)
        except BellowsError as error:
            self.refuse('plan', error)

    def _answer(self, run: PlanSimulation, stamp_ns: int) -> None:
        """Publish the package along a plan, then its summary."""
        frame, states = self._live.frame_id, run.states()
        times = run.tool.stamps_ns - run.tool.stamps_ns[0]
        count = thin_out(times, states, self.values['plan.points_rate'],
                         self.values['tool_twist.frame'] == 'world')
        times, states = times[:count], states[:count]
        if self._plan_out.subscribed:
            self._plan_out.publish(plan_messages.encode_multi_dof(plan_messages.PlanMessage(
                stamp_ns, frame, (self.values['frames.package'],), times, states[:, :7],
                states[:, 7:])))
        if self._path_out.subscribed:
            self._path_out.publish(
                plan_messages.encode_path(stamp_ns, frame, times, states[:, :7]))
        self._outcome = run.prediction()

    @property
    def status(self) -> Status | None:
        """The line of the diagnostics on the plan, once there was one."""
        found, words = self._outcome, []
        if found is None or isinstance(found, Status):
            return found
        if found.grip:
            words.append(safety_sentence(
                *found.smallest_safety, 0.0, self.values['safety.least']))
        outside = found.outside(self.values)
        if outside:
            words.append(f'Outside the validity range: {"; ".join(outside)}.')
        words.append(found.flips)
        said = ' '.join(word for word in words if word)
        lost = found.grip is not None and found.smallest_safety[0] < 1.0
        level = Level.ERROR if lost else Level.WARN if said else Level.OK
        seconds = float(found.tool.seconds[-1])
        values = {'left (s)': number(seconds)} | {
            name: number(value) for name, value in found.figures().items()}
        return Status('plan', level, said or 'The plan is within all known limits.', values)

    def _on_request(self, request: Header) -> None:
        """Answer a request for the package at a stamp beside the live prediction."""
        if self.worker.pending(int) < MAX_PENDING_REQUESTS:
            self.worker.submit(stamp_to_ns(request.stamp), self._predict_at, request)
            return
        self._node.get_logger().warning(
            'Requests on package/predict_at arrive faster than they can be answered, and some are '
            'skipped. Send fewer.', throttle_duration_sec=1.0)

    def _predict_at(self, request: Header) -> None:
        """Publish the package at a stamp, with the tool moving as planned or steadily."""
        live, now = self._live, self._now()
        try:
            if now is None:
                raise BellowsError(
                    'There is no prediction to start from; expected poses of the tool, and an '
                    'attached package.')
            duration = (stamp_to_ns(request.stamp) - now.stamp_ns) / NS_PER_S
            if not 0.0 < duration <= MAX_REQUEST_LEAD:
                raise BellowsError(
                    f'Its stamp is {duration:.6g} s after the newest pose of the tool; expected '
                    f'above 0 and up to {MAX_REQUEST_LEAD:g} s.')
            assert live.flight is not None  # set with the values
            body = live.flight.later(live.model, now, duration)
        except BellowsError as error:
            self._node.get_logger().warning(
                f'A request on package/predict_at was refused. {error}', throttle_duration_sec=1.0)
            return
        later = Prediction(stamp_to_ns(request.stamp), *body[:4], ZERO, ZERO)
        self._at.send(write_odometry, self._live.frame_id, self.values['frames.package'], later,
                      UNKNOWN_ROOT)

    def steered(self, wanted: Trajectory, of_package: bool = False) -> Trajectory:
        """Return a motion of the tool without swing; refuse to work on it for long."""
        if wanted.seconds[-1] > MAX_STEERED_DURATION:
            raise BellowsError(
                f'It takes {wanted.seconds[-1]:.4g} s; expected at most {MAX_STEERED_DURATION:g}. '
                'Split the motion, or use bellows steer.')
        tool = steer(self._live.model, wanted, self.values['steer.method'], of_package).tool
        if self.steerer.stop[0]:
            raise BellowsError('The steering was stopped before its end.')
        return tool

    def _on_steer(self, answer: Callable[[Any], None], message: Any) -> None:
        """Answer a motion with one that leaves the package without swing."""
        try:
            answer(message)
        except BellowsError as error:
            self.refuse('motion to be steered', error)

    def _steer(self, data: bytes) -> None:
        """Publish a motion of the tool or the package, steered."""
        message, plan = self._read(data)
        of_package = message.names[:1] == (self.values['frames.package'],)
        tool = self.steered(plan.trajectory(), of_package)
        self._steered.publish(plan_messages.encode_multi_dof(plan_messages.plan_message(
            from_tip(tool, tip_of(self.values)), message.stamp_ns, message.frame_id, 'tool',
            self.values['tool_twist.frame'])))


def _rows(tool: Trajectory) -> ToolRows:
    """Return the rows of a motion of the tool."""
    return ToolRows(tool.stamps_ns, tool_rows(tool))


def _standstill() -> ToolRows:
    """Return a plan of a tool that stands."""
    return rows_of(np.arange(9) * 50_000_000, np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (9, 1)),
                   np.zeros((9, 6)))


class JointPlanning:
    """
    Subscribers and publishers for plans of the joints of the arm on robot_description.

    Parameters
    ----------
    node : PredictorNode
        Publishes, subscribes and logs.
    planning : Planning
        Answers plans of the tool.

    """

    def __init__(self, node: Any, planning: Planning) -> None:
        """Advertise and subscribe."""
        self._planning = planning
        self._urdf = ''
        self._steered = Topic(node, JointTrajectory, 'tool_arm/steered_joints')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(String, 'robot_description', self._on_description, latched)

    def _on_description(self, message: String) -> None:
        """Keep the arm, which is read when a plan needs it."""
        self._urdf = message.data

    def _read(self, message: JointTrajectory) -> tuple[JointPlan, Trajectory, Joints]:
        """Return a plan as received, the motion of the tool, and its joints."""
        values = self._planning.values
        if not (self._urdf and values['tool_link']):
            what = 'tool_link is not set' if self._urdf else 'there is no robot_description'
            raise BellowsError(
                f'It is one of joints, but {what}; expected both. Publish the URDF of the arm, '
                'and set tool_link to the link at the tool tip.')
        arm: Arm = read_arm(self._urdf, values['tool_link']).with_tip(tip_of(values))
        self._planning.require_frame(arm.root)
        plan = plan_messages.joint_plan(message)
        return plan, *plan_of_joints(arm, plan.names, plan.times_ns, *plan[4:])

    def read(self, message: JointTrajectory) -> tuple[JointPlan, ToolRows]:
        """Return a plan as received, and the tool by it."""
        plan, tool, _ = self._read(message)
        return plan, _rows(tool)

    def steer(self, message: JointTrajectory) -> None:
        """Publish a motion, steered, in the same joints."""
        _, tool, joints = self._read(message)
        path = steered_joints(joints, tool, self._planning.steered)
        answer = JointTrajectory(header=message.header, joint_names=joints.arm.moving)
        answer.points = [
            JointTrajectoryPoint(
                positions=q.tolist(), velocities=v.tolist(), accelerations=a.tolist(),
                time_from_start=Duration(**dict(zip(
                    ('sec', 'nanosec'), divmod(round(seconds * NS_PER_S), NS_PER_S),
                    strict=True))))
            for seconds, q, v, a in zip(*path, strict=True)]
        self._steered.publish(answer)


def steered_joints(
    joints: Joints, planned: Trajectory, steer_tool: Callable[[Trajectory], Trajectory]
) -> JointPath:
    """Return the joints of a steered motion, slowed down where their speeds need that."""
    found: list[JointPath] = []

    def motion(scale: float) -> tuple[Trajectory, float, tuple[float, str]]:
        tool = steer_tool(timed(planned, scale))
        found.append(joints.along(tool, planned))
        return tool, math.inf, joint_excess(joints.arm, found[-1], math.inf)

    scale, limit = stretched(NO_LIMITS, motion)
    return joints.along(steer_tool(timed(planned, scale)), planned) if limit else found[-1]
