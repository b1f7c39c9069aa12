"""
The codec of frequent messages, for recordings and topics, and their conversion to streams.

Frequent messages consist of a header, one or two frame names, and a fixed row of doubles, in CDR.
They are decoded by `Decoder` and written by `pack`, as `LAYOUTS` describes.

Unusable messages are omitted from a stream, and counted by reason.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
import struct
import tomllib
from typing import Any

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.resampling import clock_steps
from bellows_ros.core.signals.screening import (
    LEVER,
    pose_steps,
    repeated,
    UNIT_TOLERANCE,
    unusable_stamps,
)
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, TwistStream
from bellows_ros.errors import BellowsError, is_name, shown
import numpy as np

HEAD = b'\0\1\0\0'
"""Encapsulation of plain CDR in little-endian order."""

LATEST_NS = 2**63 - 1

NO_STAMP = 0
"""Stamp (ns) given to a message whose nanoseconds exceed a second; the message is then
rejected."""

BOOL = 'std_msgs/msg/Bool'
"""Type of the messages of a valve."""

POSE = 'geometry_msgs/msg/PoseStamped'
TWIST = 'geometry_msgs/msg/TwistStamped'
WRENCH = 'geometry_msgs/msg/WrenchStamped'
VECTOR = 'geometry_msgs/msg/Vector3Stamped'
INERTIA = 'geometry_msgs/msg/InertiaStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
LIP_FRAME, PACKAGE_FRAME = 'cup_lip', 'package'
"""Name of the frame S of the cup's lip; no transform has it, so that no other cell's may clash."""

DETECTIONS = 'apriltag_msgs/msg/AprilTagDetectionArray'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'

TAG_TYPES = {
    'apriltag_msgs/msg/Point': 'float64 x\nfloat64 y',
    'apriltag_msgs/msg/AprilTagDetection':
    'string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n'
    'apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography',
    DETECTIONS: 'std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections'}
"""Definitions of apriltag_msgs, for recordings without definitions."""

_STAMP_AT, _STRINGS_AT = 4, 12
_MAX_PADDING = 3  # at the end, to a multiple of four


@dataclass(frozen=True)
class Layout:
    """
    The fields of a message type.

    Parameters
    ----------
    strings : int
        Number of frame names after the stamp.
    doubles : int
        Number of doubles after the names.
    pose : slice or None
        Slice of x, y, z and the quaternion (x, y, z, w) among the doubles.
    twist : slice or None
        Slice of the linear and the angular velocity among the doubles.
    pose_covariance : int
        Number of doubles of the covariance after the pose.
    in_list : bool
        Whether the message is a list, here with one item.

    """

    strings: int
    doubles: int
    pose: slice | None = None
    twist: slice | None = None
    pose_covariance: int = 0
    in_list: bool = False


# A pose has 7 doubles, a twist 6, and a covariance 36.
_POSE = slice(0, 7)

LAYOUTS: Mapping[str, Layout] = {
    POSE: Layout(1, 7, _POSE),
    POSE_WITH_COVARIANCE: Layout(1, 43, _POSE, pose_covariance=36),
    TRANSFORM: Layout(2, 7, _POSE),
    TWIST: Layout(1, 6, twist=slice(0, 6)),
    ODOMETRY: Layout(2, 85, _POSE, twist=slice(43, 49), pose_covariance=36),
    WRENCH: Layout(1, 6),
    VECTOR: Layout(1, 3),
    INERTIA: Layout(1, 10),
    TRANSFORMS: Layout(2, 7, in_list=True)}

POSE_TYPES: Mapping[str, str] = {
    'pose': POSE, 'pose_with_covariance': POSE_WITH_COVARIANCE, 'transform': TRANSFORM,
    'odometry': ODOMETRY}
"""Message types of one pose each by the parameters tool_pose.type and measured.type."""

MOTIONS = frozenset(name for name, layout in LAYOUTS.items() if layout.pose or layout.twist)
"""Types that hold a pose or a twist."""


Frames = Sequence[tuple[str, ...]]
Decoded = tuple[int, tuple[str, ...], Any]
"""Stamp (ns; `NO_STAMP` if invalid), frame names and doubles of a message."""


class Decoder:
    """
    Decodes messages of one type one at a time.

    A message with the frame names of its predecessor is unpacked by a single call.

    Parameters
    ----------
    kind : str
        One of `LAYOUTS` that is not a list.

    """

    def __init__(self, kind: str) -> None:
        self._kind, self._sizes, self._strings = kind, range(0), b''
        self._names: tuple[str, ...] = ()
        self._unpack: Callable[[bytes], tuple[Any, ...]] = struct.Struct('').unpack_from

    def __call__(self, data: bytes) -> Decoded | None:
        """Return the content of a message; None unless it is complete, plain CDR, and named."""
        if len(data) in self._sizes:
            content = self._unpack(data)
            head, sec, nanosec, strings = content[:4]
            if strings == self._strings and head == HEAD:
                stamp_ns = sec * NS_PER_S + nanosec if nanosec < NS_PER_S else NO_STAMP
                return stamp_ns, self._names, content[4:]
        names, end = _strings(data, LAYOUTS[self._kind].strings)
        if not (end and all(map(is_name, names))):
            return None
        form, *_ = _form(self._kind, names)
        sizes, strings = range(form.size, form.size + _MAX_PADDING + 1), data[_STRINGS_AT:end]
        if len(data) not in sizes:
            return None
        self._names = tuple(name.removeprefix('/') for name in names)  # as tf2
        self._sizes, self._unpack = sizes, form.unpack_from
        self._strings = strings  # with any bytes in its gaps
        return self(data)


@lru_cache(maxsize=64)
def _form(kind: str, names: tuple[str, ...]) -> tuple[struct.Struct, bytes, bytes]:
    """Return the form of messages with given names, their first bytes, and the names' bytes."""
    layout = LAYOUTS[kind]
    head = HEAD + struct.pack('<I', 1) * layout.in_list
    data = head + bytes(_STRINGS_AT - _STAMP_AT)
    at = len(data)
    for raw in (name.encode() + b'\0' for name in names):
        data += bytes(-len(data) % 4) + struct.pack('<I', len(raw)) + raw
    padding = (_STAMP_AT - len(data)) % 8  # doubles are aligned to 8, counted from the body
    return (struct.Struct(f'<{len(head)}siI{len(data) - at}s{padding}x{layout.doubles}d'), head,
            data[at:])


def pack(kind: str, names: tuple[str, ...], stamp_ns: int, *doubles: float) -> bytes:
    """
    Encode a message, as ROS does.

    Parameters
    ----------
    kind : str
        One of `LAYOUTS`.
    names : tuple of str
        frame_id, and child_frame_id if the type has one.
    stamp_ns : int
        Stamp, ns.
    doubles : float
        All other fields, in their order.

    """
    form, head, strings = _form(kind, names)
    return form.pack(head, *divmod(stamp_ns, NS_PER_S), strings, *doubles)


def decode(
    data: Sequence[bytes], log_times_ns: Sequence[int], kind: str, part: slice
) -> tuple[np.ndarray, Frames]:
    """
    Decode messages of one type.

    Parameters
    ----------
    data : sequence of bytes (N,)
        CDR with its four-byte head, in any encoding of rosbags.
    log_times_ns : sequence of int (N,)
        Time of recording of each message, ns.
    kind : str
        One of `MOTIONS`.
    part : slice
        Range of the returned doubles.

    Returns
    -------
    decoded : structured array (N,)
        Fields of `rows`; the frame is -1 if the message could not be decoded.
    frames : list of tuple of str
        Names of the frames by index.

    """
    read, numbers = Decoder(kind), dict[tuple[str, ...], int]()
    found = [read(each) or read(_converted(each, kind)) for each in data]
    decoded = np.zeros(len(data), rows(part.stop - part.start))
    decoded['arrival'] = [min(max(each, 0), LATEST_NS) for each in log_times_ns]
    decoded['frame'] = [numbers.setdefault(each[1], len(numbers)) if each else -1
                        for each in found]
    good = np.flatnonzero(decoded['frame'] >= 0)
    decoded['stamp'][good] = [each[0] for each in found if each]
    decoded['values'][good] = np.array([each[2][part] for each in found if each]).reshape(
        len(good), part.stop - part.start)
    return decoded, list(numbers)


def _converted(data: bytes, kind: str) -> bytes:
    """Return a message as plain little-endian CDR, empty if damaged."""
    try:
        return bytes(message_types().serialize_cdr(
            message_types().deserialize_cdr(data, kind), kind))
    except Exception:  # noqa: BLE001 (damaged bytes make readers raise anything)
        return b''


def rows(width: int) -> np.dtype[np.void]:
    """Return the type of decoded messages: stamp, arrival (ns), index of the frame, values."""
    return np.dtype([('stamp', 'i8'), ('arrival', 'i8'), ('frame', 'i8'), ('values', 'f8', width)])


def _strings(message: bytes, count: int) -> tuple[tuple[str, ...], int]:
    """Return the strings after a stamp, and the position of their end; (), 0 unless plain CDR."""
    names, at = list[str](), _STRINGS_AT
    if message[:_STAMP_AT] != HEAD:
        return (), 0
    try:
        for _ in range(count):
            at += -at % 4
            (size,) = struct.unpack_from('<I', message, at)
            raw, at = message[at + 4:at + 4 + size], at + 4 + size
            if len(raw) != size or raw[-1:] != b'\0':
                return (), 0
            names.append(raw[:-1].decode())
    except (struct.error, UnicodeDecodeError):
        return (), 0
    return tuple(names), at


def encode(
    stamps_ns: Stamps, values: Array, names: tuple[str, ...], kind: str
) -> list[bytes]:
    """
    Encode messages of one type.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Header stamps, ns.
    values : array (N, D)
        Pose, then twist, if the type has them; covariances are zero.
    names : tuple of str
        frame_id, and child_frame_id if the type has one.
    kind : str
        One of `MOTIONS`.

    """
    layout = LAYOUTS[kind]
    doubles = np.zeros((len(stamps_ns), layout.doubles))
    doubles[:, np.r_[*filter(None, (layout.pose, layout.twist))]] = values
    return [pack(kind, names, stamp_ns, *row) for stamp_ns, row in zip(
        stamps_ns.tolist(), doubles.tolist(), strict=True)]


Refused = dict[str, tuple[int, ...]]

REASONS: Mapping[str, str] = tomllib.loads(
    Path(__file__).with_name('refusals.toml').read_text())
"""Reasons for rejecting a message or for a restart, in words."""


def describe(refused: Mapping[str, tuple[int, ...]]) -> str:
    """Return the rejections in words: number for each reason, and position of the first."""
    return ', '.join(
        f'{len(indices)} x {REASONS.get(reason, reason)} (first: message {indices[0]})'
        for reason, indices in refused.items() if indices) or 'none'


def stream_of(
    role: str, topic: tuple[str, str], log_times_ns: Sequence[int], data: Sequence[bytes]
) -> PoseStream | TwistStream:
    """
    Return the usable messages of a topic (name, type) for a role; of 'measured' by stamps.

    Raises
    ------
    BellowsError
        If no message is usable.

    """
    name, kind = topic
    layout, is_measured = LAYOUTS[kind], role == 'measured'
    is_twist = role.endswith('twist')
    part = (layout.twist if is_twist else layout.pose) or slice(0)
    part = slice(part.start, part.stop + layout.pose_covariance * is_measured)
    decoded, frames = decode(data, log_times_ns, kind, part)
    order = np.argsort(decoded['stamp' if is_measured else 'arrival'], kind='stable')
    make = twist_stream if is_twist else pose_stream
    stream: PoseStream | TwistStream = make(name, decoded[order], frames)
    if not len(stream):
        raise BellowsError(
            f'has no usable message. Of {len(decoded)}: {describe(stream.refused)}. Check what '
            'publishes it, and record again.')
    return stream


def pose_stream(name: str, decoded: np.ndarray, frames: Frames) -> PoseStream:
    """
    Return the usable poses.

    Parameters
    ----------
    name : str
        Topic.
    decoded : array (N,)
        Rows in the recorded order; values are x, y, z, the quaternion (x, y, z, w),
        and, if requested, the covariance.
    frames : sequence of tuple of str
        Names of the frames by index: frame_id, and child_frame_id if the type has one.

    Returns
    -------
    PoseStream
        Its `refused` has only reasons that occur; each message counts once, under the first reason
        that applies.

    """
    poses, covariance = decoded['values'][:, :7], decoded['values'][:, 7:]
    with np.errstate(over='ignore', invalid='ignore'):  # infinite if the square overflows
        norm = np.linalg.norm(poses[:, 3:], axis=1)
    unusable = {
        'zero_quaternion': norm < 1e-6,
        'not_unit': np.abs(norm - 1.0) > UNIT_TOLERANCE}
    used, names, refused = _drop_invalid(decoded, poses, poses[:, :3], frames, unusable)
    rotation = quaternion_to_rotation(poses[used, 3:])
    used = refuse(refused, used, {'repeated': repeated(pose_steps(poses[used, :3], rotation))})
    return PoseStream(
        name, names[0], decoded['stamp'][used], poses[used, :3],
        quaternion_to_rotation(poses[used, 3:]), refused,
        covariance[used].reshape(-1, 6, 6) if covariance.size else None,
        clock_steps(*(decoded[name][decoded['stamp'] > 0] for name in ('stamp', 'arrival'))))


def twist_stream(name: str, decoded: np.ndarray, frames: Frames) -> TwistStream:
    """
    Return the usable twists in their recorded axes; in Odometry these are axes of the child frame.

    Parameters
    ----------
    name : str
        Topic.
    decoded, frames
        As in `pose_stream`; values are linear, then angular.

    Returns
    -------
    TwistStream
        Stream with `refused` as in `pose_stream`.

    """
    twists = decoded['values']
    used, names, refused = _drop_invalid(decoded, twists, twists, frames, {})
    changes = np.diff(twists[used], axis=0) * np.repeat([1.0, LEVER], 3)
    used = refuse(refused, used, {'repeated': repeated(np.linalg.norm(changes, axis=1))})
    return TwistStream(
        name, names[-1], decoded['stamp'][used], twists[used, :3], twists[used, 3:], refused)


def _drop_invalid(
    decoded: np.ndarray, values: Array, lengths: Array, frames: Frames,
    unusable: Mapping[str, Mask]
) -> tuple[Stamps, tuple[str, ...], Refused]:
    """Return the indices of the usable messages, their frames, and the others by reason."""
    finite = np.isfinite(values).all(axis=1)
    tests: dict[str, Any] = {
        'malformed': decoded['frame'] < 0,
        'zero_stamp': decoded['stamp'] <= 0,
        'nan': ~finite,
        'out_of_range': finite & (np.abs(lengths) > 1e6).any(axis=1),
        **unusable}
    refused: Refused = {}
    usable = refuse(refused, np.arange(len(decoded)), tests)
    # The frame of most messages; the first one if tied.
    frame = int(np.argmax(np.bincount(decoded['frame'][usable]))) if len(usable) else 0
    usable = refuse(refused, usable, {'frame_id': decoded['frame'][usable] != frame})
    again = np.zeros(len(usable), dtype=bool)
    again[1:] = (np.diff(decoded['stamp'][usable]) == 0) & (
        values[usable[1:]] == values[usable[:-1]]).all(axis=1)
    usable = refuse(refused, usable, {'copy': again})
    usable = refuse(refused, usable, unusable_stamps(
        decoded['stamp'][usable], decoded['arrival'][usable]))
    return usable, frames[frame] if len(usable) else ('',), refused


def refuse(refused: Refused, indices: Stamps, tests: Mapping[str, Mask]) -> Stamps:
    """Add messages to the rejections, each by the first test that it fails; return the others."""
    good = np.ones(len(indices), dtype=bool)
    for reason, bad in tests.items():
        if (bad & good).any():
            refused[reason] = tuple(indices[bad & good].tolist())
        good &= ~bad
    return indices[good]


def decoded(data: bytes, type_name: str, definition: str = '', where: str = '') -> Any:
    """
    Return a message of a type, by its recorded definition if any; `where` it is, for errors.

    Raises
    ------
    BellowsError
        If the message is damaged.

    """
    try:
        return message_types(type_name if definition else '', definition).deserialize_cdr(
            data, type_name)
    except Exception as error:  # noqa: BLE001 (damaged bytes make readers raise anything)
        raise BellowsError(f'A {type_name}{where} cannot be decoded: {shown(str(error), 300)}. '
                           'Record or send it again.') from None


@cache
def message_types(type_name: str = '', definition: str = '') -> Any:
    """Return the types of a definition in a recording; without one, the types of ROS 2 Jazzy."""
    # late, as it takes long and is rarely needed
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores

    store = get_typestore(Stores.EMPTY if definition else Stores.ROS2_JAZZY)
    for name, text in ({type_name: definition} if definition else TAG_TYPES).items():
        store.register(get_types_from_msg(text, name))
    return store
