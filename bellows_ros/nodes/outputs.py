"""
Outputs of the predictor; topics other than the pose are published only with subscribers.

Markers for RViz are the package as a box with its mass and inertia, the cup, and its force.
"""

from collections.abc import Callable
from contextlib import suppress
import importlib.util
from typing import Any, Self

from bellows_ros.core.parameters import conversion
from builtin_interfaces.msg import Duration, Time
from geometry_msgs import msg as geometry
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from nav_msgs.msg import Odometry
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Bool, ColorRGBA, Header, String
from visualization_msgs.msg import Marker, MarkerArray

from .conversions import odometry
from .guarding import LATCHED, ManagedNode
from ..core.geometry.tuples import add, add_scaled, apply, rotation_matrix, Vector
from ..core.live import Prediction, Predictor, uncertainty, vacuum
from ..core.live.landing import Landing
from ..core.model import kernels
from ..core.parameters.values import Values
from ..core.signals.trajectory import NS_PER_S
from ..files import messages
from ..files.messages import pack

QUEUE = 500
"""Length of each queue, messages: the longest bridged gap (0.5 s) at 1 kHz."""


class Predicting:
    """
    The shared state of all parts of a configured predictor.

    Attributes
    ----------
    node : ManagedNode
        Node of subscriptions, publishers and logs; messages are processed while it is active.
    live : Predictor

    """

    node: ManagedNode
    live: Predictor
    publish: Callable[..., None]
    """Function that publishes the predictions of a step, even if other outputs fail."""
    change: Callable[..., Any]
    """Function that returns the result of a step, and reports a change of the state."""

    @property
    def load(self) -> vacuum.Load:
        """Safety factor of the grip, and distance from the validity range."""
        assert self.live.load
        return self.live.load


class Topic:
    """
    A publisher with the presence of its subscribers.

    Parameters
    ----------
    kind : type
        Message type.
    name : str
        Relative name.
    make : callable, optional
        Function that makes the message of a prediction.
    qos : QoSProfile, optional
        Default: reliable with a queue; it can be overridden.

    Attributes
    ----------
    subscribed : bool
        Whether there is a subscriber.

    """

    def __init__(
        self, kind: type, name: str, make: Callable[[Prediction], Any] | None = None,
        qos: QoSProfile | None = None,
    ) -> None:
        self._kind, self.name, self._make = kind, name, make
        self._qos, self.subscribed = qos or QoSProfile(depth=QUEUE), False

    def advertise(self, node: ManagedNode) -> Self:
        """Create the publisher."""
        self._node = node
        self._publisher = node.create_lifecycle_publisher(
            self._kind, self.name, self._qos,
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.name = str(self._publisher.topic_name)
        return self

    def try_with(self, still: Prediction) -> None:
        """Make the message of a package at rest, which compiles all its kernels."""
        if self._make:
            self._make(still)

    def send(self, prediction: Prediction) -> None:
        """Publish the message of a prediction, if there is a subscriber."""
        if self.subscribed and self._make:
            self.publish(self._make(prediction))

    def publish(self, message: Any) -> None:
        """Send a message or its bytes; a failure is recorded, without effect on other topics."""
        try:
            with suppress(InvalidHandle):  # of a thread that answers while the node ends
                self._publisher.publish(message)
        except Exception as error:  # noqa: BLE001 (of the middleware)
            self._node.note_failure(error, self.name)

    def _on_matched(self, matched: Any) -> None:
        """Update the presence of subscribers."""
        self.subscribed = matched.current_count > 0


class Outputs:
    """
    All published outputs on the package.

    Parameters
    ----------
    shared : Predicting

    Attributes
    ----------
    pose : Topic
        Poses of the package.

    """

    def __init__(self, shared: Predicting) -> None:
        """Compile all messages, then advertise all topics."""
        self._shared, node = shared, shared.node
        self.pose = Topic(geometry.PoseStamped, 'package/pose', self._make_pose)
        self._twist = Topic(geometry.TwistStamped, 'package/twist', lambda now: pack(
            messages.TWIST, (messages.PACKAGE_FRAME,), now.stamp_ns, *now.linear, *now.angular))
        self._wrench = Topic(geometry.WrenchStamped, 'cup/wrench', lambda now: pack(
            messages.WRENCH, (messages.LIP_FRAME,), now.stamp_ns, *now.force, *now.moment))
        self._safety = Topic(geometry.Vector3Stamped, 'cup/safety_factor')
        self._odometry = Topic(Odometry, 'package/odometry', self._make_odometry)
        self._deflection = Topic(geometry.PoseStamped, 'cup/deflection', self._make_deflection)
        self._markers = Topic(MarkerArray, 'package/markers', lambda now: markers(
            shared.live.values, shared.live.frame_id, shared.live.model, now))
        self.landing = Topic(geometry.PoseWithCovarianceStamped, 'package/landing')
        self._state = Topic(String, 'package/state', qos=LATCHED)
        self._ok = Topic(Bool, 'package/ok', qos=LATCHED)
        self._tf: Topic | None = None
        if importlib.util.find_spec('tf2_msgs') is None:
            node.get_logger().info('tf2_msgs is not installed: the package is not sent to tf.')
        else:
            from tf2_msgs.msg import TFMessage

            self._tf = Topic(TFMessage, '/tf', lambda now: pack(
                messages.TRANSFORMS, (shared.live.frame_id, messages.PACKAGE_FRAME),
                now.stamp_ns, *now.position, *now.quaternion_xyzw))
        topics = [part for part in vars(self).values() if isinstance(part, Topic)]
        still = uncertainty.still(shared.live.model)
        for topic in topics:
            topic.try_with(still)
        for topic in topics:
            topic.advertise(node)
        self._last_state = ''
        self._was_ok: bool | None = None
        self._drawn_ns = self._newest_ns = -1

    def _make_pose(self, now: Prediction) -> bytes:
        """Return the pose of the package in the frame of the tool's poses."""
        return pack(messages.POSE, (self._shared.live.frame_id,), now.stamp_ns, *now.position,
                    *now.quaternion_xyzw)

    def _make_odometry(self, now: Prediction) -> bytes:
        """Return pose and twist, with large covariance while it is unknown."""
        P = self._shared.live.covariance(now.stamp_ns)
        return odometry(self._shared.live.frame_id, messages.PACKAGE_FRAME, now,
                        uncertainty.UNKNOWN if P is None else P)

    def _make_deflection(self, now: Prediction) -> bytes:
        """Return the lip relative to its place without load."""
        return pack(
            messages.POSE, (f'{messages.LIP_FRAME}_nominal',), now.stamp_ns,
            *vacuum.deflection(self._shared.live.model, now)[0], *vacuum.deflection_rotation(now))

    def publish(self, prediction: Prediction) -> None:
        """Publish the pose of a prediction, one for each pose of the tool."""
        if not prediction.coasting:
            self.pose.publish(self._make_pose(prediction))

    def publish_more(
        self, prediction: Prediction, factors: tuple[float, float] | None
    ) -> None:
        """Publish all other outputs for the last prediction, and its safety factors."""
        if not prediction.coasting:
            self._twist.send(prediction)
            self._wrench.send(prediction)
            if factors and self._safety.subscribed:
                self._safety.publish(pack(
                    messages.VECTOR, (messages.LIP_FRAME,), prediction.stamp_ns,
                    # many plots cannot show infinity
                    *(min(factor, 1000.0) for factor in (*factors, min(factors)))))
        if 0 <= self._newest_ns - prediction.stamp_ns < 1_000_000_000:  # already extrapolated
            return
        self._newest_ns = prediction.stamp_ns
        self._odometry.send(prediction)
        self._deflection.send(prediction)
        if not 0 <= prediction.stamp_ns - self._drawn_ns < 40_000_000:  # 25 Hz
            self._drawn_ns = prediction.stamp_ns
            self._markers.send(prediction)
        if self._tf:
            self._tf.send(prediction)

    def publish_landing(self, landing: Landing) -> None:
        """Publish where a released package lands."""
        position, xyzw, *_ = landing.body
        self.landing.publish(pack(
            messages.POSE_WITH_COVARIANCE, (self._shared.live.frame_id,), landing.stamp_ns,
            *position, *xyzw, *landing.covariance.ravel().tolist()))

    def publish_state(self, state: str, is_ok: bool = False) -> None:
        """Publish changes of the state and of `is_ok`; late subscribers get both."""
        if state != self._last_state:
            self._last_state = state
            self._state.publish(String(data=state))
        if is_ok != self._was_ok:
            self._was_ok = is_ok
            self._ok.publish(Bool(data=is_ok))


def markers(
    values: Values, frame_id: str, model: kernels.ModelTuple, now: Prediction
) -> MarkerArray:
    """Return a prediction as markers; grey while the tool is extrapolated."""
    lip, R_world_package = vacuum.lip_position(model, now), rotation_matrix(now.quaternion_xyzw)
    tool, R_world_tool = now.tool[0], rotation_matrix(now.tool[1])
    tip = add_scaled(lip, 0.005, apply(R_world_package, now.force))  # m/N
    cups = [end for x, y, z in conversion.places_of(values)[:, :3].tolist() for end in (
        add(tool, apply(R_world_tool, (x, y, z))), add(lip, apply(R_world_package, (x, y, z))))]
    array, stamp = MarkerArray(), Time()
    stamp.sec, stamp.nanosec = divmod(now.stamp_ns, NS_PER_S)
    for number, (kind, scale, rgba, points) in enumerate((
            (Marker.CUBE, vacuum.equivalent_box(values), (0.76, 0.6, 0.42, 0.8), []),
            (Marker.LINE_LIST, (0.04, 0.0, 0.0), (0.2, 0.3, 0.8, 0.9), cups),
            (Marker.ARROW, (0.006, 0.012, 0.015), (0.9, 0.2, 0.1, 1.0), [lip, tip]))):
        r, g, b, a = (0.6, 0.6, 0.6, 0.5) if now.coasting else rgba
        array.markers.append(Marker(
            header=Header(stamp=stamp, frame_id=frame_id), ns='bellows_ros', id=number, type=kind,
            action=Marker.ADD, scale=Vector3(**named(scale)), color=ColorRGBA(r=r, g=g, b=b, a=a),
            points=[Point(**named(each)) for each in points],
            lifetime=Duration(nanosec=500_000_000)))
    array.markers[0].pose = Pose(
        position=Point(**named(now.position)), orientation=Quaternion(
            **dict(zip('xyzw', now.quaternion_xyzw, strict=True))))
    return array


def named(xyz: Vector) -> dict[str, float]:
    """Return the numbers of a vector by the names of their axes."""
    return dict(zip('xyz', xyz, strict=True))
