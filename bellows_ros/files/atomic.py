"""
Output that is written whole or not at all: beside its target, then renamed.

A process that is killed leaves the old output or the new one, and at most a hidden file or folder
beside it.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import combinations
import os
from pathlib import Path
import secrets
import shutil
import sys
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import File

PREFIX = '.bellows-'
STDOUT = '-'
"""Name of standard output."""


class Output(str):
    """Name of a text file to write, `STDOUT` for standard output."""


class Binary(Output):
    """Name of a binary file to write."""


class Folder(Binary):
    """Name of a folder to write."""


def write_text(path: File, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all, or '-' for stdout; see `write_bytes`."""
    if path == STDOUT:
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
    with _beside(path, target) as temporary:
        with temporary.open('xb') as file:
            if target.exists():
                os.fchmod(file.fileno(), target.stat().st_mode & 0o777)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)


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
    with _beside(path, target) as work:
        work.mkdir()
        yield work / target.name
        for file in (work / target.name).iterdir():
            with file.open('rb') as stream:
                os.fsync(stream.fileno())
        if replace and target.exists():
            os.rename(target, work / 'replaced')
        os.rename(work / target.name, target)


@contextmanager
def _beside(path: File, target: Path) -> Iterator[Path]:
    """Provide a hidden path in the folder of a target, and remove what is left of it."""
    work = target.with_name(f'{PREFIX}{os.getpid()}-{secrets.token_hex(4)}.tmp')
    try:
        yield work
    except OSError as error:
        raise _failed(path, error) from None
    finally:
        if work.is_dir():
            shutil.rmtree(work, ignore_errors=True)
        else:
            work.unlink(missing_ok=True)


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
        raise BellowsError(f"Output '{path}' is no plain file. Give the name of a file.")
    return target


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
        is_there = target.parent.is_dir()
        target.exists()  # raises for a name that is too long
    except (OSError, ValueError, RuntimeError) as error:
        raise _failed(path, error) from None
    if not is_there:
        raise BellowsError(
            f"Output '{path}': folder '{target.parent}' does not exist. Make it first.")
    return target


def require_outputs(named: Iterable[Any], force: bool = False) -> None:
    """
    Check all outputs of a command before any work.

    Parameters
    ----------
    named : iterable
        Values of a command line, of which `Output` are outputs and `Path` inputs.
    force : bool
        Whether an existing folder may be replaced.

    Raises
    ------
    BellowsError
        If a folder is missing, a path is not a file, two paths are equal, an output would replace
        an input or be inside one, or binary output is for stdout.

    """
    named = list(named)
    outputs = [name for name in named if isinstance(name, Output) and name]
    on_stdout = [type(name) for name in outputs if name == STDOUT]
    if on_stdout not in ([], [Output]):
        raise BellowsError(
            f"'{STDOUT}' is stdout, which has room for one output, of text: {len(on_stdout)} are "
            'given. Give the others, and recordings and pictures, a name.')
    targets = list[Path]()
    for name in outputs:
        if name == STDOUT:
            continue
        require_no_input(name, (name for name in named if isinstance(name, Path)))
        is_folder = isinstance(name, Folder)
        require_absent(name, force or not (is_folder and os.path.isdir(name)))
        targets.append(Path(os.path.realpath(
            require_folder_target(name) if is_folder else require_file_target(name))))
    for one, other in combinations(targets, 2):
        if one == other or one in other.parents or other in one.parents:
            raise BellowsError(
                f"Two outputs have the same name, or one is in the other: '{other}'. Rename one.")


def require_absent(name: File, force: bool) -> None:
    """Raise for an output that exists, unless it may be replaced."""
    if name and os.path.exists(name) and not force:
        raise BellowsError(
            f"Output '{name}' exists. Give another name, or replace it with --force; what it "
            'holds is then lost.')


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
            raise _failed(path, error) from None
        if (source.parent / 'metadata.yaml').exists():  # a storage file of a recording
            source = source.parent
        if target == source or source in target.parents or target in source.parents:
            raise BellowsError(
                f"Output '{path}' would change the input '{name}'. Give a name elsewhere.")


def _failed(path: File, error: Exception) -> BellowsError:
    """Return the error for output that cannot be written."""
    reason = getattr(error, 'strerror', None) or str(error)
    return BellowsError(
        f"Output '{os.fspath(path)!s}' cannot be written: {reason}. It is unchanged.")
