"""
Messages of recordings: decoding, encoding, and conversion to streams.

These messages are a header, one or two strings, and a fixed row of doubles; messages whose first
bytes and strings agree therefore lie in memory as one array. Everything else about CDR is not
needed here.

What cannot be used is left out of a stream, and counted by reason.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import struct

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.screening import UNIT_TOLERANCE, unusable_stamps, WHY_REFUSED
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, TwistStream
from bellows_ros.errors import BellowsError
import numpy as np

Indices = Stamps

# A stamped pose or twist is at most this long; longer ones are not decoded.
MAX_MESSAGE_BYTES = 4096

_STAMP_AT, _STRINGS_AT = 4, 12
_MAX_PADDING = 3  # at the end, to a multiple of four

HEAD = b'\0\1\0\0'
"""Plain CDR, little-endian."""

BOOL = 'std_msgs/msg/Bool'
"""Type of the messages of a valve."""


@dataclass(frozen=True)
class Layout:
    """
    The fields after the stamp of a message type.

    Parameters
    ----------
    strings : int
        Number of frame names.
    doubles : int
        Number of doubles after them.
    pose : slice or None
        Where among the doubles x, y, z and the quaternion (x, y, z, w) are.
    twist : slice or None
        Where among the doubles the linear and the angular velocity are.
    pose_covariance : int
        Doubles after the pose that are its covariance.

    """

    strings: int
    doubles: int
    pose: slice | None = None
    twist: slice | None = None
    pose_covariance: int = 0


# A pose has 7 doubles, a twist 6, and the covariance behind either 36.
_POSE = slice(0, 7)

LAYOUTS: Mapping[str, Layout] = {
    'geometry_msgs/msg/PoseStamped': Layout(1, 7, _POSE),
    'geometry_msgs/msg/PoseWithCovarianceStamped': Layout(1, 43, _POSE, pose_covariance=36),
    'geometry_msgs/msg/TransformStamped': Layout(2, 7, _POSE),
    'geometry_msgs/msg/TwistStamped': Layout(1, 6, twist=slice(0, 6)),
    'nav_msgs/msg/Odometry': Layout(2, 85, _POSE, twist=slice(43, 49), pose_covariance=36)}


def decode(
    messages: Sequence[bytes], log_times_ns: Sequence[int], layout: Layout, part: slice,
    numbers: dict[tuple[str, ...], int],
) -> np.ndarray:
    """
    Decode messages of one type.

    Parameters
    ----------
    messages : sequence of bytes (N,)
        CDR with its four-byte head, of either endianness.
    log_times_ns : sequence of int (N,)
        When each was recorded, ns.
    layout : Layout
        Of their type.
    part : slice
        Which of the doubles to return.
    numbers : dict
        The frames met before, with their indices; gets the new ones.

    Returns
    -------
    structured array (N,)
        stamp and arrival (ns), frame (its index; -1 where the message could not be decoded), and
        values, the doubles asked for.

    """
    decoded = np.zeros(len(messages), [
        ('stamp', 'i8'), ('arrival', 'i8'), ('frame', 'i8'),
        ('values', 'f8', (part.stop - part.start,))])
    decoded['arrival'] = np.maximum(log_times_ns, 0)
    decoded['frame'] = -1
    for (size, head, strings), (names, members) in same_layout(messages, layout.strings).items():
        doubles_at = _doubles_at(_STRINGS_AT + len(strings))
        padding = size - doubles_at - 8 * layout.doubles
        if size > MAX_MESSAGE_BYTES or not 0 <= padding <= _MAX_PADDING:
            continue
        dtype = _dtype('<' if head[1] else '>', doubles_at, size, layout)
        rows = np.frombuffer(b''.join([messages[i] for i in members]), dtype)
        index = np.array(members)
        decoded['stamp'][index] = rows['sec'].astype(np.int64) * NS_PER_S + rows['nanosec']
        decoded['values'][index] = rows['doubles'][:, part]
        sound = (rows['sec'] >= 0) & (rows['nanosec'] < NS_PER_S)
        decoded['frame'][index[sound]] = numbers.setdefault(names, len(numbers))
    return decoded


def same_layout(
    messages: Sequence[bytes], strings: int
) -> dict[tuple[int, bytes, bytes], tuple[tuple[str, ...], list[int]]]:
    """
    Return messages that agree in all but the stamp and the doubles.

    By their size, their head and the bytes of their strings: the strings, and their indices.
    Those with damaged strings are left out.
    """
    groups: dict[tuple[int, bytes, bytes], tuple[tuple[str, ...], list[int]]] = {}
    end = 0  # of the strings of the message before, mostly also of this one
    for i, message in enumerate(messages):
        key = len(message), message[:_STAMP_AT], message[_STRINGS_AT:end]
        if key not in groups:
            names, end = _strings(message, strings)
            if not end:
                continue
            key = (*key[:2], message[_STRINGS_AT:end])
            groups.setdefault(key, (names, []))
        groups[key][1].append(i)
    return groups


class Reader:
    """Reads a message field by field; positions count from its body."""

    def __init__(self, data: bytes) -> None:
        """Take a message with its four-byte head."""
        if data[:2] not in (b'\0\0', b'\0\1'):
            raise _damaged('it is not plain CDR')
        self.order = '<' if data[1] else '>'
        self.body, self.at = memoryview(data)[4:], 0

    def number(self, kind: str = 'I') -> int:
        """Return an integer of four bytes."""
        self.at += -self.at % 4
        if self.at + 4 > len(self.body):
            raise _damaged('it ends too early')
        (value,) = struct.unpack_from(self.order + kind, self.body, self.at)
        self.at += 4
        return int(value)

    def text(self) -> str:
        """Return a string."""
        size = self.number()
        raw = bytes(self.body[self.at:self.at + size])
        self.at += size
        if len(raw) != size or raw[-1:] != b'\0':
            raise _damaged('a string in it does not end')
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise _damaged('a string in it is not UTF-8') from None

    def skip_list(self, doubles: int) -> int:
        """Skip a list of items of so many doubles; return the number of items."""
        count = self.number()
        if count:
            self.at += -self.at % 8 + 8 * doubles * count
        return count

    def rows(self, dtype: np.dtype[np.void], count: int) -> np.ndarray:
        """Return consecutive structures."""
        if self.at + count * dtype.itemsize > len(self.body):
            raise _damaged('it ends too early')
        return np.frombuffer(self.body, dtype, count, self.at)


def _damaged(why: str) -> BellowsError:
    """Return the error for a message that cannot be decoded."""
    return BellowsError(f'A message cannot be decoded: {why}. Send it as ROS does.')


def with_number(data: bytes, number: int) -> bytes:
    """Return data followed by an integer."""
    return data + bytes(-len(data) % 4) + struct.pack('<I', number)


def with_text(data: bytes, text: str) -> bytes:
    """Return data followed by a string."""
    raw = text.encode() + b'\0'
    return with_number(data, len(raw)) + raw


def _strings(message: bytes, count: int) -> tuple[tuple[str, ...], int]:
    """Return the strings behind a stamp, and where they end; 0 where they are damaged."""
    try:
        reader = Reader(message)
        reader.at = _STRINGS_AT - _STAMP_AT
        return tuple(reader.text() for _ in range(count)), _STAMP_AT + reader.at
    except BellowsError:
        return (), 0


def _doubles_at(end: int) -> int:
    """Return where the doubles begin behind strings: aligned to 8, counted after the head."""
    return end + (_STAMP_AT - end) % 8


def _dtype(order: str, doubles_at: int, size: int, layout: Layout) -> np.dtype[np.void]:
    """Return the memory layout of messages of a byte order and a size."""
    return np.dtype({
        'names': ['sec', 'nanosec', 'doubles'],
        'formats': [f'{order}i4', f'{order}u4', (f'{order}f8', (layout.doubles,))],
        'offsets': [_STAMP_AT, _STAMP_AT + 4, doubles_at],
        'itemsize': size})


def encode(stamps_ns: Indices, values: Array, names: Sequence[str], layout: Layout) -> np.ndarray:
    """
    Encode messages of one type, little-endian.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Header stamps, ns.
    values : array (N, D)
        Pose, then twist, as far as the type has them; what else it has (covariances) is zero.
    names : sequence of str
        frame_id, and child_frame_id where the type has one.
    layout : Layout
        Of the type.

    Returns
    -------
    array (N,) of raw bytes

    """
    head = HEAD
    for name in names:
        head = with_text(head, name)
    strings = head[_STAMP_AT:]
    doubles_at = _doubles_at(_STRINGS_AT + len(strings))
    size = doubles_at + 8 * layout.doubles
    message = (HEAD + bytes(_STRINGS_AT - _STAMP_AT) + strings).ljust(size, b'\0')
    raw = np.tile(np.frombuffer(message, f'V{size}'), len(stamps_ns))
    rows = raw.view(_dtype('<', doubles_at, size, layout))
    rows['sec'], rows['nanosec'] = np.divmod(stamps_ns, NS_PER_S)
    rows['doubles'][:, np.r_[*filter(None, (layout.pose, layout.twist))]] = values
    return raw


def encode_bool(value: bool) -> bytes:
    """Return a std_msgs/Bool."""
    return HEAD + bytes([value])


def decode_bool(message: bytes) -> bool | None:
    """Return the value of a std_msgs/Bool, or None if it is damaged."""
    sound = len(message) > 4 and message[0] == 0 and message[1] <= 1 and message[4] <= 1
    return bool(message[4]) if sound else None


Refused = dict[str, tuple[int, ...]]
Frames = Sequence[tuple[str, ...]]

MIN_QUATERNION_NORM = 1e-6
"""A shorter quaternion is zero."""

# No robot is further away (m), or faster (m/s, rad/s), than this; a damaged message may say so.
MAX_VALUE = 1e6

REASONS: Mapping[str, str] = {**WHY_REFUSED['both'], **WHY_REFUSED['recorded']}


def describe(refused: Mapping[str, tuple[int, ...]]) -> str:
    """Return the refusals in words: how many of each reason, and where the first is."""
    return ', '.join(
        f'{len(indices)} x {REASONS.get(reason, reason)} (first: message {indices[0]})'
        for reason, indices in refused.items() if indices) or 'none'


def pose_stream(name: str, decoded: np.ndarray, frames: Frames) -> PoseStream:
    """
    Return the usable poses.

    Parameters
    ----------
    name : str
        Topic.
    decoded : array (N,)
        As of `decode`, in the recording's order; values are x, y, z, the quaternion (x, y, z, w),
        and the covariance where that is wanted.
    frames : sequence of tuple of str
        The names of the frames by their indices: frame_id, and child_frame_id where the type has
        one.

    Returns
    -------
    PoseStream
        Its `refused` holds only the reasons that occur; each message is counted once, under the
        first that applies.

    """
    poses, covariance = decoded['values'][:, :7], decoded['values'][:, 7:]
    with np.errstate(over='ignore', invalid='ignore'):  # infinite where the square overflows
        norm = np.linalg.norm(poses[:, 3:], axis=1)
    unusable = {
        'zero_quaternion': norm < MIN_QUATERNION_NORM,
        'not_unit': np.abs(norm - 1.0) > UNIT_TOLERANCE}
    used, names, refused = _drop_invalid(decoded, poses, poses[:, :3], frames, unusable)
    return PoseStream(
        name, names[0], decoded['stamp'][used], poses[used, :3],
        quaternion_to_rotation(poses[used, 3:]), refused,
        covariance[used].reshape(-1, 6, 6) if covariance.size else None)


def twist_stream(name: str, decoded: np.ndarray, frames: Frames) -> TwistStream:
    """
    Return the usable twists, in the axes they were recorded in: of Odometry those of its child.

    Parameters
    ----------
    name : str
        Topic.
    decoded, frames
        As of `pose_stream`; values are linear, then angular.

    Returns
    -------
    TwistStream
        With `refused` as in `pose_stream`.

    """
    twists = decoded['values']
    used, names, refused = _drop_invalid(decoded, twists, twists, frames, {})
    return TwistStream(
        name, names[-1], decoded['stamp'][used], twists[used, :3], twists[used, 3:], refused)


def _drop_invalid(
    decoded: np.ndarray, values: Array, lengths: Array, frames: Frames,
    unusable: Mapping[str, Mask]
) -> tuple[Stamps, tuple[str, ...], Refused]:
    """Return the indices of the usable messages, their frames, and the others by reason."""
    finite = np.isfinite(values).all(axis=1)
    tests = {
        'malformed': decoded['frame'] < 0,
        'zero_stamp': decoded['stamp'] == 0,
        'nan': ~finite,
        'out_of_range': finite & (np.abs(lengths) > MAX_VALUE).any(axis=1),
        **unusable}
    usable = np.arange(len(decoded))
    refused: Refused = {}
    for reason, bad in tests.items():
        usable = _drop(refused, reason, usable, bad[usable])
    # The frame that most messages have; of equals, the one met first.
    frame = int(np.argmax(np.bincount(decoded['frame'][usable]))) if len(usable) else 0
    usable = _drop(refused, 'frame_id', usable, decoded['frame'][usable] != frame)
    of_stamps = unusable_stamps(decoded['stamp'][usable], decoded['arrival'][usable])
    for reason, bad in of_stamps.items():
        _drop(refused, reason, usable, bad)
    usable = usable[~np.logical_or.reduce(list(of_stamps.values()))]
    return usable, frames[frame] if len(usable) else ('',), refused


def _drop(refused: Refused, reason: str, usable: Stamps, bad: Mask) -> Stamps:
    """Note the bad ones among usable messages, and return the others."""
    if bad.any():
        refused[reason] = tuple(usable[bad].tolist())
    return usable[~bad]
