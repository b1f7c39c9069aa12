"""
Reading of one storage file of a recording: MCAP or SQLite, plain or compressed.

rosbags reads undamaged files. An MCAP file whose end is missing or damaged is read linearly by
mcap, and a damaged database row by row. Every file is read up to its damage, with a note.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from bellows_ros.files import bag_folder
from bellows_ros.files.bag_folder import (
    Batch,
    Channel,
    channel,
    Counts,
    DamagedError,
    MAX_RECORD_BYTES,
    Stored,
    Wanted,
    ZSTD_MAGIC,
)
from mcap import records
from mcap.stream_reader import StreamReader
import numpy as np
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

MCAP_MAGIC, SQLITE_MAGIC, ROS1_MAGIC = b'\x89MCAP0\r\n', b'SQLite format 3\0', b'#ROSBAG'

BATCH = 4096
"""Largest number of messages in a batch."""

MAX_INFLATED = 2**27
"""Largest decompressed content of a small file, bytes."""

MAX_INFLATION = 30
"""Additional decompressed bytes per byte of a file."""

INFLATING = 'its content is far larger than the file'


def batches(path: Path, wanted: Wanted, counts: Counts, notes: list[str]) -> Iterator[Batch]:
    """
    Yield the messages of the wanted topics of a storage file, topic by topic in batches.

    Parameters
    ----------
    path : Path
        File, whose first bytes identify storage and compression.
    wanted : callable
        Function that selects topics.
    counts : dict
        Number of messages of every topic; topics are added before their first message.
    notes : list of str
        Losses, added during reading.

    Raises
    ------
    DamagedError
        If the file is no recording.

    """
    before, pending = dict(counts), dict[int, _Pending]()
    try:
        for topic, log_time_ns, data in _stored(path, wanted, counts, notes):
            own = pending.get(id(topic))  # a topic takes long to hash
            if own is None:
                own = pending[id(topic)] = _Pending(topic, wanted(topic))
            own.times.append(log_time_ns)
            own.messages.append(data)
            if len(own.times) == BATCH:
                yield from own.batch()
    except (DamagedError, OSError):
        raise
    except Exception as error:  # noqa: BLE001 (damaged bytes make readers raise anything)
        reason = str(error) or type(error).__name__
        for own in pending.values():
            yield from own.batch()
        total = sum(own.count for own in pending.values())
        last_ns = max((own.last_ns for own in pending.values()), default=0)
        notes.append(
            f'its recording was not closed, or it is damaged ({reason:.200}); read were '
            f'{total} messages' + f' up to {_utc(last_ns)} UTC' * bool(total))
        return
    met = Counter[Channel]()
    for own in pending.values():
        yield from own.batch()
        met[own.topic] += own.count
    notes += [f"its index lists {stated} messages of '{topic.name}'; read were {number}"
              for topic, number in met.items()
              if number != (stated := counts[topic] - before.get(topic, 0))]


class _Pending:
    """Messages of a topic that wait for a batch; number and last time of the yielded ones."""

    def __init__(self, topic: Channel, wanted: bool) -> None:
        self.topic, self._wanted = topic, wanted
        self.times, self.messages = list[int](), list[bytes]()
        self.count = self.last_ns = 0

    def batch(self) -> Iterator[Batch]:
        """Yield the messages, if any and wanted."""
        times, messages = self.times, self.messages
        self.times, self.messages = [], []
        self.count += len(times)
        self.last_ns = max(self.last_ns, *times, 0)
        if times and self._wanted:
            yield self.topic, times, messages


def _utc(stamp_ns: int) -> np.datetime64:
    """Return a time of recording to the millisecond."""
    return np.datetime64(min(stamp_ns, 2**63 - 1) // 10**6, 'ms')


def _stored(path: Path, wanted: Wanted, counts: Counts, notes: list[str]) -> Iterator[Stored]:
    """Yield the wanted messages up to the first exception due to damage."""
    with _plain(path, notes) as plain:
        magic = _first(plain, len(SQLITE_MAGIC))
        if magic.startswith(MCAP_MAGIC):
            yield from _from_mcap(plain, wanted, counts)
        elif magic == SQLITE_MAGIC:
            yield from _from_database(plain, wanted, counts)
        elif magic.startswith(ROS1_MAGIC):
            raise DamagedError(
                f"it is a bag of ROS 1. Convert it with 'rosbags-convert --src {path} --dst "
                "FOLDER', of the Python package rosbags; it is neither an MCAP nor an SQLite file")
        elif magic:
            raise DamagedError('it is neither an MCAP nor an SQLite file')
        else:
            notes.append('it is empty')


def _first(path: Path, size: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open('rb') as file:
        return file.read(size)


@contextmanager
def _plain(path: Path, notes: list[str]) -> Iterator[Path]:
    """Provide a file, or a copy of it that is decompressed or merged with a journal."""
    compressed = _first(path, len(ZSTD_MAGIC)) == ZSTD_MAGIC
    journals = [journal for suffix in ('-wal', '-journal')
                if (journal := path.with_name(path.name + suffix)).is_file()
                and journal.stat().st_size]
    if not compressed and not journals:
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        if compressed:
            _decompress(path, copy)
        else:
            shutil.copyfile(path, copy)
        for journal in journals:
            shutil.copyfile(journal, copy.with_name(journal.name))
            with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as database:
                database.execute('SELECT COUNT(*) FROM sqlite_master').fetchall()
            notes.append(f'its recording was not closed; read with its journal {journal.name}')
        yield copy


def _decompress(path: Path, copy: Path) -> None:
    """Decompress a file up to its damage, within a limit."""
    bytes_left = MAX_INFLATED + MAX_INFLATION * path.stat().st_size
    with bag_folder.ZstdFile(path) as file, copy.open('wb') as out, suppress(
            EOFError, bag_folder.ZstdError):
        while block := file.read(2**20):
            bytes_left -= out.write(block)
            if bytes_left < 0:
                raise DamagedError(INFLATING)


def _from_mcap(path: Path, wanted: Wanted, counts: Counts) -> Iterator[Stored]:
    """Yield the messages of an MCAP file, by its index if rosbags reads the index."""
    reader = McapReader(path)
    try:
        reader.open()
    except Exception:  # noqa: BLE001 (struct.error, KeyError, ReaderError ...)
        yield from _linear(path, counts)
        return
    with closing(reader):
        if any(x.msgtype == '__schemaless__' for x in reader.connections):
            yield from _linear(path, counts)
            return
        if sum(x.uncompressed_size for x in reader.chunks) > (
                MAX_INFLATED + MAX_INFLATION * path.stat().st_size):
            raise DamagedError(INFLATING)
        yield from _by_index(reader, wanted, counts)


def _linear(path: Path, counts: Counts) -> Iterator[Stored]:
    """Yield the messages of an MCAP file without its index."""
    schemas, topics = dict[int, Any](), dict[int, Channel]()
    with path.open('rb') as file:
        for record in StreamReader(
                file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES).records:
            if isinstance(record, records.Message):
                topic = topics.get(record.channel_id)
                if topic is None:
                    raise ValueError(
                        f'a message belongs to channel {record.channel_id}, which is not defined')
                counts[topic] += 1
                yield topic, record.log_time, record.data
            elif isinstance(record, records.Schema):
                schemas[record.id] = record
            elif isinstance(record, records.Channel):
                schema = schemas[record.schema_id]
                topic = topics[record.id] = channel(
                    record.topic, schema.name, record.message_encoding,
                    schema.data.decode(errors='replace'))
                counts.setdefault(topic, 0)


def _from_database(path: Path, wanted: Wanted, counts: Counts) -> Iterator[Stored]:
    """Yield the messages of a database, row by row where rosbags cannot open it."""
    address = quote(str(path.resolve()))
    reader = Sqlite3Reader(Path(address))
    try:
        reader.open()
    except Exception:  # noqa: BLE001 (those of apsw and of damaged texts)
        yield from _by_row(address, counts)
        raise
    with closing(reader):
        for topic, log_time_ns, data in _by_index(reader, wanted, counts):
            if not (isinstance(log_time_ns, int) and isinstance(data, bytes)):
                raise ValueError("its table 'messages' has other types")
            yield topic, log_time_ns, data
    page_bytes = int.from_bytes(_first(path, 18)[16:], 'big')
    if page_bytes > 1 and path.stat().st_size % page_bytes:  # SQLite reads zeros beyond the end
        raise ValueError('its last page is cut')


def _by_index(reader: Any, wanted: Wanted, counts: Counts) -> Iterator[Stored]:
    """Yield the wanted messages of an opened file."""
    topics = {x.id: channel(x.topic, x.msgtype, x.ext.serialization_format, x.msgdef.data)
              for x in reader.connections}
    for x in reader.connections:
        counts[topics[x.id]] = counts.get(topics[x.id], 0) + x.msgcount
    chosen = [x for x in reader.connections if wanted(topics[x.id])]
    for connection, log_time_ns, data in reader.messages(chosen) if chosen else ():
        yield topics[connection.id], log_time_ns, data


def _by_row(address: str, counts: Counts) -> Iterator[Stored]:
    """Yield the messages of a damaged database in the order of its rows."""
    with closing(sqlite3.connect(f'file:{address}?mode=ro&immutable=1', uri=True)) as database:
        tables = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name IN ('messages', "
            "'topics')").fetchall()
        if len(tables) < 2:
            raise DamagedError("it lacks the tables 'messages' and 'topics' of a recording")
        topics = {
            number: channel(name, kind, encoding, '') for number, name, kind, encoding
            in database.execute('SELECT id, name, type, serialization_format FROM topics')}
        counts.update({topic: counts.get(topic, 0) for topic in topics.values()})
        for number, log_time_ns, data in database.execute(
                'SELECT topic_id, timestamp, data FROM messages NOT INDEXED'):
            counts[topics[number]] += 1
            yield topics[number], int(log_time_ns), bytes(data)
