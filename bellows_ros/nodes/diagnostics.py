"""Publish the health of the predictor on /diagnostics, and log it."""

from collections.abc import Mapping
import time
from typing import Any

from bellows_ros.core.parameters import gravity_of
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from .attachment import Attachment
from .conversions import diagnostic
from .observing import Observing
from .outputs import Outputs
from .planning import Planning
from .reports import InputReport
from .tool_inputs import SensorInput
from ..core.live import LivePredictor, Prediction
from ..core.live.health import (
    input_status,
    Level,
    load_status,
    prediction_status,
    PredictionSeen,
    Status,
    twist_status,
)
from ..core.live.load import Load
from ..core.live.timing import Window
from ..core.tuples import rotation_matrix

HARDWARE = 'suction cup'
TOPIC = '/diagnostics'
OF_TWISTS = 'twist_'

LOGGED_AFTER, LOGGED_EVERY = 5.0, 30.0
"""Seconds for which something must lack until it is logged, and until it is logged again."""

UPSIDE_DOWN = 0.5
"""Part of gravity along z of the tool with which the package is above it."""


class Diagnostics:
    """
    Watch a predictor and say how it is.

    Parameters
    ----------
    node : rclpy.node.Node
        Publishes and logs.

    """

    def __init__(self, node: Any) -> None:
        """Advertise."""
        self._node = node
        self._publisher = node.create_publisher(
            DiagnosticArray, TOPIC, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.compute = Window()
        self.forget()

    def forget(self) -> None:
        """Report only the state of the lifecycle."""
        self._live: LivePredictor | None = None
        self._inputs: tuple[SensorInput, ...] = ()
        self._said = Level.OK
        self._restarts: Mapping[str, int] = {}
        self._due: dict[str, float] = {}

    def watch(
        self, live: LivePredictor, pose: SensorInput, twist: SensorInput,
        attachment: Attachment, outputs: Outputs, observing: Observing,
        planning: Planning, values: Mapping[str, Any],
    ) -> None:
        """Report on this predictor, its inputs and outputs from now on."""
        self._live, self._inputs = live, (pose, twist)
        self._attachment, self._outputs, self._observing = attachment, outputs, observing
        self._planning = planning
        self._restarts = dict(live.restarts)
        self._gone = live.poses_in, live.twists_estimated
        self._report = InputReport(live)
        self.load = Load(values, None)
        self.set_values(values)

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Take other limits."""
        self.load = Load(values, self.load.pressure)
        self._cup = values['cup.name'] or 'cup.*'
        self._gravity = gravity_of(values)

    def log(self, twists_exist: bool) -> None:
        """Warn about what was refused, and why the package was taken to be at rest."""
        if self._live is None:
            return
        warnings, errors = self._report.take(twists_exist)
        for sentence in warnings:
            self._node.get_logger().warning(sentence)
        for sentence in errors:
            self._node.get_logger().error(sentence)

    def publish(self, state: str, last: Prediction | None) -> None:
        """Publish all lines; `state` is that of the lifecycle, `last` the newest prediction."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [diagnostic(status, HARDWARE) for status in self._lines(state, last)]
        self._publisher.publish(message)

    def _lines(self, state: str, last: Prediction | None) -> list[Status]:
        """Return all lines."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        above = last is not None and self._is_above(last)
        lines = [self._prediction(f'{name}: prediction', state, above)]
        self._log_lasting(lines[0], above)
        if self._live is not None and state == 'active':
            pose, twist = self._inputs
            refused = self._live.refused
            of_twists = {k: n for k, n in refused.items() if k.startswith(OF_TWISTS)}
            of_poses = {k: n for k, n in refused.items() if k not in of_twists}
            of_twists.pop('twist_unpaired')  # no fault where twists come more often than poses
            seen = pose.seen(of_poses), twist.seen(of_twists)
            lines += [input_status(f'{name}: tool pose', seen[0]), twist_status(
                f'{name}: tool twist', seen[1], *self._poses_alone(self._live))]
            for line, own in zip(lines[-2:], seen, strict=True):
                self._log_lasting(line, line.level > Level.OK and not own.rhythm.messages)
            if measured := self._observing.status(f'{name}: measured package'):
                lines.append(measured)
            if vacuum := self._attachment.status(f'{name}: vacuum'):
                lines.append(vacuum)
            lines.append(self._load(f'{name}: load'))
            if plan := self._planning.status:
                lines.append(plan._replace(name=f'{name}: plan'))
        return lines

    def _is_above(self, last: Prediction) -> bool:
        """Return whether z of the tool points down, so that the package is above it."""
        z = np.array(rotation_matrix(last.tool[1])[2::3])
        return bool(z @ self._gravity > UPSIDE_DOWN * np.linalg.norm(self._gravity))

    def _log_lasting(self, status: Status, wrong: bool) -> None:
        """Log a line whose fault lasts, and not often."""
        now = time.monotonic()
        if not wrong:
            self._due.pop(status.name, None)
        elif now >= self._due.setdefault(status.name, now + LOGGED_AFTER):
            self._due[status.name] = now + LOGGED_EVERY
            log = self._node.get_logger()
            (log.error if status.name.endswith('prediction') else log.warning)(status.message)

    def _load(self, name: str) -> Status:
        """Return the line on the load; a safety factor that became too small is logged too."""
        safety, away, bending = self.load.take()
        status = load_status(
            name, safety, away, bending, self.load.limits_known, self.load.envelope_known,
            self.load.least)
        level = status.level if safety and safety.factor < self.load.least else Level.OK
        if level > max(self._said, Level.WARN):
            self._node.get_logger().error(status.message)
        elif level > self._said:
            self._node.get_logger().warning(status.message)
        self._said = level
        return status

    def _poses_alone(self, live: LivePredictor) -> tuple[int, int]:
        """Return how many poses came since the last report, and to how many no twist."""
        before = self._gone
        self._gone = live.poses_in, live.twists_estimated
        return self._gone[0] - before[0], self._gone[1] - before[1]

    def _prediction(self, name: str, state: str, above: bool) -> Status:
        """Return the line on the prediction."""
        live, restarts = self._live, {}
        phase, counts, verdict, cup, covariance_known = 'none', {}, 'unknown', 'none', True
        if live is not None:
            restarts = {k: n - self._restarts[k] for k, n in live.restarts.items()}
            self._restarts = dict(live.restarts)
            phase, verdict = live.phase(time.monotonic_ns()), live.twist_check.verdict
            failures = {f'failed: {what}': n for what, n in self._node.failures.items()}
            counts, cup = {**live.counts, **failures}, self._cup
            covariance_known = self._outputs.covariance_known
        seen = PredictionSeen(
            state, phase, cup, self.compute.take(), counts, restarts, verdict, covariance_known,
            above)
        return prediction_status(name, seen)
