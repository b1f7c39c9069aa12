"""Outputs of the predictor; beside the pose, each topic only while it has subscribers."""

from collections.abc import Callable, Mapping
import importlib.util
from typing import Any

from geometry_msgs.msg import (
    PoseStamped,
    TransformStamped,
    TwistStamped,
    Vector3Stamped,
    WrenchStamped,
)
from nav_msgs.msg import Odometry
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from .conversions import (
    write_deflection,
    write_odometry,
    write_pose,
    write_safety,
    write_transform,
    write_twist,
    write_wrench,
)
from .markers import gone, Picture
from ..core.arrays import Array
from ..core.kernels import ModelTuple
from ..core.live import Prediction
from ..core.live.samples import ORIGIN, ZERO
from ..core.live.uncertainty import Uncertainty, UNKNOWN_ROOT

QUEUE = 500

LATE_WITHIN_NS = 1_000_000_000
"""Stamps behind an extrapolated one by no more (ns) are late; by more, of another clock."""

NOMINAL = '_nominal'
"""Added to the name of the lip's frame: where the lip is without load."""


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

    """

    def __init__(self, node: Any, kind: type, name: str, qos: QoSProfile | None = None) -> None:
        """Advertise."""
        self.wanted = False
        self._publisher = node.create_lifecycle_publisher(
            kind, name, qos or QoSProfile(depth=QUEUE),
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.name = str(self._publisher.topic_name)
        self.publish: Callable[[Any], None] = self._publisher.publish

    def _on_matched(self, matched: Any) -> None:
        """Note whether somebody listens."""
        self.wanted = matched.current_count > 0


class Outputs:
    """
    All that is published about the package.

    Parameters
    ----------
    node : rclpy.lifecycle.LifecycleNode
        Makes the publishers.
    values : mapping
        Parameters by name.

    Attributes
    ----------
    model : tuple
        Cup, package and gravity.

    """

    def __init__(self, node: Any, values: Mapping[str, Any]) -> None:
        """Advertise all topics; messages are made once and filled in again."""
        self._pose = Topic(node, PoseStamped, 'package/pose')
        self._twist = Topic(node, TwistStamped, 'package/twist')
        self._odometry = Topic(node, Odometry, 'package/odometry')
        self._wrench = Topic(node, WrenchStamped, 'cup/wrench')
        self._safety = Topic(node, Vector3Stamped, 'cup/safety_factor')
        self._deflection = Topic(node, PoseStamped, 'cup/deflection')
        self._markers = Topic(node, MarkerArray, 'package/markers')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._state = Topic(node, String, 'package/state', latched)
        self._tf = self._tf_topic(node) if values['frames.tf'] else None
        self._messages = PoseStamped(), TwistStamped(), WrenchStamped()
        self._factors = Vector3Stamped()
        self._said = ''
        self._extrapolated_ns = -1

    def _tf_topic(self, node: Any) -> Topic | None:
        """Return the topic for tf where its messages are installed."""
        if importlib.util.find_spec('tf2_msgs') is None:
            node.get_logger().info('tf2_msgs is not installed: the package is not sent to tf.')
            return None
        from tf2_msgs.msg import TFMessage

        self._tf_message = TFMessage(transforms=[TransformStamped()])
        return Topic(node, TFMessage, '/tf')

    def set_model(self, model: ModelTuple, values: Mapping[str, Any]) -> None:
        """Go on with another cup or package."""
        self.model, self._values = model, values
        self._uncertainty = Uncertainty(model, values)
        self._picture = Picture(values)
        self._warm_up()

    def _warm_up(self) -> None:
        """Compile what is shown of a prediction, so that nothing compiles when one comes."""
        still = Prediction(1, *ORIGIN, ZERO, ZERO)
        write_deflection(PoseStamped(), '', self.model, still)
        Picture(self._values).of('', self.model, still)

    @property
    def topic(self) -> str:
        """Full name of the topic with the package's poses."""
        return self._pose.name

    @property
    def covariance_known(self) -> bool:
        """Whether the last covariance that was sent is one."""
        return self._uncertainty.known

    def covariance(self, prediction: Prediction) -> Array:
        """Return how sure a prediction is (12, 12); see `Uncertainty`."""
        return self._uncertainty.covariance(prediction)

    def publish(
        self, prediction: Prediction, frame_id: str, factors: tuple[float, float] | None
    ) -> None:
        """
        Send a prediction and its safety factors; a message is serialised at once and used again.

        One for each pose goes where no other goes. Elsewhere stamps never go back behind one that
        was extrapolated.
        """
        late = self._is_late(prediction)
        if not (late if self._values['coast.poses'] else prediction.coasting):
            self._publish_plain(prediction, frame_id)
            if factors and self._safety.wanted:
                write_safety(
                    self._factors, self._values['frames.lip'], prediction.stamp_ns, factors)
                self._safety.publish(self._factors)
        if not late:
            self._publish_more(prediction, frame_id)

    def _is_late(self, prediction: Prediction) -> bool:
        """Return whether a later one has been sent, of the extrapolated tool."""
        if 0 <= self._extrapolated_ns - prediction.stamp_ns < LATE_WITHIN_NS:
            return True
        self._extrapolated_ns = prediction.stamp_ns if prediction.coasting else -1
        return False

    def _publish_more(self, prediction: Prediction, frame_id: str) -> None:
        """Send what goes on while the tool is extrapolated."""
        if self._odometry.wanted:
            self._publish_odometry(prediction, frame_id)
        if self._deflection.wanted and not prediction.flies:
            message = PoseStamped()
            write_deflection(
                message, self._values['frames.lip'] + NOMINAL, self.model, prediction)
            self._deflection.publish(message)
        if self._markers.wanted and self._picture.is_due(prediction.stamp_ns):
            self._markers.publish(self._picture.of(frame_id, self.model, prediction))
        if self._tf and self._tf.wanted:
            write_transform(
                self._tf_message.transforms[0], frame_id, self._values['frames.package'],
                prediction)
            self._tf.publish(self._tf_message)

    def _publish_plain(self, prediction: Prediction, frame_id: str) -> None:
        """Send what cannot show how sure it is."""
        pose, twist, wrench = self._messages
        write_pose(pose, frame_id, prediction)
        self._pose.publish(pose)
        if self._twist.wanted:
            write_twist(twist, self._values['frames.package'], prediction)
            self._twist.publish(twist)
        if self._wrench.wanted:
            write_wrench(wrench, self._values['frames.lip'], prediction)
            self._wrench.publish(wrench)

    def _publish_odometry(self, prediction: Prediction, frame_id: str) -> None:
        """Send pose and twist with their covariance, which is not known in flight."""
        message = Odometry()
        write_odometry(
            message, frame_id, self._values['frames.package'], prediction,
            UNKNOWN_ROOT if prediction.flies else self._uncertainty.root(prediction),
        )
        self._odometry.publish(message)

    def say_state(self, state: str) -> None:
        """Send what is going on when it has changed; a late listener gets it too."""
        if state != self._said:
            self._said = state
            self._state.publish(String(data=state))
            if state in ('detached', 'lost', 'inactive') and self._markers.wanted:
                self._markers.publish(gone())
