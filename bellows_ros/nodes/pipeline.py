"""From messages to predictions: inputs, live predictor and outputs of a configured predictor."""

from collections import Counter
from collections.abc import Callable
from functools import partial
import math
from operator import mul
import time
from typing import Any

from bellows_ros.core.parameters.checks import gravity_of
from bellows_ros.files.parameter_files import with_chosen_cup
from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from .conversions import read_pose, stamp_to_ns, TOOL_POSES, vector
from .inputs import Attachment, Observing, SensorInput, TransformInput
from .node_parameters import Values
from .outputs import Outputs, Tossing
from .planning import Planning
from ..core.geometry.jit import release_compiler
from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import flight, health, LivePredictor, load, Prediction, uncertainty, warm_up
from ..core.model.cup_package import cup_of, model_tuple, package_of
from ..core.signals.trajectory import tip_of

TICK = 0.02
"""Time (s) between two checks for missing messages; each costs as much as a message."""

PAUSE_NS = 40_000_000
"""A tick this late (ns) after the last shows that the process paused: messages are waiting."""

MAX_TWIST_WAIT_NS = 40_000_000
"""This long (ns) after the newest pose none waits for its twist any longer."""

LOAD_TICKS = 3
"""Ticks between two comparisons of the cup's deflection with its validity range."""

MIN_UPWARD_GRAVITY = 0.5
"""Above this fraction of gravity along z of the tool the package is above the tool."""

MAX_CLOCK_OFFSET_NS = 500_000_000
"""If the node's clock differs by more (ns), the valve is switched at the newest pose."""


class Pipeline:
    """
    The live predictor with all that feeds it and all that publishes its predictions.

    Parameters
    ----------
    node : PredictorNode
        Subscribes, publishes and logs; messages count while it is active.

    Attributes
    ----------
    live : LivePredictor
    values : dict
        Parameters in use: with the chosen cup, without cups of a gripper that do not hold.
    latest : Prediction or None
        The newest one, of a package that is held or flies.
    load : Load
        Safety factor of the grip, and distance from the validity range.
    pose_in, twist_in : SensorInput
    compute : Window
        Computing times of messages, s.
    reported : Counter
        Counts up to the last report of the diagnostics.

    """

    def __init__(self, node: Any) -> None:
        """Prepare the model, compile all it needs, and only then make the topics."""
        self.node, self.latest = node, None
        self.values: Values = with_chosen_cup(node.values)
        self.compute, self.reported = health.Window(), Counter[str]()
        self._twists_exist = False
        self._ticks = self._ticked_ns = 0
        self._was_late = self._is_compiling = False
        self._arrival_at_last_tick: int | None = None
        values = self.values
        cup = cup_of(values)
        model = cup, package_of(values), gravity_of(values), values['tool_twist.frame']
        warm_up(*model)
        self._compiled = {len(cup.as_tuple)}
        self.live = LivePredictor(*model)
        self.live.tool.set_tip(tip_of(values))
        self.load = load.Load(values)
        self.outputs = Outputs(self)
        self._publish_secondary_guarded = node.guarded(self._publish_secondary)
        if values['tool_pose.type'] == 'tf':
            self.pose_in: SensorInput = TransformInput(node, values, self.process_pose)
        else:
            kind, parts = TOOL_POSES[values['tool_pose.type']]
            self.pose_in = SensorInput(node, kind, 'tool_arm/pose', lambda message: (
                self.process_pose(*read_pose(message, parts))))
        self.twist_in = SensorInput(
            node, TwistStamped, 'tool_arm/twist', self._on_twist, self._on_twist_publishers)
        self.attachment = Attachment(self)
        self.planning = Planning(self)
        self.tossing = Tossing(self)
        self.observing = Observing(self)
        self._apply()
        if self.tossing.flight.has_size:  # whose landings have a covariance
            uncertainty.warm_up_uncertainty(cup.relaxation)
        release_compiler()
        node.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def held(self) -> Prediction | None:
        """The newest prediction of a held package."""
        now = self.latest
        return None if now is None or now.flies else now

    @property
    def is_above(self) -> bool:
        """Whether z of the tool points down, so that the package is above it."""
        if self.latest is None:
            return False
        (x, y, z, w), gravity = self.latest.tool[1], self.live.model[2]
        z_world = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        return sum(map(mul, z_world, gravity)) > MIN_UPWARD_GRAVITY * math.hypot(*gravity)

    def reset(self) -> None:
        """Start from rest at the next tool pose."""
        self.live.reset()
        self.live.pairing.expect = self._twists_exist

    def stop(self) -> None:
        """Stop publishing, and drop plans and searches."""
        self.outputs.publish_state('inactive')
        self.latest = None
        self.live.reset()
        for worker in self.node.workers:
            worker.cancel()
        self.planning.forget()

    # --------------------------------------------------------------- messages

    def process_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, orientation: Quaternion
    ) -> None:
        """Predict with a pose of the tool, wherever it is from."""
        if not self.node.is_active:
            return
        arrival_ns = self.pose_in.note(stamp_ns)
        self.publish(self.live.on_pose, stamp_ns, frame_id, position, orientation, arrival_ns)
        self.compute.add((time.monotonic_ns() - arrival_ns) * 1e-9)

    def _on_twist(self, message: TwistStamped) -> None:
        """Predict with a twist of the tool."""
        if not self.node.is_active:
            return
        twist, stamp_ns = message.twist, stamp_to_ns(message.header.stamp)
        arrival_ns = self.twist_in.note(stamp_ns)
        self.publish(self.live.on_twist, stamp_ns, vector(twist.linear), vector(twist.angular),
                     message.header.frame_id)
        self.compute.add((time.monotonic_ns() - arrival_ns) * 1e-9)

    def advance(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a step of the live prediction does; start afresh where it raises."""
        try:
            return step(*arguments)
        except Exception:
            self.restart('failure')
            raise

    def restart(self, reason: str) -> None:
        """Start again from rest, as after a failure, or where simulated time was set."""
        if self.node.is_active:
            self.live.reset(reason)
            self.latest = None

    def publish(self, step: Callable[..., list[Prediction]], *arguments: Any) -> None:
        """Send the predictions of a step; other outputs that fail do not affect their poses."""
        was_predicting = self.latest is not None
        for prediction in self.advance(step, *arguments):
            self.latest = prediction
            self.outputs.publish(prediction)
            self._publish_secondary_guarded(prediction)
        if self.latest and not was_predicting:  # a tick may be too late to see it
            self.publish_state()

    def _publish_secondary(self, prediction: Prediction) -> None:
        """Send all but the pose, and watch the load on the cup."""
        factors = self.load.watch_force(self.live.model, prediction)
        if factors and min(factors) < self.load.required:
            self.outputs.note_unsafe()
        self.outputs.publish_more(prediction, factors)
        self.planning.follow()

    # ----------------------------------------------------------------- events

    def _on_twist_publishers(self, count: int) -> None:
        """Let poses wait for their twists while twists have a publisher."""
        self._twists_exist = self.live.pairing.expect = count > 0
        if self.node.is_active and not count:
            self.publish(self.live.flush)

    def switch_valve(self, on: bool) -> None:
        """Toss the package when its valve is switched off; take up the next one with it on."""
        if not self.node.is_active:
            return
        if not self.tossing.flight.has_size:
            self.node.get_logger().warning(
                'vacuum/valve has a publisher, but package.size is not set, so the package '
                'counts as held. Set package.size and landing.height.', once=True)
            return
        stamp_ns, newest_ns = self.node.get_clock().now().nanoseconds, self.live.newest_ns
        if abs(stamp_ns - newest_ns) > MAX_CLOCK_OFFSET_NS:  # stamps are of another clock
            stamp_ns = newest_ns
        if on and self.tossing.flight.state:
            self.latest = None  # of the package before
        self.advance(self.live.switch_valve, on, stamp_ns)
        self.publish_state()

    def attach(self, held: bool, why: str) -> bool:
        """Attach or detach the package; return whether the node is active."""
        if not self.node.is_active:
            return False
        if not held and self.tossing.flight.state:  # the vacuum falls, as the valve has it
            return True
        self.publish(self.live.set_attached, held)
        if held and self.observing.lost_cups:  # they may hold the next package
            self.observing.lost_cups.clear()
            self.use_values()
        self.latest = None
        self.node.get_logger().info(f'{"Attached" if held else "Detached"} ({why}).')
        self.publish_state()
        return True

    def _tick(self) -> None:
        """Predict for waiting poses when no more messages arrive, and bridge a pause."""
        before_ns, self._ticked_ns = self._ticked_ns, time.monotonic_ns()
        # After a pause of this process what waits comes first; not twice.
        self._was_late = not self._was_late and self._ticked_ns - before_ns > PAUSE_NS
        if self._is_compiling and len(self._compiled) > 1:
            self.use_values()
        if not self.node.is_active or self._was_late:
            return
        self._ticks += 1
        live = self.live
        if live.pairing.waiting and (
                self._ticked_ns - (live.arrivals.newest_ns or 0) >= MAX_TWIST_WAIT_NS):
            self.publish(live.flush)
        if live.arrivals.newest_ns == self._arrival_at_last_tick:
            self.publish(live.coast, self._ticked_ns)
        self._arrival_at_last_tick = live.arrivals.newest_ns
        self.publish_state()
        if held := self.held:
            if self._ticks % LOAD_TICKS == 0:
                self.load.watch_deflection(live.model, held)
            self.tossing.publish(held)

    def publish_state(self) -> None:
        """Publish the state when it changes."""
        alarm = self.observing.alarm
        self.outputs.publish_state(
            f'alarm: {alarm.cause}' if alarm else self.live.phase(time.monotonic_ns()),
            self.is_above)

    # ------------------------------------------------------------- parameters

    def use_values(self) -> None:
        """Use the node's parameters, without cups that do not hold; the package moves on."""
        values = with_chosen_cup(self.node.values)
        opened = {*values['cup.open'], *map(
            float, {*self.attachment.vacuum.open_cups, *self.observing.lost_cups})}
        if len(opened - {-1.0}) < len(values['cup.layout']) // 3:  # else none holds: see detached
            values = {**values, 'cup.open': tuple(opened)}
        cup, package = cup_of(values), package_of(values)
        if len(cup.as_tuple) not in self._compiled:  # relaxing or not, it is compiled anew
            if not self._is_compiling:
                self.node.get_logger().info(
                    'Compiling for a cup that relaxes, or does not; until then the one before '
                    'predicts.')
                self.node.in_background(partial(self._compile, values))
            self._is_compiling = True
            return
        self._is_compiling = False
        self.values = values
        self.live.set_model(cup, package)
        self._apply()

    def _compile(self, values: Values) -> None:
        """Compile for a cup of another kind, in a thread; the next tick goes on with it."""
        cup, package, gravity = cup_of(values), package_of(values), gravity_of(values)
        try:
            warm_up(cup, package, gravity, values['tool_twist.frame'])
            uncertainty.warm_up_uncertainty(cup.relaxation)
            model = model_tuple(cup, package, gravity)
            flight.Flight(values).warm_up(model)
            self.observing.warm_up(model)
            release_compiler()
        finally:  # what fails to compile fails again where it is used
            self._compiled.add(len(cup.as_tuple))

    def _apply(self) -> None:
        """Let all parts use the values and the model, between two messages."""
        live, values = self.live, self.values
        self.attachment.vacuum.values = values
        self.load = load.Load(values, self.load.pressure)
        live.coast_limit_ns = round(values['coast.limit'] * 1e9)
        self.observing.use_values()
        self.outputs.use_values()
        self.planning.use_values()
        if live.flight is None or not live.flight.state:
            self.tossing.use_values()
            live.flight = self.tossing.flight
