"""
Reading of the messages of an MCAP file from front to back, and the checksums of its chunks.

The file is read as a stream without trust in declared sizes: they are bounded before allocation,
chunks are decompressed one at a time up to their declared size, their sum is bounded by the size
of the file, and indexes are ignored. A file without its proper end, as after a crash of the
recorder, is read up to the break; a damaged summary after the messages is noted. The format is
specified at https://mcap.dev/spec.
"""

from collections import Counter
from collections.abc import Iterator
import os
from pathlib import Path
import struct
from typing import BinaryIO
import zlib

from bellows_ros.files import bag_folder
from bellows_ros.files.bag_folder import (
    Channel,
    DamagedError,
    DEFINED_TYPES,
    MAX_DEFINITION,
    MAX_RECORD_BYTES,
    Stored,
    Wanted,
)

MAGIC = b'\x89MCAP0\r\n'

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS, _DATA_END = 0x0B, 0x0F
_RECORD_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIqQ')  # channel, number, log time, publish time
_CHUNK_CHECKSUM_AT = 24  # after first and last time and size
_TRUNCATED = 'a record goes beyond its end'
_SKIP_STEP = 2**20

MAX_INFLATED, MAX_INFLATION = 2**27, 30
"""Largest decompressed content of a small file, bytes, and additional decompressed bytes per byte
of a file."""


class _InflatingError(DamagedError):
    """The content of a file is too large for its size; its end is not searched."""


def scan(
    file: BinaryIO, wanted: Wanted, counts: dict[Channel, int], notes: list[str], stored_bytes: int
) -> Iterator[Stored]:
    """
    Yield the stored messages of the wanted topics.

    Parameters
    ----------
    file : binary file
        Binary file that begins with `MAGIC`.
    wanted : callable
        Function that selects topics.
    counts : dict
        Topics, filled during reading, with the number of messages at the end.
    notes : list of str
        Losses of a recording that was not closed, or the state of its summary; filled during
        reading.
    stored_bytes : int
        Size of the stored, possibly compressed, file.

    Raises
    ------
    DamagedError
        If the file is damaged although it has its proper end.

    """
    file.seek(len(MAGIC))
    scanned = _Scan(wanted, counts, MAX_INFLATED + MAX_INFLATION * stored_bytes)
    try:
        yield from scanned.messages(file)
    except _InflatingError:
        raise
    except (struct.error, UnicodeDecodeError, DamagedError) as error:
        named = isinstance(error, DamagedError)
        reason = str(error) if named else f'a record is damaged ({error})'
        if scanned.data_ended:
            notes.append(f'its summary is damaged, {reason}: all {sum(scanned.met.values())} '
                         'messages before it were read')
            return
        size = file.seek(0, os.SEEK_END)
        file.seek(size - len(MAGIC))
        if size >= 2 * len(MAGIC) and file.read() == MAGIC:  # proper end
            raise DamagedError(reason) from None
        notes.append(
            f'the recording was not closed, {reason}: {sum(scanned.met.values())} messages were '
            f'read; the last {size - scanned.whole} of {size} bytes are damaged or cut short')
    finally:
        for channel, number in scanned.met.items():
            counts[scanned.channels[channel]] += number


class _Scan:
    """The schemas and channels read so far, and the number of bytes in complete records."""

    def __init__(self, wanted: Wanted, counts: dict[Channel, int], most_bytes: int) -> None:
        self._wanted = wanted
        self._counts = counts
        self._schemas: dict[int, tuple[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self._wanted_channels: set[int] = set()
        self.met: Counter[int] = Counter()
        self.whole = len(MAGIC)
        self.data_ended = False
        self._bytes_left = most_bytes

    def messages(self, file: BinaryIO) -> Iterator[Stored]:
        """Yield the wanted messages, and count all."""
        for block in self._blocks(file):
            end, last = 0, len(block)
            while end < last:
                kind, size = _RECORD_HEAD.unpack_from(block, end)
                at = end + _RECORD_HEAD.size
                end = at + size
                if end > last or not kind:
                    raise DamagedError(_TRUNCATED if kind else 'a record has no kind')
                if kind != _MESSAGE:
                    self._read_other(kind, block[at:end])
                    continue
                if size < _MESSAGE_HEAD.size:
                    raise DamagedError('a message has no head')
                number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(block, at)
                if number not in self.met:
                    raise DamagedError(
                        f'a message belongs to channel {number}, which is not defined')
                self.met[number] += 1
                if number in self._wanted_channels:
                    yield self.channels[number], log_time, block[at + _MESSAGE_HEAD.size:end]

    def _blocks(self, file: BinaryIO) -> Iterator[bytes]:
        """
        Yield the records of each chunk, and others one by one; check completeness.

        A truncated record gives its available part.
        """
        kind = -1
        while kind != _FOOTER:
            head = _exactly(file, _RECORD_HEAD.size)
            kind, size = _RECORD_HEAD.unpack(head)
            if kind not in {0, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS}:
                for at in range(0, size, _SKIP_STEP):
                    _exactly(file, min(size - at, _SKIP_STEP))
                    self._take(_SKIP_STEP)
            elif size > MAX_RECORD_BYTES:
                raise DamagedError(f'a record says it is {size} bytes long')
            else:
                body = file.read(size)
                records = _chunk_data(body) if kind == _CHUNK else head + body
                self._take(len(records))
                yield records
                if len(body) != size:
                    raise DamagedError(_TRUNCATED)
            self.whole += len(head) + size
            self.data_ended |= kind == _DATA_END
        if file.read(len(MAGIC) + 1) != MAGIC:
            raise DamagedError('it does not end as an MCAP file does')

    def _take(self, size: int) -> None:
        """Raise for a file whose content is too large for its size."""
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise _InflatingError('its content is far larger than the file')

    def _read_other(self, kind: int, body: bytes) -> None:
        """Read a record other than a message; raise for inconsistent counts in the statistics."""
        if kind == _SCHEMA:
            (number,) = struct.unpack_from('<H', body)
            type_name, end = _text(body, 2)
            definition = ''
            if type_name in DEFINED_TYPES and len(body) < MAX_DEFINITION:
                definition, _ = _text(body, _text(body, end)[1])
            self._schemas[number] = type_name, definition
        elif kind == _CHANNEL:  # repeated in the summary at the end
            number, schema = struct.unpack_from('<HH', body)
            name, end = _text(body, 4)
            encoding, _ = _text(body, end)
            type_name, definition = self._schemas.get(schema, ('', ''))
            topic = Channel(name, type_name, encoding, definition)
            if self.channels.setdefault(number, topic) != topic:
                raise DamagedError(f'channel {number} is defined twice and differently')
            self.met[number] += 0
            self._counts.setdefault(topic, 0)
            if self._wanted(topic):
                self._wanted_channels.add(number)
        elif kind == _STATISTICS:
            (size,) = struct.unpack_from('<42xI', body)  # after totals and times
            for number, count in struct.iter_unpack('<HQ', body[46:46 + size]):
                if self.met[number] != count:
                    raise DamagedError(f'it has {self.met[number]} messages in channel {number}, '
                                       f'but says {count}')


def _exactly(file: BinaryIO, size: int) -> bytes:
    """Return exactly a number of bytes, or raise."""
    data = file.read(size)
    if len(data) != size:
        raise DamagedError(_TRUNCATED)
    return data


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Return the string at an offset, and the offset of its end."""
    (size,) = struct.unpack_from('<I', body, at)
    end = at + 4 + size
    if end > len(body):
        raise DamagedError(f'a field of {size} bytes has only {len(body) - at - 4}')
    return body[at + 4:end].decode(), end


def _chunk_data(body: bytes) -> bytes:
    """
    Return the decompressed records of a chunk, checked against its size and its checksum.

    A truncated chunk gives its available part.
    """
    (size,), (compression, at) = struct.unpack_from('<16xQ', body), _text(body, 28)
    (stored_size,) = struct.unpack_from('<Q', body, at)
    stored = body[at + 8:at + 8 + stored_size]
    cut = len(stored) != stored_size
    if size > MAX_RECORD_BYTES:
        raise DamagedError(f'a chunk says it is {size} bytes long')
    if compression not in ('', *bag_folder.FRAMES):
        raise DamagedError(
            f"its compression '{compression[:20]}' is not supported; zstd, lz4 and none are")
    try:
        data = bag_folder.decompressed(compression, stored, size, cut) if compression else stored
    except DamagedError as error:
        raise DamagedError(f'a chunk cannot be decompressed: {error}') from None
    if cut:
        return data
    if len(data) != size:
        raise DamagedError(f'a chunk has {len(data)} bytes, but says {size}')
    (checksum,) = struct.unpack_from('<I', body, _CHUNK_CHECKSUM_AT)
    if checksum not in (0, zlib.crc32(data)):
        raise DamagedError('the checksum of a chunk is wrong')
    return data


def seal(path: Path) -> None:
    """Write the checksums of the chunks of an intact MCAP file written without them."""
    with path.open('r+b') as file:
        file.seek(len(MAGIC))
        kind = 0
        while kind != _FOOTER:
            kind, size = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
            at = file.tell()
            if kind == _CHUNK:
                records = _chunk_data(file.read(size))
                file.seek(at + _CHUNK_CHECKSUM_AT)
                file.write(struct.pack('<I', zlib.crc32(records)))
            file.seek(at + size)
