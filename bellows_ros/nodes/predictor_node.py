"""The node that publishes the pose of the held package, and its health on /diagnostics."""

from collections.abc import Callable, Collection, Iterable
from functools import partial
import gc
import time
from typing import Any

from bellows_ros.core.parameters.values import Values
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future

from .guarding import ManagedNode, TableNode
from .pipeline import Pipeline
from ..core.findings import Level
from ..core.geometry.jit import COMPILED, NOT_COMPILED
from ..core.live.vacuum import check_live
from ..core.parameters import checks
from ..errors import BellowsError, MAX_MESSAGE, shown
from ..report import health

REPORT_PERIOD = 1.0

CUP = ('cup.stiffness', 'cup.damping', 'cup.length')
"""Parameters of a cup with the defaults (4.78), (4.79) and 48.1 mm of the thesis."""


class PredictorNode(ManagedNode):
    """
    Predict the package's pose and twist and the cup's wrench from the tool arm's messages.

    The node has a lifecycle: a configured node has its model and its topics, an active node
    predicts. With the parameter autostart the node becomes active at its start. Invalid
    transitions are rejected.

    Parameters
    ----------
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    pipeline : Pipeline or None
        Parts of the prediction; None until configured.
    finished : rclpy.task.Future
        Ends the process when done.

    Raises
    ------
    BellowsError
        If a parameter is unknown, invalid or missing.

    """

    def __init__(self, **options: Any) -> None:
        """Check the parameters, and start unless autostart is off."""
        self.pipeline: Pipeline | None = None
        TableNode.__init__(self, 'predictor', **options)
        LifecycleNodeMixin.__init__(self)
        # rclpy's callback raises for an invalid transition, without an answer.
        service = next(each for each in self.services if each.srv_type is ChangeState)
        service.callback = partial(self._change_state, service.callback)
        self.finished: Future = Future()
        self._before: set[Any] | None = None  # entities of the unconfigured node
        self._failure, self.is_active = '', False
        self.diagnostics = Diagnostics(self)
        self.create_timer(REPORT_PERIOD, self.guarded(lambda: self.diagnostics.report()),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        if not self.values.autostart:
            self.get_logger().info('Unconfigured: waits for its lifecycle manager (autostart).')
            return
        for step in (self.trigger_configure, self.trigger_activate):
            if step() != TransitionCallbackReturn.SUCCESS:
                self.destroy_node()
                raise BellowsError(self._failure or 'The node could not be started.')

    @property
    def lifecycle_state(self) -> str:
        """Name of the state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """
        Make the pipeline: model, inputs, outputs; or log the reason for a failure, and clean up.

        The garbage collector ignores all objects made until then.
        """
        self._before = {*self.publishers, *self.subscriptions, *self.services, *self.timers}
        gc.unfreeze()
        try:
            self.create_trigger('~/reset', self.reset,
                                'Starts from static equilibrium at the next tool pose.')
            self.pipeline = Pipeline(self)
        except Exception as error:  # noqa: BLE001 (rclpy would swallow whatever it is)
            kind = '' if isinstance(error, BellowsError) else f'{type(error).__name__}: '
            self._failure = f'{kind}{shown(str(error), 1000)}'
            self.get_logger().error(f'Cannot be configured: {self._failure}')
            self.release_resources()
            return TransitionCallbackReturn.FAILURE
        self._log_model(self.pipeline)
        gc.collect()
        gc.freeze()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let publishers publish and callbacks work; start from rest at the next tool pose."""
        assert self.pipeline
        self.pipeline.live.reset()
        result = super().on_activate(state)
        self.is_active = True
        self.pipeline.publish_state()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing."""
        assert self.pipeline
        self.pipeline.stop()
        self.is_active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release all configured parts, so that the node can be configured again."""
        self.release_resources()
        return super().on_cleanup(state)

    on_error = on_cleanup

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing for good."""
        if self.is_active:
            self.on_deactivate(state)
        self.release_resources()
        return super().on_shutdown(state)

    def release_resources(self) -> None:
        """Log the final counts, end the threads, and destroy the configured parts."""
        if self.pipeline:
            self.pipeline.planning.forget()
            live = self.pipeline.live
            self.get_logger().info(', '.join(
                f'{count} {what}' for what, count in {**live.counts, **live.refused}.items()
                if count))
        self.pipeline, self.is_active = None, False
        self.forget_work()
        if self._before is None:
            return
        made: tuple[tuple[Iterable[Any], Callable[[Any], object]], ...] = (
            (self.publishers, self.destroy_lifecycle_publisher),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service), (self.timers, self.destroy_timer))
        for entities, destroy in made:
            for entity in set(entities) - self._before:
                destroy(entity)
        self._before = None

    def close(self) -> None:
        """Release all parts, and leave the graph."""
        self.release_resources()
        self.destroy_node()

    def _change_state(
        self, change: Callable[..., Any], request: ChangeState.Request,
        response: ChangeState.Response,
    ) -> ChangeState.Response:
        """Go through an allowed transition; reject any other."""
        try:
            change(request, response)
        except RuntimeError as error:  # of rcl
            self.get_logger().warning(
                f"Transition '{shown(request.transition.label) or request.transition.id}' from "
                f"'{self.lifecycle_state}' refused: {shown(str(error))}")
            response.success = False
        return response

    def destroy_node(self) -> None:
        """Leave the graph, with the state machine that rclpy leaves behind."""
        super().destroy_node()
        if hasattr(self, '_state_machine'):  # missing if the parameters were rejected
            self._state_machine.destroy_when_not_in_use()

    def _log_model(self, pipeline: Pipeline) -> None:
        """Log the cup in use, and the topics."""
        log = self.get_logger().info
        if thesis := sorted({*CUP} - self.overridden):
            log(f"Not set, so using the thesis's values: {', '.join(thesis)}. Identify your own "
                "with 'bellows identify'.")
        if not COMPILED:
            log(f'A prediction takes 100 times as long, as {NOT_COMPILED}.')
        inputs = [each.topic for each in (pipeline.pose_in, pipeline.twist_in) if each]
        log(f'Listens to {" and ".join(inputs)}, publishes {pipeline.outputs.pose.name}.')

    def reset(self) -> None:
        """Restart from static equilibrium."""
        assert self.pipeline
        self.pipeline.publish(self.pipeline.live.flush)
        self.pipeline.live.reset()

    def check_values(self, values: Values) -> Collection[str]:
        """Raise for impossible cups and packages; return doubts."""
        check_live(values)
        return checks.implausible(values)

    def on_values(self) -> None:
        """Use the new cup and package; the state of motion is kept."""
        if self.pipeline:
            self.pipeline.use_values()


LOG_DELAY = 5.0
"""Duration of silence before it is logged, s."""

LOG_INTERVAL = 30.0
"""Time before a fault is logged again, s."""

UNLOGGED = ('flips', 'no_poses', 'outside', 'state')
"""Findings that another line explains, or that come and go with the motion."""


class Diagnostics:
    """
    Report the state of a predictor.

    Parameters
    ----------
    node : PredictorNode
        Node of publishers and logs.

    """

    def __init__(self, node: PredictorNode) -> None:
        self._node = node
        self._publisher = node.create_publisher(
            DiagnosticArray, '/diagnostics', QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._due: dict[tuple[str, str, int], float] = {}

    def report(self) -> None:
        """Publish all lines, and log their faults."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        message, lines = DiagnosticArray(), self._lines()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([line.level]), name=f'{name}: {line.name}',
                message=shown(line.message, MAX_MESSAGE), hardware_id='suction cup',
                values=[KeyValue(key=key, value=shown(value, MAX_MESSAGE))
                        for key, value in line.values.items()])
            for line in lines]
        self._publisher.publish(message)
        now, log = time.monotonic(), self._node.get_logger()
        good = {line.name for line in lines if line.level == Level.OK}
        self._due = {key: due for key, due in self._due.items() if key[0] not in good}
        for line in lines:
            code, key = line.finding.code, (line.name, line.finding.code, line.level)
            if line.level == Level.OK or code in UNLOGGED or code.startswith('alarm_'):
                continue
            if now >= self._due.setdefault(key, now + LOG_DELAY * (code == 'silent')):
                self._due[key] = now + LOG_INTERVAL
                text = shown(line.message, MAX_MESSAGE)
                log.error(text) if line.level == Level.ERROR else log.warning(text)

    def _lines(self) -> list[health.Status]:
        """Return all lines."""
        state: str = self._node.lifecycle_state
        pipeline: Pipeline | None = self._node.pipeline
        if pipeline is None or state != 'active':
            return [health.Status('prediction', health.fact(
                'state', Level.OK, state=f'{state.capitalize()}: nothing is published'), {})]
        live, new = pipeline.live, pipeline.new_counts()
        counts = {**live.counts, **{f'failed: {k}': n for k, n in self._node.failures.items()}}
        phase = live.phase(time.monotonic_ns())
        line = health.Status('prediction', health.prediction_finding(
            phase, {reason: new[reason] for reason in live.restarts},
            live.motion.verdict != 'does_not_fit', live.package.has_covariance,
            live.is_above), {
                'phase': phase,
                **health.quantiles(
                    'compute time {} (us)', health.taken(pipeline.compute), 1e6),
                'twists against poses': live.motion.verdict,
                **{name: str(count) for name, count in counts.items()}})
        of_twists, twist_in = live.pairing.refused, pipeline.twist_in
        poses = pipeline.pose_in.report(live.screen.refused)
        twists = twist_in.report(of_twists) if twist_in else poses._replace(
            refused={}, total_refused=of_twists)
        others = (
            pipeline.observing.status(), pipeline.observing.wrench_status(),
            pipeline.attachment.status(), pipeline.planning.status)
        return [
            line, health.input_status('tool pose', poses),
            health.twist_status('tool twist', twists, new['poses'], new['alone'] * bool(twist_in)),
            health.load_status('load', pipeline.load), *filter(None, others)]
