"""Publish the health of the predictor on /diagnostics, and log it."""

from collections.abc import Mapping
import time
from typing import Any

from bellows_ros.core.parameters import gravity_of
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from .attachment import Attachment
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
"""Seconds that a fault must last before it is logged, and before it is logged again."""

UPSIDE_DOWN = 0.5
"""Above this fraction of gravity along z of the tool the package is above the tool."""


class Diagnostics:
    """
    Watch a predictor and report its state.

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
        self._said = Level.OK
        self._due: dict[str, float] = {}

    def watch(
        self, live: LivePredictor, pose: SensorInput, twist: SensorInput,
        attachment: Attachment, outputs: Outputs, observing: Observing,
        planning: Planning, values: Mapping[str, Any],
    ) -> None:
        """Report on this predictor, its inputs and outputs from now on."""
        self._live, self._pose, self._twist = live, pose, twist
        self._attachment, self._outputs, self._observing = attachment, outputs, observing
        self._planning = planning
        self._report = InputReport(live)
        self.load = Load(values, None)
        self.set_values(values)

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Take other limits."""
        self.load = Load(values, self.load.pressure)
        self._cup = values['cup.name'] or 'cup.*'
        self._gravity = gravity_of(values)

    def report(self, state: str, last: Prediction | None, twists_exist: bool) -> None:
        """
        Publish all lines, and log what was refused, and why the package was taken to be at rest.

        Parameters
        ----------
        state : str
            Of the lifecycle.
        last : Prediction or None
            The newest one.
        twists_exist : bool
            Whether somebody sends twists.

        """
        log = self._node.get_logger()
        if self._live is not None:
            warnings, errors = self._report.take(twists_exist)
            for sentence in warnings:
                log.warning(sentence)
            for sentence in errors:
                log.error(sentence)
        name = self._node.get_fully_qualified_name().lstrip('/')
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([line.level]), name=f'{name}: {line.name}', message=line.message,
                hardware_id=HARDWARE,
                values=[KeyValue(key=key, value=value) for key, value in line.values.items()])
            for line in self._lines(state, last)]
        self._publisher.publish(message)

    def _lines(self, state: str, last: Prediction | None) -> list[Status]:
        """Return all lines."""
        above = last is not None and self._is_above(last)
        lines = [self._prediction(state, above)]
        self._log_lasting(lines[0], above)
        live = self._live
        if live is None or state != 'active':
            return lines
        of_twists = {k: n for k, n in live.refused.items() if k.startswith(OF_TWISTS)}
        of_poses = {k: n for k, n in live.refused.items() if k not in of_twists}
        of_twists.pop('twist_unpaired')  # no fault where twists come more often than poses
        poses, twists = self._pose.seen(of_poses), self._twist.seen(of_twists)
        lines += [
            input_status('tool pose', poses),
            twist_status('tool twist', twists, self._report.poses, self._report.alone)]
        for line, seen in zip(lines[1:], (poses, twists), strict=True):
            self._log_lasting(line, line.level > Level.OK and not seen.rhythm.messages)
        others = (
            self._observing.status('measured package'), self._attachment.status('vacuum'),
            self._load(), self._planning.status)
        return [*lines, *(line for line in others if line)]

    def _is_above(self, last: Prediction) -> bool:
        """Return whether the tool's z axis points down, so that the package is above it."""
        z = np.array(rotation_matrix(last.tool[1])[2::3])
        return bool(z @ self._gravity > UPSIDE_DOWN * np.linalg.norm(self._gravity))

    def _log_lasting(self, line: Status, wrong: bool) -> None:
        """Log a line if its fault lasts, but not often."""
        now = time.monotonic()
        if not wrong:
            self._due.pop(line.name, None)
        elif now >= self._due.setdefault(line.name, now + LOGGED_AFTER):
            self._due[line.name] = now + LOGGED_EVERY
            log = self._node.get_logger()
            (log.error if line.name == 'prediction' else log.warning)(line.message)

    def _load(self) -> Status:
        """Return the line on the load; a safety factor that became too small is logged too."""
        safety, away, bending = self.load.take()
        status = load_status(
            'load', safety, away, bending, self.load.limits_known, self.load.envelope_known,
            self.load.least)
        level = status.level if safety and safety.factor < self.load.least else Level.OK
        if level > max(self._said, Level.WARN):
            self._node.get_logger().error(status.message)
        elif level > self._said:
            self._node.get_logger().warning(status.message)
        self._said = level
        return status

    def _prediction(self, state: str, above: bool) -> Status:
        """Return the line on the prediction."""
        live, compute = self._live, self.compute.take()
        if live is None:
            return prediction_status('prediction', PredictionSeen(
                state, 'none', 'none', compute, {}, {}, 'unknown', above=above))
        failures = {f'failed: {what}': n for what, n in self._node.failures.items()}
        return prediction_status('prediction', PredictionSeen(
            state, live.phase(time.monotonic_ns()), self._cup, compute,
            {**live.counts, **failures}, self._report.restarts, live.twist_check.verdict,
            self._outputs.uncertainty.known, above))
