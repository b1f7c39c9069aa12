"""
Reading the messages of an MCAP file from front to back, and the checksums of its chunks.

The file is read as a stream and nothing in it is believed that could cost memory: sizes are
bounded before they are allocated, chunks are decompressed one at a time up to the size they
declare, and indexes are not used. A file that does not end as it should, as of a recorder that
crashed, is read up to the break. The format is specified at https://mcap.dev/spec.
"""

from collections import Counter
from collections.abc import Iterator
import os
from pathlib import Path
import struct
from typing import BinaryIO
import zlib

from bellows_ros.files import bag_folder
from bellows_ros.files.bag_folder import Batch, Channel, DamagedError, MAX_RECORD_BYTES, Wanted
import numpy as np

MAGIC = b'\x89MCAP0\r\n'

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS = 0x0B
_READ_KINDS = {_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS}
_RECORD_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = np.dtype([
    ('kind', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('number', '<u4'), ('log_time', '<u8'),
    ('publish_time', '<u8')])
_MIN_MESSAGE_BYTES = _MESSAGE_HEAD.itemsize - _RECORD_HEAD.size
_CHUNK_CHECKSUM_AT = 24  # behind the first and last time and the size
_TRUNCATED = 'a record goes beyond its end'
_SHORT_MESSAGE = 'a message is damaged, as it is shorter than its head'
_SKIP_STEP = 2**20
_LOOSE_BYTES = 2**20  # bytes of records outside chunks that are read at once
_MAX_TIME = np.uint64(2**63 - 1)

_DAMAGE = (struct.error, UnicodeDecodeError, DamagedError)

Record = tuple[int, bytes]


def scan(
    file: BinaryIO, wanted: Wanted, counts: dict[Channel, int], notes: list[str]
) -> Iterator[list[Batch]]:
    """
    Yield the messages of the wanted topics, chunk by chunk, each topic's as they are stored.

    Parameters
    ----------
    file : binary file
        It begins with `MAGIC`.
    wanted : callable
        Topic to whether its messages are yielded.
    counts : dict
        Filled while reading: every topic, and at the end its number of messages.
    notes : list of str
        Filled while reading: what was lost because the recording was not closed.

    Raises
    ------
    DamagedError
        If the file is damaged though it ends as it should.

    """
    file.seek(len(MAGIC))
    scanned = _Scan(wanted, counts)
    try:
        yield from scanned.batches(scanned.file_records(file))
    except _DAMAGE as error:
        named = isinstance(error, DamagedError)
        reason = str(error) if named else f'a record is damaged ({error})'
        size = file.seek(0, os.SEEK_END)
        file.seek(size - len(MAGIC))
        if size >= 2 * len(MAGIC) and file.read() == MAGIC:  # it ends well
            raise DamagedError(reason) from None
        notes.append(
            f'the recording was not closed, {reason}: {sum(scanned.met.values())} messages were '
            f'read; the last {size - scanned.whole} of {size} bytes are damaged or cut short')
    finally:
        scanned.add_counts()


class _Scan:
    """The schemas and channels met so far, and how many bytes hold whole records."""

    def __init__(self, wanted: Wanted, counts: dict[Channel, int]) -> None:
        """Start empty."""
        self._wanted = wanted
        self._counts = counts
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._wanted_channels: set[int] = set()
        self.met: Counter[int] = Counter()
        self.whole = len(MAGIC)

    def file_records(self, file: BinaryIO) -> Iterator[Record]:
        """
        Yield the records that matter, and check that the file is whole to its end.

        Of a chunk at which the file ends, what there is of it.
        """
        kind = 0
        while kind != _FOOTER:
            head = _exactly(file, _RECORD_HEAD.size)
            kind, size = _RECORD_HEAD.unpack(head)
            if not kind:
                raise DamagedError('a record has no kind')
            if kind not in _READ_KINDS:
                for at in range(0, size, _SKIP_STEP):
                    _exactly(file, min(size - at, _SKIP_STEP))
            elif size > MAX_RECORD_BYTES:
                raise DamagedError(f'a record says it is {size} bytes long')
            else:
                body = file.read(size)
                if len(body) == size or kind == _CHUNK:
                    yield kind, body
                if len(body) != size:
                    raise DamagedError(_TRUNCATED)
            self.whole += len(head) + size
        if file.read(len(MAGIC) + 1) != MAGIC:
            raise DamagedError('it does not end as an MCAP file does')

    def batches(self, records: Iterator[Record]) -> Iterator[list[Batch]]:
        """Yield the wanted messages of each chunk, and of records outside chunks together."""
        loose = bytearray()
        try:
            for kind, body in records:
                if kind == _MESSAGE and len(body) < _MIN_MESSAGE_BYTES:
                    raise DamagedError(_SHORT_MESSAGE)
                if kind != _CHUNK:
                    loose += _RECORD_HEAD.pack(kind, len(body)) + body
                if kind == _CHUNK or len(loose) > _LOOSE_BYTES:
                    together, loose = bytes(loose), bytearray()
                    yield from self._read_chunk(together)
                if kind == _CHUNK:
                    yield from self._read_chunk(_chunk_data(body))
        except _DAMAGE:
            yield from self._read_chunk(bytes(loose))
            raise
        yield from self._read_chunk(bytes(loose))

    def _read_chunk(self, records: bytes) -> Iterator[list[Batch]]:
        """Read the records of a chunk; yield its wanted messages, of a damaged one up to there."""
        at, end, starts = 0, len(records), list[int]()
        unpack, head = _RECORD_HEAD.unpack_from, _RECORD_HEAD.size
        try:
            while at < end:
                kind, size = unpack(records, at)
                if size > end - at - head or kind in (0, _CHUNK):
                    raise DamagedError('a record inside a chunk is damaged')
                if kind == _MESSAGE:
                    if size < _MIN_MESSAGE_BYTES:
                        raise DamagedError(_SHORT_MESSAGE)
                    starts.append(at)
                else:
                    before, starts = starts, []
                    yield from self._messages(records, before)
                    self._read_other(kind, records[at + head:at + head + size])
                at += head + size
        except _DAMAGE:
            yield from self._messages(records, starts)
            raise
        yield from self._messages(records, starts)

    def _messages(self, records: bytes, starts: list[int]) -> Iterator[list[Batch]]:
        """Count the messages that begin there, and yield those that are wanted."""
        at = np.array(starts, dtype=np.int64)
        heads = bag_folder.rows_of(records, at, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD)[:, 0]
        unknown = ~np.isin(heads['channel'], list(self._channels))
        sound = heads[:np.argmax(unknown)] if unknown.any() else heads
        batches = []
        for channel, count in Counter(sound['channel'].tolist()).items():
            self.met[channel] += count
            if channel in self._wanted_channels:
                index = np.flatnonzero(sound['channel'] == channel)
                times = np.minimum(sound['log_time'][index], _MAX_TIME).astype(np.int64)
                batches.append(Batch(
                    self._channels[channel], times, records, at[index] + _MESSAGE_HEAD.itemsize,
                    sound['size'][index].astype(np.int64) - _MIN_MESSAGE_BYTES))
        if batches:
            yield batches
        if unknown.any():
            raise DamagedError(f"a message belongs to channel {heads['channel'][len(sound)]}, "
                               'which is not defined')

    def _read_other(self, kind: int, body: bytes) -> None:
        """Read what is no message."""
        if kind == _SCHEMA:
            (number,) = struct.unpack_from('<H', body)
            self._schemas[number] = _texts(body, 2, 1)[0]
        elif kind == _CHANNEL:
            self._add_channel(body)
        elif kind == _STATISTICS:
            self._compare(body)

    def add_counts(self) -> None:
        """Add the messages met to those of their topics."""
        for channel, number in self.met.items():
            self._counts[self._channels[channel]] += number

    def _compare(self, body: bytes) -> None:
        """Refuse a file with fewer or more messages than its statistics count."""
        (size,) = struct.unpack_from('<42xI', body)  # behind totals and times
        for channel, count in struct.iter_unpack('<HQ', _field(body, 46, size)):
            if self.met[channel] != count:
                raise DamagedError(
                    f'it has {self.met[channel]} messages in channel {channel}, but says {count}')

    def _add_channel(self, body: bytes) -> None:
        """Remember a topic; the summary at the end repeats them."""
        number, schema = struct.unpack_from('<HH', body)
        name, encoding = _texts(body, 4, 2)
        topic = Channel(name, self._schemas.get(schema, ''), encoding)
        if self._channels.setdefault(number, topic) != topic:
            raise DamagedError(f'channel {number} is defined twice and differently')
        self._counts.setdefault(topic, 0)
        if self._wanted(topic):
            self._wanted_channels.add(number)


def _exactly(file: BinaryIO, size: int) -> bytes:
    """Read a number of bytes, which must be there."""
    data = file.read(size)
    if len(data) != size:
        raise DamagedError(_TRUNCATED)
    return data


def _field(body: bytes, at: int, size: int) -> bytes:
    """Return so many bytes, which must be there."""
    if at + size > len(body):
        raise DamagedError(f'a field of {size} bytes has only {len(body) - at}')
    return body[at:at + size]


def _texts(body: bytes, at: int, count: int) -> list[str]:
    """Return so many strings from there on."""
    texts = []
    for _ in range(count):
        (size,) = struct.unpack_from('<I', body, at)
        texts.append(_field(body, at + 4, size).decode())
        at += 4 + size
    return texts


def _chunk_data(body: bytes) -> bytes:
    """
    Return the decompressed records of a chunk, checked against its size and its checksum.

    Of one that is cut short, what there is.
    """
    (size,), (compression,) = struct.unpack_from('<16xQ', body), _texts(body, 28, 1)
    at = 32 + len(compression.encode())
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
    """Write the checksums of the chunks of a sound MCAP file that was written without them."""
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
