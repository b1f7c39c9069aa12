"""
Reading the messages of an MCAP file from front to back.

The file is read as a stream and nothing in it is believed that could cost memory: sizes are
bounded before they are allocated, chunks are decompressed one at a time up to the size they
declare, and indexes are not used. A file that does not end as it should, as of a recorder that
crashed, is read up to the break. The format is specified at https://mcap.dev/spec.
"""

from collections import Counter
from collections.abc import Iterator
import io
import struct
from typing import BinaryIO
import zlib

from bellows_ros.files.bag_folder import (
    DamagedError,
    decompressed,
    FRAMES,
    LARGEST_RECORD,
    Message,
    Topic,
    Wanted,
)

MAGIC = b'\x89MCAP0\r\n'

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS, _DATA_END = 0x0B, 0x0F
_READ = {_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END}
_RECORD_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_SUMMARY_CHECKSUM_AT = 16  # behind two offsets, in the footer
_SKIP_STEP = 2**20

Record = tuple[int, bytes | memoryview]


def scan(
    file: BinaryIO, wanted: Wanted, counts: dict[Topic, int], notes: list[str]
) -> Iterator[Message]:
    """
    Yield the messages of the wanted topics in the order they are stored in.

    Parameters
    ----------
    file : binary file
        At its beginning; need not be seekable.
    wanted : callable
        Topic to whether its messages are yielded.
    counts : dict
        Filled while reading: every topic, with its number of messages.
    notes : list of str
        Filled while reading: what was lost because the recording was not ended.

    Raises
    ------
    DamagedError
        If the file is damaged though it ends as it should, or is no MCAP file.

    """
    source = _Source(file)
    if source.read(len(MAGIC)) != MAGIC:
        raise DamagedError('it does not begin as an MCAP file does')
    scanned = _Scan(wanted, counts)
    try:
        yield from scanned.messages(_file_records(source))
    except (struct.error, UnicodeDecodeError, DamagedError) as error:
        named = isinstance(error, DamagedError)
        reason = str(error) if named else f'a record is damaged ({error})'
        if source.ends_well():
            raise DamagedError(reason) from None
        notes.append(
            f'its recording was not ended, {reason}: {sum(scanned.met.values())} messages were '
            f'read; the last {source.at - source.whole} of {source.at} bytes are damaged or cut '
            'short')


class _Source:
    """
    The bytes of a file, one after the other.

    Attributes
    ----------
    at : int
        How many were read.
    whole : int
        How many of these hold whole records.
    checksum : int
        Of all bytes so far, or of those behind the end of the data.

    """

    def __init__(self, file: BinaryIO) -> None:
        """Start at the beginning."""
        self._file = file
        self._tail = b''
        self.at = self.whole = self.checksum = 0

    def read(self, size: int) -> bytes:
        """Read up to a number of bytes."""
        data = self._file.read(size)
        self.at += len(data)
        self.checksum = zlib.crc32(data, self.checksum)
        self._tail = (self._tail + data[-len(MAGIC):])[-len(MAGIC):]
        return data

    def read_all(self, size: int) -> bytes:
        """Read exactly a number of bytes."""
        data = self.read(size)
        if len(data) != size:
            raise _truncated()
        return data

    def skip(self, size: int) -> None:
        """Skip a number of bytes, which must be there."""
        while size:
            step = len(self.read(min(size, _SKIP_STEP)))
            if not step:
                raise _truncated()
            size -= step

    def ends_well(self) -> bool:
        """Read the rest, and return whether it ends as an MCAP file does."""
        while self.read(_SKIP_STEP):
            pass
        return self.at >= 2 * len(MAGIC) and self._tail == MAGIC


def _truncated() -> DamagedError:
    """Return the error for a file that ends in the middle."""
    return DamagedError('a record goes beyond its end')


class _Scan:
    """The schemas and channels met so far."""

    def __init__(self, wanted: Wanted, counts: dict[Topic, int]) -> None:
        """Start empty."""
        self._wanted = wanted
        self._counts = counts
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Topic] = {}
        self._wanted_channels: set[int] = set()
        self.met: Counter[int] = Counter()

    def messages(self, records: Iterator[Record]) -> Iterator[Message]:
        """Yield the wanted messages among records, and those in their chunks."""
        for kind, body in records:
            if kind == _MESSAGE:
                channel, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(body)
                if channel not in self._channels:
                    raise DamagedError(
                        f'a message belongs to channel {channel}, which is not defined')
                topic = self._channels[channel]
                self._counts[topic] += 1
                self.met[channel] += 1
                if channel in self._wanted_channels:
                    yield Message(topic, log_time_ns, bytes(body[_MESSAGE_HEAD.size:]))
            elif kind == _CHUNK:
                yield from self.messages(_chunk_records(body))
            elif kind == _SCHEMA:
                fields = _Fields(body)
                number = fields.number('<H')
                self._schemas[number] = fields.text()
            elif kind == _CHANNEL:
                self._add_channel(_Fields(body))
            elif kind == _STATISTICS:
                self._compare(_Fields(body))

    def _compare(self, fields: '_Fields') -> None:
        """Refuse a file with fewer or more messages than its statistics count."""
        fields.block(42)  # totals and times
        counted = fields.block(fields.number('<I'))
        for channel, count in struct.iter_unpack('<HQ', counted):
            if self.met[channel] != count:
                raise DamagedError(
                    f'it has {self.met[channel]} messages in channel {channel}, but says {count}'
                )

    def _add_channel(self, fields: '_Fields') -> None:
        """Remember a topic; the summary at the end repeats them."""
        number, schema = fields.number('<H'), fields.number('<H')
        name, encoding = fields.text(), fields.text()
        topic = Topic(name, self._schemas.get(schema, ''), encoding)
        if self._channels.setdefault(number, topic) != topic:
            raise DamagedError(f'channel {number} is defined twice and differently')
        self._counts.setdefault(topic, 0)
        if self._wanted(topic):
            self._wanted_channels.add(number)


class _Fields(io.BytesIO):
    """The fields of a record, read in order."""

    def number(self, form: str) -> int:
        """Take an unsigned number."""
        (value,) = struct.unpack(form, self.read(struct.calcsize(form)))
        return int(value)

    def text(self) -> str:
        """Take a string."""
        return self.block(self.number('<I')).decode()

    def block(self, size: int) -> bytes:
        """Take a number of bytes."""
        block = self.rest(size)
        if len(block) != size:
            raise DamagedError(f'a field of {size} bytes has only {len(block)}')
        return block

    def rest(self, size: int) -> bytes:
        """Take up to a number of bytes."""
        return self.read(min(size, LARGEST_RECORD))


def _file_records(source: _Source) -> Iterator[Record]:
    """
    Yield the records that matter, and check that the file is whole to its end.

    Of a chunk at which the file ends, what there is of it.
    """
    kind = 0
    while kind != _FOOTER:
        source.whole, checksum = source.at, source.checksum
        head = source.read_all(_RECORD_HEAD.size)
        kind, size = _RECORD_HEAD.unpack(head)
        if not kind:
            raise DamagedError('a record has no kind')
        if kind not in _READ:
            source.skip(size)
            continue
        if size > LARGEST_RECORD:
            raise DamagedError(f'a record says it is {size} bytes long')
        body = source.read(size)
        if kind == _DATA_END:
            _require_checksum(_Fields(body).number('<I'), checksum, 'its data')
            source.checksum = 0
        elif kind == _FOOTER:
            before = zlib.crc32(body[:_SUMMARY_CHECKSUM_AT], zlib.crc32(head, checksum))
            fields = _Fields(body)
            fields.block(_SUMMARY_CHECKSUM_AT)
            _require_checksum(fields.number('<I'), before, 'its summary')
        if len(body) == size or kind == _CHUNK:
            yield kind, body
        if len(body) != size:
            raise _truncated()
    source.whole = source.at
    if source.read(len(MAGIC)) != MAGIC or source.read(1):
        raise DamagedError('it does not end as an MCAP file does')


def _require_checksum(said: int, found: int, of: str) -> None:
    """Refuse a checksum other than the stated one; 0 stands for none."""
    if said and said != found:
        raise DamagedError(f'the checksum of {of} is wrong')


def _chunk_records(chunk: bytes | memoryview) -> Iterator[Record]:
    """Yield the records of a chunk; of one that is cut short, those that are whole."""
    records = memoryview(_chunk_data(_Fields(chunk)))
    at = 0
    while at < len(records):
        kind, size = _RECORD_HEAD.unpack_from(records, at)
        at += _RECORD_HEAD.size
        if size > len(records) - at or kind in (0, _CHUNK):
            raise DamagedError('a record inside a chunk is damaged')
        yield kind, records[at:at + size]
        at += size


def _chunk_data(fields: _Fields) -> bytes:
    """
    Return the decompressed records of a chunk, checked against its size and its checksum.

    Of one that is cut short, what there is.
    """
    fields.block(16)  # first and last time
    size, checksum = fields.number('<Q'), fields.number('<I')
    compression = fields.text()
    stored_size = fields.number('<Q')
    stored = fields.rest(stored_size)
    cut = len(stored) != stored_size
    if size > LARGEST_RECORD:
        raise DamagedError(f'a chunk says it is {size} bytes long')
    if compression not in ('', *FRAMES):
        raise DamagedError(
            f"its compression '{compression[:20]}' is not supported; zstd, lz4 and none are")
    try:
        data = decompressed(compression, stored, size, cut) if compression else stored
    except DamagedError as error:
        raise DamagedError(f'a chunk cannot be decompressed: {error}') from None
    if cut:
        return data
    if len(data) != size:
        raise DamagedError(f'a chunk has {len(data)} bytes, but says {size}')
    _require_checksum(checksum, zlib.crc32(data), 'a chunk')
    return data
