"""Topics of plans of the tool and of joints: prediction before and during the motion; steering."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
import gc
import math
import sys
import time
from typing import Any

from bellows_ros.core.model.equilibrium import largest_step
from nav_msgs.msg import Odometry, Path
import numpy as np
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from .conversions import odometry, stamp_to_ns
from .guarding import LATCHED, Worker
from .node_parameters import ManagedNode
from .outputs import Predicting, Topic
from ..core.geometry.tuples import ZERO
from ..core.live import LivePredictor, Prediction
from ..core.live.plan_tracker import DEVIATED, DONE, MAX_WAIT, PlanTracker, thin_out, WAITING
from ..core.live.uncertainty import STILL
from ..core.model.grip import safety_sentence
from ..core.model.simulation import ToolRows
from ..core.parameters.conversion import grip_of, parameter_envelope, tip_of
from ..core.planning.arm import Arm, read_arm
from ..core.planning.limits import NO_LIMITS, stretched
from ..core.planning.plan_prediction import COARSE_STEP_FACTOR, PlanPrediction, PlanSimulation
from ..core.planning.points import joint_excess, JointPath, Joints, plan_of, plan_of_joints, timed
from ..core.planning.steering import steer
from ..core.signals.trajectory import at_tip, from_tip, NS_PER_S, Trajectory
from ..errors import BellowsError
from ..files import plan_messages
from ..files.plan_messages import JointPlan, PlanMessage
from ..report.health import Level, number, Status
from ..report.sentences import flip_warning

MAX_REQUEST_LEAD = 10.0
"""Longest lead of a request on package/predict_at, s."""

MAX_PLAN_LEAD = 3600.0
"""Longest lead of a plan stamped by the same clock, s."""

TAIL = 2.0
"""Predicted time after the end of a plan, s."""

MAX_STEERED_DURATION = 60.0
"""Longest motion that is steered live, s; longer ones would delay the live prediction."""


class Answers:
    """
    Answers to the newest message, computed in a thread.

    The thread hardly delays the live prediction: kernels run without Python's lock, and other code
    is short.

    Parameters
    ----------
    node : PredictorNode
        Node of the subscriptions.
    what : str
        Name of the request.
    warm_up : callable
        Function that compiles the answers, in the thread, once a possible publisher appears.
    refuse : callable
        Callback with the rejected subject, and the explaining BellowsError.

    Attributes
    ----------
    worker : Worker
        Thread of the answers.
    is_warm : bool
        Whether a possible publisher has appeared.

    """

    def __init__(
        self, node: ManagedNode, what: str, warm_up: Callable[[], None],
        refuse: Callable[[str, BellowsError], None],
    ) -> None:
        self._node, self._what, self._warm_up, self._refuse = node, what, warm_up, refuse
        self.worker, self.is_warm = Worker(node, what), False
        sys.setswitchinterval(5e-5)  # s; limits the wait of the live prediction

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any], None]) -> None:
        """Subscribe; messages with many points are handled as bytes."""
        self._node.create_subscription(
            kind, topic, callback, 10, on_publishers=self._on_publishers,
            raw=kind is MultiDOFJointTrajectory)

    def submit(self, work: Callable[..., None], *content: Any) -> None:
        """Answer a message by some work, which replaces waiting work."""
        self.worker.submit(self._what, self._attempt, work, *content)

    def _attempt(self, work: Callable[..., None], *content: Any) -> None:
        """Do some work; reject a request without an answer, unless a newer request is waiting."""
        try:
            work(*content)
        except BellowsError as error:
            if not self.worker.stop[0]:
                self._refuse(self._what, error)

    def _on_publishers(self, count: int) -> None:
        """Compile once a possible publisher appears."""
        if count and not self.is_warm:
            self.is_warm = True
            self.worker.submit('warm up', self._compile_ahead)

    def _compile_ahead(self) -> None:
        """Compile ahead of the first answer, unless the cup cannot hold the package."""
        with suppress(BellowsError):
            self._warm_up()


class Planning:
    """
    Prediction of plans, before and during their motion, and of single stamps.

    Parameters
    ----------
    pipeline : Predicting
        Node, live prediction and parameters.

    Attributes
    ----------
    plans, steering : Answers
        Answers, in two threads, as steering takes long.
    reader : PlanReader

    """

    def __init__(self, pipeline: Predicting) -> None:
        """Advertise and subscribe."""
        self._pipeline, self._node = pipeline, pipeline.node
        self._live: LivePredictor = pipeline.live
        self._plan_out = Topic(MultiDOFJointTrajectory, 'package/plan').advertise(pipeline.node)
        self._path_out = Topic(Path, 'package/plan_path').advertise(pipeline.node)
        self._at = Topic(Odometry, 'package/predicted_at').advertise(pipeline.node)
        self.plans = plans = Answers(self._node, 'plan', self._warm_up, self._refuse)
        self.reader = reader = PlanReader(pipeline)
        for kind, topic, read in (
                (MultiDOFJointTrajectory, 'tool_arm/plan', reader.of_tool),
                (JointTrajectory, 'tool_arm/plan_joints', reader.of_joints)):
            plans.subscribe(kind, topic, partial(plans.submit, self._on_plan, read))
        plans.subscribe(Header, 'package/predict_at', self._on_request)
        self.steering = Steering(pipeline, reader, self._refuse)
        self.forget()

    def forget(self) -> None:
        """Forget the plan."""
        self._tracker: PlanTracker | None = None
        self._outcome: PlanPrediction | Status | None = None
        self._predicted_ns = 0

    def use_values(self) -> None:
        """Continue with other values."""
        self._coarse = COARSE_STEP_FACTOR * largest_step(self._live.model)
        # poses come at their rate
        self._period_ns = round(0.9e9 / self._pipeline.values.plan.rate)

    def _warm_up(self) -> None:
        """Compile the answers to a plan and to a request with an example of each."""
        self._pipeline.compile_filter()
        model, tracker = self._live.model, PlanTracker(_standstill(), 0)
        tracker.follow(STILL)
        PlanSimulation(
            model, grip_of(self._pipeline.values), tracker.rest(STILL), tail=0.1).predict()
        thin_out(np.zeros(1, np.int64), np.zeros((1, 13)), 1.0, True)
        assert self._live.flight is not None  # set with the values
        with suppress(BellowsError):  # the package may have landed
            self._live.flight.later(model, STILL, 0.1)
        self._live.flight.root_later(model, STILL, 0.1, self._pipeline.uncertainty)
        gc.freeze()  # the collector need not scan objects of numba

    def rest(self, now: Prediction, deviations: float = 0.0) -> ToolRows | None:
        """
        Return the plan of the tool from a prediction on, or None without a plan in progress.

        The progress is changed by a number of its standard deviations.
        """
        tracker = self._tracker
        if tracker is None or not tracker.is_driven(now):
            return None
        return tracker.rest(now, deviations=deviations)

    def _refuse(self, what: str, error: BellowsError) -> None:
        """Log why a message is rejected; the prediction continues."""
        self._tracker = None if what == 'plan' else self._tracker
        self._outcome = Status('plan', Level.WARN, f'The last {what} was refused. {error}', {})
        self._node.get_logger().warning(f'A {what} was refused. {error}')

    def _on_plan(
        self, read: Callable[[Any], tuple[PlanMessage | JointPlan, Trajectory | ToolRows, Any]],
        message: Any,
    ) -> None:
        """Predict a plan of the tool, and follow it from now on."""
        plan, tool, _ = read(message)
        stamp_ns = plan.stamp_ns
        tracker = PlanTracker(tool, stamp_ns)
        now, grip = self._pipeline.held, grip_of(self._pipeline.values)
        rest, body = tracker.plan, None
        if now is not None:
            wait = (stamp_ns - now.stamp_ns) / NS_PER_S
            if wait > MAX_PLAN_LEAD:
                raise BellowsError(
                    f'It begins {wait:.6g} s after the newest pose of the tool; expected at '
                    f'most {MAX_PLAN_LEAD:g} s. Stamp plans and poses with one clock, or '
                    'give the plan the stamp 0.')
            tracker.follow(now)
            grip = self._pipeline.load.grip
            if wait <= MAX_WAIT and tracker.state != DEVIATED:
                rest = tracker.rest(now, self._coarse)  # points as far apart as steps
                body, stamp_ns = now.body, now.stamp_ns
        self._tracker = tracker
        self._publish(PlanSimulation(
            self._live.model, grip, rest, body, TAIL, self._coarse, self.plans.worker.stop),
            stamp_ns)
        if (status := self.status) and status.level > Level.OK:
            self._node.get_logger().warning(f'Plan: {status.message}')

    def follow(self) -> None:
        """Locate the tool on its plan; predict the rest at the requested rate."""
        tracker, now = self._tracker, self._pipeline.held
        if tracker is None or now is None or now.coasting:
            return
        tracker.follow(now)
        if tracker.state == DONE:
            self._tracker = None
        elif (tracker.state != WAITING and tracker.is_driven(now) and not self.plans.worker.is_busy
                and time.monotonic_ns() - self._predicted_ns >= self._period_ns):
            self._predicted_ns = time.monotonic_ns()
            self.plans.submit(self._predict_rest, tracker, now)

    def _predict_rest(self, tracker: PlanTracker, now: Prediction) -> None:
        """Predict the rest of a plan from a live state, after its delivery."""
        time.sleep(4e-4)  # s; subscribers of the prediction come first
        self._publish(PlanSimulation(
            self._live.model, self._pipeline.load.grip, tracker.rest(now), now.body, 0.0,
            self._coarse, self.plans.worker.stop), now.stamp_ns)

    def _publish(self, run: PlanSimulation, stamp_ns: int) -> None:
        """Publish the package along a plan, then its summary."""
        frame, states, values = self._live.frame_id, run.states(), self._pipeline.values
        times = run.tool.stamps_ns - run.tool.stamps_ns[0]
        count = thin_out(
            times, states, values.plan.points_rate, values.tool_twist.frame == 'world')
        times, states = times[:count], states[:count]
        if self._plan_out.subscribed:
            self._plan_out.publish(plan_messages.encode_multi_dof(PlanMessage(
                stamp_ns, frame, (values.frames.package,), times, states[:, :7],
                states[:, 7:])))
        if self._path_out.subscribed:
            self._path_out.publish(
                plan_messages.encode_path(stamp_ns, frame, times, states[:, :7]))
        self._outcome = run.prediction()

    @property
    def status(self) -> Status | None:
        """The line of the diagnostics on the plan, if there was one."""
        outcome, values = self._outcome, self._pipeline.values
        if outcome is None or isinstance(outcome, Status):
            return outcome
        safety, outside = outcome.smallest_safety, outcome.outside(
            parameter_envelope(values), values.package.mass, values.vacuum.holding)
        message = ' '.join(filter(None, (
            safety_sentence(*safety, 0.0, values.safety.least) if outcome.grip else '',
            f'Outside the validity range: {"; ".join(outside)}.' if outside else '',
            flip_warning(outcome.bending))))
        released = outcome.grip is not None and safety[0] < 1.0
        level = Level.ERROR if released else Level.WARN if message else Level.OK
        return Status('plan', level, message or 'The plan is within all given limits.', {
            'left (s)': number(float(outcome.tool.seconds[-1])),
            **{name: number(value) for name, value in outcome.summary().items()}})

    def _on_request(self, request: Header) -> None:
        """Answer a request for the package at a stamp, in a thread."""
        worker = self.plans.worker
        if worker.pending(int) < 4:
            worker.submit(stamp_to_ns(request.stamp), self._predict_at, stamp_to_ns(request.stamp))
            return
        self._node.get_logger().warning(
            'Requests on package/predict_at arrive faster than they can be answered, and some are '
            'skipped. Send fewer.', throttle_duration_sec=1.0)

    def _predict_at(self, stamp_ns: int) -> None:
        """Publish the package at a stamp (ns); the tool follows its plan or its twist."""
        live, now = self._live, self._pipeline.latest
        try:
            if now is None:
                raise BellowsError(
                    'There is no prediction to start from; expected poses of the tool, and an '
                    'attached package.')
            duration = (stamp_ns - now.stamp_ns) / NS_PER_S
            if not 0.0 < duration <= MAX_REQUEST_LEAD:
                raise BellowsError(
                    f'Its stamp is {duration:.6g} s after the newest pose of the tool; expected '
                    f'above 0 and up to {MAX_REQUEST_LEAD:g} s.')
            assert live.flight is not None  # set with the values
            body = live.flight.later(live.model, now, duration)
            root = live.flight.root_later(live.model, now, duration, self._pipeline.uncertainty)
        except BellowsError as error:
            self._node.get_logger().warning(
                f'A request on package/predict_at was refused. {error}', throttle_duration_sec=1.0)
            return
        if self._at.subscribed:
            self._at.publish(odometry(
                live.frame_id, self._pipeline.values.frames.package,
                Prediction(stamp_ns, *body[:4], ZERO, ZERO), root))


def _standstill() -> ToolRows:
    """Return a plan of a tool at rest."""
    return plan_of(np.arange(9) * 50_000_000, np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (9, 1)),
                   np.zeros((9, 6)))


class PlanReader:
    """
    Reader of plans of the tool, and of the joints of the arm on robot_description.

    Parameters
    ----------
    pipeline : Predicting
        Node, frame of the tool's poses, and parameters.

    """

    def __init__(self, pipeline: Predicting) -> None:
        """Subscribe to the arm, which is read when a plan needs it."""
        self._pipeline, self._urdf = pipeline, ''
        pipeline.node.create_subscription(
            String, 'robot_description', self._on_description, LATCHED)

    def _on_description(self, message: String) -> None:
        """Store the arm."""
        self._urdf = message.data

    def of_tool(self, data: bytes) -> tuple[PlanMessage, Trajectory | ToolRows, bool]:
        """Return a plan, its motion of E or of the package, and whether the package is planned."""
        values = self._pipeline.values
        message = plan_messages.decode_multi_dof(data)
        self._require_frame(message.frame_id)
        of_package = message.names[:1] == (values.frames.package,)
        plan, tip = plan_of(
            message.times_ns, message.poses, message.twists, message.accelerations,
            values.tool_twist.frame), tip_of(values)
        self._pipeline.node.note_frame(
            message.frame_id, 'a topic of plans', 'its frame is that of the tool poses')
        if tip is None or of_package:
            return message, plan, of_package
        return message, at_tip(plan.trajectory(), tip), False

    def of_joints(self, message: JointTrajectory) -> tuple[JointPlan, Trajectory, Joints]:
        """Return a plan, the motion of E by it, and its joints."""
        values = self._pipeline.values
        if not (self._urdf and values.tool_link):
            what = 'tool_link is not set' if self._urdf else 'there is no robot_description'
            raise BellowsError(
                f'It is one of joints, but {what}; expected both. Publish the URDF of the arm, '
                'and set tool_link to the link at the tool tip.')
        arm: Arm = read_arm(self._urdf, values.tool_link).with_tip(tip_of(values))
        self._require_frame(arm.root)
        plan = plan_messages.joint_plan(message)
        return plan, *plan_of_joints(arm, plan.names, plan.times_ns, *plan[4:])

    def _require_frame(self, frame_id: str) -> None:
        """Raise for a plan in another frame than the tool's poses."""
        plan_messages.require_frame(frame_id, self._pipeline.values)
        frame = self._pipeline.live.frame_id
        if frame and frame_id not in ('', frame):
            raise BellowsError(
                f"The plan is in frame '{frame_id}'; expected '{frame}', the frame of "
                "the tool's poses. Transform the plan.")


class Steering(Answers):
    """
    Motions that leave the package without swing.

    Parameters
    ----------
    pipeline : Predicting
        Node, model and parameters.
    reader : PlanReader
        Reader of the motions.
    refuse : callable
        Callback as in `Answers`.

    """

    def __init__(
        self, pipeline: Predicting, reader: PlanReader, refuse: Callable[[str, BellowsError], None]
    ) -> None:
        """Advertise and subscribe."""
        super().__init__(pipeline.node, 'motion to be steered', self._compile, refuse)
        self._pipeline, self._reader = pipeline, reader
        self._tool = Topic(MultiDOFJointTrajectory, 'tool_arm/steered').advertise(pipeline.node)
        self._joints = Topic(JointTrajectory, 'tool_arm/steered_joints').advertise(pipeline.node)
        for kind, topic, work in (
                (MultiDOFJointTrajectory, 'tool_arm/steer', self._steer_tool),
                (JointTrajectory, 'tool_arm/steer_joints', self._steer_joints)):
            self.subscribe(kind, topic, partial(self.submit, work))

    def _compile(self) -> None:
        """Compile the answer to a motion with an example."""
        self._steered(_standstill().trajectory())
        gc.freeze()

    def _steered(self, plan: Trajectory, of_package: bool = False) -> Trajectory:
        """Return a motion of the tool without swing; raise for too long a motion."""
        if plan.seconds[-1] > MAX_STEERED_DURATION:
            raise BellowsError(
                f'It takes {plan.seconds[-1]:.4g} s; expected at most {MAX_STEERED_DURATION:g}. '
                'Split the motion, or use bellows steer.')
        method = self._pipeline.values.steer.method
        found = steer(self._pipeline.live.model, plan, method, of_package)
        if self.worker.stop[0]:
            raise BellowsError('The steering was stopped before its end.')
        if found.method != method:
            self._node.get_logger().warning(
                f'A motion is steered by {found.method} instead of {method}, and leaves a swing '
                f'of {math.degrees(found.residual):.2g} degrees.', throttle_duration_sec=1.0)
        return found.tool

    def _steer_tool(self, data: bytes) -> None:
        """Publish a steered motion of the tool or the package."""
        message, plan, of_package = self._reader.of_tool(data)
        values = self._pipeline.values
        tool = self._steered(plan.trajectory() if isinstance(plan, ToolRows) else plan, of_package)
        self._tool.publish(plan_messages.encode_multi_dof(plan_messages.plan_message(
            from_tip(tool, tip_of(values)), message.stamp_ns, message.frame_id, 'tool',
            values.tool_twist.frame)))

    def _steer_joints(self, message: JointTrajectory) -> None:
        """Publish a steered motion of these joints, slowed down to their speeds."""
        plan, planned, joints = self._reader.of_joints(message)

        @cache
        def steered(scale: float) -> tuple[Trajectory, JointPath]:
            tool = self._steered(timed(planned, scale))
            return tool, joints.along(tool, planned)

        def motion(scale: float) -> tuple[Trajectory, float, tuple[float, str]]:
            tool, path = steered(scale)
            return tool, math.inf, joint_excess(joints.arm, path, math.inf)

        scale, _ = stretched(NO_LIMITS, motion)
        self._joints.publish(plan_messages.encode_joints(
            plan.stamp_ns, plan.frame_id, joints.arm.moving, steered(scale)[1]))
