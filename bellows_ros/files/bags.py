"""
Recordings (rosbag2): reading of whole ones by rosbags, and writing, whole or not at all.

A recording without its end, or with damage, is refused with the command that repairs it. The bytes
of a written one depend only on content, name and version of rosbags.
"""

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
import heapq
from itertools import repeat
import os
from pathlib import Path
import re
import sqlite3
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError, NoTopicError, shown
from bellows_ros.files import atomic, File, messages, read_text
from bellows_ros.files.decompression import bound_rosbags, require_bounded
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from ruamel.yaml import YAML

bound_rosbags()

METADATA = 'metadata.yaml'
RECORDED = '.mcap', '.db3', '.bag'
"""Suffixes of recordings that are no folders."""
MAX_METADATA = 2**26
"""Largest size of a metadata.yaml, bytes."""

Stream = PoseStream | TwistStream


class TopicCount(NamedTuple):
    """A topic of a recording: name, type and number of messages."""

    name: str
    type_name: str
    messages: int


class Contents(NamedTuple):
    """The streams of a recording by role, and the errors of unreadable roles."""

    streams: dict[str, Stream]
    problems: dict[str, BellowsError]


@contextmanager
def _opened(path: File) -> Iterator[Reader]:
    """Provide an opened recording; raise for one that is not whole."""
    bag = Path(path)
    with ExitStack() as stack:
        try:
            _require_recording(bag)
            _require_closed(bag)
            if bag.is_dir():
                _require_lists(bag)
            reader = Reader(bag)
            reader.open()
            stack.callback(reader.close)
            _require_types(reader)
        except BellowsError:
            raise
        except Exception as error:  # noqa: BLE001 (damaged bytes make readers raise anything)
            raise _damaged(bag, error) from None
        yield reader


def _require_recording(bag: Path) -> None:
    """Raise for a path or folder without a recording, and for pipes, whose reading may not end."""
    if not bag.exists():
        raise BellowsError(f"Recording '{shown(str(bag), 200)}' does not exist. Give a "
                           'rosbag2 folder, or a .mcap or .db3 file.')
    if bag.is_dir() and not (bag / METADATA).exists():
        inner = ', '.join(each.parent.name for each in sorted(bag.glob(f'*/{METADATA}')))
        raise BellowsError(f"Folder '{bag}' has no {METADATA}: " + (
            f'it holds recordings, {shown(inner, 1000)}. Give one of them.' if inner else
            "it is no recording, or its recorder has crashed. Run 'ros2 bag reindex' on it."))
    for file in bag.iterdir() if bag.is_dir() else [bag]:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise _damaged(bag, f"'{file.name}' is no plain file")
    if bag.is_file() and bag.suffix not in RECORDED:
        raise BellowsError(
            f"'{shown(str(bag), 200)}' is no recording: expected a rosbag2 folder, or a .mcap or "
            ".db3 file. 'bellows convert' makes one of the poses in files of Motive or TUM.")


def _require_closed(bag: Path) -> None:
    """Raise for a bag of ROS 1, and for a database with a journal or without its last pages."""
    if bag.suffix == '.bag' and not bag.is_dir():
        raise BellowsError(f"'{bag}' is a bag of ROS 1. Convert it: 'rosbags-convert --src {bag} "
                           "--dst FOLDER', of the Python package rosbags.")
    databases = list(bag.glob('*.db3'))
    if bag.suffix == '.db3' and not bag.is_dir():
        databases = [bag]
    for file in databases:
        journals = [file.with_name(file.name + end) for end in ('-wal', '-journal')]
        with file.open('rb') as stream:
            head, size = stream.read(32), stream.seek(0, 2)
        # SQLite reads zeros beyond the end.
        whole = int.from_bytes(head[16:18]) * int.from_bytes(head[28:32]) <= size
        if not whole or any(each.is_file() and each.stat().st_size for each in journals):
            raise _damaged(bag, f'{file.name} was not closed, or its end is missing')


def _require_lists(bag: Path) -> None:
    """
    Raise for a metadata.yaml in which files are no list, or a file is listed repeatedly.

    Each entry would be expanded; rosbags itself refuses what is missing or not YAML.
    """
    with suppress(KeyError, TypeError):
        content = YAML(typ='safe').load(read_text(bag / METADATA, MAX_METADATA))
        information = content['rosbag2_bagfile_information']
        names = Counter(Path(name).name for name in information['relative_file_paths'])
        for name, count in names.items():
            if count > 1:
                raise ValueError(f"{METADATA} lists '{name}' {count} times")
        if not isinstance(information.get('files', []), list):
            raise ValueError(f'{METADATA} has files that are no list')


def _require_types(reader: Reader) -> None:
    """Raise for topics or counts of a wrong type, from metadata.yaml or a database."""
    for own in reader.connections:
        if not (isinstance(own.topic, str) and isinstance(own.msgtype, str)):
            raise TypeError(f'a topic is named {own.topic!r}, of type {own.msgtype!r}')
    for count in (reader.message_count, *(own.msgcount for own in reader.connections)):
        if not isinstance(count, int):
            raise TypeError(f'a number of messages is {count!r}')


def _damaged(bag: object, reason: object) -> BellowsError:
    """Return the error for a recording that cannot be read."""
    name, why = shown(str(bag), 200), shown(str(reason).rstrip('.') or 'damage', 300)
    return BellowsError(
        f"Recording '{name}' cannot be read: {why}. Give a rosbag2 folder, or a .mcap or .db3 "
        "file; repair a damaged .mcap file with 'mcap recover', a folder with 'ros2 bag reindex'.")


def _stored(
    reader: Reader, wanted: Callable[[str, str], bool]
) -> Iterator[tuple[Any, int, bytes]]:
    """Yield the messages of topics selected by name and type: connection, log time (ns), bytes."""
    count, chosen = 0, [each for each in reader.connections if wanted(each.topic, each.msgtype)]
    size, expanded = _size(Path(str(reader.path))), 0
    try:
        for connection, log_time_ns, data in reader.messages(chosen) if chosen else ():
            if not isinstance(data, bytes) or not abs(log_time_ns) < 2**63:
                raise TypeError(f'a message at {shown(log_time_ns)} is no message')
            require_bounded(expanded := expanded + len(data), size)
            yield connection, log_time_ns, data
            count += 1
    except Exception as error:  # noqa: BLE001 (damaged bytes make readers raise anything)
        raise _damaged(reader.path, f'{error}, after {count} messages') from None
    if count < (stated := sum(each.msgcount for each in chosen)):
        raise _damaged(reader.path, f'its index lists {stated} messages, but {count} are there')


def _size(bag: Path) -> int:
    """Return the size of a recording's files, bytes."""
    return sum(each.stat().st_size for each in (bag.iterdir() if bag.is_dir() else [bag]))


def _topics(reader: Reader) -> list[TopicCount]:
    """Return the topics of an opened recording, by name."""
    counts = Counter[tuple[str, str]]()
    for each in reader.connections:
        counts[each.topic, each.msgtype] += each.msgcount
    return sorted(TopicCount(*names, count) for names, count in counts.items())


def topics(path: File) -> list[TopicCount]:
    """
    Return the topics of a recording, by name.

    Raises
    ------
    BellowsError
        If there is no recording, or it is damaged.

    """
    with _opened(path) as reader:
        return _topics(reader)


def read_messages(path: File, names: Collection[str]) -> list[tuple[str, int, bytes]]:
    """
    Return topic, time of recording (ns) and bytes of the messages of topics, in their order.

    Raises
    ------
    BellowsError
        If there is no recording, it is damaged, or lacks the topics.

    """
    wanted = {absolute(name) for name in names}
    with _opened(path) as reader:
        found = [(own.topic, log_time_ns, data) for own, log_time_ns, data
                 in _stored(reader, lambda name, _: name in wanted)]
    if missing := wanted - {topic for topic, *_ in found}:
        raise BellowsError(
            f"Recording '{path}' has no messages on {', '.join(sorted(missing))}.")
    return sorted(found, key=lambda message: message[1])


def messages_of(
    path: File, types: Collection[str], topic: str = ''
) -> Iterator[tuple[str, int, Any]]:
    """
    Return the decoded messages of some types, with topic and time of recording (ns).

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
        If there is no recording, or it or a message is damaged.

    """
    name = topic and absolute(topic)
    with _opened(path) as reader:
        for connection, log_ns, data in _stored(
                reader, lambda own, kind: kind in types and name in ('', own)):
            yield connection.topic, log_ns, messages.decoded(
                data, connection.msgtype, connection.msgdef.data, f" in '{path}'")


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
        A role that ends in 'twist' is read as twists, any other as poses, and 'measured' as poses
        with their covariances, if any.
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
    contents, chosen = Contents({}, {}), dict[str, TopicCount]()
    with _opened(path) as reader:
        recorded = _topics(reader)
        if not reader.message_count:
            raise BellowsError(f"Recording '{path}' is empty: it has {len(recorded)} topics and "
                               'no message. Record while they are published.')
        for role, name in wanted.items():
            try:
                if name:
                    chosen[role] = _topic_of_role(path, role, absolute(name), recorded)
            except BellowsError as problem:
                contents.problems[role] = problem
        stored = {topic[:2]: (array('q'), list[bytes]()) for topic in chosen.values()}
        for own, log_time_ns, data in _stored(reader, lambda *names: names in stored):
            log_times_ns, messages_ = stored[own.topic, own.msgtype]
            log_times_ns.append(log_time_ns)
            messages_.append(data)
    for role, topic in chosen.items():
        try:
            contents.streams[role] = messages.stream_of(role, topic[:2], *stored[topic[:2]])
        except BellowsError as problem:
            contents.problems[role] = BellowsError(
                f"Topic '{topic.name}' in recording '{path}' {problem}")
    return contents


def _topic_of_role(path: File, role: str, name: str, recorded: Sequence[TopicCount]) -> TopicCount:
    """Return the topic of a role, or raise for its fault."""
    types, own = accepted_types(role), [each for each in recorded if each.name == name]
    fitting = [each for each in own if each.type_name in types]
    filled = [each for each in fitting if each.messages]
    if len(filled) == 1:
        return filled[0]
    where = f"Topic '{name}' in recording '{path}'"
    if filled:
        kinds = ' and '.join(each.type_name for each in filled)
        raise BellowsError(
            f'{where} has messages of two types, {kinds}. Record them under two names.')
    if fitting:
        raise BellowsError(f'{where} has no messages. Record while it is published.')
    fault = f"Topic '{name}' is not in recording '{path}'. "
    if own:
        fault = f'{where} is of type {own[0].type_name}; accepted are {", ".join(types)}. '
        if has_several_bodies(own[0].type_name):
            fault += SEVERAL_BODIES
    setting = f'topics.{role}' if f'topics.{role}' in PARAMETERS else 'the topic'
    there = ', '.join(f'{each.name} ({each.type_name})' for each in recorded) or 'none'
    remedy = f'None is of a type for {setting}; there are: {there}.'
    if others := ', '.join(each.name for each in recorded if each.type_name in types):
        remedy = f'Set {setting} to one of: {others}.'
    raise NoTopicError(fault + remedy)


SEVERAL_BODIES = (
    'A message of several bodies is not read: let its driver publish a PoseStamped for each body, '
    "or export the poses as text and use 'bellows convert'. ")


def has_several_bodies(type_name: str) -> bool:
    """Return whether messages of a type seem to hold the poses of several bodies."""
    return bool(re.search('(PoseArray|BodyArray|Bodies|Poses|Markers|Subjects)$', type_name))


def absolute(topic: str) -> str:
    """Return a topic's name with a leading slash, as in recordings."""
    return f'/{topic.lstrip("/")}'


def accepted_types(role: str) -> tuple[str, ...]:
    """Return the message types from which a role can be read."""
    twists = role.endswith('twist')
    return tuple(name for name, x in messages.LAYOUTS.items() if (x.twist if twists else x.pose))


STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


class Encoded(NamedTuple):
    """Messages to record on a topic: times of receipt (ns) in order, and CDR with its head."""

    topic: str
    type_name: str
    stamps_ns: Stamps
    data: Any


def as_messages(
    topic: str, type_name: str, stamps_ns: Stamps, values: Array, frame_id: str = 'world',
    child_frame_id: str = '', log_times_ns: Stamps | None = None,
) -> Encoded:
    """
    Encode poses or twists.

    Parameters
    ----------
    topic, type_name : str
        Topic and type, one of `messages.MOTIONS`, for example 'geometry_msgs/msg/PoseStamped'.
    stamps_ns : int array (N,)
        Header stamps, ns; any order.
    values : array (N, 7), (N, 6) or (N, 13)
        Poses as x, y, z and the quaternion (x, y, z, w); twists as linear, angular; Odometry has
        both, pose first. Any numbers are allowed, so that faults can be recorded. Covariances are
        zero.
    frame_id, child_frame_id : str
        Frame names; the child's only for TransformStamped and Odometry.
    log_times_ns : int array (N,), optional
        Times of receipt, ns, which give the order; default: the stamps.

    Raises
    ------
    BellowsError
        If times are before 1970.

    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    log_times = stamps if log_times_ns is None else np.asarray(log_times_ns)
    if min(stamps.min(initial=0), log_times.min(initial=0)) < 0:
        raise BellowsError(f"Topic '{topic}' has times before 1970.")
    order = np.argsort(log_times, kind='stable')
    names = (frame_id, child_frame_id)[:messages.LAYOUTS[type_name].strings]
    return Encoded(topic, type_name, log_times[order], messages.encode(
        stamps[order], np.asarray(values)[order], names, type_name))


def write_bag(
    path: File, recorded: Sequence[Encoded], storage: str = 'mcap', zstd: bool = False,
    replace: bool = False
) -> None:
    """
    Write a recording.

    Parameters
    ----------
    path : path
        Folder to make.
    recorded : sequence of Encoded
        Messages; several items may share a topic of one type.
    storage : str
        'mcap' or 'sqlite3'.
    zstd : bool
        Whether the recording is compressed.
    replace : bool
        Whether an existing recording may be replaced.

    Raises
    ------
    BellowsError
        If there is nothing to record, or the output exists.

    """
    if not any(len(r.stamps_ns) for r in recorded):
        raise BellowsError(f"Recording '{path}' would be empty. Give messages to record.")
    _require_replaceable(Path(path), replace)
    with atomic.whole(path, is_folder=True) as folder:
        # ROS 2 Jazzy writes version 9 of metadata.yaml.
        writer = Writer(folder, version=9, storage_plugin=STORAGES[storage])
        if zstd:
            writer.set_compression(  # chunks inside an MCAP file, messages in a database
                CompressionMode.STORAGE if storage == 'mcap' else CompressionMode.MESSAGE,
                CompressionFormat.ZSTD)
        try:
            with writer:
                _write(writer, recorded)
        except sqlite3.Error as error:  # a full disk, reported by the system's message
            raise OSError(f'SQLite says {error}') from None


def _write(writer: Writer, recorded: Sequence[Encoded]) -> None:
    """Write messages in the order of their receipt."""
    names = [(r.topic, r.type_name) for r in recorded]
    connections = {name: writer.add_connection(*name, typestore=messages.message_types())
                   for name in dict.fromkeys(names)}
    streams = [zip(map(int, r.stamps_ns), repeat(number), map(bytes, r.data))
               for number, r in enumerate(recorded)]
    for log_time_ns, number, data in heapq.merge(*streams, key=lambda m: m[:2]):
        writer.write(connections[names[number]], log_time_ns, data)


def _require_replaceable(folder: Path, replace: bool) -> None:
    """Raise for a folder that may not be replaced, or contains anything but a recording."""
    atomic.require_absent(folder, replace)
    if atomic.require_target(folder, is_folder=True).exists():
        names = os.listdir(folder)
        strange = [name for name in names if name != METADATA
                   and not name.endswith(('.mcap', '.db3', '.zstd'))]
        if strange or METADATA not in names:
            why = f"it holds '{strange[0]}'" if strange else f'it has no {METADATA}'
            raise BellowsError(
                f"Folder '{folder}' is not replaced because it is not just a recording: {why}. "
                'Give another name, or remove it first.')
