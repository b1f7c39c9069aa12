"""Topics of plans of an arm's joints: predicted, and steered in the same joints."""

from collections.abc import Callable, Mapping
from functools import partial
import math
from typing import Any

from builtin_interfaces.msg import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from .outputs import Topic
from .tool_inputs import OVERRIDABLE
from ..core.model.simulation import tool_rows, ToolRows
from ..core.planning.arm import Arm, read_arm
from ..core.planning.limits import NO_LIMITS, stretched
from ..core.planning.points import joint_excess, JointPath, Joints, plan_of_joints, timed
from ..core.signals.trajectory import NS_PER_S, tip_of, Trajectory
from ..errors import BellowsError
from ..files.joint_plans import joint_plan, JointPlan


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

    def __init__(self, node: Any, planning: Any) -> None:
        """Advertise and subscribe."""
        self._planning = planning
        self._urdf = ''
        self._steered = Topic(node, JointTrajectory, 'tool_arm/steered_joints')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, topic, callback, qos in (
                (String, 'robot_description', self._on_description, latched),
                (JointTrajectory, 'tool_arm/plan_joints',
                 partial(planning.worker.submit, 'plan', self._on_plan), QoSProfile(depth=10)),
                (JointTrajectory, 'tool_arm/steer_joints',
                 partial(planning.steerer.submit, 'steering', self._on_steer),
                 QoSProfile(depth=10))):
            node.create_subscription(
                kind, topic, callback, qos,
                qos_overriding_options=QoSOverridingOptions(OVERRIDABLE))

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Go on with other values."""
        self._values = values

    def _on_description(self, message: String) -> None:
        """Keep the arm, which is read when a plan needs it."""
        self._urdf = message.data

    def _read(self, message: JointTrajectory) -> tuple[JointPlan, Joints, Trajectory]:
        """Return a plan as received, its joints, and the motion of the tool."""
        if not (self._urdf and self._values['tool_link']):
            what = 'tool_link is not set' if self._urdf else 'there is no robot_description'
            raise BellowsError(
                f'It is one of joints, but {what}; expected both. Publish the URDF of the arm, '
                'and set tool_link to the link at the tool tip.')
        arm: Arm = read_arm(self._urdf, self._values['tool_link']).with_tip(
            tip_of(self._values))
        self._planning.require_frame(arm.root)
        plan = joint_plan(message)
        columns = arm.columns(plan.names, 'The plan')
        parts = [None if part is None else part[:, columns] for part in plan[4:]]
        tool = plan_of_joints(arm, plan.times_ns, *parts)  # type: ignore[arg-type]
        return plan, Joints(arm, plan.times_ns, plan.position[:, columns]), tool

    def _on_plan(self, message: JointTrajectory) -> None:
        """Predict a plan, and follow it from now on."""
        def read() -> tuple[int, ToolRows]:
            plan, _, tool = self._read(message)
            return plan.stamp_ns, ToolRows(tool.stamps_ns, tool_rows(tool))

        self._planning.take_plan(read)

    def _on_steer(self, message: JointTrajectory) -> None:
        """Answer a motion with one that leaves the package without swing, in the same joints."""
        try:
            plan, joints, tool = self._read(message)
            path = steered_joints(joints, tool, self._planning.steered)
        except BellowsError as error:
            self._planning.refuse('motion to be steered', error)
            return
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
