"""
Convert ROS messages to the core's tuples, and predictions to ROS messages.

Stamps are integer nanoseconds; a round trip through them changes nothing.
"""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs import msg as geometry
from nav_msgs.msg import Odometry
import numpy as np

from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import flight, Prediction, uncertainty
from ..core.observer.observer import Payload
from ..core.signals.trajectory import NS_PER_S

TOOL_POSES = {
    'pose': (geometry.PoseStamped, attrgetter('pose.position', 'pose.orientation')),
    'transform': (
        geometry.TransformStamped, attrgetter('transform.translation', 'transform.rotation')),
    'pose_with_covariance': (
        geometry.PoseWithCovarianceStamped,
        attrgetter('pose.pose.position', 'pose.pose.orientation')),
    'odometry': (Odometry, attrgetter('pose.pose.position', 'pose.pose.orientation'))}
"""By the parameters tool_pose.type and measured.type: the message, and its parts."""

NO_STAMP = 0


def stamp_to_ns(stamp: Time) -> int:
    """
    Return a stamp as integer nanoseconds.

    For a stamp whose nanosec field holds a second or more this is `NO_STAMP`, which the predictor
    refuses and counts.
    """
    nanosec: int = stamp.nanosec
    return stamp.sec * NS_PER_S + nanosec if nanosec < NS_PER_S else NO_STAMP


def write_stamp(stamp: Time, stamp_ns: int) -> None:
    """Write integer nanoseconds into a stamp."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, NS_PER_S)


vector: Callable[[Any], Vector] = attrgetter('x', 'y', 'z')
"""Returns a Point or Vector3 as a tuple."""

quaternion_xyzw: Callable[[Any], Quaternion] = attrgetter('x', 'y', 'z', 'w')
"""Returns a Quaternion as a tuple."""


def read_pose(
    message: Any, parts: Callable[[Any], tuple[Any, Any]]
) -> tuple[int, str, Vector, Quaternion]:
    """Return stamp (ns), frame, position and quaternion of a message, by its `TOOL_POSES`."""
    position, orientation = parts(message)
    header = message.header
    return (stamp_to_ns(header.stamp), header.frame_id, vector(position),
            quaternion_xyzw(orientation))


def write_vector(message: Any, values: Vector) -> None:
    """Write a tuple into a Point or Vector3."""
    message.x, message.y, message.z = values


def write_quaternion(message: Any, xyzw: Quaternion) -> None:
    """Write a tuple into a Quaternion."""
    message.x, message.y, message.z, message.w = xyzw


def write_header(message: Any, stamp_ns: int, frame_id: str) -> None:
    """Write stamp and frame of a message with a header."""
    write_stamp(message.header.stamp, stamp_ns)
    message.header.frame_id = frame_id


def write_place(pose: geometry.Pose, position: Vector, xyzw: Quaternion) -> None:
    """Write position and orientation."""
    write_vector(pose.position, position)
    write_quaternion(pose.orientation, xyzw)


def write_pose(
    message: geometry.PoseStamped, stamp_ns: int, frame_id: str, position: Vector, xyzw: Quaternion
) -> None:
    """Write position and orientation with their header."""
    write_header(message, stamp_ns, frame_id)
    write_place(message.pose, position, xyzw)


def write_tf(message: Any, frame_id: str, child_frame_id: str, prediction: Prediction) -> None:
    """Write the package's pose into the one transform of a TFMessage."""
    (stamped,) = message.transforms
    write_header(stamped, prediction.stamp_ns, frame_id)
    stamped.child_frame_id = child_frame_id
    write_vector(stamped.transform.translation, prediction.position)
    write_quaternion(stamped.transform.rotation, prediction.quaternion_xyzw)


def write_twist(message: geometry.TwistStamped, frame_id: str, prediction: Prediction) -> None:
    """Write the package's body twist, in the axes of its frame."""
    write_header(message, prediction.stamp_ns, frame_id)
    write_vector(message.twist.linear, prediction.linear)
    write_vector(message.twist.angular, prediction.angular)


def write_wrench(message: geometry.WrenchStamped, frame_id: str, prediction: Prediction) -> None:
    """Write the wrench of the cup on the package about the lip's centre, in lip axes."""
    write_header(message, prediction.stamp_ns, frame_id)
    write_vector(message.wrench.force, prediction.force)
    write_vector(message.wrench.torque, prediction.moment)


def write_safety(
    message: geometry.Vector3Stamped, stamp_ns: int, frame_id: str, factors: Vector
) -> None:
    """Write the safety factors against peeling and slipping, and the smaller one."""
    write_header(message, stamp_ns, frame_id)
    write_vector(message.vector, factors)


def write_odometry(
    message: Odometry, frame_id: str, child_frame_id: str, prediction: Prediction, root: np.ndarray
) -> None:
    """
    Write pose and twist of the package with their covariances (REP-103: row-major, xyz first).

    The root (12, n) of the covariance is in body axes; that of the pose is turned into the
    world's, that of the twist stays in those of the child frame.
    """
    write_header(message, prediction.stamp_ns, frame_id)
    message.child_frame_id = child_frame_id
    write_place(message.pose.pose, prediction.position, prediction.quaternion_xyzw)
    write_vector(message.twist.twist.linear, prediction.linear)
    write_vector(message.twist.twist.angular, prediction.angular)
    message.pose.covariance = uncertainty.in_world_axes(
        root[:6], prediction.quaternion_xyzw).ravel()
    message.twist.covariance = (root[6:] @ root[6:].T).ravel()


def write_payload(message: geometry.InertiaStamped, frame_id: str, payload: Payload) -> None:
    """Write an estimated payload, in the frame of the lip."""
    write_header(message, payload.stamp_ns, frame_id)
    inertia, entries = message.inertia, payload.inertia
    inertia.m = payload.mass
    write_vector(inertia.com, payload.com)
    inertia.ixx, inertia.ixy, inertia.ixz = entries[0], entries[1], entries[2]
    inertia.iyy, inertia.iyz, inertia.izz = entries[4], entries[5], entries[8]


def write_landing(
    message: geometry.PoseWithCovarianceStamped, frame_id: str, landing: flight.Landing
) -> None:
    """Write the pose of B at landing, stamped as the prediction that it was made from."""
    write_header(message, landing.stamp_ns, frame_id)
    write_place(message.pose.pose, *landing.toss.landing[:2])
    message.pose.covariance = landing.covariance.ravel()
