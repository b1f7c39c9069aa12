"""
From messages to predictions: inputs, live predictor and outputs of a configured predictor.

The vacuum attaches and detaches the package; measured poses of the package and wrenches correct
the prediction.
"""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
import time
from typing import Any

from bellows_ros.core.parameters.conversion import gravity_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.files.messages import LAYOUTS, POSE_TYPES
from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_msgs.msg import Bool

from .conversions import message_class, reader
from .guarding import ManagedNode
from .inputs import Attachment, PackageInput, SensorInput, TransformInput
from .outputs import Outputs, Predicting
from .planning import Planning
from .planning import warm_up as warm_up_plans
from ..core.geometry.arrays import Array
from ..core.geometry.jit import announce
from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import landing, Prediction, Predictor, warm_up
from ..core.live.cycle import RELEASED
from ..core.model.cup_package import model_tuple
from ..core.model.grip import Grip
from ..core.observer.observer import warm_up_observer
from ..core.parameters.conversion import cup_of, package_of
from ..core.signals.trajectory import NS_PER_S
from ..report import health

TICK = 0.02
"""Period of the check for waiting poses, gaps and the state, s."""

MAX_SILENCE_NS = 40_000_000
"""Longest wait of a pose for its twist without any message, ns."""

OTHER_CLOCK_NS = 500_000_000
"""Difference of the node's clock from the newest stamp from which stamps are of another clock,
ns."""


class Pipeline(Predicting):
    """
    The live predictor with its inputs and the publishers of its predictions.

    Parameters
    ----------
    node : ManagedNode

    Attributes
    ----------
    pose_in, twist_in : SensorInput
        Inputs of poses and of twists; `twist_in` is None for Odometry, which includes twists.
    compute : deque
        Computing times of messages, s.

    """

    def __init__(self, node: ManagedNode) -> None:
        """Prepare the model, compile all kernels, and only then make the topics."""
        self.node = node
        values = node.values
        self.compute, self._reported = health.window(), Counter[str]()
        announce(lambda: node.get_logger().info(
            'Compiling (once a version and kind of cup): about a minute.'))
        compile_all(values)
        self._kind = len(cup_of(values).as_tuple)  # more numbers if it relaxes
        self._compiling: Future[None] | None = None
        self.live = Predictor.from_parameters(node.values)
        self.outputs = Outputs(self)
        self._publish_secondary_guarded = node.guarded(self._publish_secondary)
        self._twist_at: slice | None = None
        if values.tool_pose.type == 'tf':
            self.pose_in: SensorInput = TransformInput(node, values, self.process_pose)
        else:
            name = POSE_TYPES[values.tool_pose.type]
            kind = message_class(
                name, f'tool_pose.type is {values.tool_pose.type}', 'tool_arm/pose')
            self._read_pose, self._twist_at = reader(kind), LAYOUTS[name].twist
            self.pose_in = SensorInput(node, kind, 'tool_arm/pose', self._on_pose)
        self._read_twist, self._has_odometry_twists = reader(TwistStamped), False
        self.twist_in = None if self._twist_at else SensorInput(
            node, TwistStamped, 'tool_arm/twist', self._on_twist)
        self.attachment = Attachment(self)
        self.planning = Planning(self)
        node.create_subscription(
            Bool, 'vacuum/valve', lambda message: self.switch_valve(message.data), 10)
        self.observing = PackageInput(self)
        # each costs as much as a message
        node.create_timer(
            TICK, node.guarded(self._tick), clock=Clock(clock_type=ClockType.STEADY_TIME))

    def new_counts(self) -> Counter[str]:
        """Return restarts by reason, poses, and poses without a twist, since the last call."""
        live, before = self.live, self._reported
        self._reported = Counter(
            {**live.restarts, 'poses': live.screen.poses, 'alone': live.motion.estimated})
        return self._reported - before

    def stop(self) -> None:
        """Stop publishing, and drop plans and searches."""
        self.outputs.publish_state('inactive')
        self.live.reset()
        self.planning.forget()

    # --------------------------------------------------------------- messages

    def process_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, orientation: Quaternion
    ) -> None:
        """Predict with a pose of the tool from any input."""
        if not self.node.is_active:
            return
        arrival_ns = self.pose_in.note(stamp_ns)
        self.publish(self.live.on_pose, stamp_ns, frame_id, position, orientation, arrival_ns)
        self.compute.append((time.monotonic_ns() - arrival_ns) / NS_PER_S)

    def _on_pose(self, data: bytes) -> None:
        """Predict with a message, and with its twist if its driver provides it."""
        if not self.node.is_active:
            return
        stamp_ns, names, numbers = self._read_pose(data)
        if self._twist_at:
            twist = numbers[self._twist_at]
            self._has_odometry_twists |= any(twist)
            if self._has_odometry_twists:
                self.publish(self.live.on_twist, stamp_ns, twist[:3], twist[3:], names[1])
        self.process_pose(stamp_ns, names[0], numbers[:3], numbers[3:7])

    def _on_twist(self, data: bytes) -> None:
        """Predict with a twist of the tool."""
        if not (self.node.is_active and self.twist_in):
            return
        stamp_ns, names, numbers = self._read_twist(data)
        arrival_ns = self.twist_in.note(stamp_ns)
        self.publish(self.live.on_twist, stamp_ns, numbers[:3], numbers[3:], names[0])
        self.compute.append((time.monotonic_ns() - arrival_ns) / NS_PER_S)

    def change(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a step of the live predictor; start from rest if it raises."""
        before = self.live.state
        try:
            result = step(*arguments)
        except Exception:
            self.live.reset('failure')
            raise
        if self.live.state != before:
            self.observing.log_alarms()
            self.node.get_logger().info(f'Package: {self.live.state}.')
            self.publish_state()
        return result

    def publish(self, step: Callable[..., list[Prediction]], *arguments: Any) -> None:
        """Publish the predictions of a step, even if other outputs fail."""
        was_predicting = self.live.latest is not None
        for prediction in self.change(step, *arguments):
            self.outputs.publish(prediction)
            self._publish_secondary_guarded(prediction)
        if self.live.latest and not was_predicting:  # a tick may be too late to see it
            self.publish_state()

    def _publish_secondary(self, prediction: Prediction) -> None:
        """Publish all but the pose, and record the load of the cup."""
        factors = self.live.watch(prediction)
        self.outputs.publish_more(prediction, factors)
        if factors and min(factors) < self.load.required:
            self.publish_state()

    # ----------------------------------------------------------------- events

    def switch_valve(self, on: bool) -> None:
        """Process a message of the valve, which has no stamp."""
        stamp_ns, newest_ns = self.node.get_clock().now().nanoseconds, self.live.newest_ns
        if abs(stamp_ns - newest_ns) > OTHER_CLOCK_NS:
            stamp_ns = newest_ns
        held, grip, before = self.live.latest, self.load.grip, self.live.state
        topic, covariance = self.outputs.landing, None
        if held and topic.subscribed:
            covariance = self.live.covariance(held.stamp_ns)
        self.change(self.live.on_valve, on, stamp_ns)
        if held and covariance is not None and self.live.state == RELEASED != before:
            self.node.aside(
                self._land, held, grip, covariance, max(0, stamp_ns - held.stamp_ns))

    def _land(
        self, held: Prediction, grip: Grip | None, covariance: Array, switched_ns: int
    ) -> None:
        """Publish the landing of a released package, in a thread."""
        found = landing.landing(
            self.live.values, self.live.model, grip, held, covariance, switched_ns)
        if found:
            self.outputs.publish_landing(found)

    def _tick(self) -> None:
        """Predict for waiting poses when no more messages arrive, and bridge a gap."""
        if self._compiling:
            self.use_values()
        if not self.node.is_active:
            return
        live, now_ns = self.live, time.monotonic_ns()
        if live.pairing.waiting and (
                now_ns - (live.screen.arrival_ns or 0) >= MAX_SILENCE_NS):
            self.publish(live.flush)
        self.publish(live.coast, now_ns)
        self.observing.log_alarms()
        self.publish_state()
        if held := live.latest:
            self.load.watch_deflection(live.model, held)

    def publish_state(self) -> None:
        """Publish a change of the state while the node is active."""
        if self.node.is_active:
            alarm, now_ns = self.live.alarm, time.monotonic_ns()
            self.outputs.publish_state(
                f'alarm: {alarm.kind}' if alarm else self.live.phase(now_ns),
                abs(self.pose_in.age) <= health.MAX_AGE and self.live.is_ok_at(now_ns))

    # ------------------------------------------------------------- parameters

    def use_values(self) -> None:
        """Use the node's parameters; the package keeps its motion."""
        values, before = self.node.values, self._kind
        self._kind = len(cup_of(values).as_tuple)
        if self._kind != before:
            self.node.get_logger().info(
                'Compiling for the new values; the ones before are used until then.')
            self._compiling = self.node.aside(compile_all, values)
        if self._compiling is None or self._compiling.done():
            self._compiling = None
            self.live.use(values)


def compile_all(values: Values) -> None:
    """Compile all kernels that a node with these values may need."""
    cup, package, gravity = cup_of(values), package_of(values), gravity_of(values)
    model = model_tuple(cup, package, gravity)
    warm_up(cup, package, gravity, values.tool_twist.frame)
    warm_up_observer(values, model)
    landing.warm_up(values, model)
    warm_up_plans(model)
