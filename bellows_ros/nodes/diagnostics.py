"""Publish the health of the predictor on /diagnostics, and log it."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
import time
from typing import Any

from bellows_ros.core.parameters.checks import gravity_of
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from .outputs import Outputs
from .tool_inputs import SensorInput
from ..core.geometry.tuples import rotation_matrix
from ..core.live import health, LivePredictor, Prediction
from ..core.live.health import Window
from ..core.live.load import Load

HARDWARE = 'suction cup'
TOPIC = '/diagnostics'
OF_TWISTS = 'twist_'
OWN = ('prediction', 'load')
"""Lines on faults that are logged as errors; those of others are warnings."""

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
        self.reset()

    def reset(self) -> None:
        """Report only the state of the lifecycle."""
        self._live: LivePredictor | None = None
        self._due: dict[tuple[str, object], float] = {}

    def watch(
        self, live: LivePredictor, pose: SensorInput, twist: SensorInput, outputs: Outputs,
        values: Mapping[str, Any], others: Callable[[], Iterable[health.Status | None]],
    ) -> None:
        """Report on this predictor, its inputs and outputs from now on, and what others report."""
        self._live, self._pose, self._twist = live, pose, twist
        self._outputs, self._others = outputs, others
        self._before: Counter[str] = Counter()
        self.load = Load(values, None)
        self.set_values(values)

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Take other limits."""
        self.load = Load(values, self.load.pressure)
        self._cup = values['cup.name'] or 'cup.*'
        self._gravity = gravity_of(values)

    def report(self, state: str, last: Prediction | None) -> None:
        """
        Publish all lines, and log their faults.

        Parameters
        ----------
        state : str
            Of the lifecycle.
        last : Prediction or None
            The newest one.

        """
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

    def _lines(self, state: str, last: Prediction | None) -> list[health.Status]:
        """Return all lines."""
        live = self._live
        if live is None:
            return [health.prediction_status('prediction', health.PredictionReport(
                state, 'none', 'none', self.compute.reset(), {}, {}, 'unknown'))]
        now = Counter({**live.restarts, 'poses': live.poses_in, 'alone': live.twists_estimated})
        new, self._before = now - self._before, now
        restarts = {reason: new[reason] for reason in live.restarts}
        down = rotation_matrix(last.tool[1])[2::3] if last else (0.0, 0.0, 0.0)  # z of the tool
        above = bool(np.dot(down, self._gravity) > UPSIDE_DOWN * np.linalg.norm(self._gravity))
        failures = {f'failed: {what}': n for what, n in self._node.failures.items()}
        lines = [health.prediction_status('prediction', health.PredictionReport(
            state, live.phase(time.monotonic_ns()), self._cup, self.compute.reset(),
            {**live.counts, **failures}, restarts, live.tool.check.verdict,
            self._outputs.uncertainty.known, above))]
        if state != 'active':
            return lines
        started = any(restarts.values())
        self._log(lines[0], above or started, 0.0 if started else LOGGED_AFTER,
                  tuple(reason for reason, count in restarts.items() if count))
        of_twists = {k: n for k, n in live.refused.items() if k.startswith(OF_TWISTS)}
        of_poses = {k: n for k, n in live.refused.items() if k not in of_twists}
        of_twists.pop('twist_unpaired')  # no fault where twists come more often than poses
        poses, twists = self._pose.seen(of_poses), self._twist.seen(of_twists)
        lines += [
            health.input_status('tool pose', poses),
            health.twist_status('tool twist', twists, new['poses'], new['alone'])]
        for line, seen in zip(lines[1:], (poses, twists), strict=True):
            refused = any(seen.refused.values())
            self._log(line, line.level > health.Level.OK, 0.0 if refused else LOGGED_AFTER,
                      refused)
        return [*lines, self._load(), *(line for line in self._others() if line)]

    def _log(
        self, line: health.Status, wrong: bool, after: float = 0.0, kind: object = None
    ) -> None:
        """Log a line if its fault lasts for a time (s), but one of a level and kind not often."""
        now, key = time.monotonic(), (line.name, (line.level, kind))
        if not wrong:
            self._due = {other: due for other, due in self._due.items() if other[0] != line.name}
        elif now >= self._due.setdefault(key, now + after):
            self._due[key] = now + LOGGED_EVERY
            if line.level == health.Level.ERROR and line.name in OWN:
                self._node.get_logger().error(line.message)
            else:  # a line of its own: rclpy refuses a second severity from one
                self._node.get_logger().warning(line.message)

    def _load(self) -> health.Status:
        """Return the line on the load; a safety factor that became too small is logged too."""
        safety, away, bending = self.load.reset()
        status = health.load_status(
            'load', safety, away, bending, self.load.grip is not None, self.load.envelope_known,
            self.load.required)
        self._log(status, safety is not None and safety.factor < self.load.required)
        return status
