"""
Turn ROS messages into the core's tuples, and predictions into ROS messages.

Stamps are integer nanoseconds; a round trip through them changes nothing.
"""

from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped

from ..core.live import Prediction
from ..core.tuples import Quaternion, Vector

NANOSECONDS = 1_000_000_000
NO_STAMP = 0


def stamp_to_ns(stamp: Time) -> int:
    """
    Return a stamp as integer nanoseconds.

    A stamp whose nanosec field holds a second or more is none: it gives `NO_STAMP`, which the
    predictor refuses and counts.
    """
    nanosec: int = stamp.nanosec
    return stamp.sec * NANOSECONDS + nanosec if nanosec < NANOSECONDS else NO_STAMP


def write_stamp(stamp: Time, stamp_ns: int) -> None:
    """Write integer nanoseconds into a stamp."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, NANOSECONDS)


def vector(message: Any) -> Vector:
    """Return a Point or Vector3 as a tuple."""
    return message.x, message.y, message.z


def quaternion_xyzw(message: Any) -> Quaternion:
    """Return a Quaternion as a tuple."""
    return message.x, message.y, message.z, message.w


def write_vector(message: Any, values: Vector) -> None:
    """Write a tuple into a Point or Vector3."""
    message.x, message.y, message.z = values


def write_quaternion(message: Any, xyzw: Quaternion) -> None:
    """Write a tuple into a Quaternion."""
    message.x, message.y, message.z, message.w = xyzw


def write_pose(message: PoseStamped, frame_id: str, prediction: Prediction) -> None:
    """Write the package's pose in the frame of the tool's poses."""
    write_stamp(message.header.stamp, prediction.stamp_ns)
    message.header.frame_id = frame_id
    write_vector(message.pose.position, prediction.position)
    write_quaternion(message.pose.orientation, prediction.quaternion_xyzw)


def write_twist(message: TwistStamped, frame_id: str, prediction: Prediction) -> None:
    """Write the package's body twist, in the axes of its frame."""
    write_stamp(message.header.stamp, prediction.stamp_ns)
    message.header.frame_id = frame_id
    write_vector(message.twist.linear, prediction.linear)
    write_vector(message.twist.angular, prediction.angular)


def write_wrench(message: WrenchStamped, frame_id: str, prediction: Prediction) -> None:
    """Write the wrench of the cup on the package about the lip's centre, in lip axes."""
    write_stamp(message.header.stamp, prediction.stamp_ns)
    message.header.frame_id = frame_id
    write_vector(message.wrench.force, prediction.force)
    write_vector(message.wrench.torque, prediction.moment)
