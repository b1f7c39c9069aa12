"""Publish the health of the predictor on /diagnostics and put it into its log."""

from collections.abc import Mapping
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from .attachment import Attachment
from .conversions import diagnostic
from .outputs import Outputs
from .reports import InputReport
from .tool_inputs import SensorInput
from ..core.live import LivePredictor
from ..core.live.health import (
    input_status,
    load_status,
    prediction_status,
    PredictionSeen,
    Status,
    twist_status,
)
from ..core.live.load import Load
from ..core.live.timing import Window

HARDWARE = 'suction cup'
TOPIC = '/diagnostics'
OF_TWISTS = 'twist_'


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
        self._clear()

    def _clear(self) -> None:
        """Watch nothing."""
        self._live: LivePredictor | None = None
        self._inputs: tuple[SensorInput, ...] = ()
        self._restarts: Mapping[str, int] = {}

    def watch(
        self, live: LivePredictor, pose: SensorInput, twist: SensorInput,
        attachment: Attachment, outputs: Outputs, values: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Report on this predictor, its inputs and outputs from now on."""
        self._live, self._inputs = live, (pose, twist)
        self._attachment, self._outputs = attachment, outputs
        self._restarts = dict(live.restarts)
        self._gone = live.poses_in, live.twists_estimated
        self._report = InputReport(live)
        self.set_values(values)

    def forget(self) -> None:
        """Report only the state of the lifecycle."""
        self._clear()

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Take other limits."""
        self.load = Load(values)
        self._cup = values['cup.name'] or 'cup.*'

    def log(self, twists_exist: bool) -> None:
        """Warn about what was refused, and why the package was taken to be at rest."""
        if self._live is None:
            return
        warnings, errors = self._report.take(twists_exist)
        for sentence in warnings:
            self._node.get_logger().warning(sentence)
        for sentence in errors:
            self._node.get_logger().error(sentence)

    def publish(self, state: str) -> None:
        """Publish all lines; `state` is that of the lifecycle."""
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [diagnostic(status, HARDWARE) for status in self._lines(state)]
        self._publisher.publish(message)

    def _lines(self, state: str) -> list[Status]:
        """Return all lines."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        lines = [self._prediction(f'{name}: prediction', state)]
        if self._live is not None and state == 'active':
            pose, twist = self._inputs
            refused = self._live.refused
            of_twists = {k: n for k, n in refused.items() if k.startswith(OF_TWISTS)}
            of_poses = {k: n for k, n in refused.items() if k not in of_twists}
            of_twists.pop('twist_unpaired')  # no fault where twists come more often than poses
            lines.append(input_status(f'{name}: tool pose', pose.seen(of_poses)))
            lines.append(twist_status(
                f'{name}: tool twist', twist.seen(of_twists), *self._poses_alone()))
            if self._attachment.signal:
                lines.append(self._attachment.status(f'{name}: vacuum'))
            lines.append(load_status(
                f'{name}: load', *self.load.take(), self.load.limits_known,
                self.load.envelope_known))  # fmt: skip
        return lines

    def _poses_alone(self) -> tuple[int, int]:
        """Return how many poses came since the last report, and to how many no twist."""
        before = self._gone
        self._gone = self._live.poses_in, self._live.twists_estimated
        return self._gone[0] - before[0], self._gone[1] - before[1]

    def _prediction(self, name: str, state: str) -> Status:
        """Return the line on the prediction."""
        live, restarts = self._live, {}
        phase, counts, verdict, cup, covariance_known = 'none', {}, 'unknown', 'none', True
        if live is not None:
            restarts = {k: n - self._restarts[k] for k, n in live.restarts.items()}
            self._restarts = dict(live.restarts)
            phase, verdict = live.phase(time.monotonic_ns()), live.twist_check.verdict
            counts, cup = live.counts, self._cup
            covariance_known = self._outputs.covariance_known
        seen = PredictionSeen(
            state, phase, cup, self.compute.take(), counts, restarts, verdict, covariance_known)
        return prediction_status(name, seen)
