"""
Reading of one storage file of a recording with rosbags: MCAP or SQLite, plain or compressed.

rosbags needs the index at the end of an MCAP file, and a sound database; other files are read by
`unclosed.py`. Files are not trusted: sizes are bounded before rosbags decompresses a chunk, and a
database may not define its tables by queries.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager, ExitStack, suppress
from os import truncate
from pathlib import Path
import shutil
import sqlite3
import struct
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from bellows_ros.files import bag_folder, unclosed
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
from bellows_ros.files.unclosed import INFLATING, MCAP_MAGIC
from mcap.reader import SeekingReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

SQLITE_MAGIC = b'SQLite format 3\0'

MAX_INFLATED, MAX_INFLATION = 2**27, 30
"""Largest decompressed content of a small file, bytes, and additional decompressed bytes per byte
of a file."""

_CHUNK_DATA_AT = 49
"""Position of the content of a chunk without the name of its compression."""

BATCH = 4096
"""Largest number of messages of a topic that are given together."""


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
        If the file is no recording, or is damaged although it was closed.

    """
    met, before = Counter[Channel](), dict(counts)
    pending: dict[Channel, tuple[list[int], list[bytes]]] = defaultdict(lambda: ([], []))
    for topic, log_time_ns, data in _stored(path, wanted, counts, notes):
        times, messages = pending[topic]
        times.append(log_time_ns)
        messages.append(data)
        if len(times) == BATCH:
            met[topic] += BATCH
            yield topic, *pending.pop(topic)
    for topic, (times, messages) in pending.items():
        met[topic] += len(times)
        yield topic, times, messages
    for topic, number in met.items():
        if number != counts[topic] - before.get(topic, 0):
            raise DamagedError(f"it has {number} messages of '{topic.name}', but says "
                               f'{counts[topic] - before.get(topic, 0)}')


def _stored(path: Path, wanted: Wanted, counts: Counts, notes: list[str]) -> Iterator[Stored]:
    """Yield the wanted messages one by one."""
    most_bytes = MAX_INFLATED + MAX_INFLATION * path.stat().st_size
    with _plain(path, notes, most_bytes) as plain:
        magic = _first(plain, len(SQLITE_MAGIC))
        if magic.startswith(MCAP_MAGIC):
            yield from _from_mcap(plain, wanted, counts, notes, most_bytes)
        elif magic == SQLITE_MAGIC:
            yield from _from_database(plain, wanted, counts, notes)
        elif magic.startswith(b'#ROSBAG'):
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
def _plain(path: Path, notes: list[str], most_bytes: int) -> Iterator[Path]:
    """
    Provide a file decompressed, and a database merged with its journal, if need be as a copy.

    Compressed content is given up to its damage, and a database without an incomplete last page,
    which SQLite would fill with zeros.
    """
    compressed = _first(path, len(ZSTD_MAGIC)) == ZSTD_MAGIC
    journals = [journal for suffix in ('-wal', '-journal')
                if (journal := path.with_name(path.name + suffix)).is_file()
                and journal.stat().st_size]
    if not compressed and not journals and path.stat().st_size % _page_bytes(path) == 0:
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder, path.name)
        if compressed:
            _decompress(path, copy, most_bytes)
        else:
            shutil.copyfile(path, copy)
        truncate(copy, copy.stat().st_size // _page_bytes(copy) * _page_bytes(copy))
        for journal in journals:
            shutil.copyfile(journal, copy.with_name(journal.name))
            with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as database:
                database.execute('SELECT COUNT(*) FROM sqlite_master').fetchall()
            notes.append(f'its recording was not closed; read with its journal {journal.name}')
        yield copy


def _page_bytes(path: Path) -> int:
    """Return the size of the pages of a database; 1 for another file."""
    head = _first(path, 18)
    if not head.startswith(SQLITE_MAGIC) or len(head) < 18:
        return 1
    (size,) = struct.unpack_from('>H', head, 16)
    return 65536 if size == 1 else max(size, 1)


def _decompress(path: Path, copy: Path, most_bytes: int) -> None:
    """Decompress a file up to where it is cut."""
    with bag_folder.ZstdFile(path) as file, copy.open('wb') as out, suppress(EOFError):
        while block := file.read(2**20):
            most_bytes -= out.write(block)
            if most_bytes < 0:
                raise DamagedError(INFLATING)


def _from_mcap(
    path: Path, wanted: Wanted, counts: Counts, notes: list[str], most_bytes: int
) -> Iterator[Stored]:
    """Yield the messages of an MCAP file, by its index if this is complete."""
    reader = _indexed(path, most_bytes)
    if reader is None:
        yield from unclosed.linear_mcap(path, wanted, counts, notes, most_bytes)
        return
    with closing(reader):
        yield from _by_index(reader, wanted, counts)


def _indexed(path: Path, most_bytes: int) -> McapReader | None:
    """Return the opened reader of an MCAP file; None without a complete summary at its end."""
    reader = McapReader(path)
    try:
        with _guarded(), path.open('rb') as file:
            # rosbags searches all chunks of a file without these, and decompresses without a bound
            end = SeekingReader(file, record_size_limit=MAX_RECORD_BYTES).get_summary()
            if not (end and end.statistics and end.schemas and end.chunk_indexes):
                return None
            reader.open()
    except DamagedError:
        return None
    with ExitStack() as stack:
        stack.callback(reader.close)
        with _guarded():
            if not _indexes_all(reader, path, most_bytes):
                return None
        stack.pop_all()
        return reader


def _indexes_all(reader: McapReader, path: Path, most_bytes: int) -> bool:
    """Return whether an index lists all messages; raise for chunks not of their stated size."""
    stated = sum(x.msgcount for x in reader.connections)
    indexed = sum(sum(chunk.channel_count.values()) for chunk in reader.chunks)
    if not stated == indexed == reader.metadata.message_count:
        return False
    if sum(chunk.uncompressed_size for chunk in reader.chunks) > most_bytes:
        raise DamagedError(INFLATING)
    with path.open('rb') as file:
        for chunk in reader.chunks:
            if chunk.compression:
                file.seek(chunk.chunk_start_offset + _CHUNK_DATA_AT + len(chunk.compression))
                bag_folder.decompressed(
                    chunk.compression, file.read(chunk.compressed_size), chunk.uncompressed_size)
    return not any(x.msgtype == '__schemaless__' for x in reader.connections)


def _from_database(
    path: Path, wanted: Wanted, counts: Counts, notes: list[str]
) -> Iterator[Stored]:
    """Yield the messages of a database, up to its damage if it has one."""
    address = quote(str(path.resolve()))
    with closing(sqlite3.connect(f'file:{address}?mode=ro&immutable=1', uri=True)) as database:
        if damage := _damage(database):
            yield from unclosed.readable_rows(database, damage, wanted, counts, notes)
            return
    reader = Sqlite3Reader(Path(address))
    with _guarded():
        reader.open()
    with closing(reader):
        unlisted = reader.metadata.message_count - sum(x.msgcount for x in reader.connections)
        if unlisted:
            raise DamagedError(f'{unlisted} messages have a topic it does not list')
        for topic, log_time_ns, data in _by_index(reader, wanted, counts):
            if not (isinstance(log_time_ns, int) and isinstance(data, bytes)):
                raise DamagedError("its table 'messages' is damaged")
            yield topic, log_time_ns, data


def _damage(database: sqlite3.Connection) -> str:
    """Return what SQLite finds damaged in a database; '' for nothing."""
    try:
        (verdict,) = database.execute('PRAGMA quick_check(1)').fetchone()
        tables = database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name IN ('messages', "
            "'topics') ORDER BY name").fetchall()
    except (sqlite3.Error, UnicodeError) as error:
        return str(error)
    if verdict != 'ok':
        return str(verdict)
    if tables != [('messages',), ('topics',)]:
        raise DamagedError("it lacks the tables 'messages' and 'topics' of a recording")
    return ''


def _by_index(reader: Any, wanted: Wanted, counts: Counts) -> Iterator[Stored]:
    """Yield the messages of an opened file."""
    topics = {}
    for x in reader.connections:
        if not all(isinstance(text, str) for text in (x.topic, x.msgtype)):
            raise DamagedError("its table 'topics' is damaged")
        topic = topics[x.id] = channel(
            x.topic, x.msgtype, x.ext.serialization_format, x.msgdef.data)
        counts[topic] = counts.get(topic, 0) + x.msgcount
    chosen = [x for x in reader.connections if wanted(topics[x.id])]
    with _guarded():
        for connection, log_time_ns, data in reader.messages(chosen) if chosen else ():
            yield topics[connection.id], log_time_ns, data


@contextmanager
def _guarded() -> Iterator[None]:
    """Raise DamagedError for whatever rosbags and mcap make of damaged bytes."""
    try:
        yield
    except DamagedError:
        raise
    except Exception as error:  # noqa: BLE001 (KeyError, TypeError, those of zstd ...)
        what = str(error) or type(error).__name__
        raise DamagedError(f'a record in it is damaged ({what:.200})') from None
