"""
From messages to predictions: inputs, live predictor and outputs of a configured predictor.

Inputs are subscriptions to sensors, best effort unless overridden, monitored for rate, age and
QoS: the tool's poses and twists; the vacuum, which attaches and detaches the package as two
services do; and measured poses of the package, which correct the prediction.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
import gc
import importlib.util
import math
from operator import mul
import time
from typing import Any

from bellows_ros.core.parameters.checks import gravity_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.files.messages import LAYOUTS, TRANSFORMS
from bellows_ros.files.parameter_files import with_chosen_cup
from geometry_msgs.msg import InertiaStamped, TwistStamped
import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from . import conversions
from .conversions import quaternion_xyzw, reader, stamp_to_ns, TOOL_POSES, type_name, vector
from .guarding import GuardedNode
from .node_parameters import ManagedNode
from .outputs import Outputs, Predicting, QUEUE, Topic, Tossing
from .planning import Planning
from ..core.geometry.jit import release_compiler
from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import flight, health, LivePredictor, load, Prediction, uncertainty, warm_up
from ..core.model.cup_package import cup_of, model_tuple, package_of
from ..core.model.kernels import ModelTuple
from ..core.observer.alarms import Alarm
from ..core.observer.observer import Observer, VERDICTS, warm_up_observer
from ..core.signals.screening import PoseSample
from ..core.signals.trajectory import NS_PER_S, tip_of
from ..core.signals.transforms import Chain
from ..errors import BellowsError, shown

TICK = 0.02
"""Time (s) between two checks for missing messages; each costs as much as a message."""

PAUSE_NS = 40_000_000
"""A tick this late (ns) after the last shows that the process paused: messages are waiting."""

MAX_TWIST_WAIT_NS = 40_000_000
"""This long (ns) after the newest pose none waits for its twist any longer."""

MIN_UPWARD_GRAVITY = 0.5
"""Above this fraction of gravity along z of the tool the package is above the tool."""

ENCODED = LAYOUTS.keys() - {TRANSFORMS}
"""Types of which a subscription takes the bytes."""

MAX_CLOCK_OFFSET_NS = 500_000_000
"""If the node's clock differs by more (ns), the valve is switched at the newest pose."""


class Pipeline(Predicting):
    """
    The live predictor with all that feeds it and all that publishes its predictions.

    Parameters
    ----------
    node : ManagedNode

    Attributes
    ----------
    pose_in, twist_in : SensorInput
    compute : deque
        Computing times of messages, s.

    """

    def __init__(self, node: ManagedNode) -> None:
        """Prepare the model, compile all it needs, and only then make the topics."""
        self.node = node
        self.values = values = with_chosen_cup(node.values)
        self.compute, self._reported = health.window(), Counter[str]()
        self._ticked_ns = 0
        self._was_late = self._is_compiling = False
        self._arrival_at_last_tick: int | None = None
        self._compile_predictor(values)
        self._compiled = {_kernels_of(values)}
        self.live = LivePredictor(
            cup_of(values), package_of(values), gravity_of(values), values.tool_twist.frame)
        self.live.tool.set_tip(tip_of(values))
        self.load = load.Load(values)
        self.outputs = Outputs(self)
        self._publish_secondary_guarded = node.guarded(self._publish_secondary)
        if values.tool_pose.type == 'tf':
            self.pose_in: SensorInput = TransformInput(node, values, self.process_pose)
        else:
            kind = TOOL_POSES[values.tool_pose.type]
            self._read_pose = reader(kind)
            self.pose_in = SensorInput(node, kind, 'tool_arm/pose', self._on_pose)
        self._read_twist = reader(TwistStamped)
        self.twist_in = SensorInput(
            node, TwistStamped, 'tool_arm/twist', self._on_twist, self._on_twist_publishers)
        self.attachment = Attachment(self)
        self.planning = Planning(self)
        self.tossing = Tossing(self, self.planning.rest, lambda now: (
            self.outputs.uncertainty.covariance(now)))
        node.create_subscription(
            Bool, 'vacuum/valve', lambda message: self.switch_valve(message.data), 10)
        self.observing = Observing(self)
        self._apply()
        release_compiler()
        node.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def is_above(self) -> bool:
        """Whether z of the tool points down, so that the package is above it."""
        if self.latest is None:
            return False
        (x, y, z, w), gravity = self.latest.tool[1], self.live.model[2]
        z_world = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
        along: float = sum(map(mul, z_world, gravity))
        return along > MIN_UPWARD_GRAVITY * math.hypot(*gravity)

    def new_counts(self) -> Counter[str]:
        """Return fresh starts by reason, poses, and those without a twist, since the last call."""
        live, before = self.live, self._reported
        self._reported = Counter(
            {**live.restarts, 'poses': live.poses_in, 'alone': live.twists_estimated})
        return self._reported - before

    def stop(self) -> None:
        """Stop publishing, and drop plans and searches."""
        self.outputs.publish_state('inactive')
        self.latest = None
        self.live.reset()
        for worker in self.node.workers:
            worker.cancel()
        self.planning.forget()

    # --------------------------------------------------------------- messages

    def process_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, orientation: Quaternion
    ) -> None:
        """Predict with a pose of the tool, wherever it is from."""
        if not self.node.is_active:
            return
        arrival_ns = self.pose_in.note(stamp_ns)
        self.publish(self.live.on_pose, stamp_ns, frame_id, position, orientation, arrival_ns)
        self.compute.append((time.monotonic_ns() - arrival_ns) / NS_PER_S)

    def _on_pose(self, data: bytes) -> None:
        """Predict with a message."""
        if self.node.is_active:
            stamp_ns, names, numbers = self._read_pose(data)
            self.process_pose(stamp_ns, names[0], numbers[:3], numbers[3:7])

    def _on_twist(self, data: bytes) -> None:
        """Predict with a twist of the tool."""
        if not self.node.is_active:
            return
        stamp_ns, names, numbers = self._read_twist(data)
        arrival_ns = self.twist_in.note(stamp_ns)
        self.publish(self.live.on_twist, stamp_ns, numbers[:3], numbers[3:], names[0])
        self.compute.append((time.monotonic_ns() - arrival_ns) / NS_PER_S)

    def advance(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a step of the live prediction does; start afresh where it raises."""
        try:
            return step(*arguments)
        except Exception:
            self.restart('failure')
            raise

    def restart(self, reason: str) -> None:
        """Start again from rest, as after a failure, or where simulated time was set."""
        if self.node.is_active:
            self.live.reset(reason)
            self.latest = None

    def publish(self, step: Callable[..., list[Prediction]], *arguments: Any) -> None:
        """Send the predictions of a step; other outputs that fail do not affect their poses."""
        was_predicting = self.latest is not None
        for prediction in self.advance(step, *arguments):
            self.latest = prediction
            self.outputs.publish(prediction)
            self._publish_secondary_guarded(prediction)
        if self.latest and not was_predicting:  # a tick may be too late to see it
            self.publish_state()

    def _publish_secondary(self, prediction: Prediction) -> None:
        """Send all but the pose, and watch the load on the cup."""
        factors = self.load.watch_force(self.live.model, prediction)
        if factors and min(factors) < self.load.required:
            self.outputs.note_unsafe()
        self.outputs.publish_more(prediction, factors)
        self.planning.follow()

    # ----------------------------------------------------------------- events

    def _on_twist_publishers(self, count: int) -> None:
        """Let poses wait for their twists while twists have a publisher."""
        self.live.expect_twists(count > 0)
        if self.node.is_active and not count:
            self.publish(self.live.flush)

    def switch_valve(self, on: bool) -> None:
        """Toss the package when its valve is switched off; take up the next one with it on."""
        if not self.node.is_active:
            return
        if not self.tossing.flight.has_size:
            self.node.get_logger().warning(
                'vacuum/valve has a publisher, but package.size is not set, so the package '
                'counts as held. Set package.size and landing.height.', once=True)
            return
        stamp_ns, newest_ns = self.node.get_clock().now().nanoseconds, self.live.newest_ns
        if abs(stamp_ns - newest_ns) > MAX_CLOCK_OFFSET_NS:  # stamps are of another clock
            stamp_ns = newest_ns
        if on and self.tossing.flight.state:
            self.latest = None  # of the package before
        self.advance(self.live.switch_valve, on, stamp_ns)
        self.publish_state()

    def attach(self, held: bool, why: str) -> bool:
        """Attach or detach the package; return whether the node is active."""
        if not self.node.is_active:
            return False
        if not held and self.tossing.flight.state:  # the vacuum falls, as the valve has it
            return True
        self.publish(self.live.set_attached, held)
        if held and self.observing.lost_cups:  # they may hold the next package
            self.observing.lost_cups.clear()
            self.use_values()
        self.latest = None
        self.node.get_logger().info(f'{"Attached" if held else "Detached"} ({why}).')
        self.publish_state()
        return True

    def _tick(self) -> None:
        """Predict for waiting poses when no more messages arrive, and bridge a pause."""
        before_ns, self._ticked_ns = self._ticked_ns, time.monotonic_ns()
        # After a pause of this process what waits comes first; not twice.
        self._was_late = not self._was_late and self._ticked_ns - before_ns > PAUSE_NS
        if self._is_compiling and len(self._compiled) > 1:
            self.use_values()
        if not self.node.is_active or self._was_late:
            return
        live = self.live
        if live.pairing.waiting and (
                self._ticked_ns - (live.arrivals.newest_ns or 0) >= MAX_TWIST_WAIT_NS):
            self.publish(live.flush)
        if live.arrivals.newest_ns == self._arrival_at_last_tick:
            self.publish(live.coast, self._ticked_ns)
        self._arrival_at_last_tick = live.arrivals.newest_ns
        self.publish_state()
        if held := self.held:
            self.load.watch_deflection(live.model, held)
            self.tossing.publish(held)

    def publish_state(self) -> None:
        """Publish the state when it changes."""
        alarm = self.observing.alarm
        self.outputs.publish_state(
            f'alarm: {alarm.cause}' if alarm else self.live.phase(time.monotonic_ns()),
            self.is_above)

    # ------------------------------------------------------------- parameters

    def use_values(self) -> None:
        """Use the node's parameters, without cups that do not hold; the package moves on."""
        values = with_chosen_cup(self.node.values)
        opened = {*values.cup.open, *map(
            float, {*self.attachment.vacuum.open_cups, *self.observing.lost_cups})}
        if len(opened - {-1.0}) < len(values.cup.layout) // 3:  # else none holds: see detached
            values = values.replaced({'cup.open': tuple(opened)})
        if _kernels_of(values) not in self._compiled:
            if not self._is_compiling:
                self.node.get_logger().info(
                    'Compiling for the new values; the ones before are used until then.')
                self.node.in_background(partial(self._compile, values))
            self._is_compiling = True
            return
        self._is_compiling = False
        self.values = values
        self.live.set_model(cup_of(values), package_of(values))
        self._apply()

    def _compile_predictor(self, values: Values) -> ModelTuple:
        """Compile what predicts with some values, and tosses; return their model."""
        cup, package, gravity = cup_of(values), package_of(values), gravity_of(values)
        model = model_tuple(cup, package, gravity)
        warm_up(cup, package, gravity, values.tool_twist.frame)
        release = flight.Flight(values)
        if release.has_size:  # whose landings have a covariance
            release.warm_up(model)
            uncertainty.warm_up_uncertainty(cup.relaxation)
        return model

    def _compile(self, values: Values) -> None:
        """Compile for values of another kind, in a thread; the next tick goes on with them."""
        try:
            model = self._compile_predictor(values)
            uncertainty.warm_up_uncertainty(cup_of(values).relaxation)
            self.observing.warm_up(model)
            release_compiler()
        finally:  # what fails to compile fails again where it is used
            self._compiled.add(_kernels_of(values))

    def _apply(self) -> None:
        """Let all parts use the values and the model, between two messages."""
        live, values = self.live, self.values
        self.load = load.Load(values, self.load.pressure)
        self.observing.use_values()
        self.outputs.use_values()
        self.planning.use_values()
        if live.flight is None or not live.flight.state:
            self.tossing.use_values()
        live.configure(round(values.coast.limit * NS_PER_S), self.tossing.flight)


def _kernels_of(values: Values) -> tuple[int, bool]:
    """Return the properties of values that decide on kernels: relaxing cups, flights."""
    return len(cup_of(values).as_tuple), flight.Flight(values).has_size


class SensorInput:
    """
    One subscription with the statistics of its messages.

    Parameters
    ----------
    node : rclpy.node.Node
    kind : type
        Of the messages.
    topic : str
        Relative name.
    callback : callable
        Takes each message; its bytes if the type is one of `LAYOUTS`.
    on_publishers : callable, optional
        Takes the number of matching publishers when it changes.
    qos : QoSProfile, optional
        As for any sensor unless given: without asking for lost messages.

    Attributes
    ----------
    topic : str
        Full name.

    """

    def __init__(
        self, node: GuardedNode, kind: type, topic: str, callback: Callable[[Any], None],
        on_publishers: Callable[[int], None] | None = None, qos: QoSProfile | None = None,
    ) -> None:
        """Listen as to any sensor, without asking for lost messages; QoS can be overridden."""
        self._node, self._type = node, type_name(kind)
        self.arrivals = health.Arrivals()
        self._refused: Mapping[str, int] = {}
        self._subscription = node.create_subscription(
            kind, topic, callback,
            qos or QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT),
            on_publishers=on_publishers, raw=type_name(kind) in ENCODED)
        self.topic = str(self._subscription.topic_name)

    def note(self, stamp_ns: int | None = None) -> int:
        """
        Note a message, and its age if it has a stamp; return its arrival (ns), monotonic.

        The node's clock takes 2.5 us to ask, the system's 0.04: it is the same one unless time is
        simulated, which is looked up once a report.
        """
        arrival_ns = time.monotonic_ns()
        if not self.arrivals.count:
            self._clock = self._node.get_clock()
            self._is_simulated = bool(getattr(self._clock, 'ros_time_is_active', False))
        now_ns = self._clock.now().nanoseconds if self._is_simulated else time.time_ns()
        age = math.nan if stamp_ns is None else (now_ns - stamp_ns) / NS_PER_S
        self.arrivals.add(arrival_ns, age)
        return arrival_ns

    def report(self, refused: Mapping[str, int]) -> health.InputReport:
        """Return the statistics since the last call, with the refused messages so far."""
        before, self._refused = self._refused, dict(refused)
        if any(count < before.get(reason, 0) for reason, count in refused.items()):
            before = {}  # what counts has been replaced
        last_ns = self.arrivals.last_ns
        silent = (time.monotonic_ns() - last_ns) / NS_PER_S if last_ns >= 0 else float('inf')
        publishers = self._node.count_publishers(self.topic)
        return health.InputReport(
            self.topic, publishers, self._mismatch(publishers), *self.arrivals.reset(), silent,
            {reason: count - before.get(reason, 0) for reason, count in refused.items()}, refused)

    def _mismatch(self, publishers: int) -> str:
        """Return why a publisher cannot be heard, if there is one."""
        if self._subscription.get_publisher_count() >= publishers:
            return ''
        asked = self._subscription.qos_profile
        for other in self._node.get_publishers_info_by_topic(self.topic):
            offered = other.qos_profile
            if other.topic_type != self._type:
                return self._sentence('type', other.topic_type)
            for name, mismatch in (
                    ('reliability', (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)),
                    ('durability', (DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE))):
                if (getattr(asked, name), getattr(offered, name)) == mismatch:
                    return self._sentence('qos', name)
        return ''

    def _sentence(self, mismatch: str, name: str) -> str:
        """Return what does not match, in words."""
        return str(health.INPUTS[mismatch].format(topic=self.topic, name=name))


class TransformInput(SensorInput):
    """
    The poses of the tool by tf: the way from `frames.world` to `frames.tool`.

    Parameters
    ----------
    node : rclpy.node.Node
    values : mapping
        Parameters by name.
    on_pose : callable
        Takes stamp (ns), frame, position and quaternion of each pose.

    Raises
    ------
    BellowsError
        Where tf2_msgs is not installed.

    """

    def __init__(
        self, node: GuardedNode, values: Values, on_pose: Callable[..., None]
    ) -> None:
        """Listen to transforms, and to the static ones, which come once."""
        if importlib.util.find_spec('tf2_msgs') is None:
            raise BellowsError(
                'tool_pose.type is tf, but tf2_msgs is not installed. Install it (apt: '
                'ros-jazzy-tf2-msgs), or publish the pose on tool_arm/pose.')
        from tf2_msgs.msg import TFMessage

        self._on_pose = on_pose
        self._chain = Chain(values.frames.world, values.frames.tool)
        super().__init__(node, TFMessage, '/tf', self._on_moving)
        self._static = SensorInput(
            node, TFMessage, '/tf_static', partial(self._add, static=True),
            qos=QoSProfile(depth=QUEUE, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def _on_moving(self, message: Any) -> None:
        """Pass on the poses that a message completes."""
        self._add(message, static=False)
        for pose in self._chain.due():
            self._on_pose(pose.stamp_ns, self._chain.world, *pose[1:])

    def _add(self, message: Any, static: bool) -> None:
        """Put the transforms of a message into the tree."""
        for stamped in message.transforms:
            header, transform = stamped.header, stamped.transform
            self._chain.add(header.frame_id, stamped.child_frame_id, PoseSample(
                stamp_to_ns(header.stamp), vector(transform.translation),
                quaternion_xyzw(transform.rotation)), static)

    def report(self, refused: Mapping[str, int]) -> health.InputReport:
        """Return the arrivals since the last call, with the poses that lacked a transform."""
        return super().report({**refused, 'no_transform': self._chain.dropped})

    def _mismatch(self, publishers: int) -> str:
        """Return why there is no pose although there is a publisher."""
        missing = self._chain.missing if publishers and not self.arrivals.count else ''
        return self._sentence('frames', missing) if missing else super()._mismatch(publishers)


class Attachment:
    """
    Ask to attach and to detach.

    What a service asks for holds until the vacuum signal changes the next time.

    Parameters
    ----------
    pipeline : Pipeline
        Attaches and detaches.

    Attributes
    ----------
    held : bool
        Whether the cup holds the package, by the newest service call or vacuum signal.
    signal : SensorInput or None
        The vacuum signal, where one is asked for.
    vacuum : Vacuum
        Which cups hold, by their pressures.

    """

    def __init__(self, pipeline: Pipeline) -> None:
        """Offer the services, and listen to the vacuum if the parameters say so."""
        self._pipeline, node, values = pipeline, pipeline.node, pipeline.values
        self.vacuum = load.Vacuum()
        self._kind = values.vacuum.signal
        self.held = values.package.attached and self._kind == 'none'
        for service, held, words in (
                ('attach', True, 'Attached: starts from rest at the next tool pose.'),
                ('detach', False, 'Detached: nothing is predicted.')):
            node.create_service(Trigger, f'package/{service}', partial(self._answer, held, words))
        self._last_reading: bool | None = None  # by the vacuum signal, the last time
        self._refused = {'nan': 0, 'negative': 0, 'no_such_cup': 0}
        self.signal = None if self._kind == 'none' else SensorInput(node, *{
            'bool': (Bool, 'vacuum/held', self._on_held),
            'pressure': (FluidPressure, 'vacuum/pressure', self._on_pressure)}[self._kind])

    def _answer(
        self, held: bool, words: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Carry out a service request."""
        response.success = self._pipeline.attach(held, 'service')
        response.message = words if response.success else 'The node is not active.'
        if response.success:
            self.held = held
        return response

    def _on_held(self, message: Bool) -> None:
        """Follow a vacuum switch."""
        assert self.signal
        self.signal.note()
        self._pipeline.observing.on_vacuum(message.data, load.ALL)
        self._follow(message.data)

    def _on_pressure(self, message: FluidPressure) -> None:
        """Follow the pressure in the cup, and go on without cups of a gripper that lose it."""
        assert self.signal
        self.signal.note(stamp_to_ns(message.header.stamp))
        vacuum, opened = self.vacuum, self.vacuum.open_cups
        readings = vacuum.update(
            self._pipeline.values, message.fluid_pressure, message.header.frame_id)
        if isinstance(readings, str):
            self._refused[readings] += 1
            return
        for reading in readings:
            self._pipeline.observing.on_vacuum(*reading)
        if vacuum.pressure is not None:
            self._pipeline.load.set_pressure(vacuum.pressure)
        if vacuum.open_cups != opened:
            cups = ', '.join(map(str, vacuum.open_cups))
            self._pipeline.node.get_logger().warning(
                f'Without vacuum: cups {cups} of cup.layout.' if cups else 'All cups have vacuum.')
            self._pipeline.use_values()
        self._follow(vacuum.held)

    def _follow(self, held: bool) -> None:
        """Follow the vacuum when it changes; a node that is not active yet does so once it is."""
        changed, self._last_reading = held != self._last_reading, held
        if changed and held != self.held:
            self.held = held
            self._pipeline.attach(held, 'vacuum')

    def status(self, name: str) -> health.Status | None:
        """Return the diagnostics line on the vacuum signal, if there is to be one."""
        if self.signal is None:
            return None
        latched = self._kind == 'bool'
        return health.vacuum_status(name, self.signal.report(self._refused), self.held, latched)


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
    is_ready : bool
        Whether everything is compiled; measured poses are used from then on.

    """

    def __init__(self, pipeline: Pipeline) -> None:
        """Subscribe; nothing changes before the first message."""
        self._pipeline, node = pipeline, pipeline.node
        self._live = pipeline.live
        kind = pipeline.values.measured.type
        self._with_covariance = kind != 'pose'
        message_type = TOOL_POSES[kind]
        self._read = reader(message_type)
        self._has_camera = self.is_ready = False
        self._reported = 0
        self.lost_cups: set[int] = set()
        self._measured_in = SensorInput(
            node, message_type, 'package/measured', self._on_measured, self._on_publishers)
        self._estimated = Topic(InertiaStamped, 'package/estimated').advertise(node)

    def use_values(self) -> None:
        """Use other values; the estimate starts again, alarms stay."""
        if before := self._observer:
            self._live.package.observe(Observer(self._pipeline.values, before.alarms))

    @property
    def _observer(self) -> Observer | None:
        """The observer that corrects the predictions, if any."""
        return self._live.package.observer

    def _on_publishers(self, count: int) -> None:
        """Compile, in a thread, once a possible publisher appears."""
        if count and not self._has_camera:
            self._has_camera = True
            self._pipeline.node.in_background(self._make_ready)

    def _make_ready(self) -> None:
        """Compile; use measured poses from then on."""
        node = self._pipeline.node
        with node.noticed('Compiling the observer; measured poses are used from its end on.'):
            self.warm_up(self._live.model)
        gc.freeze()  # as `spin` does: what a compiler leaves is never looked at again
        self.is_ready = True

    def warm_up(self, model: ModelTuple) -> None:
        """Compile for a model what corrects it, if a camera may come."""
        if self._has_camera:
            warm_up_observer(self._pipeline.values, model)

    def _on_measured(self, data: bytes) -> None:
        """Correct the prediction."""
        live, node = self._live, self._pipeline.node
        if live.arrivals.newest_ns is None or not self.is_ready:
            return
        if (observer := live.package.observer) is None:
            live.package.observe(observer := Observer(self._pipeline.values))
        stamp_ns, (frame_id, *_), numbers = self._read(data)
        self._measured_in.note(stamp_ns)
        pose, covariance = (numbers[:3], numbers[3:7]), None
        if self._with_covariance:
            covariance = np.reshape(numbers[7:43], (6, 6))
        self._pipeline.advance(live.on_measured, stamp_ns, frame_id, *pose, covariance)
        if frame_id != live.frame_id and not observer.sensor.has_own_world:
            node.get_logger().warning(
                f"package/measured is in frame '{shown(frame_id)}', the tool in "
                f"'{shown(live.frame_id)}', so its poses are not used. Set "
                'recording.package_world to the pose of the first frame in the second, as '
                'estimated by bellows identify.',
                throttle_duration_sec=10.0)
        self.log_alarms()
        payload = self._observer and self._observer.payload
        if payload and self._estimated.subscribed:
            self._estimated.publish(
                conversions.payload_message(self._pipeline.values.frames.lip, payload))

    def on_vacuum(self, held: bool, cup: int) -> None:
        """Join the vacuum, or that of one cup, with what a camera sees."""
        self._live.on_vacuum(held, cup)
        self.log_alarms()

    def log_alarms(self) -> None:
        """Log the alarms since the last call, and go on without the cups that are lost."""
        alarms = self._observer.alarms if self._observer else []
        new_alarms, self._reported = alarms[self._reported:], len(alarms)
        for alarm in new_alarms:
            self._pipeline.node.get_logger().error(f'Alarm, {alarm.cause}: {alarm.message}')
        if lost := {alarm.cup for alarm in new_alarms if alarm.cup >= 0}:
            self.lost_cups |= lost
            self._pipeline.use_values()

    @property
    def alarm(self) -> Alarm | None:
        """The alarm of the last seconds, if any."""
        newest = self._observer.alarms[-1] if self._observer and self._observer.alarms else None
        is_recent = newest and self._live.newest_ns - newest.stamp_ns < ALARM_DURATION_NS
        return newest if is_recent else None

    def status(self, name: str) -> health.Status | None:
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
        status = health.input_status(
            name, self._measured_in.report({verdict: counts[verdict] for verdict in VERDICTS}))
        status.values.update({key: str(value) for key, value in more.items()})
        if self.alarm:
            return status._replace(level=health.Level.ERROR, message=self.alarm.message)
        flight = self._live.flight
        is_held = self._live.attached and not (flight and flight.state)
        return status if is_held else status._replace(level=min(status.level, health.Level.WARN))
