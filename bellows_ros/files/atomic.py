"""
Atomic output: written next to its target, then renamed.

A process that is killed leaves the old output or the new one, and at most a hidden file or folder
next to it.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import ctypes
import os
from pathlib import Path
import secrets
import shutil
import stat
import sys
import time

from bellows_ros.errors import BellowsError
from bellows_ros.files import File

# Constants of renameat2(2): relative names start at the working folder; exchange of two files.
_HERE, _EXCHANGE = -100, 2

PREFIX = '.bellows-'

ABANDONED = 86400.0
"""Age (s) above which a hidden file or folder is assumed to be left by a killed run."""


def write_text(path: File, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all, or '-' for stdout; see `write_bytes`."""
    if path == '-':
        sys.stdout.write(text)
    else:
        write_bytes(path, text.encode())


def write_bytes(path: File, data: bytes) -> None:
    """
    Write a file, whole or not at all.

    Parameters
    ----------
    path : path
        Target of the data. An existing file is replaced and keeps its permissions; a link is
        followed.
    data : bytes
        Complete content.

    Raises
    ------
    BellowsError
        If the file cannot be written; an existing file is then unchanged.

    """
    target = require_file_target(path)
    temporary = _temporary_path(target)
    try:
        with temporary.open('xb') as file:
            if target.exists():
                os.fchmod(file.fileno(), stat.S_IMODE(target.stat().st_mode))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
        _sync(target.parent)
    except OSError as error:
        raise _failed(path, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def require_file_target(path: File) -> Path:
    """
    Return the path of an output file, checked before its content is computed.

    Raises
    ------
    BellowsError
        If its folder does not exist, or the path is taken by something other than a plain file.

    """
    target = require_folder_target(path, follow=True)
    if target.exists() and not target.is_file():
        what = 'a folder: name a file in it' if target.is_dir() else (
            'not a plain file: give another name')
        raise BellowsError(f"Output '{path}' is {what}.")
    return target


@contextmanager
def new_folder(path: File, replace: bool = False) -> Iterator[Path]:
    """
    Provide a path for a folder that gets its name only when it is complete.

    Parameters
    ----------
    path : path
        Final path of the folder.
    replace : bool
        Whether an existing folder may be replaced. The caller ensures that it may be deleted.

    Yields
    ------
    Path
        Temporary path with the name of the folder; the caller makes the folder at this path.

    Raises
    ------
    BellowsError
        If the final path exists and may not be replaced, or the folder cannot be written.

    """
    target = require_folder_target(path)
    if os.path.lexists(target) and not (replace and target.is_dir() and not target.is_symlink()):
        raise BellowsError(f"Output '{path}' exists. Give another name, or remove it first.")
    try:
        work = _temporary_path(target)
        work.mkdir()
        finished = work / target.name
        try:
            yield finished
            for part in [*finished.rglob('*'), finished]:
                _sync(part)
            _move_into_place(work, target, replace)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        raise _failed(path, error) from None


def require_folder_target(path: File, follow: bool = False) -> Path:
    """
    Return the path of an output folder, checked before its content is computed.

    Parameters
    ----------
    path : path
        Path of the output.
    follow : bool
        Whether a link stands for its target.

    Raises
    ------
    BellowsError
        If the parent folder does not exist, or the name is invalid for a folder.

    """
    try:
        target = Path(path).resolve() if follow else Path(os.path.abspath(path))
        with suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(target)
        no_folder = not target.parent.is_dir()
    except (OSError, ValueError, RuntimeError) as error:
        raise _failed(path, error) from None
    if no_folder:
        raise BellowsError(
            f"Output '{path}': folder '{target.parent}' does not exist. Make it first.")
    return target


def _move_into_place(work: Path, target: Path, replace: bool) -> None:
    """Rename the finished folder, or exchange it with the one that it replaces."""
    finished = work / target.name
    if replace and target.exists():
        if not _exchange(finished, target):  # with a moment without either
            os.rename(target, work / 'replaced')
            os.rename(finished, target)
    elif os.path.lexists(target):
        raise FileExistsError(f"'{target}' has appeared in the meantime")
    else:
        os.rename(finished, target)
    _sync(target.parent)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; return whether the system supports it."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except AttributeError:  # not Linux
        return False
    names = (_HERE, os.fsencode(one), _HERE, os.fsencode(other))
    return bool(rename(*names, _EXCHANGE) == 0)


def _temporary_path(target: Path) -> Path:
    """Return a hidden path in the folder of a target; remove the paths of killed runs."""
    for path in target.parent.glob(f'{PREFIX}*.tmp'):
        with suppress(OSError):
            if time.time() - path.lstat().st_mtime > ABANDONED:
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    return target.with_name(f'{PREFIX}{os.getpid()}-{secrets.token_hex(4)}.tmp')


def _sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to disk if the file system supports it."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _failed(path: File, error: Exception) -> BellowsError:
    """Return the error for output that cannot be written."""
    reason = getattr(error, 'strerror', None) or str(error)
    return BellowsError(
        f"Output '{os.fspath(path)!s}' cannot be written: {reason}. It is unchanged.")
