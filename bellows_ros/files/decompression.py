"""
Bounded decompression: a small recording cannot expand without end.

rosbags decompresses messages, chunks and whole files to any size, so this module replaces the
functions that rosbags calls.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from types import SimpleNamespace
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag2 import reader, storage_mcap

zstd: Any = reader.zstd  # type: ignore[attr-defined]

EXPANSION = 100
"""Largest ratio of sizes after and before decompression, for sizes above `ALWAYS`."""
ALWAYS = 2**26
"""Size up to which everything is decompressed, bytes."""


class ExpansionError(Exception):
    """Compressed data expands beyond its bound."""


def largest(size: int) -> int:
    """Return the largest size to which compressed data of a size may expand, bytes."""
    return ALWAYS + EXPANSION * size


def require_bounded(expanded: int, size: int) -> None:
    """Raise ExpansionError if compressed data of a size expands beyond its bound, bytes."""
    if expanded > largest(size):
        raise ExpansionError(
            f'{size} bytes expand to more than {largest(size)}, which no real recording does')


def decompressed(data: bytes, decoder_of: Callable[[], Any]) -> bytes:
    """Return the content of compressed data, one or several frames, each with a new decoder."""
    content, rest = b'', data
    while rest:
        decoder = decoder_of()
        content += decoder.decompress(rest, max_length=largest(len(data)) + 1 - len(content))
        require_bounded(len(content), len(data))
        if not decoder.eof:
            raise EOFError('compressed data ends too early')
        rest = decoder.unused_data or b''
    return content


@contextmanager
def opened(stream: BinaryIO, mode: str) -> Iterator[SimpleNamespace]:
    """Provide the content of an opened compressed file, by its `read` only."""
    size, expanded = os.fstat(stream.fileno()).st_size, 0
    with zstd.open(stream, mode) as file:
        def read(count: int) -> bytes:
            nonlocal expanded
            data: bytes = file.read(count)
            expanded += len(data)
            require_bounded(expanded, size)
            return data

        yield SimpleNamespace(read=read)


def of_zstd(data: bytes) -> bytes:
    """Return the content of data compressed by zstd."""
    return decompressed(data, zstd.ZstdDecompressor)


def of_lz4(data: bytes) -> bytes:
    """Return the content of data compressed by lz4."""
    return decompressed(data, LZ4FrameDecompressor)


def bound_rosbags() -> None:
    """Let rosbags decompress with a bound; its writers keep their functions."""
    bounded: Any = SimpleNamespace(**{**vars(zstd), 'decompress': of_zstd, 'open': opened})
    for module in (reader, storage_mcap):
        module.zstd = bounded  # type: ignore[attr-defined]
    storage_mcap.lz4_decompress = of_lz4  # type: ignore[attr-defined]
