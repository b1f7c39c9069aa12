"""The node that publishes the pose of the held package: convert, predict, convert back."""

from collections.abc import Callable
from functools import partial
import sys
import time
from typing import Any

from bellows_ros.core.parameters.checks import gravity_of, implausible
from bellows_ros.files.parameter_files import with_chosen_cup
from geometry_msgs.msg import TwistStamped
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from .attachment import Attachment
from .command import origin_of
from .conversions import quaternion_xyzw, stamp_to_ns, TOOL_POSES, vector
from .diagnostics import Diagnostics
from .observing import Observing
from .outputs import Outputs
from .parameters import ManagedNode, QOS_PREFIX, Values
from .planning import Planning
from .tool_inputs import SensorInput, TransformInput
from .tossing import Tossing
from ..core.geometry.jit import release_compiler
from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import LivePredictor, Prediction, warm_up
from ..core.live.flight import Flight
from ..core.live.health import summary
from ..core.live.load import check_live
from ..core.live.uncertainty import warm_up_uncertainty
from ..core.model.cup_package import cup_of, model_tuple, package_of
from ..core.model.grip import grip_of
from ..core.parameters.table import short
from ..core.signals.trajectory import tip_of
from ..errors import BellowsError

TICK = 0.02
"""Time (s) between two checks for missing messages; each costs as much as a message."""

PAUSE_NS = 40_000_000
"""A tick this late (ns) after the last shows that the process paused: messages are waiting."""

IDLE_TICKS = 2
"""After this many ticks without a pose, none waits for its twist any longer."""

LOAD_TICKS = 3
"""Ticks between two comparisons of the cup's deflection with its validity range."""

REPORT_PERIOD = 1.0

MAX_CLOCK_OFFSET_NS = 500_000_000
"""If the node's clock differs by more (ns), the valve is switched at the newest pose."""

ANY_BACKWARD_JUMP = Duration(nanoseconds=-1)

CUP_DEFAULTS = {
    'cup.stiffness': 'cup.stiffness K of (4.78)',
    'cup.damping': 'cup.damping P of (4.79)',
    'cup.length': 'cup.length l0 = 0.0481 m'}
"""What describes a cup, and the value of the thesis where it is not set."""


class PredictorNode(ManagedNode):
    """
    Predict the package's pose and twist and the cup's wrench from the tool arm's messages.

    A managed node: configured it has its model and its topics, active it predicts. With the
    parameter autostart it goes there by itself.

    Parameters
    ----------
    options
        Keyword arguments of `rclpy.node.Node`.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    _live: LivePredictor = None  # type: ignore[assignment]  # none until it is configured
    _planning: Planning = None  # type: ignore[assignment]
    _tossing: Tossing = None  # type: ignore[assignment]

    def __init__(self, **options: Any) -> None:
        """Check the parameters, and start unless autostart is off."""
        super().__init__('predictor', **options)
        self._twists_exist = False
        self._idle_ticks = self._ticks = self._ticked_ns = 0
        self._was_late = False
        self._arrival_at_last_tick: int | None = None
        self._latest: Prediction | None = None
        self._compiled, self._is_compiling = set[int](), False
        self._publish_secondary_guarded = self.guarded(self._publish_secondary)
        self.diagnostics = Diagnostics(self)
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=ANY_BACKWARD_JUMP, on_clock_change=True),
            post_callback=self.guarded(lambda jump: self._restart('clock_jump')))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TICK, self._tick, clock=steady)
        self.create_timer(REPORT_PERIOD, self._report_health, clock=steady)
        if self.values['autostart']:
            self.start()
        else:
            self.get_logger().info('Unconfigured: waits for its lifecycle manager (autostart).')

    # -------------------------------------------------------------- lifecycle

    def configure(self) -> None:
        """Prepare the model, compile all it needs, and only then make the topics."""
        values = with_chosen_cup(self.values)
        cup, package, gravity = cup_of(values), package_of(values), gravity_of(values)
        model = cup, package, gravity, values['tool_twist.frame']
        warm_up(*model)
        self._compiled.add(len(cup.as_tuple))
        live = LivePredictor(*model)
        live.tool.set_tip(tip_of(values))
        self._outputs = Outputs(self, values)
        if values['tool_pose.type'] == 'tf':
            self._pose_in: SensorInput = TransformInput(self, values, self._process_pose)
        else:
            kind, self._pose_of = TOOL_POSES[values['tool_pose.type']]
            self._pose_in = SensorInput(self, kind, 'tool_arm/pose', self._on_pose)
        self._twist_in = SensorInput(
            self, TwistStamped, 'tool_arm/twist', self._on_twist, self._on_twist_publishers)
        self._attachment = Attachment(self, values)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._planning = Planning(self, lambda: self._latest, lambda: self.diagnostics.load.grip)
        self._tossing = Tossing(self, self._on_valve, self._planning)
        self._observing = Observing(self, values['measured.type'])
        self.diagnostics.watch(
            live, self._pose_in, self._twist_in, self._outputs, values,
            lambda: (self._observing.status('measured package'),
                     self._attachment.status('vacuum'), self._planning.status))
        self._apply(live, values)
        if self._tossing.flight.has_size:  # whose landings have a covariance
            warm_up_uncertainty(cup.relaxation)
        release_compiler()
        self._live = live
        self._log_model(values)
        for name in self._parameter_overrides:
            if name.startswith(QOS_PREFIX) and not self.has_parameter(name):
                self.get_logger().warning(
                    f"The QoS override '{short(name)}' matches no topic of this node.")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start from rest at the next tool pose."""
        self._live.reset()
        self._live.set_attached(self._attachment.held)
        self._live.pairing.expect = self._twists_exist
        result = super().on_activate(state)
        self._publish_state()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall silent."""
        self._outputs.publish_state('inactive')
        self._latest = None
        self._live.reset()
        self._planning.cancel()
        self._tossing.cancel()
        return super().on_deactivate(state)

    def clean_up(self) -> None:
        """Release the model and the topics."""
        if self._live is None:
            return
        self.get_logger().info(summary(self._live))
        del self._live
        self.release_resources()

    def release_resources(self) -> None:
        """End the threads, too."""
        self.diagnostics.reset()
        for part in (self._planning, self._tossing):
            if part is not None:
                part.close()
        self._planning = self._tossing = None  # type: ignore[assignment]
        super().release_resources()

    def _log_model(self, values: Values) -> None:
        """Log the cup and the package that are used."""
        log = self.get_logger().info
        name = values['cup.name']
        if name:
            log(f"Using the cup '{name}'.")
        if thesis := [text for key, text in CUP_DEFAULTS.items()
                      if not {key, key.replace('cup', f'cups.{name}')} & self.overridden]:
            log(f"Not set, so using the thesis's values: {', '.join(thesis)}. Identify your own "
                "with 'bellows identify'.")
        origin = short(origin_of('package.mass', sys.argv), 200)
        log(f"Package of {values['package.mass']:g} kg" + (f', from {origin}.' if origin else '.'))
        for sentence in implausible(values):
            self.get_logger().warning(sentence)
        log(f'Listens to {self._pose_in.topic} and {self._twist_in.topic}, publishes '
            f'{self._outputs.pose.name}.')
        if grip_of(values, 0.0 if values['vacuum.signal'] == 'pressure' else None) is None:
            log('The safety factor of the grip is unknown: set cup.lip_radius and vacuum.holding.')

    # --------------------------------------------------------------- messages

    def _on_pose(self, message: Any) -> None:
        """Predict with a pose of the tool."""
        header = message.header
        position, orientation = self._pose_of(message)
        self._process_pose(
            stamp_to_ns(header.stamp), header.frame_id, vector(position),
            quaternion_xyzw(orientation))

    def _process_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, orientation: Quaternion
    ) -> None:
        """Predict with a pose of the tool, wherever it is from."""
        if not self._active:
            return
        arrival_ns = time.monotonic_ns()
        self._pose_in.note(arrival_ns, stamp_ns)
        self._publish(self._live.on_pose, stamp_ns, frame_id, position, orientation, arrival_ns)
        self.diagnostics.compute.add((time.monotonic_ns() - arrival_ns) * 1e-9)

    def _on_twist(self, message: TwistStamped) -> None:
        """Predict with a twist of the tool."""
        if not self._active:
            return
        header, twist, arrival_ns = message.header, message.twist, time.monotonic_ns()
        stamp_ns = stamp_to_ns(header.stamp)
        self._twist_in.note(arrival_ns, stamp_ns)
        self._publish(
            self._live.on_twist,
            stamp_ns, vector(twist.linear), vector(twist.angular), header.frame_id)
        self.diagnostics.compute.add((time.monotonic_ns() - arrival_ns) * 1e-9)

    def advance(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a step of the live prediction does; start afresh where it raises."""
        try:
            return step(*arguments)
        except Exception:
            self._restart('failure')
            raise

    def _publish(self, step: Callable[..., list[Prediction]], *arguments: Any) -> None:
        """Send the predictions of a step; what fails beside their poses does not touch them."""
        for prediction in self.advance(step, *arguments):
            self._latest = prediction
            self._outputs.publish(prediction, self._live.frame_id)
            self._publish_secondary_guarded(prediction)

    def _publish_secondary(self, prediction: Prediction) -> None:
        """Send all but the pose, and watch the load on the cup."""
        factors = self.diagnostics.load.watch_force(self._live.model, prediction)
        if factors and min(factors) < self.diagnostics.load.required:
            self._outputs.note_unsafe()
        self._outputs.publish_more(prediction, self._live.model, self._live.frame_id, factors)
        self._planning.follow()

    # ----------------------------------------------------------------- events

    def _on_twist_publishers(self, count: int) -> None:
        """Let poses wait for their twists while twists have a publisher."""
        self._twists_exist = count > 0
        if self._live is None:
            return
        self._live.pairing.expect = self._twists_exist
        if self._active and not self._twists_exist:
            self._publish(self._live.flush)

    def _restart(self, reason: str) -> None:
        """Start again from rest, as after a failure, or where simulated time was set."""
        if self._active:
            self._live.reset(reason)
            self._latest = None

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start again from static equilibrium."""
        response.success = self._active
        response.message = 'The node is not active.'
        if self._active:
            self._publish(self._live.flush)
            self._live.reset()
            self._live.pairing.expect = self._twists_exist
            response.message = 'Starts from static equilibrium at the next tool pose.'
        return response

    def _on_valve(self, on: bool) -> None:
        """Toss the package when its valve is switched off; take up the next one with it on."""
        if not self._active:
            return
        if not self._tossing.flight.has_size:
            self.get_logger().warning(
                'vacuum/valve has a publisher, but package.size is not set, so the package '
                'counts as held. Set package.size and landing.height.', once=True)
            return
        stamp_ns, newest_ns = self.get_clock().now().nanoseconds, self._live.newest_ns
        if abs(stamp_ns - newest_ns) > MAX_CLOCK_OFFSET_NS:  # stamps are of another clock
            stamp_ns = newest_ns
        if on and self._tossing.flight.state:
            self._latest = None  # of the package before
        self.advance(self._live.switch_valve, on, stamp_ns)
        self._publish_state()

    def on_vacuum(self, held: bool, cup: int) -> None:
        """Join the vacuum, or that of one cup, with what a camera sees."""
        self._live.on_vacuum(held, cup)
        self._observing.log_alarms()

    def attach(self, held: bool, why: str) -> bool:
        """Attach or detach the package; return whether the node is active."""
        if not self._active:
            return False
        if not held and self._tossing.flight.state:  # the vacuum falls, as the valve has it
            return True
        self._publish(self._live.set_attached, held)
        if held and self._observing.lost_cups:  # they may hold the next package
            self._observing.lost_cups.clear()
            self.use_values()
        self._latest = None
        self.get_logger().info(f'{"Attached" if held else "Detached"} ({why}).')
        self._publish_state()
        return True

    def _tick(self) -> None:
        """Predict for waiting poses when no more messages arrive, and bridge a pause."""
        before_ns, self._ticked_ns = self._ticked_ns, time.monotonic_ns()
        # After a pause of this process what waits comes first; not twice.
        self._was_late = not self._was_late and self._ticked_ns - before_ns > PAUSE_NS
        if self._is_compiling and self._live is not None and len(self._compiled) > 1:
            self.use_values()
        if not self._active or self._was_late:
            return
        self._ticks += 1
        live = self._live
        idle = live.arrival_ns == self._arrival_at_last_tick
        self._idle_ticks = self._idle_ticks + 1 if idle else 0
        self._arrival_at_last_tick = live.arrival_ns
        if live.pairing.waiting and self._idle_ticks >= IDLE_TICKS:
            self._publish(live.flush)
        if idle:
            self._publish(live.coast, self._ticked_ns)
        self._publish_state()
        held = self._planning.held
        if held is not None and self._ticks % LOAD_TICKS == 0:
            self.diagnostics.load.watch_deflection(live.model, held)
        flight = self._tossing.flight
        if held is not None and flight.has_size and not flight.state:
            self._tossing.publish(
                live.model, held, live.frame_id, self._outputs.uncertainty.covariance)

    def _report_health(self) -> None:
        """Report the health of the node, and log what is wrong."""
        self.diagnostics.report(self.lifecycle_state, self._latest)

    def _publish_state(self) -> None:
        """Publish the state when it changes."""
        alarm = self._observing.alarm
        self._outputs.publish_state(
            f'alarm: {alarm.cause}' if alarm else self._live.phase(time.monotonic_ns()))

    # ------------------------------------------------------------- parameters

    def check_values(self, values: Values) -> None:
        """Refuse impossible cups and packages, and settings without effect."""
        name = values['cup.name']
        for key in CUP_DEFAULTS if name else ():
            if values[key] != self.values[key]:
                raise BellowsError(
                    f"{key} has no effect while cup.name is '{name}'. Set "
                    f"cups.{name}.{key.removeprefix('cup.')}, or set cup.name to ''.")
        check_live(with_chosen_cup(values))

    def on_values(self, names: list[str]) -> None:
        """Go on with the new cup and package; the package keeps its motion."""
        self.get_logger().info(f"Set while running: {', '.join(names)}.")
        if self._live is not None:
            self.use_values()

    def on_open_cups(self) -> None:
        """Go on without the cups of a gripper that have no vacuum."""
        cups = ', '.join(map(str, self._attachment.vacuum.open_cups))
        self.get_logger().warning(
            f'Without vacuum: cups {cups} of cup.layout.' if cups else 'All cups have vacuum.')
        self.use_values()

    def use_values(self) -> None:
        """Pass on the parameters, with the cups that are open; the package keeps its motion."""
        values = with_chosen_cup(self.values)
        opened = {*values['cup.open'], *map(
            float, {*self._attachment.vacuum.open_cups, *self._observing.lost_cups})}
        if len(opened - {-1.0}) < len(values['cup.layout']) // 3:  # else none holds: see detached
            values = {**values, 'cup.open': tuple(opened)}
        cup, package = cup_of(values), package_of(values)
        if len(cup.as_tuple) not in self._compiled:  # relaxing or not, it is compiled anew
            if not self._is_compiling:
                self.get_logger().info(
                    'Compiling for a cup that relaxes, or does not; until then the one before '
                    'predicts.')
                self.in_background(partial(self._compile, values))
            self._is_compiling = True
            return
        self._is_compiling = False
        self._live.set_model(cup, package)
        self._attachment.vacuum.values = values
        self.diagnostics.set_values(values)
        self._apply(self._live, values)

    def _compile(self, values: Values) -> None:
        """Compile for a cup of another kind, in a thread; the next tick goes on with it."""
        cup, package, gravity = cup_of(values), package_of(values), gravity_of(values)
        try:
            warm_up(cup, package, gravity, values['tool_twist.frame'])
            warm_up_uncertainty(cup.relaxation)
            model = model_tuple(cup, package, gravity)
            Flight(values).warm_up(model)
            self._observing.warm_up(model)
            release_compiler()
        finally:  # what fails to compile fails again where it is used
            self._compiled.add(len(cup.as_tuple))

    def _apply(self, live: LivePredictor, values: Values) -> None:
        """Pass values on to what uses them, between two messages."""
        live.coast_limit_ns = round(values['coast.limit'] * 1e9)
        self._observing.set_values(live, values)
        self._outputs.set_model(live.model, values)
        self._planning.set_model(live, values)
        if live.flight is None or not live.flight.state:
            self._tossing.set_model(live.model, values)
            live.flight = self._tossing.flight

    def close(self) -> None:
        """Log the final counts, and end."""
        self._active = False
        self.clean_up()
        self.destroy_node()
