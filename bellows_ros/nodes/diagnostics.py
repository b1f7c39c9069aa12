"""Publish the health of the predictor on /diagnostics, and log it."""

from collections import Counter
import time
from typing import Any

from bellows_ros.core.parameters.checks import gravity_of
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from .pipeline import Pipeline
from ..core.geometry.tuples import rotation_matrix
from ..core.live import health
from ..core.live.load import Load

HARDWARE = 'suction cup'
TOPIC = '/diagnostics'
OF_TWISTS = 'twist_'
LOGGED_AS_ERRORS = ('prediction', 'load')
"""Lines whose errors are logged as such; those of others are warnings."""

LOGGED_AFTER, LOGGED_EVERY = 5.0, 30.0
"""Seconds that a fault must last before it is logged, and before it is logged again."""

UPSIDE_DOWN = 0.5
"""Above this fraction of gravity along z of the tool the package is above the tool."""


class Diagnostics:
    """
    Report the state of a predictor.

    Parameters
    ----------
    node : PredictorNode
        Publishes and logs.

    """

    def __init__(self, node: Any) -> None:
        """Advertise."""
        self._node = node
        self._publisher = node.create_publisher(
            DiagnosticArray, TOPIC, QoSProfile(depth=10),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._due: dict[tuple[str, object], float] = {}

    def report(self) -> None:
        """Publish all lines, and log their faults."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=bytes([line.level]), name=f'{name}: {line.name}', message=line.message,
                hardware_id=HARDWARE,
                values=[KeyValue(key=key, value=value) for key, value in line.values.items()])
            for line in self._lines()]
        self._publisher.publish(message)

    def _lines(self) -> list[health.Status]:
        """Return all lines."""
        state: str = self._node.lifecycle_state
        pipeline: Pipeline | None = self._node.pipeline
        if pipeline is None:
            self._due.clear()
            return [health.prediction_status('prediction', health.PredictionReport(
                state, 'none', 'none', np.empty(0), {}, {}, 'unknown'))]
        live, last = pipeline.live, pipeline.latest
        now = Counter({**live.restarts, 'poses': live.poses_in, 'alone': live.twists_estimated})
        new, pipeline.reported = now - pipeline.reported, now
        restarts = {reason: new[reason] for reason in live.restarts}
        gravity = gravity_of(pipeline.values)
        down = rotation_matrix(last.tool[1])[2::3] if last else (0.0, 0.0, 0.0)  # z of the tool
        above = bool(np.dot(down, gravity) > UPSIDE_DOWN * np.linalg.norm(gravity))
        failures = {f'failed: {what}': n for what, n in self._node.failures.items()}
        lines = [health.prediction_status('prediction', health.PredictionReport(
            state, live.phase(time.monotonic_ns()), pipeline.values['cup.name'] or 'cup.*',
            pipeline.compute.reset(), {**live.counts, **failures}, restarts,
            live.tool.check.verdict, pipeline.outputs.uncertainty.known, above))]
        if state != 'active':
            return lines
        started = tuple(reason for reason, count in restarts.items() if count)
        self._log(lines[0], above or bool(started), 0.0 if started else LOGGED_AFTER, started)
        of_twists = {k: n for k, n in live.refused.items() if k.startswith(OF_TWISTS)}
        of_poses = {k: n for k, n in live.refused.items() if k not in of_twists}
        of_twists.pop('twist_unpaired')  # no fault where twists come more often than poses
        poses, twists = pipeline.pose_in.report(of_poses), pipeline.twist_in.report(of_twists)
        lines += [
            health.input_status('tool pose', poses),
            health.twist_status('tool twist', twists, new['poses'], new['alone'])]
        for line, report in zip(lines[1:], (poses, twists), strict=True):
            refused = any(report.refused.values())
            self._log(line, line.level > health.Level.OK, 0.0 if refused else LOGGED_AFTER,
                      refused)
        others = (
            pipeline.observing.status('measured package'), pipeline.attachment.status('vacuum'),
            pipeline.planning.status)
        return [*lines, self._load(pipeline.load), *(line for line in others if line)]

    def _log(
        self, line: health.Status, wrong: bool, after: float = 0.0, kind: object = None
    ) -> None:
        """Log a line if its fault lasts for a time (s), but one of a level and kind not often."""
        now, key = time.monotonic(), (line.name, (line.level, kind))
        if not wrong:
            self._due = {other: due for other, due in self._due.items() if other[0] != line.name}
        elif now >= self._due.setdefault(key, now + after):
            self._due[key] = now + LOGGED_EVERY
            if line.level == health.Level.ERROR and line.name in LOGGED_AS_ERRORS:
                self._node.get_logger().error(line.message)
            else:  # a line of its own: rclpy refuses a second severity from one
                self._node.get_logger().warning(line.message)

    def _load(self, load: Load) -> health.Status:
        """Return the line on the load; a safety factor that became too small is logged too."""
        safety, distance, bending = load.reset()
        status = health.load_status(
            'load', safety, distance, bending, load.grip is not None, load.envelope_known,
            load.required)
        self._log(status, safety is not None and safety.factor < load.required)
        return status
