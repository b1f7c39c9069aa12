"""
Reading of a damaged storage file, up to the damage and with a note of what was read.

An MCAP file is read linearly by mcap, without its index at the end, and a database row by row.
Declared sizes are bounded, and so is the sum of the decompressed content.
"""

from collections import Counter
from collections.abc import Iterator
from io import BytesIO
import os
from pathlib import Path
import sqlite3
import struct
from typing import Any, BinaryIO
import zlib

from bellows_ros.files.bag_folder import (
    Channel,
    channel,
    Counts,
    DamagedError,
    decompressed,
    FRAMES,
    MAX_RECORD_BYTES,
    Stored,
    Wanted,
)
from mcap import records
from mcap.exceptions import McapError, RecordLengthLimitExceeded
from mcap.stream_reader import CRCValidationError, StreamReader
import numpy as np

MCAP_MAGIC = b'\x89MCAP0\r\n'
FOOTER = struct.pack('<BQ', 2, 20) + bytes(20) + MCAP_MAGIC
"""End of an MCAP file without a summary."""

INFLATING = 'its content is far larger than the file'
TRUNCATED = 'a record goes beyond its end'
LATEST_NS = 2**63 - 1
_TOLD = DamagedError, CRCValidationError, RecordLengthLimitExceeded
"""Errors whose text tells the damage."""


class _InflatingError(DamagedError):
    """The content of a file is too large for its size."""


class _Progress:
    """The number of messages read, and the largest time of recording."""

    def __init__(self) -> None:
        self.met: Counter[Any] = Counter()
        self._last_ns = 0

    def count(self, number: int, log_time_ns: int) -> None:
        """Count a message."""
        self.met[number] += 1
        self._last_ns = max(self._last_ns, log_time_ns)

    def __str__(self) -> str:
        """Return what was read in words."""
        time = np.datetime64(min(self._last_ns, LATEST_NS) // 10**6, 'ms')
        return f'{self.met.total()} messages' + f' up to {time} UTC' * bool(self.met.total())


class _Source:
    """
    A file whose reads are bounded, and whose cut field is filled with zeros.

    Attributes
    ----------
    missing : int
        Number of bytes missing in a field that goes beyond the end.

    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.missing = file, 0

    def read(self, size: int) -> bytes:
        """Return the next bytes."""
        if size > MAX_RECORD_BYTES:
            raise DamagedError(f'a record says it is {size} bytes long')
        data = self._file.read(size)
        if size and not data:
            raise DamagedError(TRUNCATED)
        self.missing += size - len(data)
        return data.ljust(size, b'\0')


def linear_mcap(
    path: Path, wanted: Wanted, counts: Counts, notes: list[str], most_bytes: int
) -> Iterator[Stored]:
    """
    Yield the wanted messages of an MCAP file up to its end, or with a note to its damage.

    Parameters
    ----------
    path : Path
        File that begins with `MCAP_MAGIC`.
    wanted, counts, notes
        As in `storage.stored_messages`.
    most_bytes : int
        Largest size of the decompressed content.

    Raises
    ------
    DamagedError
        If the file is damaged although it has its proper end, or is far too large.

    """
    with path.open('rb') as file:
        scan = _Scan(wanted, counts, most_bytes)
        try:
            yield from scan.messages(file)
        except _InflatingError:
            raise
        except (McapError, CRCValidationError, DamagedError, struct.error, ValueError) as error:
            reason = str(error) if isinstance(error, _TOLD) else TRUNCATED
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - len(MCAP_MAGIC)))
            if not scan.ended and size > 2 * len(MCAP_MAGIC) and file.read() == MCAP_MAGIC:
                raise DamagedError(reason) from None
            what = ('its summary is damaged' if scan.ended else
                    'its recording was not closed, or its end is damaged')
            notes.append(f'{what} ({reason:.200}); read were {scan.progress}')
        finally:
            for number, amount in scan.progress.met.items():
                counts[scan.channels[number]] += amount


class _Scan:
    """The schemas and channels of an MCAP file that is read linearly."""

    def __init__(self, wanted: Wanted, counts: Counts, most_bytes: int) -> None:
        self._wanted, self._counts, self._bytes_left = wanted, counts, most_bytes
        self._schemas: dict[int, tuple[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self._wanted_channels: set[int] = set()
        self.progress, self.ended = _Progress(), False

    def messages(self, file: BinaryIO) -> Iterator[Stored]:
        """Yield the wanted messages, and count all."""
        for record in self._records(file):
            if not isinstance(record, records.Message):
                self._read_other(record)
                continue
            number = record.channel_id
            if number not in self.channels:
                raise DamagedError(f'a message belongs to channel {number}, which is not defined')
            self.progress.count(number, record.log_time)
            if number in self._wanted_channels:
                yield self.channels[number], record.log_time, record.data

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """Yield the records, those of a truncated chunk as far as they go."""
        source: Any = _Source(file)
        reader = StreamReader(
            source, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
        for record in reader.records:
            if isinstance(record, records.Chunk):
                inner: Any = _Source(BytesIO(self._chunk_data(record, source.missing)))
                for each in StreamReader(inner, skip_magic=True).records:
                    if inner.missing:
                        break
                    yield each
            elif not source.missing:
                yield record
            if source.missing:
                raise DamagedError(TRUNCATED)

    def _chunk_data(self, chunk: records.Chunk, missing: int) -> bytes:
        """Return the decompressed records of a chunk, with an end unless bytes are missing."""
        form, size = chunk.compression, chunk.uncompressed_size
        if form not in ('', *FRAMES):
            raise DamagedError(
                f"its compression '{form[:20]}' is not supported; zstd, lz4 and none are")
        if size > MAX_RECORD_BYTES:
            raise DamagedError(f'a chunk says it is {size} bytes long')
        data = chunk.data[:len(chunk.data) - missing]
        data = decompressed(form, data, size, cut=missing > 0) if form else data
        self._bytes_left -= len(data)
        if self._bytes_left < 0:
            raise _InflatingError(INFLATING)
        if missing:
            return data
        if len(data) != size:
            raise DamagedError(f'a chunk has {len(data)} bytes, but says {size}')
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise DamagedError('the checksum of a chunk is wrong')
        return data + FOOTER

    def _read_other(self, record: Any) -> None:
        """Read a record other than a message; raise for contradictions."""
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record.name, record.data.decode(errors='replace')
        elif isinstance(record, records.Channel):  # repeated in the summary at the end
            type_name, definition = self._schemas.get(record.schema_id, ('', ''))
            topic = channel(record.topic, type_name, record.message_encoding, definition)
            if self.channels.setdefault(record.id, topic) != topic:
                raise DamagedError(f'channel {record.id} is defined twice and differently')
            self._counts.setdefault(topic, 0)
            if self._wanted(topic):
                self._wanted_channels.add(record.id)
        elif isinstance(record, records.DataEnd):
            self.ended = True
        elif isinstance(record, records.Statistics):
            for number, stated in record.channel_message_counts.items():
                if self.progress.met[number] != stated:
                    raise DamagedError(f'it has {self.progress.met[number]} messages in channel '
                                       f'{number}, but says {stated}')


def readable_rows(
    database: sqlite3.Connection, damage: str, wanted: Wanted, counts: Counts, notes: list[str]
) -> Iterator[Stored]:
    """
    Yield the wanted messages of a damaged database, as far as SQLite reads it, with a note.

    Parameters
    ----------
    database : sqlite3.Connection
        Damaged database.
    damage : str
        Damage that SQLite has found.
    wanted, counts, notes
        As in `storage.stored_messages`.

    Raises
    ------
    DamagedError
        If the topics cannot be read.

    """
    progress, topics = _Progress(), dict[int, Channel]()
    try:
        for number, *texts in database.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            name, type_name, encoding = texts
            topics[number] = channel(name, type_name, encoding, '')
            counts.setdefault(topics[number], 0)
    except sqlite3.Error as error:
        raise DamagedError(f'SQLite cannot read its topics: {error}') from None
    chosen = {number for number, topic in topics.items() if wanted(topic)}
    try:
        for number, log_time_ns, data in database.execute(
                'SELECT topic_id, timestamp, data FROM messages NOT INDEXED'):
            if not (isinstance(log_time_ns, int) and isinstance(data, bytes) and number in topics):
                break
            progress.count(number, log_time_ns)
            if number in chosen:
                yield topics[number], log_time_ns, data
    except sqlite3.Error as error:
        damage = f'{damage}; {error}'
    finally:
        for number, amount in progress.met.items():
            counts[topics[number]] += amount
    notes.append(f'SQLite finds it damaged ({damage:.200}); read were {progress}')
