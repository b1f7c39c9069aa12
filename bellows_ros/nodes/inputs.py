"""
Inputs: subscriptions, best effort unless overridden, monitored for rate, age and QoS.

The vacuum attaches and detaches the package; measured poses of the package and wrenches correct
the prediction.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
import math
import time
from typing import Any, NamedTuple

from bellows_ros.core.parameters.values import Values
from bellows_ros.files.messages import (
    DETECTIONS,
    LAYOUTS,
    LIP_FRAME,
    POSE_TYPES,
    REASONS,
    TRANSFORMS,
)
from geometry_msgs.msg import InertiaStamped, WrenchStamped
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, FluidPressure
from std_msgs.msg import Bool

from . import conversions
from .conversions import message_class, quaternion_xyzw, reader, stamp_to_ns, type_name, vector
from .guarding import GuardedNode
from .outputs import Predicting, QUEUE, Topic
from ..core.findings import Finding, Level
from ..core.geometry import lie
from ..core.geometry.tuples import Quaternion, Vector
from ..core.observer.observer import Observer, VERDICTS
from ..core.sensors.camera import TagCamera
from ..core.signals.screening import PoseSample
from ..core.signals.trajectory import NS_PER_S, same_frame
from ..core.signals.transforms import Chain
from ..errors import BellowsError, shown
from ..report import findings, health

RAW = frozenset({*LAYOUTS, DETECTIONS} - {TRANSFORMS})
"""Types of messages that callbacks receive as bytes."""


class SensorInput:
    """
    One subscription with the statistics of its messages.

    Parameters
    ----------
    node : rclpy.node.Node
    kind : type
        Type of the messages.
    topic : str
        Relative name.
    callback : callable
        Callback for each message; with its bytes if the type is one of `RAW`.
    qos : QoSProfile, optional
        Default: as for any sensor, without repetition of lost messages.

    Attributes
    ----------
    topic : str
        Full name.
    age : float
        Arrival minus stamp of the newest message on the node's clock, s; NaN without a stamp.

    """

    def __init__(
        self, node: GuardedNode, kind: type, topic: str, callback: Callable[[Any], None],
        qos: QoSProfile | None = None,
    ) -> None:
        self._node, self._type = node, type_name(kind)
        self._clock: Any = node.get_clock()
        self.last_ns, self._count, self.age = -1, 0, math.nan
        self._intervals, self._ages = health.window(), health.window()
        self._refused: Mapping[str, int] = {}
        self._subscription = node.create_subscription(
            kind, topic, callback,
            qos or QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT),
            raw=self._type in RAW)
        self.topic = str(self._subscription.topic_name)

    def note(self, stamp_ns: int | None = None) -> int:
        """
        Record a message, and its age if it has a stamp; return its arrival (ns), monotonic.

        The system's clock is read in 0.04 us instead of 2.5 us for the node's clock. Both are
        equal unless time is simulated, which is checked once per report.
        """
        arrival_ns = time.monotonic_ns()
        if not self._count:
            self._is_simulated = self._clock.ros_time_is_active
        now_ns = self._clock.now().nanoseconds if self._is_simulated else time.time_ns()
        self.age = math.nan if stamp_ns is None else (now_ns - stamp_ns) / NS_PER_S
        if self.last_ns >= 0:
            self._intervals.append((arrival_ns - self.last_ns) / NS_PER_S)
        self.last_ns = arrival_ns
        self._count += 1
        self._ages.append(self.age)
        return arrival_ns

    def report(self, refused: Mapping[str, int]) -> health.InputReport:
        """Return the statistics since the last call, with the rejected messages so far."""
        before, self._refused = self._refused, dict(refused)
        silent = (time.monotonic_ns() - self.last_ns) / NS_PER_S if self.last_ns >= 0 else math.inf
        count, self._count = self._count, 0
        publishers = self._node.count_publishers(self.topic)
        return health.InputReport(
            self.topic, publishers, self._mismatch(publishers), count,
            health.taken(self._intervals), health.taken(self._ages), silent,
            {reason: count - before.get(reason, 0) for reason, count in refused.items()}, refused)

    def _mismatch(self, publishers: int) -> Finding | None:
        """Return the finding on several publishers, if any; rclpy logs an incompatible QoS."""
        if publishers < 2 or self._type == TRANSFORMS:  # /tf is shared
            return None
        others = self._node.get_publishers_info_by_topic(self.topic)
        return health.fact('publishers', topic=self.topic, names=', '.join(
            sorted({shown(other.node_name) for other in others})))


class TransformInput(SensorInput):
    """
    The poses of the tool by tf: the chain from `frames.world` to `frames.tool`.

    Parameters
    ----------
    node : rclpy.node.Node
    values : mapping
        Parameters by name.
    on_pose : callable
        Callback with stamp (ns), frame, position and quaternion of each pose.

    Raises
    ------
    BellowsError
        If tf2_msgs is not installed.

    """

    def __init__(
        self, node: GuardedNode, values: Values, on_pose: Callable[..., None]
    ) -> None:
        """Subscribe to transforms, and to the static ones, which are sent once."""
        kind = message_class(TRANSFORMS, 'tool_pose.type is tf', 'tool_arm/pose')
        self._on_pose = on_pose
        self._chain = Chain(values.frames.world, values.frames.tool)
        super().__init__(node, kind, '/tf', self._on_moving)
        self._static = SensorInput(
            node, kind, '/tf_static', partial(self._add, static=True),
            qos=QoSProfile(depth=QUEUE, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def _on_moving(self, message: Any) -> None:
        """Process the poses that a message completes."""
        self._add(message, static=False)
        for pose in self._chain.due():
            self._on_pose(pose.stamp_ns, self._chain.world, *pose[1:])

    def _add(self, message: Any, static: bool) -> None:
        """Add the transforms of a message to the tree."""
        for stamped in message.transforms:
            header, transform = stamped.header, stamped.transform
            self._chain.add(header.frame_id, stamped.child_frame_id, PoseSample(
                stamp_to_ns(header.stamp), vector(transform.translation),
                quaternion_xyzw(transform.rotation)), static)

    def report(self, refused: Mapping[str, int]) -> health.InputReport:
        """Return the arrivals since the last call, with the poses that lacked a transform."""
        return super().report({**refused, 'no_transform': self._chain.dropped})

    def _mismatch(self, publishers: int) -> Finding | None:
        """Return the finding on missing poses despite a publisher."""
        missing = self._chain.missing if publishers and not self._count else ''
        return health.fact('frames', topic=self.topic, name=missing) if missing else (
            super()._mismatch(publishers))


class Attachment:
    """
    Services and vacuum signal that attach and detach the package.

    Parameters
    ----------
    pipeline : Predicting
        Pipeline that attaches and detaches the package.

    """

    def __init__(self, pipeline: Predicting) -> None:
        """Offer the services, and subscribe to the vacuum if configured."""
        self._pipeline, self._live, node = pipeline, pipeline.live, pipeline.node
        self._kind = self._live.values.vacuum.signal
        for service, held, words in (
                ('attach', True, 'Attached: starts from rest at the next tool pose.'),
                ('detach', False, 'Detached: nothing is predicted.')):
            node.create_trigger(f'package/{service}', partial(
                pipeline.publish, self._live.set_attached, held), words)
        self._refused = Counter[str]()
        if self._kind == 'bool':
            self._signal = SensorInput(node, Bool, 'vacuum/held', self._on_held)
        elif self._kind == 'pressure':
            self._signal = SensorInput(node, FluidPressure, 'vacuum/pressure', self._on_pressure)

    def _on_held(self, message: Bool) -> None:
        """Process a message of a vacuum switch."""
        self._signal.note()
        self._pipeline.change(self._live.on_vacuum, message.data)

    def _on_pressure(self, message: FluidPressure) -> None:
        """Process the pressure in the cup, and continue without a gripper's lost cups."""
        self._signal.note(stamp_to_ns(message.header.stamp))
        if rejected := self._pipeline.change(
                self._live.on_pressure, message.fluid_pressure, message.header.frame_id):
            self._refused[rejected] += 1

    def status(self) -> health.Status | None:
        """Return the diagnostics line on the vacuum signal, if any."""
        return None if self._kind == 'none' else health.vacuum_status(
            'vacuum', self._signal.report(self._refused), self._live.attached,
            self._live.vacuum.open_cups, latched=self._kind == 'bool')


MEASURED = 'package/measured'
"""Topic of the poses of the package, or of its tag."""

MAX_WRENCHES = 64
"""Number of wrenches used for each pose of the tool, so that its poses keep their rate: sensors
send at most 7 kHz, arms at least 125 Hz."""

MAX_MEASURED = 10
"""Number of measured poses used for each pose of the tool: trackers send at most 500 Hz, arms at
least 50 Hz."""

MAX_VIEWS = 1
"""Number of views of a tag used for each pose of the tool: a view takes 1 ms, and cameras are
slower than arms."""


class Source(NamedTuple):
    """
    The source of measured poses for a choice of measured.type.

    Parameters
    ----------
    message : str
        ROS name of the message type.
    use : callable
        Callback for each message.
    topic : str
        Relative name.
    most : float
        Largest number of messages used for each pose of the tool.

    """

    message: str
    use: Callable[[Any], None]
    topic: str = MEASURED
    most: float = MAX_MEASURED


class PackageInput:
    """
    Subscribers to measurements of the package, and the outputs of its observer.

    Parameters
    ----------
    pipeline : Predicting
        Pipeline that processes the poses.

    """

    def __init__(self, pipeline: Predicting) -> None:
        """Subscribe; nothing changes before the first message."""
        self._pipeline, self._live, node = pipeline, pipeline.live, pipeline.node
        given = self._live.values.measured
        kind, self._child_frame, self._published_ns = given.type, given.child_frame.lstrip('/'), 0
        self._reported = 0
        self._tag, self._frame = TagCamera(), ''
        self._no_view, self._no_wrench = Counter[str](), Counter[str]()
        source = self._sources()[kind]
        self._type = message_class(source.message, f'measured.type is {kind}', MEASURED)
        self._measured_in = self._input(
            self._type, source.topic, source.most, self._no_view, source.use)
        if kind in POSE_TYPES:
            self._read, self._has_covariance = reader(self._type), bool(
                LAYOUTS[source.message].pose_covariance)
        if kind == 'detections':
            SensorInput(node, CameraInfo, 'package/camera_info', self._on_camera_info)
        self._read_wrench = reader(WrenchStamped)
        self._wrench_in = self._input(
            WrenchStamped, 'tool_arm/wrench', MAX_WRENCHES, self._no_wrench, self._on_wrench)
        self._estimated = Topic(InertiaStamped, 'package/estimated').advertise(node)
        self._std = Topic(InertiaStamped, 'package/estimated_std').advertise(node)

    def _sources(self) -> dict[str, Source]:
        """Return the source of measured poses by measured.type."""
        return {
            **{name: Source(message, self._on_measured) for name, message in POSE_TYPES.items()},
            'tf': Source(TRANSFORMS, self._on_transforms, '/tf', math.inf),
            'detections': Source(DETECTIONS, self._on_detections, most=MAX_VIEWS)}

    @property
    def _observer(self) -> Observer:
        """The observer that corrects the predictions."""
        return self._live.package.observer

    def _input(
        self, kind: type, topic: str, most: float, refused: Counter[str],
        use: Callable[[Any], None],
    ) -> SensorInput:
        """Subscribe, and use at most so many messages for each pose of the tool."""
        poses = count = 0

        def on_message(message: Any) -> None:
            nonlocal poses, count
            if not self._pipeline.node.is_active:
                return
            before, poses = poses, self._live.screen.poses
            count = count + 1 if poses == before else 1
            if count <= most:
                use(message)
            else:
                refused['too_many'] += 1

        return SensorInput(self._pipeline.node, kind, topic, on_message)

    def _on_measured(self, data: bytes) -> None:
        """Correct the prediction by a measured pose."""
        stamp_ns, (frame_id, *_), numbers = self._read(data)
        covariance = np.reshape(numbers[7:43], (6, 6)) if self._has_covariance else None
        self._correct(stamp_ns, frame_id, (numbers[:3], numbers[3:7]), covariance)

    def _on_wrench(self, data: bytes) -> None:
        """Correct the prediction by a wrench of the force-torque sensor."""
        stamp_ns, (frame_id,), numbers = self._read_wrench(data)
        self._wrench_in.note(stamp_ns)
        if refused := self._pipeline.change(
                self._live.on_wrench, stamp_ns, frame_id, numbers[:3], numbers[3:]):
            self._no_wrench[refused] += 1
        self._publish_payload()

    def _on_transforms(self, message: Any) -> None:
        """Correct the prediction by the frame of a tag, in its parent."""
        for each in message.transforms:
            if each.child_frame_id.lstrip('/') == self._child_frame:
                header, transform = each.header, each.transform
                self._correct(stamp_to_ns(header.stamp), header.frame_id, (
                    vector(transform.translation), quaternion_xyzw(transform.rotation)))

    def _on_camera_info(self, message: CameraInfo) -> None:
        """Note the calibration of a camera."""
        try:
            self._tag.calibrate(message, self._live.values.measured.rectified)
        except BellowsError as error:
            self._pipeline.node.get_logger().error(str(error), throttle_duration_sec=30.0)

    def _on_detections(self, data: bytes) -> None:
        """Correct the prediction by the corners of a tag, in its camera."""
        message = deserialize_message(data, self._type)
        given, stamp_ns = self._live.values.measured, stamp_to_ns(message.header.stamp)
        seen = self._tag.pose(message, given.tag_size, given.child_frame)
        if not isinstance(seen, str):
            position, rotation = seen
            self._correct(stamp_ns, message.header.frame_id, (
                tuple(position.tolist()), tuple(lie.rotation_to_quaternion(rotation).tolist())))
        elif seen:
            self._measured_in.note(stamp_ns)
            self._no_view[seen] += 1

    def _correct(
        self, stamp_ns: int, frame_id: str, pose: tuple[Vector, Quaternion],
        covariance: Any = None,
    ) -> None:
        """Correct the prediction, and publish the estimated package."""
        arrival_ns, self._frame = self._measured_in.note(stamp_ns), frame_id
        self._pipeline.change(
            self._live.on_measured, stamp_ns, frame_id, *pose, covariance, arrival_ns)
        self._publish_payload()

    def _publish_payload(self) -> None:
        """Publish a newly estimated payload, if any."""
        payload = self._observer.payload
        if payload is None or payload.stamp_ns == self._published_ns:
            return
        self._published_ns = payload.stamp_ns
        for topic, make in ((self._std, conversions.payload_std_message),
                            (self._estimated, conversions.payload_message)):
            if topic.subscribed:
                topic.publish(make(LIP_FRAME, payload))

    def log_alarms(self) -> None:
        """Log the alarms since the last call."""
        alarms = self._live.alarms
        new_alarms, self._reported = alarms[self._reported:], len(alarms)
        for alarm in new_alarms:
            self._pipeline.node.get_logger().error(
                f'Alarm, {alarm.kind}: {findings.text(alarm.finding)}')

    def _is_used(self, source: SensorInput, prefix: str) -> bool:
        """Return whether a stream has come, or is described by parameters that are set."""
        return source.last_ns >= 0 or any(
            name.startswith(prefix) for name in self._pipeline.node.overridden)

    def wrench_status(self) -> health.Status | None:
        """Return the line of the diagnostics on the wrenches, if there are any."""
        if not self._is_used(self._wrench_in, 'wrench.'):
            return None
        status = health.input_status('wrench', self._wrench_in.report(self._no_wrench), (
            Level.WARN if self._wrench_in.last_ns < 0 else Level.ERROR))
        fault = self._live.wrench_fault
        return status._replace(finding=health.fact(
            'wrench', Level.ERROR, self._wrench_in.topic,
            reason=REASONS[f'wrench_{fault.name}'].format(
                rotation=fault.rotation))) if fault else status

    def status(self) -> health.Status | None:
        """Return the line of the diagnostics on measured poses, if there are any."""
        observer, live = self._observer, self._live
        if not self._is_used(self._measured_in, 'measured.'):
            return None
        counts, payload = observer.counts, observer.payload
        more: dict[str, object] = {what: counts[what] for what in ('used', 'recovered')}
        if payload:
            more['mass (kg)'] = f'{payload.mass:.4g} ± {payload.mass_std:.2g}'
            for axis, value, std in zip('xyz', payload.com, payload.com_std, strict=True):
                more[f'com {axis} (mm)'] = f'{1e3 * value:.2f} ± {1e3 * std:.2g}'
        if not math.isnan(slip := observer.smallest_slip):
            more['smallest slip found (mm)'] = f'{1e3 * slip:.1f}'
        more |= Counter(f'alarm: {alarm.kind}' for alarm in live.alarms)
        is_needed = live.attached and self._measured_in.last_ns >= 0
        status = health.input_status('measured package', self._measured_in.report(
            {**{verdict: counts[verdict] for verdict in VERDICTS}, **self._no_view}),
            Level.ERROR if is_needed else Level.WARN)
        status.values.update({key: str(value) for key, value in more.items()})
        if alarm := live.alarm:
            return status._replace(finding=alarm.finding)
        if not (observer.sensor.has_own_world or same_frame(self._frame, live.frame_id)):
            return status._replace(finding=health.fact(
                'package_world', why=f": {self._measured_in.topic} is in '{shown(self._frame)}', "
                f"the tool in '{shown(live.frame_id)}', so its poses are not used"))
        return status
