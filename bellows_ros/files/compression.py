"""Decompression that stops at a limit, so that a small hostile file cannot fill the memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import sys
from typing import Any, BinaryIO, cast

from bellows_ros.errors import BellowsError
import lz4.frame

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
ZstdError = zstd.ZstdError


@contextmanager
def open_plain(path: Path) -> Iterator[tuple[BinaryIO, bool]]:
    """
    Open a file that may be compressed with zstd.

    Yields
    ------
    binary file, bool
        Its plain content from the beginning, and whether it is compressed.

    """
    with path.open('rb') as stored:
        compressed = stored.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC
        stored.seek(0)
        if not compressed:
            yield stored, False
            return
        with zstd.ZstdFile(stored) as plain:
            yield cast(BinaryIO, plain), True


def unzstd(data: bytes, limit: int, cut: bool = False) -> bytes:
    """
    Decompress zstd frames that hold no more than a number of bytes together.

    Of data that is cut short, what there is.

    Raises
    ------
    BellowsError
        If the data is damaged, incomplete, or longer than the limit once decompressed.

    """
    try:
        return _decompress(zstd.ZstdDecompressor, data, limit, cut)
    except zstd.ZstdError as error:
        raise BellowsError(f'zstd data is damaged: {error}') from None


def unlz4(data: bytes, limit: int, cut: bool = False) -> bytes:
    """
    Decompress lz4 frames that hold no more than a number of bytes together; see `unzstd`.

    Raises
    ------
    BellowsError
        If the data is damaged, incomplete, or longer than the limit once decompressed.

    """
    try:
        return _decompress(lz4.frame.LZ4FrameDecompressor, data, limit, cut)
    except RuntimeError as error:  # what lz4 raises for damaged frames
        raise BellowsError(f'lz4 data is damaged: {error}') from None


def _decompress(new_decompressor: Any, data: bytes, limit: int, cut: bool) -> bytes:
    """Decompress frame after frame."""
    pieces = []
    left = limit
    while data:
        frame = new_decompressor()
        piece = frame.decompress(data, max_length=left + 1)
        left -= len(piece)
        if left < 0:
            raise BellowsError(f'decompressed data is longer than the {limit} bytes expected')
        if not (frame.eof or cut):
            raise BellowsError('compressed data ends early')
        pieces.append(piece)
        data = frame.unused_data
    return b''.join(pieces)
