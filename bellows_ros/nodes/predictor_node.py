"""The node that publishes the pose of the held package, and its health on /diagnostics."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
import gc
import time
from typing import Any

from bellows_ros.core.parameters.values import Values
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future

from .guarding import ManagedNode, QOS_PREFIX, TableNode
from .pipeline import Pipeline
from ..core.findings import Level
from ..core.geometry.jit import COMPILED, NOT_COMPILED
from ..core.live.vacuum import check_live
from ..core.parameters import checks
from ..core.parameters.conversion import grip_of
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
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True),
            post_callback=self.guarded(self._on_clock_jump))
        self.create_timer(REPORT_PERIOD, lambda: self.diagnostics.report(),
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
        """Configure, or log the reason for a failure and clean up."""
        self._before = {*self.publishers, *self.subscriptions, *self.services, *self.timers}
        try:
            self.configure()
        except Exception as error:  # noqa: BLE001 (rclpy would swallow whatever it is)
            kind = '' if isinstance(error, BellowsError) else f'{type(error).__name__}: '
            self._failure = f'{kind}{shown(str(error), 1000)}'
            self.get_logger().error(f'Cannot be configured: {self._failure}')
            self.release_resources()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def configure(self) -> None:
        """Make the pipeline: model, inputs and outputs."""
        gc.unfreeze()  # the pipeline before, a cycle, which the warm-up has frozen
        gc.collect()
        gc.freeze()
        self.create_trigger('~/reset', self.reset,
                            'Starts from static equilibrium at the next tool pose.')
        self.pipeline = Pipeline(self)
        self._log_model(self.pipeline)
        for name in self._parameter_overrides:
            if name.startswith(QOS_PREFIX) and not self.has_parameter(name):
                self.get_logger().warning(
                    f"The QoS override '{shown(name)}' matches no topic of this node.")

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
            self.get_logger().info(health.summary(self.pipeline.live))
            if self.pipeline.compiler:
                self.pipeline.compiler.terminate()
                self.pipeline.compiler.wait()
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
        """Log the cup and the package in use."""
        log, values = self.get_logger().info, pipeline.live.values
        if thesis := sorted({*CUP} - self.overridden):
            log(f"Not set, so using the thesis's values: {', '.join(thesis)}. Identify your own "
                "with 'bellows identify'.")
        log(f'Package of {values.package.mass:g} kg.')
        for sentence in self.doubts:
            self.get_logger().warning(sentence)
        inputs = [each.topic for each in (pipeline.pose_in, pipeline.twist_in) if each]
        if not COMPILED:
            log(f'A prediction takes 100 times as long, as {NOT_COMPILED}.')
        log(f'Listens to {" and ".join(inputs)}, publishes '
            f'{pipeline.outputs.pose.name}.')
        if grip_of(values, 0.0 if values.vacuum.signal == 'pressure' else None) is None:
            log('The safety factor of the grip is unknown: set cup.lip_radius and vacuum.holding.')

    def _on_clock_jump(self, jump: Any) -> None:
        """Reset the prediction after a jump of simulated time."""
        if self.pipeline:
            self.pipeline.restart('clock_jump')

    def reset(self) -> None:
        """Restart from static equilibrium."""
        assert self.pipeline
        self.pipeline.publish(self.pipeline.live.flush)
        self.pipeline.live.reset()

    def check_values(self, values: Values) -> tuple[str, ...]:
        """Raise for impossible cups and packages; return doubts."""
        check_live(values)
        return checks.implausible(values)

    def on_values(self, before: Mapping[str, object]) -> None:
        """Use the new cup and package; the state of motion is kept."""
        for name, old in before.items():
            self.get_logger().info(
                f'Set while running: {name} from {_brief(old)} to {_brief(self.values[name])}.')
        if self.pipeline:
            self.pipeline.use_values()


def _brief(value: object) -> str:
    """Return a value for the log, a matrix by its diagonal."""
    if not isinstance(value, tuple):
        return shown(value)
    step = 7 if len(value) == 36 else 1
    texts = [f'{x:.6g}' if isinstance(x, float) else shown(x) for x in value[::step]]
    return f'{"diagonal " * (step > 1)}[{", ".join(texts)}]'


LOG_DELAY = 5.0
"""Duration of silence before it is logged, s."""

LOG_INTERVAL = 30.0
"""Time before a fault is logged again, s."""

LOGGED = ('prediction', 'tool pose', 'tool twist', 'load')
"""Lines with faults that are logged; others log their faults as they occur."""

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
        for line in lines:
            self._log(line)

    def _lines(self) -> list[health.Status]:
        """Return all lines."""
        state: str = self._node.lifecycle_state
        pipeline: Pipeline | None = self._node.pipeline
        if pipeline is None:
            return [health.Status('prediction', health.prediction_finding(
                state, 'none', {}, True, True, False), {'lifecycle': state})]
        live, new = pipeline.live, pipeline.new_counts()
        counts = {**live.counts, **{f'failed: {k}': n for k, n in self._node.failures.items()}}
        phase = live.phase(time.monotonic_ns())
        line = health.Status('prediction', health.prediction_finding(
            state, phase, {reason: new[reason] for reason in live.restarts},
            live.tool.motion.verdict != 'does_not_fit', live.package.has_covariance,
            live.is_above), {
                'lifecycle': state, 'phase': phase,
                **health.quantiles(
                    'compute time {} (us)', health.taken(pipeline.compute), 1e6),
                'twists against poses': live.tool.motion.verdict,
                **{name: str(count) for name, count in counts.items()}})
        if state != 'active':
            return [line]
        of_twists = {k: n for k, n in live.refused.items() if k.startswith('twist_')}
        of_poses = {k: n for k, n in live.refused.items() if k not in of_twists}
        of_twists.pop('twist_unpaired')  # no fault if twists come more often than poses
        twist_in, poses = pipeline.twist_in, pipeline.pose_in.report(of_poses)
        twists = twist_in.report(of_twists) if twist_in else poses._replace(
            refused={}, total_refused=of_twists)
        others = (
            pipeline.observing.status('measured package'),
            pipeline.observing.wrench_status('wrench'), pipeline.attachment.status('vacuum'),
            pipeline.planning.status)
        return [
            line, health.input_status('tool pose', poses),
            health.twist_status('tool twist', twists, new['poses'], new['alone'] * bool(twist_in)),
            health.load_status('load', pipeline.load), *filter(None, others)]

    def _log(self, line: health.Status) -> None:
        """Log a fault of a line, again only at intervals; silence only if it persists."""
        now, code = time.monotonic(), line.finding.code
        key = line.name, code, line.level
        if line.level == Level.OK:
            self._due = {key: due for key, due in self._due.items() if key[0] != line.name}
        elif code in UNLOGGED or not (line.name in LOGGED or code == 'publishers'):
            return
        elif now >= self._due.setdefault(key, now + LOG_DELAY * (code == 'silent')):
            self._due[key] = now + LOG_INTERVAL
            if line.level == Level.ERROR and line.name in ('prediction', 'load'):
                self._node.get_logger().error(shown(line.message, MAX_MESSAGE))
            else:  # another line of code, as rclpy rejects a second severity from one
                self._node.get_logger().warning(shown(line.message, MAX_MESSAGE))
