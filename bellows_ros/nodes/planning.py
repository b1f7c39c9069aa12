"""Plans of the tool or of joints: the package along them, and the plans without its swing."""

from concurrent.futures import Future
from contextlib import suppress
from functools import partial
import math
import sys

from nav_msgs.msg import Path
import numpy as np
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from .guarding import LATCHED
from .outputs import Predicting, Topic
from ..core.findings import Finding, Level
from ..core.geometry.arrays import Mask
from ..core.geometry.lie import quaternion_to_rotation
from ..core.model.grip import safety_finding
from ..core.model.kernels import ModelTuple
from ..core.model.validity_range import flip_finding
from ..core.parameters.conversion import parameter_envelope, tip_of
from ..core.planning.arm import read_arm
from ..core.planning.plan_prediction import PlanPrediction, PlanSimulation
from ..core.planning.points import joint_excess, Joints, plan_of, speed_step_finding
from ..core.planning.steering import steer
from ..core.signals.trajectory import from_tip, NS_PER_S, same_frame, Trajectory
from ..errors import BellowsError
from ..files import messages, plans
from ..files.plans import Plan
from ..report.findings import warnings
from ..report.health import fact, number, Status

TAIL = 2.0
"""Predicted time after the end of a plan, s."""

ANGLES = ('peak_bending', 'swing_left')
"""Numbers of a prediction in rad, shown in degrees."""

MAX_STEERED_DURATION = 60.0
"""Longest motion that is steered live, s; longer ones would delay the next answer."""


def warm_up(model: ModelTuple) -> None:
    """Compile the answers with an example, unless the cup cannot hold the package."""
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (9, 1))
    still = plan_of(np.arange(9) * 50_000_000, poses, np.zeros((9, 6)))
    with suppress(BellowsError):
        PlanSimulation(model, None, still.trajectory(), tail=0.1).predict()


class Planning:
    """
    Answers to the newest plan, computed from rest in a thread.

    Parameters
    ----------
    pipeline : Predicting
        Node, live prediction and parameters.

    """

    def __init__(self, pipeline: Predicting) -> None:
        """Advertise and subscribe."""
        self._pipeline, node = pipeline, pipeline.node
        self._plan_out, self._path_out, self._steered, self._steered_joints = (
            Topic(kind, name).advertise(node) for kind, name in (
                (MultiDOFJointTrajectory, 'package/plan'), (Path, 'package/plan_path'),
                (MultiDOFJointTrajectory, 'tool_arm/steered'),
                (JointTrajectory, 'tool_arm/steered_joints')))
        self._urdf = ''
        self._stop, self._answering = np.zeros(1, np.bool_), Future[None]()
        self._outcome: PlanPrediction | Status | None = None
        self._findings: tuple[Finding, ...] = ()
        sys.setswitchinterval(5e-5)  # s; limits the wait of the live prediction
        for kind, topic, name in (
                (MultiDOFJointTrajectory, 'tool_arm/plan', plans.MULTI_DOF),
                (JointTrajectory, 'tool_arm/plan_joints', plans.JOINTS)):
            node.create_subscription(  # of bytes, which are decoded in the thread of the answer
                kind, topic, partial(self._on_plan, name), 10, raw=True)
        node.create_subscription(String, 'robot_description', self._on_description, LATCHED)

    def forget(self) -> None:
        """Stop the answer, and forget the plan."""
        self._stop[0], self._outcome = True, None
        self._answering.cancel()
        self._stop = np.zeros(1, np.bool_)  # the one before belongs to the work that it stops

    def _on_plan(self, kind: str, data: bytes) -> None:
        """Answer a plan, instead of the one before, in a thread."""
        self.forget()
        self._answering = self._pipeline.node.aside(self._answer, kind, data, self._stop)

    def _on_description(self, message: String) -> None:
        """Store the arm, which is read when a plan needs it."""
        self._urdf = message.data

    def _answer(self, kind: str, data: bytes, stop: Mask) -> None:
        """Publish the package along a plan and, for its subscribers, the plan without swing."""
        try:
            plan, tool, joints = self._read(kind, data)
            prediction = self._predict(tool, stop)
            self._outcome, self._findings = prediction, plan.findings
            self._publish(plan, tool, prediction)
            if (status := self.status) and status.level > Level.OK:
                self._pipeline.node.get_logger().warning(f'Plan: {status.message}')
            steered = self._steered if joints is None else self._steered_joints
            if steered.subscribed and not stop[0]:
                steered.publish(plans.encode(self._without_swing(plan, tool, joints)))
        except BellowsError as error:
            if not stop[0]:  # a newer plan is waiting
                self._outcome = Status('plan', fact('state', state=f'Refused. {error}'), {})
                self._pipeline.node.get_logger().warning(f'A plan was refused. {error}')

    def _predict(self, tool: Trajectory, stop: Mask) -> PlanPrediction:
        """Return the package along a plan, from rest."""
        return PlanSimulation(
            self._pipeline.live.model, self._pipeline.load.grip, tool, tail=TAIL,
            stop=stop).predict()

    def _publish(self, plan: Plan, tool: Trajectory, prediction: PlanPrediction) -> None:
        """Publish the package along a plan."""
        values, states = self._pipeline.live.values, prediction.states
        frame = self._pipeline.live.frame_id or plan.frame_id
        motion = Trajectory(tool.stamps_ns, states[:, :3], quaternion_to_rotation(states[:, 3:7]),
                            states[:, 7:])
        package = plans.plan_of_motion(
            motion, plan.stamp_ns, frame, messages.PACKAGE_FRAME, values.tool_twist.frame, 0)
        if self._plan_out.subscribed:
            self._plan_out.publish(plans.encode(package))
        if self._path_out.subscribed:
            self._path_out.publish(plans.encode(package._replace(kind=plans.PATH)))

    @property
    def status(self) -> Status | None:
        """The line of the diagnostics on the plan, if there was one."""
        outcome, values = self._outcome, self._pipeline.live.values
        if outcome is None or isinstance(outcome, Status):
            return outcome
        safety, outside = outcome.smallest_safety, outcome.outside(
            parameter_envelope(values), values.package.mass, values.vacuum.holding)
        found = [
            *self._findings, speed_step_finding(outcome.tool), flip_finding(outcome.bending)]
        if outcome.grip is not None:
            found.insert(0, safety_finding(*safety[:2], 0.0, values.safety.least))
        if outside:
            found.append(Finding('outside', Level.WARN, {'ranges': '; '.join(outside)}))
        message = ' '.join(warnings(each for each in found if each))
        released = outcome.grip is not None and safety[0] < 1.0
        figures = outcome.summary()
        figures['smallest_safety_time'] += float(outcome.tool.stamps_ns[0]) / NS_PER_S
        level = Level.ERROR if released else Level.WARN if message else Level.OK
        return Status('plan', fact(
            'state', level, state=message or 'The plan is within all given limits.'), {
            f'{name} (degrees)' if name in ANGLES else name:
            number(math.degrees(value) if name in ANGLES else value)
            for name, value in figures.items()})

    def _read(self, kind: str, data: bytes) -> tuple[Plan, Trajectory, Joints | None]:
        """
        Return a plan of the tool or of joints, the motion of E by it, and its joints.

        The stamps of the motion are times from the start of the plan.
        """
        live, arm = self._pipeline.live, None
        if kind == plans.JOINTS:
            if not (self._urdf and live.values.tool_link):
                what = 'tool_link is not set' if self._urdf else 'there is no robot_description'
                raise BellowsError(
                    f'It is one of joints, but {what}; expected both. Publish the URDF of the '
                    'arm, and set tool_link to the link at the tool tip.')
            arm = read_arm(self._urdf, live.values.tool_link)
        plan, = plans.plans_of(messages.decoded(data, kind))
        frame_id = arm.root if arm else plan.frame_id
        plans.require_frame(frame_id, live.values)
        if not same_frame(live.frame_id, frame_id):
            raise BellowsError(
                f"The plan is in frame '{frame_id}'; expected '{live.frame_id}', the frame of "
                "the tool's poses. Transform the plan.")
        return plan, *plans.motion_of(plan, live.values, arm)

    # --------------------------------------------------------------- steering

    def _steer(self, plan: Trajectory) -> Trajectory:
        """Return a motion of the tool without swing; raise for too long a motion."""
        if plan.seconds[-1] > MAX_STEERED_DURATION:
            raise BellowsError(
                f'It takes {plan.seconds[-1]:.4g} s; expected at most {MAX_STEERED_DURATION:g}. '
                'Split the motion, or use bellows plan --steer.')
        found = steer(self._pipeline.live.model, plan, 'zvd')
        if found.method != 'zvd':
            self._pipeline.node.get_logger().warning(
                f'A motion is steered by {"no shaper" if found.method == "none" else "zv"} '
                'instead of zvd, and leaves a swing '
                f'of {math.degrees(found.residual):.2g} degrees.', throttle_duration_sec=1.0)
        return found.tool

    def _without_swing(self, plan: Plan, tool: Trajectory, joints: Joints | None) -> Plan:
        """Return a plan of the tool, or of the same joints, without swing."""
        values, steered = self._pipeline.live.values, self._steer(tool)
        if joints is None:
            return plans.plan_of_motion(
                from_tip(steered, tip_of(values)), plan.stamp_ns, plan.frame_id, 'tool',
                values.tool_twist.frame, 0)
        path = joints.along(steered, tool)
        factor, limit = joint_excess(joints.arm, path, math.inf)
        if limit:
            raise BellowsError(
                f'Steered, it exceeds the limit {limit}; expected {factor:.4g} times its '
                'duration. Slow the plan down.')
        return plans.plan_of_path(
            plan.stamp_ns, plan.frame_id, joints.arm.moving, path, int(tool.stamps_ns[0]))
