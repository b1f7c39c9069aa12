"""Measured poses of the package: received, passed to the predictor, counted."""

from collections import Counter
from collections.abc import Mapping
import gc
import time
from typing import Any

from geometry_msgs.msg import InertiaStamped
import numpy as np

from .conversions import quaternion_xyzw, stamp_to_ns, TOOL_POSES, vector, write_payload
from .outputs import Topic
from .tool_inputs import SensorInput
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
    node : PredictorNode
        Subscribes, and starts afresh where a measured pose fails.
    kind : str
        Of `TOOL_POSES`.

    Attributes
    ----------
    lost_cups : set of int
        Cups of cup.layout that were found to be lost since the package was attached.

    """

    def __init__(self, node: Any, kind: str) -> None:
        """Subscribe; nothing changes before the first message."""
        self._with_covariance = kind != 'pose'
        message_type, self._pose_of = TOOL_POSES[kind]
        self._node, self._is_warm, self._reported = node, False, 0
        self.lost_cups: set[int] = set()
        self._measured_in = SensorInput(
            node, message_type, 'package/measured', self._on_measured, self._on_publishers)
        self._estimated = Topic(node, InertiaStamped, 'package/estimated')

    def set_values(self, live: LivePredictor, values: Mapping[str, Any]) -> None:
        """Use another predictor and other values; the estimate starts again, alarms stay."""
        self._live, self._values = live, values
        if before := self._observer:
            live.package.observe(observer := Observer(values))
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
            warm_up_observer(self._values, model)

    def _on_measured(self, message: Any) -> None:
        """Correct the prediction."""
        live, header, arrival_ns = self._live, message.header, time.monotonic_ns()
        if live.arrival_ns is None:
            return
        if (observer := live.package.observer) is None:
            live.package.observe(observer := Observer(self._values))
        stamp_ns = stamp_to_ns(header.stamp)
        self._measured_in.note(arrival_ns, stamp_ns)
        position, orientation = self._pose_of(message)
        covariance = np.reshape(message.pose.covariance, (6, 6)) if self._with_covariance else None
        self._node.advance(
            live.on_measured, stamp_ns, header.frame_id, vector(position),
            quaternion_xyzw(orientation), covariance)
        if header.frame_id != live.frame_id and not observer.sensor.has_own_world:
            self._node.get_logger().warning(
                f"package/measured is in frame '{short(header.frame_id)}', the tool in "
                f"'{short(live.frame_id)}', so its poses are not used. Set "
                'recording.package_world to the pose of the first frame in the second, as '
                'estimated by bellows identify.',
                throttle_duration_sec=10.0)
        self.log_alarms()
        payload = self._observer and self._observer.payload
        if payload and self._estimated.subscribed:
            self._estimated.send(write_payload, self._values['frames.lip'], payload)

    def log_alarms(self) -> None:
        """Log the alarms since the last call, and go on without the cups that are lost."""
        alarms = self._observer.alarms if self._observer else []
        fresh, self._reported = alarms[self._reported:], len(alarms)
        for alarm in fresh:
            self._node.get_logger().error(f'Alarm, {alarm.cause}: {alarm.message}')
        if lost := {alarm.cup for alarm in fresh if alarm.cup >= 0}:
            self.lost_cups |= lost
            self._node.use_values()

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
        counts = observer.counts
        status = input_status(
            name, self._measured_in.seen({verdict: counts[verdict] for verdict in VERDICTS}))
        more: dict[str, object] = {what: counts[what] for what in ('used', 'recovered')}
        payload = observer.payload
        if payload:
            more |= {
                'mass (kg)': f'{payload.mass:.4g} ± {payload.mass_std:.2g}',
                **{f'com {axis} (mm)': f'{1e3 * value:.2f} ± {1e3 * std:.2g}'
                   for axis, value, std in zip('xyz', payload.com, payload.com_std, strict=True)}}
        more |= Counter(f'alarm: {alarm.cause}' for alarm in observer.alarms)
        status = status._replace(values={
            **status.values, **{key: str(value) for key, value in more.items()}})
        if self.alarm:
            return status._replace(level=Level.ERROR, message=self.alarm.message)
        flight = self._live.flight
        is_held = self._live.attached and not (flight and flight.state)
        return status if is_held else status._replace(level=min(status.level, Level.WARN))
