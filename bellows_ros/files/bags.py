"""
Reading rosbag2 recordings: SQLite and MCAP, plain and zstd, by folder or by file.

Files are not trusted: sizes are bounded, and whatever is wrong with one is a BellowsError that
says what to do. What a recorder that crashed has left is read as far as it goes, with a note.
"""

from array import array
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
import os
from pathlib import Path
import shutil
from typing import Any, BinaryIO, NamedTuple

from bellows_ros.core.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files import mcap, messages
from bellows_ros.files.bag_folder import (
    DamagedError,
    differing_counts,
    Listing,
    listing,
    Message,
    open_plain,
    Topic,
    unzstd,
    Wanted,
    ZSTD_MAGIC,
    ZstdError,
)
import numpy as np

# A recording of a topic may have so many messages: five hours at 500 Hz, some 1 GB once read.
LARGEST_COUNT = 10_000_000
# A message that is not a single pose or twist has at most so many bytes.
LARGEST_PLAN = 2**28
# A compressed SQLite file is decompressed beside the system's temporary files, up to this size.
LARGEST_TEMPORARY = 16 * 2**30

SQLITE_MAGIC = b'SQLite format 3\0'

SHORTEST = 16
"""Bytes of any message with a header: its encoding, stamp, and the length of a frame's name."""

_BATCH = 8192
_COPY_STEP = 2**20
_LARGEST_INT64 = 2**63 - 1

Stream = PoseStream | TwistStream


class TopicCount(NamedTuple):
    """A topic of a recording: name, type and number of messages."""

    name: str
    type_name: str
    messages: int


class Contents(NamedTuple):
    """
    What was read of a recording.

    Parameters
    ----------
    streams : dict of role to PoseStream or TwistStream
    problems : dict of role to BellowsError
        Why the other roles cannot be read.
    notes : tuple of str
        What is missing in the recording, or differs from what it says of itself.

    """

    streams: dict[str, Stream]
    problems: dict[str, BellowsError]
    notes: tuple[str, ...]

    def all_streams(self) -> dict[str, Stream]:
        """Return the streams, or raise the first problem."""
        for problem in self.problems.values():
            raise problem
        return self.streams


def topics(path: str | os.PathLike[str], notes: list[str] | None = None) -> list[TopicCount]:
    """
    Return the topics of a recording, by name.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    notes : list of str, optional
        Gets what is missing in the recording, or differs from what it says of itself.

    Raises
    ------
    BellowsError
        If there is no such recording, or it is damaged.

    """
    counts: dict[Topic, int] = {}
    listed = listing(path)
    found = list(listed.notes)
    for _ in _messages(listed, lambda topic: False, counts, found):
        pass
    if notes is not None:
        notes += [*found, *differing_counts(listed, counts)]
    return sorted(TopicCount(t.name, t.type_name, n) for t, n in counts.items())


def read_messages(
    path: str | os.PathLike[str], names: Collection[str] = ()
) -> tuple[list[Message], list[str]]:
    """
    Return the messages of topics as they were recorded, in the order of their log times.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    names : collection of str, optional
        Topics with poses or twists; all of these where none is named.

    Returns
    -------
    list of Message
    list of str
        What is missing in the recording, differs from what it says of itself, or was left out.

    Raises
    ------
    BellowsError
        If there is no such recording, it is damaged, lacks a topic, or has more messages than can
        be read.

    """
    bag, wanted = Path(path), {_absolute(name) for name in names}

    def chosen(topic: Topic) -> bool:
        readable = topic.type_name in messages.LAYOUTS and topic.encoding == 'cdr'
        return readable and (not wanted or topic.name in wanted)

    counts: dict[Topic, int] = {}
    found: list[Message] = []
    listed = listing(bag)
    notes = list(listed.notes)
    for message in _messages(listed, chosen, counts, notes):
        if len(found) == LARGEST_COUNT:
            raise BellowsError(f"Recording '{bag}' has more than {LARGEST_COUNT} messages on "
                               'these topics. Name fewer of them.')
        found.append(message._replace(data=_plain(message.data)))
    _require_messages(bag, counts, notes)
    here = {topic.name for topic in counts if chosen(topic)}
    if wanted - here or not here:
        there = ', '.join(sorted(f'{t.name} ({t.type_name})' for t in counts))
        raise BellowsError(
            f"Recording '{bag}' has no poses or twists on "
            f'{", ".join(sorted(wanted - here)) or "any topic"}; there are: {there}.')
    whole = [message for message in found if len(message.data) >= SHORTEST]
    if len(whole) < len(found):
        notes.append(f'{len(found) - len(whole)} damaged messages are left out.')
    notes += differing_counts(listed, counts)
    return sorted(whole, key=lambda message: message.log_time_ns), notes


def read_streams(path: str | os.PathLike[str], wanted: Mapping[str, str]) -> dict[str, Stream]:
    """Return the streams of a recording, all that are wanted; see `read_contents`."""
    return read_contents(path, wanted).all_streams()


def read_contents(path: str | os.PathLike[str], wanted: Mapping[str, str]) -> Contents:
    """
    Read the streams of a recording.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    wanted : mapping of role to topic
        A role ending in 'twist' is read as twists, any other as poses. Topics are those of the
        recording; a leading '/' may be left out. A role whose topic is '' is left out of the
        result.

    Returns
    -------
    Contents
        Poses from PoseStamped, PoseWithCovarianceStamped, TransformStamped and Odometry; twists
        from TwistStamped and Odometry, whose twists are in the axes of its child frame. Stamps are
        those of the headers. What was left out is in `refused` of a stream, with indices into the
        topic's messages in the order they were recorded in. A role has a problem where the
        recording lacks its topic, or the topic has another type or nothing usable.

    Raises
    ------
    BellowsError
        If there is no such recording, it is damaged, or has no messages.

    """
    bag = Path(path)
    listed = listing(bag)
    names = {role: _absolute(topic) for role, topic in wanted.items() if topic}
    collectors = {role: _Collector(name, role) for role, name in names.items()}
    counts: dict[Topic, int] = {}
    notes = list(listed.notes)
    takers: dict[Topic, list[_Collector]] = {}
    for message in _messages(
            listed, lambda topic: any(c.accepts(topic) for c in collectors.values()), counts,
            notes):
        if message.topic not in takers:
            takers[message.topic] = [c for c in collectors.values() if c.accepts(message.topic)]
        for collector in takers[message.topic]:
            collector.add(message)
    _require_messages(bag, counts, notes)
    notes += differing_counts(listed, counts)
    contents = Contents({}, {}, tuple(notes))
    for role, collector in collectors.items():
        try:
            contents.streams[role] = _stream(bag, counts, collector)
        except BellowsError as problem:
            contents.problems[role] = problem
    return contents


def messages_of(
    path: str | os.PathLike[str], types: Collection[str], topic: str = ''
) -> Iterator[tuple[str, str, int, bytes]]:
    """
    Yield topic, type, log time (ns) and CDR of messages of some types, in the order of the files.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    types : collection of str
        As in 'trajectory_msgs/msg/JointTrajectory'.
    topic : str, optional
        Only of this one.

    Raises
    ------
    BellowsError
        If there is no such recording, or it is damaged.

    """
    name = _absolute(topic) if topic else ''
    for message in _messages(
        listing(path),
        lambda t: t.type_name in types and t.encoding == 'cdr' and name in ('', t.name), {}, [],
    ):
        data = message.data
        plain = unzstd(data, LARGEST_PLAN) if data.startswith(ZSTD_MAGIC) else data
        yield message.topic.name, message.topic.type_name, message.log_time_ns, bytes(plain)


@cache
def _types() -> Any:
    """Return what decodes messages."""
    from rosbags.typesys import get_typestore, Stores  # late: takes long, and is rarely needed

    return get_typestore(Stores.ROS2_JAZZY)


def decoded(data: bytes, type_name: str) -> Any:
    """Return a message as an object with its fields, of any type."""
    return _types().deserialize_cdr(data, type_name)


def _absolute(topic: str) -> str:
    """Return a topic's name as a recording has it."""
    return topic if topic.startswith('/') else f'/{topic}'


def accepted_types(role: str) -> tuple[str, ...]:
    """Return the message types a role can be read from."""
    twists = role.endswith('twist')
    return tuple(name for name, x in messages.LAYOUTS.items() if (x.twist if twists else x.pose))


class _Collector:
    """The messages of one topic, decoded in batches as they come."""

    def __init__(self, name: str, role: str) -> None:
        """Start with nothing."""
        self.name = name
        self.role = role
        self.given_by = '--observe' if role == 'measured' else f'topics.{role}'
        self.type_name = ''
        self.types = accepted_types(role)
        self._problem: BellowsError | None = None
        self._log_times = array('q')
        self._batch: list[bytes] = []
        self._decoded: list[messages.Decoded] = []

    def accepts(self, topic: Topic) -> bool:
        """Return whether a topic is this one, in a type and an encoding that can be read."""
        return (
            topic.name == self.name and topic.type_name in self.types and topic.encoding == 'cdr'
        )

    def add(self, message: Message) -> None:
        """Take one message, unless one before could not be taken."""
        if self._problem is None:
            self._problem = self._why_not(message)
        if self._problem is not None:
            return
        self.type_name = message.topic.type_name
        self._log_times.append(max(0, min(message.log_time_ns, _LARGEST_INT64)))
        self._batch.append(_plain(message.data))
        if len(self._batch) == _BATCH:
            self._flush()

    def _why_not(self, message: Message) -> BellowsError | None:
        """Return why a message cannot be taken, or None."""
        if self.type_name not in ('', message.topic.type_name):
            return BellowsError(
                f"Topic '{self.name}' has messages of two types, {self.type_name} and "
                f'{message.topic.type_name}. Record them under two names.'
            )
        if len(self._log_times) == LARGEST_COUNT:
            return BellowsError(
                f"Topic '{self.name}' has more than {LARGEST_COUNT} messages. "
                'Give a part of the recording.'
            )
        return None

    def decoded(self) -> messages.Decoded:
        """Return all messages, in the order they were recorded in; raise what stopped it."""
        if self._problem is not None:
            raise self._problem
        self._flush()
        frames, frame = _joined_frames(self._decoded)
        stamps_ns = np.concatenate([d.stamps_ns for d in self._decoded])
        values = np.concatenate([d.values for d in self._decoded])
        self._decoded.clear()
        order = np.argsort(self._log_times, kind='stable')
        arrivals_ns = np.array(self._log_times)[order]
        if np.array_equal(order, np.arange(len(order))):
            return messages.Decoded(stamps_ns, values, frame, frames, arrivals_ns)
        return messages.Decoded(stamps_ns[order], values[order], frame[order], frames, arrivals_ns)

    def _flush(self) -> None:
        """Decode what has come."""
        layout = messages.LAYOUTS[self.type_name]
        part = layout.twist if self.role.endswith('twist') else layout.pose
        if self._batch and part:
            self._decoded.append(messages.decode(self._batch, layout, part))
            self._batch = []


def _plain(data: bytes) -> bytes:
    """Return a message's plain bytes; none where they cannot be had, which is counted later."""
    if not data.startswith(ZSTD_MAGIC):
        return data if len(data) <= messages.LARGEST_MESSAGE else b''
    try:
        return unzstd(data, messages.LARGEST_MESSAGE)
    except DamagedError:
        return b''


def _joined_frames(
    parts: list[messages.Decoded],
) -> tuple[list[tuple[str, ...]], messages.Indices]:
    """Return the frames of all parts, numbered through, and each message's number."""
    numbers: dict[tuple[str, ...], int] = {}
    joined = []
    for part in parts:
        of_part = [numbers.setdefault(names, len(numbers)) for names in part.frames]
        joined.append(np.array([*of_part, -1])[part.frame])
    return list(numbers), np.concatenate(joined)


def _stream(bag: Path, counts: Mapping[Topic, int], collector: _Collector) -> Stream:
    """Return the stream of a topic, which must have usable messages."""
    _require_topic(bag, counts, collector)
    decoded = collector.decoded()
    stream: Stream
    if collector.role.endswith('twist'):
        in_child = messages.LAYOUTS[collector.type_name].strings > 1
        stream = messages.twist_stream(collector.name, decoded, in_child)
    else:
        stream = messages.pose_stream(collector.name, decoded)
    if not len(stream):
        raise BellowsError(
            f"Topic '{collector.name}' in recording '{bag}' has no usable message. "
            f'Of {len(decoded.stamps_ns)}: {messages.describe(stream.refused)}. '
            'Check what publishes it, and record again.'
        )
    return stream


def _require_messages(bag: Path, counts: Mapping[Topic, int], notes: list[str]) -> None:
    """Refuse a recording without messages."""
    if not any(counts.values()):
        raise BellowsError(' '.join([
            f"Recording '{bag}' is empty: it has {len(counts)} topics and no message.", *notes,
            'Record while the topics are published.',
        ]))


def _require_topic(bag: Path, counts: Mapping[Topic, int], collector: _Collector) -> None:
    """Refuse a topic that is not there, is of another type, or has no messages."""
    accepted = ', '.join(collector.types)
    here = [topic for topic in counts if topic.name == collector.name]
    readable = [topic for topic in here if collector.accepts(topic)]
    if not here:
        raise BellowsError(
            f"Topic '{collector.name}' is not in recording '{bag}'; "
            f'{_alternatives(counts, collector)}. Set {collector.given_by}.'
        )
    if not readable:
        got = ', '.join(sorted({f'{t.type_name} in {t.encoding}' for t in here}))
        raise BellowsError(
            f"Topic '{collector.name}' in recording '{bag}' is of type {got}; "
            f'accepted are {accepted}, in cdr. '
            f'For {collector.given_by}, {_alternatives(counts, collector)}.'
        )
    if not any(counts[topic] for topic in readable):
        raise BellowsError(
            f"Topic '{collector.name}' in recording '{bag}' has no messages. "
            'Record while it is published.'
        )


def _alternatives(counts: Mapping[Topic, int], collector: _Collector) -> str:
    """Return which topics of a recording could be meant."""
    fitting = sorted({t.name for t in counts if t.type_name in collector.types})
    if fitting:
        return 'topics of a fitting type there: ' + ', '.join(fitting)
    others = sorted(f'{t.name} ({t.type_name})' for t in counts)
    return 'no topic there is of a fitting type; there are: ' + (', '.join(others) or 'none')


def _messages(
    listed: Listing, wanted: Wanted, counts: dict[Topic, int], notes: list[str]
) -> Iterator[Message]:
    """Yield the wanted messages of all files of a recording, file by file."""
    for path in listed.files:
        lost: list[str] = []
        try:
            yield from _file_messages(path, wanted, counts, lost)
            notes += [f"File '{path}' is not whole: {what}." for what in lost]
        except DamagedError as error:
            raise BellowsError(
                f"File '{path}' cannot be read as a recording: {error}. "
                'Give a sound copy, or record again.'
            ) from None
        except (ZstdError, EOFError) as error:
            raise BellowsError(
                f"File '{path}' is damaged or truncated: {error}. "
                'Give a sound copy, or record again.'
            ) from None
        except OSError as error:
            raise BellowsError(f"File '{path}' cannot be read: {error}.") from None


def _file_messages(
    path: Path, wanted: Wanted, counts: dict[Topic, int], lost: list[str]
) -> Iterator[Message]:
    """Yield the wanted messages of a file; its first bytes tell its storage and compression."""
    with open_plain(path) as (file, compressed):
        magic = file.read(len(SQLITE_MAGIC))
        file.seek(0)
        if magic.startswith(mcap.MAGIC):
            yield from mcap.scan(file, wanted, counts, lost)
        elif magic == SQLITE_MAGIC:
            from bellows_ros.files import sqlite_storage  # late: as is the database

            with _on_disk(path, file, compressed) as plain:
                yield from sqlite_storage.scan(plain, wanted, counts)
        elif not magic:
            lost.append('it is empty')
        else:
            raise DamagedError('it is neither an MCAP nor an SQLite file')


@contextmanager
def _on_disk(path: Path, file: BinaryIO, compressed: bool) -> Iterator[Path]:
    """Provide the path of a file's plain content, decompressed where it must be."""
    if not compressed:
        yield path
        return
    from bellows_ros.files.atomic import scratch_folder  # late: rare

    with scratch_folder() as folder:
        plain = folder / path.stem
        _copy(file, plain)
        yield plain


def _copy(file: BinaryIO, plain: Path) -> None:
    """Write a file's content, as far as half of the free space allows."""
    left = min(LARGEST_TEMPORARY, shutil.disk_usage(plain.parent).free // 2)
    with plain.open('wb') as out:
        while piece := file.read(_COPY_STEP):
            left -= len(piece)
            if left < 0:
                raise DamagedError(
                    f'decompressed it is too large for {plain.parent.parent}. '
                    "Decompress it with 'zstd -d' where there is space, and give that file"
                )
            out.write(piece)
