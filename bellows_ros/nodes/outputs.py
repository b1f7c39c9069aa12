"""
Outputs of the predictor; other than the pose, each topic only while it has subscribers.

Markers for RViz are the package as a box of its mass and inertia, the cup, and its force; of a
toss, the path of the flight and the ellipse of the landing.
"""

from collections.abc import Callable, Sequence
from functools import partial
import importlib.util
import time
from typing import Any

from geometry_msgs import msg as geometry
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Bool, Header, String
from visualization_msgs.msg import Marker, MarkerArray

from . import conversions
from .guarding import LATCHED, Worker
from ..core.geometry.arrays import Array
from ..core.geometry.tuples import add, add_scaled, apply, rotation_matrix, Vector
from ..core.live import flight, load, Prediction, uncertainty
from ..core.model import cup_package, kernels, structure
from ..core.parameters.values import Values
from ..core.signals.trajectory import NS_PER_S
from ..core.toss.landing import ellipse
from ..core.toss.release import flight_path

QUEUE = 500
"""Length of each queue: at 1 kHz the longest gap across which the motion is followed."""

MAX_LATENESS_NS = 1_000_000_000
"""Up to this far (ns) behind an extrapolated stamp one is late; farther, of another clock."""

MAX_FACTOR = 1000.0
"""Safety factors are capped here, as many plots cannot show infinity."""

OK_STATES = ('predicting', 'settling')
"""States in which package/ok can be true."""

UNSAFE_DURATION_NS = 1_000_000_000
"""After a safety factor below safety.least, package/ok stays false for this long (ns)."""

NOMINAL_SUFFIX = '_nominal'
"""Suffix of the lip's frame for where the lip is without load."""


class Topic:
    """
    A publisher that knows whether somebody listens.

    Parameters
    ----------
    node : rclpy.lifecycle.LifecycleNode
    kind : type
        Of the message.
    name : str
        Relative name.
    qos : QoSProfile, optional
        Reliable with a queue unless given; it can be overridden.
    prepare : callable, optional
        Compiles what makes whole messages, in a thread, once somebody listens.

    Attributes
    ----------
    message : kind
        The one that `send` fills in; it is serialised at once, and used again.
    subscribed : bool
        Whether somebody listens.
    is_ready : bool
        Whether all is compiled.

    """

    def __init__(
        self, node: Any, kind: type, name: str, qos: QoSProfile | None = None,
        prepare: Callable[[], None] | None = None,
    ) -> None:
        """Advertise."""
        self.message: Any = kind()
        self.subscribed, self.is_ready = False, prepare is None
        self._node, self._prepare = node, prepare
        self._publisher = node.create_lifecycle_publisher(
            kind, name, qos or QoSProfile(depth=QUEUE),
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.name = str(self._publisher.topic_name)

    def send(self, write: Callable[..., None], *content: Any) -> None:
        """Fill in the message by a function, and publish it, if somebody listens."""
        if self.subscribed:
            write(self.message, *content)
            self.publish(self.message)

    def publish(self, message: Any) -> None:
        """Send a message; a failure is noted, and does not stop other topics."""
        try:
            self._publisher.publish(message)
        except Exception as error:  # noqa: BLE001 (of the middleware)
            self._node.note_failure(error, self.name)

    def _on_matched(self, matched: Any) -> None:
        """Note whether somebody listens, and prepare the messages for the first time."""
        self.subscribed = matched.current_count > 0
        prepare = self._prepare
        if not (self.subscribed and prepare):
            return
        self._prepare = None

        def make_ready() -> None:
            prepare()
            self.is_ready = True

        self._node.in_background(make_ready)


class Outputs:
    """
    All that is published about the package.

    Parameters
    ----------
    pipeline : Pipeline
        Has the node, the live prediction, and the parameters.

    Attributes
    ----------
    uncertainty : Uncertainty
        How sure a prediction is.
    pose : Topic
        That of the package's poses.

    """

    def __init__(self, pipeline: Any) -> None:
        """Advertise all topics."""
        self._pipeline, node, values = pipeline, pipeline.node, pipeline.values
        self.pose = Topic(node, geometry.PoseStamped, 'package/pose')
        self._twist = Topic(node, geometry.TwistStamped, 'package/twist')
        self._odometry = Topic(node, Odometry, 'package/odometry', prepare=partial(
            uncertainty.warm_up_uncertainty, cup_package.cup_of(values).relaxation))
        self._wrench = Topic(node, geometry.WrenchStamped, 'cup/wrench')
        self._safety = Topic(node, geometry.Vector3Stamped, 'cup/safety_factor')
        self._deflection = Topic(node, geometry.PoseStamped, 'cup/deflection')
        self._markers = Topic(node, MarkerArray, 'package/markers')
        self._state = Topic(node, String, 'package/state', LATCHED)
        self._ok = Topic(node, Bool, 'package/ok', LATCHED)
        self._tf: Topic | None = None
        if values.frames.tf and importlib.util.find_spec('tf2_msgs') is None:
            node.get_logger().info('tf2_msgs is not installed: the package is not sent to tf.')
        elif values.frames.tf:
            from tf2_msgs.msg import TFMessage

            self._tf = Topic(node, TFMessage, '/tf')
            self._tf.message.transforms = [geometry.TransformStamped()]
        self._last_state = ''
        self._was_ok: bool | None = None
        self._safe_from_ns = 0
        self._extrapolated_ns = -1
        self._is_late = self._is_due = False

    def use_values(self) -> None:
        """Go on with another cup or package; compile all that is shown of a prediction."""
        model, values = self._pipeline.live.model, self._pipeline.values
        self.uncertainty = uncertainty.Uncertainty(model, values)
        load.deflection_rotation(uncertainty.STILL)
        Markers(values).fill('', model, uncertainty.STILL)
        self._picture = Markers(values)

    def publish(self, prediction: Prediction) -> None:
        """
        Send the pose of a prediction.

        One for each pose goes where no other goes. Elsewhere stamps never go back behind one that
        was extrapolated.
        """
        stamp_ns = prediction.stamp_ns
        self._is_late = 0 <= self._extrapolated_ns - stamp_ns < MAX_LATENESS_NS
        if not self._is_late:
            self._extrapolated_ns = stamp_ns if prediction.coasting else -1
        self._is_due = not (
            self._is_late if self._pipeline.values.coast.poses else prediction.coasting)
        if self._is_due:
            conversions.write_pose(
                self.pose.message, stamp_ns, self._pipeline.live.frame_id, *prediction[1:3])
            self.pose.publish(self.pose.message)

    def publish_more(
        self, prediction: Prediction, factors: tuple[float, float] | None
    ) -> None:
        """Send all else of the prediction that was published last, and its safety factors."""
        values = self._pipeline.values
        if self._is_due:
            self._twist.send(conversions.write_twist, values.frames.package, prediction)
            self._wrench.send(conversions.write_wrench, values.frames.lip, prediction)
            if factors:
                self._safety.send(
                    conversions.write_safety, prediction.stamp_ns, values.frames.lip,
                    tuple(min(factor, MAX_FACTOR) for factor in (*factors, min(factors))))
        if not self._is_late:
            self._publish_continuing(prediction)

    def _publish_continuing(self, prediction: Prediction) -> None:
        """Publish the outputs that continue while the tool is extrapolated."""
        live, values, stamp_ns = self._pipeline.live, self._pipeline.values, prediction.stamp_ns
        frame_id, package = live.frame_id, values.frames.package
        if self._odometry.subscribed:
            has_covariance = self._odometry.is_ready and not prediction.flies
            self._odometry.send(
                conversions.write_odometry, frame_id, package, prediction,
                self.uncertainty.root(prediction) if has_covariance else uncertainty.UNKNOWN_ROOT)
        if self._deflection.subscribed and not prediction.flies:
            self._deflection.send(
                conversions.write_pose, stamp_ns, values.frames.lip + NOMINAL_SUFFIX,
                load.deflection(live.model, prediction)[0], load.deflection_rotation(prediction))
        if self._markers.subscribed and self._picture.is_due(stamp_ns):
            self._markers.publish(self._picture.fill(frame_id, live.model, prediction))
        if self._tf:
            self._tf.send(conversions.write_tf, frame_id, package, prediction)

    def note_unsafe(self) -> None:
        """Note a safety factor that is too small."""
        self._safe_from_ns = time.monotonic_ns() + UNSAFE_DURATION_NS
        self._publish_ok(False)

    def _publish_ok(self, ok: bool) -> None:
        """Publish whether the package is held within limits, when it changes; latched."""
        if ok != self._was_ok:
            self._was_ok = ok
            self._ok.publish(Bool(data=ok))

    def publish_state(self, state: str, is_above: bool = False) -> None:
        """
        Publish the state, and if all is well, when they change; late subscribers get both.

        A package above its tool is not where it is predicted.
        """
        if state != self._last_state:
            self._last_state = state
            self._state.publish(String(data=state))
        self._publish_ok(not is_above and state in OK_STATES and (
            time.monotonic_ns() >= self._safe_from_ns))


NAMESPACE = 'bellows_ros'
MARKER_PERIOD_NS = 40_000_000
"""Time (ns) between two sets of markers."""

METRES_PER_NEWTON = 0.005
CUP_WIDTH = 0.04
ARROW_WIDTH = (0.006, 0.012, 0.015)
CARDBOARD = (0.76, 0.6, 0.42, 0.8)
RUBBER = (0.2, 0.3, 0.8, 0.9)
FORCE = (0.9, 0.2, 0.1, 1.0)
COASTING = (0.6, 0.6, 0.6, 0.5)


class Markers:
    """Markers that are filled in again for each picture."""

    def __init__(self, values: Values) -> None:
        """Size the box."""
        self._box = marker(0, Marker.CUBE, load.equivalent_box(values))
        self._cup = marker(1, Marker.LINE_LIST, (CUP_WIDTH, 0.0, 0.0))
        self._places: list[Vector] = [
            (x, y, z) for x, y, z in structure.places_of(values)[:, :3].tolist()]
        self._force = marker(2, Marker.ARROW, ARROW_WIDTH)
        self._array = MarkerArray(markers=[self._box, self._cup, self._force])
        self._last_ns = 0

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the next markers are due."""
        return not 0 <= stamp_ns - self._last_ns < MARKER_PERIOD_NS

    def fill(self, frame: str, model: kernels.ModelTuple, prediction: Prediction) -> MarkerArray:
        """Return the markers of a prediction; grey while the tool is extrapolated."""
        self._last_ns = prediction.stamp_ns
        lip = load.lip_position(model, prediction)
        R_world_package = rotation_matrix(prediction.quaternion_xyzw)
        tip = add_scaled(lip, METRES_PER_NEWTON, apply(R_world_package, prediction.force))
        conversions.write_place(self._box.pose, prediction.position, prediction.quaternion_xyzw)
        tool, R_world_tool = prediction.tool[0], rotation_matrix(prediction.tool[1])
        self._cup.points = []
        for place in self._places:
            root = add(tool, apply(R_world_tool, place))
            end = root if prediction.flies else add(lip, apply(R_world_package, place))
            self._cup.points += [point(root), point(end)]
        self._force.points = [point(lip), point(tip)]
        for each, colour in ((self._box, CARDBOARD), (self._cup, RUBBER), (self._force, FORCE)):
            show(each, prediction.stamp_ns, frame, COASTING if prediction.coasting else colour)
        return self._array


def marker(number: int, kind: int, scale: Vector, namespace: str = NAMESPACE) -> Marker:
    """Return a marker of a kind and size (m)."""
    message = Marker(ns=namespace, id=number, type=kind, action=Marker.ADD)
    conversions.write_vector(message.scale, scale)
    message.lifetime.nanosec = 500_000_000
    return message


def show(
    marker: Marker, stamp_ns: int, frame_id: str, rgba: tuple[float, float, float, float]
) -> None:
    """Give a marker its header and colour."""
    conversions.write_header(marker, stamp_ns, frame_id)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = rgba


def point(position: Sequence[float]) -> Point:
    """Return a position as a message."""
    x, y, z = position
    return Point(x=x, y=y, z=z)


VALVE_TIME_PERIOD_NS = 200_000_000
"""Period (ns) of release/at."""
BLUE = (0.36, 0.29, 0.62, 0.9)


class Tossing:
    """
    Subscribers and publishers for a toss.

    Parameters
    ----------
    pipeline : Pipeline
        Switches the valve, and knows the tool's motion after a prediction.

    Attributes
    ----------
    flight : Flight
        Follows the package after the valve.

    """

    def __init__(self, pipeline: Any) -> None:
        """Advertise, and listen to the valve."""
        self._pipeline, node = pipeline, pipeline.node
        self._worker = Worker(node, 'release')  # no plan waits behind a search
        self._landing = Topic(node, geometry.PoseWithCovarianceStamped, 'package/landing')
        self._at = Topic(node, Header, 'release/at')
        self._markers = Topic(node, MarkerArray, 'package/landing_markers')
        node.create_subscription(
            Bool, 'vacuum/valve', lambda message: pipeline.switch_valve(message.data), 10)
        self._landing_ns = self._valve_time_ns = 0

    def use_values(self) -> None:
        """Use other values; compile what a landing needs."""
        pipeline = self._pipeline
        self.flight = flight.Flight(
            pipeline.values, pipeline.planning.rest, lambda: pipeline.load.grip)
        # ticks are not exact
        self._period_ns = round(0.9e9 / pipeline.values.landing.rate)
        self.flight.warm_up(pipeline.live.model)

    def publish(self, held: Prediction) -> None:
        """Publish the landing, and when to release, at their rates."""
        if not self.flight.has_size or self.flight.state:
            return
        model, frame_id = self._pipeline.live.model, self._pipeline.live.frame_id
        now_ns = time.monotonic_ns()
        wanted = self._landing.subscribed or self._markers.subscribed
        if wanted and now_ns - self._landing_ns >= self._period_ns:
            self._landing_ns = now_ns
            landing = self.flight.landing(
                model, held, self._pipeline.outputs.uncertainty.covariance)
            if landing is not None:
                self._landing.send(conversions.write_landing, frame_id, landing)
                if self._markers.subscribed:
                    path = flight_path(model, landing.toss, flight.PATH_POINTS)
                    self._markers.publish(_landing_markers(landing, path, frame_id))
        if (self._at.subscribed and now_ns - self._valve_time_ns >= VALVE_TIME_PERIOD_NS
                and not self._worker.is_busy):
            self._valve_time_ns = now_ns
            self._worker.submit('aim', self._publish_valve_time, model, held, frame_id)

    def _publish_valve_time(
        self, model: kernels.ModelTuple, prediction: Prediction, frame_id: str
    ) -> None:
        """Publish when to switch the valve for the target."""
        after = self.flight.time_to_target(model, prediction)
        if after is not None and not self._worker.stop[0]:
            message = Header(frame_id=frame_id)
            conversions.write_stamp(message.stamp, prediction.stamp_ns + round(after * NS_PER_S))
            self._at.publish(message)


def _landing_markers(landing: flight.Landing, path: Array, frame_id: str) -> MarkerArray:
    """Return the path of the flight, and the 95 % ellipse about its end."""
    ring = np.zeros((33, 3)) + landing.toss.landing[0]
    ring[:, :2] += ellipse(landing.covariance, 33)
    markers = []
    for number, points in enumerate((path[:, :3], ring)):
        line = marker(number, Marker.LINE_STRIP, (0.005, 0.0, 0.0), f'{NAMESPACE}_landing')
        show(line, landing.stamp_ns, frame_id, BLUE)
        line.points = [point(each) for each in points.tolist()]
        markers.append(line)
    return MarkerArray(markers=markers)
