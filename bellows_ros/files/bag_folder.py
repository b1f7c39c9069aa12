"""The storage files of a rosbag2 recording: a folder or one file, plain or compressed."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import hashlib
import os
from pathlib import Path, PurePosixPath
import re
import sys
from typing import Any, NamedTuple

from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import File, safe_yaml

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

# Largest record, chunk or message of an intact recording; a damaged file may declare more.
MAX_RECORD_BYTES = 256 * 2**20


DEFINED_TYPES = ('moveit_msgs/msg/RobotTrajectory', 'moveit_msgs/msg/DisplayTrajectory')
"""Types that differ between releases."""
MAX_DEFINITION = 2**20
"""Longest definition of a type, bytes."""


class Channel(NamedTuple):
    """A recorded topic: its name, its type and the encoding of its messages."""

    name: str
    type_name: str
    encoding: str
    definition: str = ''
    """Definition of a type in `DEFINED_TYPES`, as stored in the recording."""


class Message(NamedTuple):
    """A recorded message: topic, time of recording (ns), and bytes."""

    topic: Channel
    log_time_ns: int
    data: bytes


Stored = tuple[Channel, int, bytes]
"""Fields of a `Message`, as a plain tuple for speed."""

Batch = tuple[Channel, list[int], list[bytes]]
"""Messages of a topic: times of recording (ns), and bytes."""

Wanted = Callable[[Channel], bool]
Counts = dict[Channel, int]


def channel(name: str, type_name: str, encoding: str, definition: str) -> Channel:
    """Return a topic, with the definition of its type only if releases differ in it."""
    if not all(isinstance(text, str) for text in (name, type_name, encoding)):
        raise DamagedError('its list of topics is damaged')
    defined = type_name in DEFINED_TYPES and len(definition) < MAX_DEFINITION
    return Channel(name, type_name, encoding, definition if defined else '')


class DamagedError(BellowsError):
    """A damaged storage file; the caller adds its name."""


METADATA = 'metadata.yaml'
STORAGE_SUFFIXES = ('.mcap', '.db3', '.zstd')  # last suffixes of storage files

MAX_LISTED = 5


class Listing(NamedTuple):
    """
    The files of a recording.

    Parameters
    ----------
    files : tuple of Path
        Files with the messages, in order.
    information : dict
        Content of its metadata; empty without metadata.
    notes : tuple of str
        Faults of the folder.

    """

    files: tuple[Path, ...]
    information: dict[str, Any]
    notes: tuple[str, ...] = ()


def listing(path: File) -> Listing:
    """
    Return the files of a recording.

    Parameters
    ----------
    path : path
        Folder with metadata.yaml of any rosbag2 version, or without it after a crash of the
        recorder, or a bare storage file.

    Raises
    ------
    BellowsError
        If there is no recording, its metadata is damaged, or names files that are missing or
        outside its folder.

    """
    bag = Path(path)
    try:
        if bag.is_dir():
            return _listed_files(bag)
        if bag.is_file():
            return Listing((bag,), {})
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError for links in a circle
        reason = getattr(error, 'strerror', None) or error
        raise BellowsError(f"Recording '{str(bag):.200}' cannot be read: {reason}") from None
    problem = 'is neither a file nor a folder' if bag.exists() else 'does not exist'
    raise BellowsError(
        f"Recording '{bag}' {problem}. Give a rosbag2 folder, or a single .mcap or .db3 file.")


def require_no_input(path: File, inputs: Iterable[File]) -> None:
    """
    Raise for output that is an input, is inside an input recording, or contains an input.

    Raises
    ------
    BellowsError
        If the output would replace or change an input.

    """
    for name in inputs:
        try:
            target, source = (Path(os.path.realpath(each)) for each in (path, name))
        except (OSError, ValueError) as error:
            raise BellowsError(f"'{path}' or '{name}' is no name of a file: {error}.") from None
        if source.suffix in STORAGE_SUFFIXES and (source.parent / METADATA).exists():
            source = source.parent
        if target == source or source in target.parents or target in source.parents:
            raise BellowsError(
                f"Output '{path}' would change the input '{name}'. Give a name elsewhere.")


def _listed_files(folder: Path) -> Listing:
    """Return the files a folder's metadata lists."""
    if not (folder / METADATA).is_file():
        return _without_metadata(folder)
    content = safe_yaml.load(folder / METADATA)
    information = content.get('rosbag2_bagfile_information') if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise _damaged(folder, "it has no 'rosbag2_bagfile_information'")
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(
            isinstance(name, str) and 0 < len(name) <= 1000 for name in names):
        raise _damaged(folder, 'relative_file_paths must be a list of file names')
    if not names:
        raise BellowsError(f"Recording '{folder}' is empty: its {METADATA} lists no files.")
    files = tuple(_inside(folder, name) for name in dict.fromkeys(names))
    return Listing(files, information)


def _without_metadata(folder: Path) -> Listing:
    """Return the storage files of a folder without metadata."""
    names = {p.name for p in folder.iterdir() if p.suffix in STORAGE_SUFFIXES and p.is_file()}
    # A file exists twice during its compression.
    names -= {f'{name}.zstd' for name in names}
    if not names:
        inner = [path.name for path in sorted(folder.iterdir()) if path.is_dir() and any(
            each.name == METADATA or each.suffix in STORAGE_SUFFIXES for each in path.iterdir())]
        if inner:
            raise BellowsError(
                f"Folder '{folder}' is not a recording; it holds {len(inner)}: "
                f'{shown(", ".join(inner), 1000)}. Give one of them.')
        raise BellowsError(
            f"Folder '{folder}' has no {METADATA} and no storage file, so it is not a recording. "
            'Give the folder that ros2 bag record made.')
    of_storage = {name.removesuffix('.zstd').rpartition('.')[2]: name for name in names}
    if len(of_storage) > 1:
        raise BellowsError(
            f"Folder '{folder}' has no {METADATA}, but files of two storages, such as "
            f'{" and ".join(sorted(of_storage.values()))}. Give the one that is meant.')
    # A recorder numbers its files: numbers in names are sorted by value.
    recorded = sorted(names, key=lambda name: [
        (text, int(number or -1)) for text, number in re.findall(r'(\D*)(\d*)', name)])
    files = tuple(_inside(folder, name) for name in recorded)
    return Listing(files, {}, (
        f"Recording '{folder}' has no {METADATA}: its recorder has crashed, or is still "
        f'recording. Read were {", ".join(file.name for file in files[:MAX_LISTED])}.',))


def _damaged(folder: Path, reason: str) -> BellowsError:
    """Return the error for unusable metadata."""
    return BellowsError(
        f"'{folder / METADATA}' is damaged: {reason}. Run 'ros2 bag reindex' on the folder, "
        'or give its storage file itself.')


def _inside(folder: Path, name: str) -> Path:
    """Return the path of a listed file, which must be in the folder."""
    path = folder / PurePosixPath(name).name  # before version 4 the folder's own name came first
    if not path.is_file() or path.resolve().parent != folder.resolve():
        raise BellowsError(
            f"Recording '{folder}' lacks '{name[:200]}', which {METADATA} names; files outside "
            'the folder are not read. Copy the whole folder, or give the path of a storage file '
            'that was renamed.')
    return path


ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
ZstdError, ZstdFile = zstd.ZstdError, zstd.ZstdFile


def decompressed(data: bytes, limit: int) -> bytes:
    """
    Decompress frames of zstd, up to a total number of bytes.

    Raises
    ------
    DamagedError
        If the data is damaged, incomplete, or decompresses beyond the limit.

    """
    plain = bytearray()
    while data:
        frame = zstd.ZstdDecompressor()
        try:
            plain += frame.decompress(data, max_length=limit - len(plain) + 1)
        except ZstdError as error:
            raise DamagedError(f'zstd data is damaged: {error}') from None
        if len(plain) > limit:
            raise DamagedError(f'decompressed data is longer than the {limit} bytes expected')
        if not frame.eof:
            raise DamagedError('compressed data ends early')
        data = frame.unused_data
    return bytes(plain)


def digests(path: File) -> list[dict[str, Any]]:
    """
    Return name, size and SHA-256 of a file, or of every file in a folder, in order of names.

    Raises
    ------
    BellowsError
        If a file cannot be read.

    """
    top = Path(path)
    try:
        found = []
        for file in sorted(filter(Path.is_file, top.iterdir())) if top.is_dir() else [top]:
            with file.open('rb') as stream:
                sha256 = hashlib.file_digest(stream, 'sha256').hexdigest()
                found.append({'name': file.name, 'bytes': stream.tell(), 'sha256': sha256})
        return found
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read for its digest: {error.strerror}.") from None


def recording_digest(path: File, files: Sequence[Mapping[str, Any]] = ()) -> str:
    """
    Return the SHA-256 of a recording's stored messages, independent of path and storage.

    The digests of the files are computed unless given.

    Raises
    ------
    BellowsError
        If there is no recording, or it cannot be read.

    """
    sha256 = {file['name']: file['sha256'] for file in files or digests(path)}
    parts = [sha256[file.name] for file in listing(path).files]
    return hashlib.sha256(' '.join(parts).encode()).hexdigest()
