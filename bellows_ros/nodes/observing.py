"""Measured poses of the package: received, passed to the predictor, counted."""

from collections import Counter
import gc
from typing import Any

from geometry_msgs.msg import InertiaStamped
import numpy as np

from .conversions import read_pose, TOOL_POSES, write_payload
from .inputs import SensorInput
from .outputs import Topic
from ..core.live import LivePredictor
from ..core.live.health import input_status, Level, Status
from ..core.model.kernels import ModelTuple
from ..core.observer.alarms import Alarm
from ..core.observer.observer import Observer, VERDICTS, warm_up_observer
from ..core.parameters.table import short

ALARM_DURATION_NS = 5_000_000_000
"""How long (ns) an alarm stays in the diagnostics and as the state."""


class Observing:
    """
    Subscriber to measured poses of the package, and the outputs of the observer.

    Parameters
    ----------
    pipeline : Pipeline
        Takes the poses, and goes on without cups that are lost.

    Attributes
    ----------
    lost_cups : set of int
        Cups of cup.layout that were lost since the package was attached.

    """

    def __init__(self, pipeline: Any) -> None:
        """Subscribe; nothing changes before the first message."""
        self._pipeline, node = pipeline, pipeline.node
        self._live: LivePredictor = pipeline.live
        kind = pipeline.values['measured.type']
        self._with_covariance = kind != 'pose'
        message_type, self._parts = TOOL_POSES[kind]
        self._is_warm, self._reported = False, 0
        self.lost_cups: set[int] = set()
        self._measured_in = SensorInput(
            node, message_type, 'package/measured', self._on_measured, self._on_publishers)
        self._estimated = Topic(node, InertiaStamped, 'package/estimated')

    def use_values(self) -> None:
        """Use other values; the estimate starts again, alarms stay."""
        if before := self._observer:
            self._live.package.observe(observer := Observer(self._pipeline.values))
            observer.alarms = before.alarms

    @property
    def _observer(self) -> Observer | None:
        """The observer that corrects the predictions, if any."""
        return self._live.package.observer

    def _on_publishers(self, count: int) -> None:
        """Compile once a possible publisher appears."""
        if count and not self._is_warm:
            self._is_warm = True
            self.warm_up(self._live.model)
            gc.collect()
            gc.freeze()  # as `spin` does: what a compiler leaves is never looked at again

    def warm_up(self, model: ModelTuple) -> None:
        """Compile for a model what corrects it, if a camera may come."""
        if self._is_warm:
            warm_up_observer(self._pipeline.values, model)

    def _on_measured(self, message: Any) -> None:
        """Correct the prediction."""
        live, node = self._live, self._pipeline.node
        if live.arrival_ns is None:
            return
        if (observer := live.package.observer) is None:
            live.package.observe(observer := Observer(self._pipeline.values))
        stamp_ns, frame_id, *pose = read_pose(message, self._parts)
        self._measured_in.note(stamp_ns)
        covariance = np.reshape(message.pose.covariance, (6, 6)) if self._with_covariance else None
        self._pipeline.advance(live.on_measured, stamp_ns, frame_id, *pose, covariance)
        if frame_id != live.frame_id and not observer.sensor.has_own_world:
            node.get_logger().warning(
                f"package/measured is in frame '{short(frame_id)}', the tool in "
                f"'{short(live.frame_id)}', so its poses are not used. Set "
                'recording.package_world to the pose of the first frame in the second, as '
                'estimated by bellows identify.',
                throttle_duration_sec=10.0)
        self.log_alarms()
        if payload := self._observer and self._observer.payload:
            self._estimated.send(write_payload, self._pipeline.values['frames.lip'], payload)

    def on_vacuum(self, held: bool, cup: int) -> None:
        """Join the vacuum, or that of one cup, with what a camera sees."""
        self._live.on_vacuum(held, cup)
        self.log_alarms()

    def log_alarms(self) -> None:
        """Log the alarms since the last call, and go on without the cups that are lost."""
        alarms = self._observer.alarms if self._observer else []
        fresh, self._reported = alarms[self._reported:], len(alarms)
        for alarm in fresh:
            self._pipeline.node.get_logger().error(f'Alarm, {alarm.cause}: {alarm.message}')
        if lost := {alarm.cup for alarm in fresh if alarm.cup >= 0}:
            self.lost_cups |= lost
            self._pipeline.use_values()

    @property
    def alarm(self) -> Alarm | None:
        """The alarm of the last seconds, if any."""
        newest = self._observer.alarms[-1] if self._observer and self._observer.alarms else None
        is_recent = newest and self._live.newest_ns - newest.stamp_ns < ALARM_DURATION_NS
        return newest if is_recent else None

    def status(self, name: str) -> Status | None:
        """Return the line of the diagnostics; None if no message ever came."""
        observer = self._observer
        if observer is None:
            return None
        counts, payload = observer.counts, observer.payload
        more: dict[str, object] = {what: counts[what] for what in ('used', 'recovered')}
        if payload:
            more['mass (kg)'] = f'{payload.mass:.4g} ± {payload.mass_std:.2g}'
            for axis, value, std in zip('xyz', payload.com, payload.com_std, strict=True):
                more[f'com {axis} (mm)'] = f'{1e3 * value:.2f} ± {1e3 * std:.2g}'
        more |= Counter(f'alarm: {alarm.cause}' for alarm in observer.alarms)
        status = input_status(
            name, self._measured_in.report({verdict: counts[verdict] for verdict in VERDICTS}))
        status.values.update({key: str(value) for key, value in more.items()})
        if self.alarm:
            return status._replace(level=Level.ERROR, message=self.alarm.message)
        flight = self._live.flight
        is_held = self._live.attached and not (flight and flight.state)
        return status if is_held else status._replace(level=min(status.level, Level.WARN))
