"""
Reading the messages of an MCAP file, front to back.

The file is read as a stream and nothing in it is believed that could cost memory: sizes are
bounded before they are allocated, chunks are decompressed one at a time up to the size they
declare, and indexes are not used. The format is specified at https://mcap.dev/spec.
"""

from collections import Counter
from collections.abc import Iterator
import struct
from typing import BinaryIO
import zlib

from bellows_ros.errors import BellowsError
from bellows_ros.files.compression import unlz4, unzstd
from bellows_ros.files.storage import DamagedError, LARGEST_RECORD, Message, Topic, Wanted

MAGIC = b'\x89MCAP0\r\n'

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x02, 0x03, 0x04, 0x05, 0x06
_STATISTICS = 0x0B
_READ = {_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS}
_RECORD_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_SKIP_STEP = 2**20

Record = tuple[int, memoryview]


def scan(file: BinaryIO, wanted: Wanted, counts: dict[Topic, int]) -> Iterator[Message]:
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

    Raises
    ------
    DamagedError
        If the file is truncated or damaged.

    """
    try:
        yield from _Scan(wanted, counts).messages(_file_records(file))
    except (struct.error, UnicodeDecodeError) as error:
        raise DamagedError(f'a record is damaged ({error})') from None


class _Scan:
    """The schemas and channels met so far."""

    def __init__(self, wanted: Wanted, counts: dict[Topic, int]) -> None:
        """Start with nothing."""
        self._wanted = wanted
        self._counts = counts
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Topic] = {}
        self._wanted_channels: dict[int, Topic] = {}
        self._met: Counter[int] = Counter()

    def messages(self, records: Iterator[Record]) -> Iterator[Message]:
        """Yield the wanted messages among records, and those in their chunks."""
        for kind, body in records:
            if kind == _MESSAGE:
                channel, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(body)
                self._count(channel)
                if channel in self._wanted_channels:
                    topic = self._wanted_channels[channel]
                    yield Message(topic, log_time_ns, bytes(body[_MESSAGE_HEAD.size:]))
            elif kind == _CHUNK:
                yield from self.messages(_chunk_records(body))
            elif kind == _SCHEMA:
                self._add_schema(_Fields(body))
            elif kind == _CHANNEL:
                self._add_channel(_Fields(body))
            elif kind == _STATISTICS:
                self._compare(_Fields(body))

    def _count(self, channel: int) -> None:
        """Count a message."""
        if channel not in self._channels:
            raise DamagedError(f'a message belongs to channel {channel}, which is not defined')
        self._counts[self._channels[channel]] += 1
        self._met[channel] += 1

    def _compare(self, fields: '_Fields') -> None:
        """Refuse a file in which not all messages were met that its statistics count."""
        fields.block(42)  # totals and times
        counted = bytes(fields.block(fields.number('<I')))
        for channel, count in struct.iter_unpack('<HQ', counted):
            if self._met[channel] != count:
                raise DamagedError(
                    f'it has {self._met[channel]} messages in channel {channel}, but says {count}'
                )

    def _add_schema(self, fields: '_Fields') -> None:
        """Remember the name of a message type."""
        number = fields.number('<H')
        self._schemas[number] = fields.text()

    def _add_channel(self, fields: '_Fields') -> None:
        """Remember a topic; the summary at the end repeats them."""
        number, schema = fields.number('<H'), fields.number('<H')
        name, encoding = fields.text(), fields.text()
        topic = Topic(name, self._schemas.get(schema, ''), encoding)
        if self._channels.setdefault(number, topic) != topic:
            raise DamagedError(f'channel {number} is defined twice and differently')
        self._counts.setdefault(topic, 0)
        if self._wanted(topic):
            self._wanted_channels[number] = topic


class _Fields:
    """The fields of a record, taken one after the other."""

    def __init__(self, body: memoryview) -> None:
        """Start at the first field."""
        self._body = body
        self._at = 0

    def number(self, form: str) -> int:
        """Take an unsigned number."""
        (value,) = struct.unpack_from(form, self._body, self._at)
        self._at += struct.calcsize(form)
        return int(value)

    def text(self) -> str:
        """Take a string."""
        return bytes(self.block(self.number('<I'))).decode()

    def block(self, size: int) -> memoryview:
        """Take a number of bytes."""
        block = self._body[self._at:self._at + size]
        if len(block) != size:
            raise DamagedError(f'a field of {size} bytes has only {len(block)}')
        self._at += size
        return block


def _file_records(file: BinaryIO) -> Iterator[Record]:
    """Yield the records that matter, and check that the file is whole to its end."""
    if file.read(len(MAGIC)) != MAGIC:
        raise DamagedError('it does not begin as an MCAP file does')
    kind = 0
    while kind != _FOOTER:
        kind, size = _RECORD_HEAD.unpack(_read(file, _RECORD_HEAD.size))
        if kind not in _READ:
            _skip(file, size)
        elif size > LARGEST_RECORD:
            raise DamagedError(f'a record says it is {size} bytes long')
        else:
            yield kind, memoryview(_read(file, size))
    if _read(file, len(MAGIC)) != MAGIC or file.read(1):
        raise DamagedError('it does not end as an MCAP file does')


def _read(file: BinaryIO, size: int) -> bytes:
    """Read exactly so many bytes."""
    data = file.read(size)
    if len(data) != size:
        raise _truncated()
    return data


def _skip(file: BinaryIO, size: int) -> None:
    """Pass over so many bytes, which must be there."""
    while size:
        step = len(file.read(min(size, _SKIP_STEP)))
        if not step:
            raise _truncated()
        size -= step


def _truncated() -> DamagedError:
    """Return the error for a file that ends in the middle."""
    return DamagedError(
        'it ends in the middle: it was truncated, or its recording not ended properly. '
        "What is left may be recovered with 'mcap recover'"
    )


def _chunk_records(chunk: memoryview) -> Iterator[Record]:
    """Yield the records of a chunk."""
    records = memoryview(_chunk_data(_Fields(chunk)))
    at = 0
    while at < len(records):
        kind, size = _RECORD_HEAD.unpack_from(records, at)
        at += _RECORD_HEAD.size
        if size > len(records) - at or kind == _CHUNK:
            raise DamagedError('a record inside a chunk is damaged')
        yield kind, records[at:at + size]
        at += size


def _chunk_data(fields: _Fields) -> bytes:
    """Return the decompressed records of a chunk, checked against its size and its checksum."""
    fields.block(16)  # first and last time
    size, checksum = fields.number('<Q'), fields.number('<I')
    compression = fields.text()
    stored = bytes(fields.block(fields.number('<Q')))
    if size > LARGEST_RECORD:
        raise DamagedError(f'a chunk says it is {size} bytes long')
    data = _decompress(compression, stored, size)
    if len(data) != size:
        raise DamagedError(f'a chunk has {len(data)} bytes, but says {size}')
    if checksum and zlib.crc32(data) != checksum:
        raise DamagedError('the checksum of a chunk is wrong')
    return data


def _decompress(compression: str, stored: bytes, size: int) -> bytes:
    """Return the bytes of a chunk."""
    try:
        if compression == '':
            return stored
        if compression == 'zstd':
            return unzstd(stored, size)
        if compression == 'lz4':
            return unlz4(stored, size)
    except BellowsError as error:
        raise DamagedError(f'a chunk cannot be decompressed: {error}') from None
    raise DamagedError(
        f"its compression '{compression[:20]}' is not supported; zstd, lz4 and none are"
    )
