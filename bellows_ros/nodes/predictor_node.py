"""The node that publishes the pose of the held package: convert, predict, convert back."""

import sys
from typing import Any

from bellows_ros.core.parameters.checks import implausible
from bellows_ros.files.parameter_files import with_chosen_cup
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from .command import origin_of
from .diagnostics import Diagnostics
from .parameters import ManagedNode, QOS_PREFIX, Values
from .pipeline import Pipeline
from ..core.live.health import summary
from ..core.live.load import check_live
from ..core.model.grip import grip_of
from ..core.parameters.table import short
from ..errors import BellowsError

REPORT_PERIOD = 1.0

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

    Attributes
    ----------
    pipeline : Pipeline or None
        All that predicts; None until it is configured.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    def __init__(self, **options: Any) -> None:
        """Check the parameters, and start unless autostart is off."""
        self.pipeline: Pipeline | None = None
        super().__init__('predictor', **options)
        self.diagnostics = Diagnostics(self)
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=ANY_BACKWARD_JUMP, on_clock_change=True),
            post_callback=self.guarded(self._on_clock_jump))
        self.create_timer(REPORT_PERIOD, lambda: self.diagnostics.report(),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        if self.values['autostart']:
            self.start()
        else:
            self.get_logger().info('Unconfigured: waits for its lifecycle manager (autostart).')

    def configure(self) -> None:
        """Make all that predicts."""
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.pipeline = Pipeline(self)
        self._log_model(self.pipeline)
        for name in self._parameter_overrides:
            if name.startswith(QOS_PREFIX) and not self.has_parameter(name):
                self.get_logger().warning(
                    f"The QoS override '{short(name)}' matches no topic of this node.")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start from rest at the next tool pose."""
        assert self.pipeline
        self.pipeline.reset()
        self.pipeline.live.set_attached(self.pipeline.attachment.held)
        result = super().on_activate(state)
        self.pipeline.publish_state()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall silent."""
        assert self.pipeline
        self.pipeline.stop()
        return super().on_deactivate(state)

    def release_resources(self) -> None:
        """Log the final counts, and release the model and the topics."""
        if self.pipeline:
            self.get_logger().info(summary(self.pipeline.live))
        self.pipeline = None
        super().release_resources()

    def _log_model(self, pipeline: Pipeline) -> None:
        """Log the cup and the package that are used."""
        log, values = self.get_logger().info, pipeline.values
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
        log(f'Listens to {pipeline.pose_in.topic} and {pipeline.twist_in.topic}, publishes '
            f'{pipeline.outputs.pose.name}.')
        if grip_of(values, 0.0 if values['vacuum.signal'] == 'pressure' else None) is None:
            log('The safety factor of the grip is unknown: set cup.lip_radius and vacuum.holding.')

    def _on_clock_jump(self, jump: Any) -> None:
        """Start again from rest where simulated time was set."""
        if self.pipeline:
            self.pipeline.restart('clock_jump')

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start again from static equilibrium."""
        response.success = self.is_active
        response.message = 'The node is not active.'
        if self.is_active:
            assert self.pipeline
            self.pipeline.publish(self.pipeline.live.flush)
            self.pipeline.reset()
            response.message = 'Starts from static equilibrium at the next tool pose.'
        return response

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
        if self.pipeline:
            self.pipeline.use_values()
