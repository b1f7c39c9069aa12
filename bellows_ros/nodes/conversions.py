"""
Convert messages to the core's tuples, and predictions to the bytes of messages.

Stamps are integer nanoseconds and survive a round trip unchanged. Frequent messages are processed
as bytes, which takes a third of the time of message objects.
"""

from collections.abc import Callable
from contextlib import suppress
import importlib.util
import math
from operator import attrgetter
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

from ..core.geometry.tuples import Quaternion, Vector
from ..core.live import Prediction, uncertainty
from ..core.observer.results import Payload
from ..core.signals.trajectory import NS_PER_S
from ..errors import BellowsError
from ..files import messages
from ..files.messages import Decoded, Decoder, NO_STAMP, pack

MAX_NUMBER = 1e6
"""Bound of all numbers of poses, twists and wrenches: ten times a large one in mm, N or N mm."""

vector: Callable[[Any], Vector] = attrgetter('x', 'y', 'z')
"""Conversion of a Point or Vector3 to a tuple."""

quaternion_xyzw: Callable[[Any], Quaternion] = attrgetter('x', 'y', 'z', 'w')
"""Conversion of a Quaternion to a tuple."""


def stamp_to_ns(stamp: Time) -> int:
    """Return a stamp as integer nanoseconds; `NO_STAMP` if its nanoseconds exceed a second."""
    nanosec: int = stamp.nanosec
    return stamp.sec * NS_PER_S + nanosec if nanosec < NS_PER_S else NO_STAMP


def type_name(kind: type) -> str:
    """Return the ROS name of a message type, for example std_msgs/msg/Bool."""
    return f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'


def message_class(name: str, setting: str, topic: str) -> type:
    """Return the class of a ROS name; raise BellowsError if its package is not installed."""
    package, _, kind = name.partition('/msg/')
    if importlib.util.find_spec(package) is None:
        raise BellowsError(
            f'{setting}, but {package} is not installed. Install it (apt: '
            f'ros-jazzy-{package.replace("_", "-")}), or publish the pose on {topic}.')
    found: type = getattr(importlib.import_module(f'{package}.msg'), kind)
    return found


def reader(kind: type) -> Callable[[bytes], Decoded]:
    """
    Return a function that decodes messages of a type.

    ROS converts encodings other than plain little-endian CDR (big-endian, XCDR2) first. A damaged
    message has the stamp `NO_STAMP`, and numbers beyond `MAX_NUMBER` become NaN: the predictor
    rejects and counts both.
    """
    name = type_name(kind)
    decode, layout = Decoder(name), messages.LAYOUTS[name]
    twist = layout.twist or slice(0)
    unknown = (math.nan,) * layout.doubles
    damaged = NO_STAMP, ('',) * layout.strings, unknown

    def read(data: bytes) -> Decoded:
        if decoded := decode(data):
            numbers = decoded[2][:7] + decoded[2][twist]  # without covariances
            is_bounded = max(map(abs, numbers)) < MAX_NUMBER
            return decoded if is_bounded else (*decoded[:2], unknown)
        with suppress(Exception):  # of the middleware, or for a string that is not UTF-8
            return decode(serialize_message(deserialize_message(data, kind))) or damaged
        return damaged

    return read


def odometry(
    frame_id: str, child_frame_id: str, prediction: Prediction, covariance: np.ndarray
) -> bytes:
    """
    Return pose and twist of the package with covariances (REP-103: row-major, xyz first).

    The covariance (12, 12) is in body axes; its part of the pose is rotated into world axes, its
    part of the twist remains in the axes of the child frame.
    """
    return pack(
        messages.ODOMETRY, (frame_id, child_frame_id), prediction.stamp_ns,
        *prediction.position, *prediction.quaternion_xyzw,
        *uncertainty.in_world_axes(
            covariance[:6, :6], prediction.quaternion_xyzw).ravel().tolist(),
        *prediction.linear, *prediction.angular, *covariance[6:, 6:].ravel().tolist())


def payload_message(frame_id: str, payload: Payload) -> bytes:
    """Return an estimated payload, in the frame of the lip."""
    upper_triangle = [payload.inertia[k] for k in (0, 1, 2, 4, 5, 8)]
    return pack(messages.INERTIA, (frame_id,), payload.stamp_ns, payload.mass, *payload.com,
                *upper_triangle)


def payload_std_message(frame_id: str, payload: Payload) -> bytes:
    """Return the standard deviations of an estimated payload, with 0 for products of inertia."""
    xx, yy, zz = payload.inertia_std.tolist()
    return pack(messages.INERTIA, (frame_id,), payload.stamp_ns, payload.mass_std,
                *payload.com_std.tolist(), xx, 0.0, 0.0, yy, 0.0, zz)
