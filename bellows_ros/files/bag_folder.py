"""The storage files of a rosbag2 recording: a folder with metadata.yaml, or one file."""

from collections import Counter
from collections.abc import Iterable, Mapping
import os
from pathlib import Path, PurePosixPath, PureWindowsPath
import re
from typing import Any, NamedTuple

from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
from bellows_ros.files.storage import Topic

METADATA = 'metadata.yaml'
STORED = ('.mcap', '.db3', '.zstd')  # last suffixes of storage files

_SHOWN = 5


class Listing(NamedTuple):
    """
    The files of a recording.

    Parameters
    ----------
    files : tuple of Path
        Those that hold the messages, in order.
    information : dict
        What its metadata says; empty where there is none.
    notes : tuple of str
        What is wrong with its folder.

    """

    files: tuple[Path, ...]
    information: dict[str, Any]
    notes: tuple[str, ...] = ()


def listing(path: str | os.PathLike[str]) -> Listing:
    """
    Return the files of a recording.

    Parameters
    ----------
    path : path
        Folder with metadata.yaml of any rosbag2 version, or as a recorder leaves it that crashed,
        or a bare storage file.

    Raises
    ------
    BellowsError
        If there is no such recording, its metadata is damaged, or names files that are missing or
        outside its folder.

    """
    bag = Path(path)
    try:
        if bag.is_dir():
            return _listed_files(bag)
        if bag.is_file():
            return Listing((bag,), {})
    except (OSError, ValueError, RuntimeError) as error:  # the last for links in a circle
        raise BellowsError(f"Recording '{bag}' cannot be read: {error}") from None
    raise BellowsError(
        f"Recording '{bag}' does not exist. Give a rosbag2 folder, or a single .mcap or .db3 file."
    )


def require_no_input(
    path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]]
) -> None:
    """
    Refuse output that is an input, lies in a recording that is one, or has one in it.

    Raises
    ------
    BellowsError
        If it would replace or change what is read.

    """
    target = Path(os.path.realpath(path))
    for name in inputs:
        source = Path(os.path.realpath(name))
        if source.suffix in STORED and (source.parent / METADATA).exists():
            source = source.parent
        if target == source:
            raise BellowsError(f"Output '{path}' is also an input. Give another name.")
        if source in target.parents:
            raise BellowsError(
                f"Output '{path}' lies in '{name}', which is an input. Give a name elsewhere.")
        if target in source.parents:
            raise BellowsError(
                f"Output '{path}' has the input '{name}' in it. Give another name.")


def differing_counts(listed: Listing, counts: Mapping[Topic, int]) -> tuple[str, ...]:
    """Return in words where a recording has other numbers of messages than its metadata says."""
    information = listed.information
    if not information:
        return ()
    found = Counter({topic.name: 0 for topic in counts})
    for topic, count in counts.items():
        found[topic.name] += count
    said = _said_counts(information)
    total = information.get('message_count')
    names = [name for name in {**said, **found} if said.get(name, 0) != found[name]]
    if total == sum(found.values()) and not names:
        return ()
    which = [f"'{name}' {found[name]} of {str(said.get(name, 0))[:20]}" for name in names]
    more = [f'{len(which) - _SHOWN} more'] if len(which) > _SHOWN else []
    return (
        f'The recording has {sum(found.values())} messages, but {METADATA} says '
        f'{str(total)[:20]}{": " if which else ""}{", ".join([*which[:_SHOWN], *more])}. Was it '
        'copied whole?',
    )


def _said_counts(information: Mapping[str, Any]) -> dict[str, Any]:
    """Return what metadata says of the number of messages, by topic."""
    said: dict[str, Any] = {}
    listed = information.get('topics_with_message_count')
    for entry in listed if isinstance(listed, list) else []:
        about = entry.get('topic_metadata') if isinstance(entry, dict) else None
        if isinstance(about, dict):
            name, count = str(about.get('name')), entry.get('message_count')
            both = isinstance(count, int) and isinstance(said.get(name), int)
            said[name] = said[name] + count if both else count
    return said


def _listed_files(folder: Path) -> Listing:
    """Return the files a folder's metadata lists."""
    if not (folder / METADATA).is_file():
        return _without_metadata(folder)
    information = _information(folder)
    _require_known_compression(folder, information)
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise _damaged(folder, 'relative_file_paths must be a list of file names')
    if not names:
        raise BellowsError(f"Recording '{folder}' is empty: its {METADATA} lists no files.")
    old = isinstance(information.get('version'), int) and information['version'] < 4
    files = tuple(_inside(folder, name, old) for name in dict.fromkeys(names))
    return Listing(files, information)


def _without_metadata(folder: Path) -> Listing:
    """Return the storage files of a folder whose recorder has not come to write metadata."""
    names = {p.name for p in folder.iterdir() if p.suffix in STORED and p.is_file()}
    # A file that was being compressed is there twice.
    names -= {f'{name}.zstd' for name in names}
    if not names:
        raise BellowsError(
            f"Folder '{folder}' has no {METADATA} and no storage file, so it is not a recording. "
            'Give the folder that ros2 bag record made.')
    if len({name.removesuffix('.zstd').rpartition('.')[2] for name in names}) > 1:
        raise BellowsError(
            f"Folder '{folder}' has no {METADATA}, but files of two storages: "
            f'{", ".join(sorted(names)[:_SHOWN])}. Give the one that is meant.')
    files = tuple(_inside(folder, name, False) for name in sorted(names, key=_in_order))
    return Listing(files, {}, (
        f"Recording '{folder}' has no {METADATA}: its recorder has crashed, or is still "
        f'recording. Read were {", ".join(file.name for file in files[:_SHOWN])}.',))


def _in_order(name: str) -> tuple[tuple[str, int], ...]:
    """Return a key by which numbers in names count as such: a recorder numbers its files."""
    return tuple((text, int(number or -1)) for text, number in re.findall(r'(\D*)(\d*)', name))


def _damaged(folder: Path, reason: str) -> BellowsError:
    """Return the error for metadata that cannot be used."""
    return BellowsError(
        f"'{folder / METADATA}' is damaged: {reason}. Run 'ros2 bag reindex' on the folder, "
        'or give its storage file itself.'
    )


def _information(folder: Path) -> dict[str, Any]:
    """Return the information in a folder's metadata."""
    content = safe_yaml.load(folder / METADATA, aliases=True)
    information = content.get('rosbag2_bagfile_information') if isinstance(content, dict) else None
    if not isinstance(information, dict):
        raise _damaged(folder, "it has no 'rosbag2_bagfile_information'")
    return information


def _require_known_compression(folder: Path, information: dict[str, Any]) -> None:
    """Refuse compression other than zstd."""
    known = (None, '', 'none', 'zstd')
    form = information.get('compression_format')
    if form not in known:
        raise BellowsError(
            f"Recording '{folder}' is compressed with '{str(form)[:40]}'; zstd is supported. "
            "Decompress it with 'ros2 bag convert'."
        )


def _inside(folder: Path, name: str, old: bool) -> Path:
    """Return the path of a listed file, which must be in the folder."""
    listed = PurePosixPath(name)
    leaves = listed.is_absolute() or '..' in listed.parts or PureWindowsPath(name).drive
    if old and len(listed.parts) == 2:  # before version 4 the folder's own name came first
        listed = PurePosixPath(listed.name)
    path = folder / listed
    if leaves or not path.resolve().is_relative_to(folder.resolve()):
        raise BellowsError(
            f"'{folder / METADATA}' names '{name[:200]}', which is outside the folder; such "
            'files are not read. Give the storage file itself if it is meant.'
        )
    if not path.is_file():
        raise BellowsError(
            f"Recording '{folder}' lacks '{name[:200]}', which {METADATA} names. Copy it whole."
        )
    return path
