"""
Reading of rosbag2 recordings: SQLite and MCAP, plain and zstd, by folder or by file.

Files are not trusted: sizes are bounded, and every fault is a BellowsError with the remedy. A
recording of a crashed recorder is read up to its damage, with a note.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
import struct
from typing import Any, NamedTuple

from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError, NoTopicError, shown
from bellows_ros.files import bag_folder, File, messages, storage
from bellows_ros.files.bag_folder import (
    Batch,
    Channel,
    DamagedError,
    Message,
    Stored,
    Wanted,
    ZSTD_MAGIC,
)
from bellows_ros.files.storage import INFLATING
import numpy as np

# Largest number of messages of a topic: five hours at 500 Hz, some 1 GB in memory.
MAX_MESSAGES = 10_000_000

Stream = PoseStream | TwistStream


class TopicCount(NamedTuple):
    """A topic of a recording: name, type and number of messages."""

    name: str
    type_name: str
    messages: int


class Contents(NamedTuple):
    """
    The content of a recording.

    Parameters
    ----------
    streams : dict of role to PoseStream or TwistStream
    problems : dict of role to BellowsError
        Reasons for unreadable roles.
    notes : tuple of str
        Missing parts of the recording, and contradictions to its metadata.

    """

    streams: dict[str, Stream]
    problems: dict[str, BellowsError]
    notes: tuple[str, ...]


class _Bag:
    """
    A recording during reading.

    Attributes
    ----------
    counts : dict
        Number of messages of every topic; filled during reading.
    notes : list of str
        Missing parts, and contradictions to its metadata; complete after reading.

    """

    def __init__(self, path: File) -> None:
        self.path = Path(path)
        self._listed = bag_folder.listing(path)
        self.counts: dict[Channel, int] = {}
        self.notes = list(self._listed.notes)

    def messages(self, wanted: Wanted) -> Iterator[Stored]:
        """Yield the messages of the wanted topics one by one."""
        for topic, times_ns, messages_ in self.batches(wanted):
            for log_time_ns, data in zip(times_ns, messages_, strict=True):
                yield topic, log_time_ns, data

    def batches(self, wanted: Wanted) -> Iterator[Batch]:
        """Yield the messages of the wanted topics in batches, file by file."""
        incomplete = False
        for file in self._listed.files:
            losses: list[str] = []
            try:
                most = storage.MAX_INFLATED + storage.MAX_INFLATION * file.stat().st_size
                inflated = 0
                for topic, times_ns, stored in storage.batches(file, wanted, self.counts, losses):
                    plain = [_decompressed(topic, data) if data[:4] == ZSTD_MAGIC else data
                             for data in stored]
                    inflated += sum(map(len, plain)) - sum(map(len, stored))
                    if inflated > most:
                        raise DamagedError(INFLATING)
                    yield topic, times_ns, plain
            except (DamagedError, bag_folder.ZstdError, EOFError) as error:
                raise BellowsError(
                    f"File '{file}' cannot be read as a recording: {error}. "
                    'Use an undamaged copy, or record again.') from None
            except OSError as error:
                raise BellowsError(f"File '{file}' cannot be read: {error}.") from None
            self.notes += [f"File '{file}' is incomplete: {what}." for what in losses]
            incomplete |= bool(losses)
        count, stated = sum(self.counts.values()), self._listed.information.get('message_count')
        if self._listed.information and stated != count and not incomplete:
            self.notes.append(
                f'The recording has {count} messages, but {bag_folder.METADATA} says '
                f'{str(stated)[:20]}. Is the copy complete?')

    def require_messages(self) -> None:
        """Raise for a recording without messages."""
        if not any(self.counts.values()):
            raise BellowsError(' '.join([
                f"Recording '{self.path}' is empty: it has {len(self.counts)} topics and no "
                'message.', *self.notes, 'Record while the topics are published.']))


def topics(path: File, notes: list[str] | None = None) -> list[TopicCount]:
    """
    Return the topics of a recording, by name.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    notes : list of str, optional
        List that receives missing parts of the recording, and contradictions to its metadata.

    Raises
    ------
    BellowsError
        If there is no recording, or it is damaged.

    """
    bag = _Bag(path)
    list(bag.messages(lambda topic: False))
    if notes is not None:
        notes += bag.notes
    return sorted(TopicCount(t.name, t.type_name, n) for t, n in bag.counts.items())


def read_messages(path: File, names: Collection[str] = ()) -> tuple[list[Message], list[str]]:
    """
    Return the recorded messages of topics in the order of their log times.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    names : collection of str, optional
        Topics with poses, twists, or detected tags with their camera; default: all with poses or
        twists.

    Returns
    -------
    list of Message
    list of str
        Missing or omitted parts of the recording, and contradictions to its metadata.

    Raises
    ------
    BellowsError
        If there is no recording, it is damaged, or lacks a topic.

    """
    bag, wanted = _Bag(path), {absolute(name) for name in names}

    def chosen(topic: Channel) -> bool:
        if topic.encoding != 'cdr':
            return False
        if wanted and topic.type_name in (messages.DETECTIONS, messages.CAMERA_INFO):
            return topic.name in wanted
        return topic.type_name in messages.MOTIONS and (not wanted or topic.name in wanted)

    stored = list(map(Message._make, bag.messages(chosen)))
    bag.require_messages()
    read_topics = {topic.name for topic in bag.counts if chosen(topic)}
    if wanted - read_topics or not read_topics:
        recorded = ', '.join(sorted(f'{t.name} ({t.type_name})' for t in bag.counts))
        raise BellowsError(
            f"Recording '{path}' has no poses or twists on "
            f'{", ".join(sorted(wanted - read_topics)) or "any topic"}; there are: {recorded}.')
    sound = [message for message in stored
             if 16 <= len(message.data) <= messages.MAX_MESSAGE_BYTES]  # encoding and stamp
    if len(sound) < len(stored):
        bag.notes.append(f'{len(stored) - len(sound)} damaged messages are left out.')
    return sorted(sound, key=lambda message: message.log_time_ns), bag.notes


def read_streams(path: File, wanted: Mapping[str, str]) -> dict[str, Stream]:
    """Return all wanted streams of a recording; see `read_contents`."""
    contents = read_contents(path, wanted)
    for problem in contents.problems.values():
        raise problem
    return contents.streams


def read_contents(path: File, wanted: Mapping[str, str]) -> Contents:
    """
    Read the streams of a recording.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    wanted : mapping of role to topic
        A role that ends in 'twist' is read as twists, one in 'wrench' as wrenches, in the
        form of twists, any other as poses, and 'measured' as poses with their covariances, if any.
        Topics are as recorded, optionally without a leading '/'. A role with the topic '' is
        omitted.

    Returns
    -------
    Contents
        Poses from PoseStamped, PoseWithCovarianceStamped, TransformStamped and Odometry; twists
        from TwistStamped and Odometry, whose twists are in the axes of its child frame. Stamps
        come from the headers. Omitted messages are in `refused` of a stream, with indices into the
        topic's messages in the order of recording. A role has a problem if its topic is missing,
        has another type, or no usable message.

    Raises
    ------
    BellowsError
        If there is no recording, it is damaged, or has no messages.

    """
    bag = _Bag(path)
    roles = {role: absolute(topic) for role, topic in wanted.items() if topic}
    collectors: dict[Channel, dict[str, _Collector]] = {}

    def is_wanted(topic: Channel) -> bool:
        """Add collectors of a topic for its roles, and return whether there are any."""
        if topic not in collectors:
            collectors[topic] = {
                role: _Collector(topic, role) for role, name in roles.items()
                if name == topic.name and topic.type_name in accepted_types(role)
                and topic.encoding == 'cdr'}
        return bool(collectors[topic])

    for topic, times_ns, stored in bag.batches(is_wanted):
        for collector in collectors[topic].values():
            collector.add(times_ns, stored)
    bag.require_messages()
    contents = Contents({}, {}, tuple(bag.notes))
    for role, name in roles.items():
        of_role = [of_topic[role] for of_topic in collectors.values() if role in of_topic]
        try:
            contents.streams[role] = _stream_of_role(bag, role, name, of_role)
        except BellowsError as problem:
            contents.problems[role] = problem
    return contents


def messages_of(path: File, types: Collection[str], topic: str = '') -> Iterator[Stored]:
    """
    Return the messages of some types, in CDR and in the order of the files.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    types : collection of str
        Types, such as 'trajectory_msgs/msg/JointTrajectory'.
    topic : str, optional
        Topic of the messages; default: all.

    Raises
    ------
    BellowsError
        If there is no recording, or it is damaged.

    """
    name = topic and absolute(topic)
    return _Bag(path).messages(
        lambda t: t.type_name in types and t.encoding == 'cdr' and name in ('', t.name))


ROBOT_TRAJECTORY, DISPLAY_TRAJECTORY = bag_folder.DEFINED_TYPES
MOVEIT_TYPES = {
    ROBOT_TRAJECTORY: 'trajectory_msgs/JointTrajectory joint_trajectory\n'
    'trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory',
    DISPLAY_TRAJECTORY: 'string model_id\nmoveit_msgs/RobotTrajectory[] trajectory'}
"""Definitions of types unknown to rosbags, for recordings without definitions: the first fields,
common to all releases."""
TAG_TYPES = {
    'apriltag_msgs/msg/Point': 'float64 x\nfloat64 y',
    'apriltag_msgs/msg/AprilTagDetection':
    'string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n'
    'apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography',
    'apriltag_msgs/msg/AprilTagDetectionArray':
    'std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections'}
"""Definitions of apriltag_msgs."""


def decoded(data: bytes, type_name: str, definition: str = '') -> Any:
    """
    Return a message of any type as an object with its fields.

    A type of `MOVEIT_TYPES` is decoded by its definition in the recording, if any.

    Raises
    ------
    BellowsError
        If the message is damaged.

    """
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    try:
        types = message_types(type_name, definition)
        if type_name not in MOVEIT_TYPES:
            return types.deserialize_cdr(data, type_name)
        begun = types.get_msgdef(type_name)  # further fields of a message are not read
        read = begun.deserialize_cdr_le if data[1] else begun.deserialize_cdr_be
        return read(data[4:], 0, begun.cls, types)[0]
    except (SerdeError, TypesysError, LookupError, struct.error, ValueError) as error:
        raise BellowsError(
            f'A {type_name} cannot be decoded: {shown(str(error), 300)} Record it again.'
        ) from None


@cache
def message_types(type_name: str = '', definition: str = '') -> Any:
    """Return the store of message types, or the types in the definition of a type alone."""
    # late, as it takes long and is rarely needed
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores

    store = get_typestore(Stores.EMPTY if definition else Stores.ROS2_JAZZY)
    known = {**MOVEIT_TYPES, **TAG_TYPES}
    for name, text in ({type_name: definition} if definition else known).items():
        store.register(get_types_from_msg(text, name))
    return store


def absolute(topic: str) -> str:
    """Return a topic's name with a leading slash, as in recordings."""
    return f'/{topic.lstrip("/")}'


def accepted_types(role: str) -> tuple[str, ...]:
    """Return the message types from which a role can be read."""
    if role.endswith('wrench'):
        return (messages.WRENCH,)
    twists = role.endswith('twist')
    return tuple(name for name, x in messages.LAYOUTS.items() if (x.twist if twists else x.pose))


class _Collector:
    """The messages of one topic and type for one role, decoded."""

    def __init__(self, topic: Channel, role: str) -> None:
        self.topic = topic
        self._layout = layout = messages.LAYOUTS[topic.type_name]
        self._pairs, self._by_stamp = role.endswith(('twist', 'wrench')), role == 'measured'
        part = layout.twist or slice(0, 6) if self._pairs else layout.pose
        assert part  # for all accepted types
        covariance = layout.pose_covariance if self._by_stamp else 0
        self._part = slice(part.start, part.stop + covariance)
        self._frames: dict[tuple[str, ...], int] = {}
        self.count, self._decoded = 0, list[np.ndarray]()

    def add(self, times_ns: Sequence[int], stored: Sequence[bytes]) -> None:
        """Decode a batch of messages, unless there are too many."""
        self.count += len(times_ns)
        if self.count > MAX_MESSAGES:
            raise BellowsError(f"Topic '{self.topic.name}' has more than {MAX_MESSAGES} messages. "
                               'Give a shorter recording.')
        self._decoded.append(messages.decode(
            stored, times_ns, self._layout, self._part, self._frames))

    def stream(self, recording: Path) -> Stream:
        """Return the usable messages in the recorded order; measured poses in order of stamps."""
        decoded = np.concatenate(self._decoded)
        order = np.argsort(decoded['stamp' if self._by_stamp else 'arrival'], kind='stable')
        make: Any = messages.twist_stream if self._pairs else messages.pose_stream
        name = self.topic.name
        stream: Stream = make(name, decoded[order], list(self._frames))
        if not len(stream):
            raise BellowsError(
                f"Topic '{name}' in recording '{recording}' has no usable message. "
                f'Of {len(decoded)}: {messages.describe(stream.refused)}. '
                'Check what publishes it, and record again.')
        return stream


def _stream_of_role(bag: _Bag, role: str, name: str, collectors: Sequence[_Collector]) -> Stream:
    """Return the stream of a role from its messages, or raise its fault."""
    filled = [each for each in collectors if each.count]
    if len(filled) > 1:
        raise BellowsError(
            f"Topic '{name}' has messages of two types, {filled[0].topic.type_name} and "
            f'{filled[1].topic.type_name}. Record them under two names.')
    if filled:
        return filled[0].stream(bag.path)
    where = f"'{name}' in recording '{bag.path}'"
    if collectors:
        remedy = ' '.join(bag.notes) or 'Record while it is published.'
        raise BellowsError(f'Topic {where} has no messages. {remedy}')
    types = accepted_types(role)
    given_by = f'topics.{role}' if f'topics.{role}' in PARAMETERS else 'the topic'
    fitting = sorted({t.name for t in bag.counts if t.type_name in types})
    others = sorted(f'{t.name} ({t.type_name})' for t in bag.counts)
    remedy = f'Set {given_by} to one of: {", ".join(fitting)}.' if fitting else (
        f'None is of a type for {given_by}; there are: {", ".join(others) or "none"}.')
    got = sorted({f'{t.type_name} in {t.encoding}' for t in bag.counts if t.name == name})
    if not fitting and any(t.type_name.endswith('/TFMessage') for t in bag.counts):
        raise NoTopicError(
            f"Recording '{bag.path}' has transforms, but no poses. Make them: 'bellows convert "
            f"{bag.path} --tool-frame FRAME --package-frame FRAME --out with_poses' ('bellows "
            "info' names the frames).")
    if not got:
        raise NoTopicError(f"Topic '{name}' is not in recording '{bag.path}'. {remedy}")
    raise NoTopicError(
        f'Topic {where} is of type {", ".join(got)}; accepted are {", ".join(types)}, in cdr. '
        f'{remedy}')


def _decompressed(topic: Channel, data: bytes) -> bytes:
    """Return a decompressed message; a damaged message becomes empty, and is counted later."""
    is_layout = topic.type_name in messages.MOTIONS
    with suppress(DamagedError):
        return bag_folder.decompressed(
            data, messages.MAX_MESSAGE_BYTES if is_layout else 2**28)
    return b''
