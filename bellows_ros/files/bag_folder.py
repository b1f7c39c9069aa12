"""The storage files of a rosbag2 recording: a folder with metadata.yaml, or one file."""

import os
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml

METADATA = 'metadata.yaml'


def storage_files(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """
    Return the files that hold the messages of a recording, in order.

    Parameters
    ----------
    path : path
        Folder with metadata.yaml of any rosbag2 version, or a bare storage file.

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
            return (bag,)
    except (OSError, ValueError) as error:
        raise BellowsError(f"Recording '{bag}' cannot be read: {error}") from None
    raise BellowsError(
        f"Recording '{bag}' does not exist. Give a rosbag2 folder, or a single .mcap or .db3 file."
    )


def _listed_files(folder: Path) -> tuple[Path, ...]:
    """Return the files a folder's metadata lists."""
    if not (folder / METADATA).is_file():
        raise _no_metadata(folder)
    information = _information(folder)
    _require_known_compression(folder, information)
    names = information.get('relative_file_paths')
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise _damaged(folder, 'relative_file_paths must be a list of file names')
    if not names:
        raise BellowsError(f"Recording '{folder}' is empty: its {METADATA} lists no files.")
    old = isinstance(information.get('version'), int) and information['version'] < 4
    return tuple(_inside(folder, name, old) for name in dict.fromkeys(names))


def _no_metadata(folder: Path) -> BellowsError:
    """Return the error for a folder that is no recording, or one whose recording was cut short."""
    suffixes = ('.mcap', '.db3', '.zstd')
    files = sorted(p.name for p in folder.iterdir() if p.suffix in suffixes)
    hint = (
        f"It holds {', '.join(files[:5])}: run 'ros2 bag reindex' on it, or give the file itself."
        if files
        else 'Give the folder that ros2 bag record made.'
    )
    return BellowsError(f"Folder '{folder}' has no {METADATA}, so it is not a recording. {hint}")


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
