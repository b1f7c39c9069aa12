"""The node that publishes where the held package is: convert, predict, convert back."""

from collections.abc import Iterable
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from std_srvs.srv import Trigger

from .conversions import (
    quaternion_xyzw,
    stamp_to_ns,
    vector,
    write_pose,
    write_twist,
    write_wrench,
)
from .parameters import TableNode, Values
from .reports import InputReport, summary
from ..core.live import LivePredictor, Prediction, warm_up
from ..core.model import cup_of, package_of

QUEUE = 100
"""Messages kept on each topic: bursts and pauses of the machine of 0.1 s at 1 kHz."""

FLUSH_PERIOD = 0.02
IDLE_TICKS = 2
"""
After so many periods (s) in a row without a message no pose waits for its twist any longer.

One would not do: after a pause of the machine the timer comes before the messages that wait.
"""

REPORT_PERIOD = 1.0

FROM_THESIS = {
    'cup.stiffness': 'cup.stiffness K of (4.78)',
    'cup.damping': 'cup.damping P of (4.79)',
    'cup.length': 'cup.length l0 = 0.0481 m',
}


class PredictorNode(TableNode):
    """
    Predict the package's pose and twist and the cup's wrench from the tool arm's messages.

    Parameters
    ----------
    options
        Keyword arguments of `rclpy.node.Node`.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    def __init__(self, **options: Any) -> None:
        """Prepare the model, compile all it needs, and only then subscribe."""
        super().__init__('predictor', **options)
        self.finished: Future = Future()
        values = self.values
        cup, package = cup_of(values), package_of(values)
        gravity, frame = values['gravity'], values['tool_twist.frame']
        warm_up(cup, package, gravity, frame)
        self._live = LivePredictor(cup, package, gravity, frame)
        self._report = InputReport(self._live)
        self._twists_exist = False
        self._inputs_at_last_tick = self._idle_ticks = 0
        self._say_model()
        self._advertise()
        self._listen()
        self._start_timers()
        for name in self.unmatched_qos_overrides():
            self.get_logger().warning(f"No topic of this node takes the QoS override '{name}'.")

    # ------------------------------------------------------------------ start

    def _say_model(self) -> None:
        """Log the cup and the package that are used."""
        log = self.get_logger().info
        thesis = [text for name, text in FROM_THESIS.items() if name not in self.given]
        if thesis:
            log(
                f"Not set, so using the cup of the thesis: {', '.join(thesis)}. "
                "Identify your own with 'bellows identify'."
            )
        log(f"Package of {self.values['package.mass']:g} kg.")

    def _advertise(self) -> None:
        """Publish what is predicted; twist and wrench only while somebody listens."""
        self._pose, self._twist, self._wrench = PoseStamped(), TwistStamped(), WrenchStamped()
        self._twist_wanted = self._wrench_wanted = False
        self._pose_out = self._publisher(PoseStamped, 'package/pose')
        self._twist_out = self._publisher(
            TwistStamped, 'package/twist', PublisherEventCallbacks(matched=self._on_twist_readers)
        )
        self._wrench_out = self._publisher(
            WrenchStamped, 'cup/wrench', PublisherEventCallbacks(matched=self._on_wrench_readers)
        )

    def _publisher(
        self, kind: type, topic: str, events: PublisherEventCallbacks | None = None
    ) -> Publisher:
        """Return a reliable publisher whose QoS can be overridden."""
        return self.create_publisher(
            kind, topic, QoSProfile(depth=QUEUE), event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )  # fmt: skip

    def _listen(self) -> None:
        """Subscribe to the tool arm, and serve `~/reset`."""
        self._subscribe(PoseStamped, 'tool_arm/pose', self._on_pose)
        self._subscribe(
            TwistStamped, 'tool_arm/twist', self._on_twist,
            SubscriptionEventCallbacks(matched=self._on_twist_writers),
        )  # fmt: skip
        self.create_service(Trigger, '~/reset', self._on_reset)

    def _subscribe(self, kind: type, topic: str, callback: Any, events: Any = None) -> None:
        """Listen as to any sensor, without asking for lost messages; QoS can be overridden."""
        qos = QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)  # is written to
        self.create_subscription(
            kind, topic, callback, qos, event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )  # fmt: skip

    def _start_timers(self) -> None:
        """Look after lost twists and the report, on the clock that nobody sets."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(FLUSH_PERIOD, self._flush_lost_twists, clock=steady)
        self.create_timer(REPORT_PERIOD, self._say_report, clock=steady)

    # --------------------------------------------------------------- messages

    def _on_pose(self, message: PoseStamped) -> None:
        """Predict with a pose of the tool."""
        header, pose = message.header, message.pose
        self._publish(
            self._live.on_pose(
                stamp_to_ns(header.stamp), header.frame_id,
                vector(pose.position), quaternion_xyzw(pose.orientation),
            )
        )  # fmt: skip

    def _on_twist(self, message: TwistStamped) -> None:
        """Predict with a twist of the tool."""
        twist = message.twist
        self._publish(
            self._live.on_twist(
                stamp_to_ns(message.header.stamp), vector(twist.linear), vector(twist.angular)
            )
        )

    def _publish(self, predictions: Iterable[Prediction]) -> None:
        """Send predictions; a message is serialised at once and can be used again."""
        for prediction in predictions:
            write_pose(self._pose, self._live.frame_id, prediction)
            self._pose_out.publish(self._pose)
            if self._twist_wanted:
                write_twist(self._twist, self.values['frames.package'], prediction)
                self._twist_out.publish(self._twist)
            if self._wrench_wanted:
                write_wrench(self._wrench, self.values['frames.lip'], prediction)
                self._wrench_out.publish(self._wrench)

    # ----------------------------------------------------------------- events

    def _on_twist_readers(self, matched: Any) -> None:
        """Publish twists while somebody listens."""
        self._twist_wanted = matched.current_count > 0

    def _on_wrench_readers(self, matched: Any) -> None:
        """Publish wrenches while somebody listens."""
        self._wrench_wanted = matched.current_count > 0

    def _on_twist_writers(self, matched: Any) -> None:
        """Let poses wait for their twists while somebody sends some."""
        self._twists_exist = matched.current_count > 0
        self._live.expect_twists = self._twists_exist
        if not self._twists_exist:
            self._publish(self._live.flush())

    def _flush_lost_twists(self) -> None:
        """Predict for poses that wait, when nothing comes any more."""
        inputs = self._live.poses_in + self._live.twists_in
        self._idle_ticks = self._idle_ticks + 1 if inputs == self._inputs_at_last_tick else 0
        self._inputs_at_last_tick = inputs
        if self._live.waiting and self._idle_ticks >= IDLE_TICKS:
            self._publish(self._live.flush())

    def _on_reset(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Start again from static equilibrium."""
        self._publish(self._live.flush())
        self._live.reset()
        self._live.expect_twists = self._twists_exist
        response.success = True
        response.message = 'Starts from static equilibrium at the next tool pose.'
        return response

    # ------------------------------------------------------------- parameters

    def check_values(self, values: Values) -> None:
        """Refuse what no cup or package can be."""
        cup_of(values)
        package_of(values)

    def on_values(self, names: list[str]) -> None:
        """Go on with the new cup and package; the package keeps its motion."""
        self.get_logger().info(f"Set while running: {', '.join(names)}.")
        self._live.set_model(cup_of(self.values), package_of(self.values))

    # ---------------------------------------------------------------- reports

    def _say_report(self) -> None:
        """Warn about what was refused, and why the package was taken to be at rest."""
        warnings, errors = self._report.take(self._twists_exist)
        for sentence in warnings:
            self.get_logger().warning(sentence)
        for sentence in errors:
            self.get_logger().error(sentence)

    def close(self) -> None:
        """Say what came and went, and end."""
        self.get_logger().info(summary(self._live))
        self.destroy_node()
