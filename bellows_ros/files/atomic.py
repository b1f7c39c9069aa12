"""
Output that is written whole or not at all: in a folder beside its target, then renamed.

An error or a signal leaves the old output or the new one. A process that is killed leaves at most
a hidden folder beside it, which has the old folder if there is no other. A link is followed.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import secrets
import shutil
import sys
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files import File

PREFIX = '.bellows-'
REPLACED = f'{PREFIX}replaced'
"""Name of a replaced folder in the hidden one."""
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

    An existing file is replaced and keeps its permissions.

    Raises
    ------
    BellowsError
        If the file cannot be written; an existing file is then unchanged.

    """
    target = require_target(path)
    with whole(path) as new:
        new.write_bytes(data)
        if target.exists():
            shutil.copymode(target, new)


@contextmanager
def whole(path: File, is_folder: bool = False) -> Iterator[Path]:
    """
    Provide a temporary path for a file or folder, which is renamed when it is complete.

    The caller makes the file or folder, and ensures that an existing one may be replaced.

    Raises
    ------
    BellowsError
        If the output cannot be written; an existing one is then unchanged.

    """
    target = require_target(path, is_folder)
    try:
        with _workplace(target) as work:
            new = work / target.name
            yield new
            for file in new.iterdir() if is_folder else [new]:
                with file.open('rb') as stream:
                    os.fsync(stream.fileno())
            if is_folder and target.exists():
                os.rename(target, work / REPLACED)
            os.replace(new, target)
    except OSError as error:
        raise _failed(path, error) from None


@contextmanager
def _workplace(target: Path) -> Iterator[Path]:
    """Provide a hidden folder beside a target, for the time of an error or a signal too."""
    work = target.with_name(PREFIX + secrets.token_hex(8))
    try:
        work.mkdir(mode=0o700)
        yield work
    finally:
        try:
            _clear(work, target)
        finally:  # again, since a signal may have ended the first call
            _clear(work, target)


def _clear(work: Path, target: Path) -> None:
    """Rename a replaced folder back if its target is missing; remove the hidden folder."""
    replaced = work / REPLACED
    if replaced.exists() and not target.exists():
        try:
            os.rename(replaced, target)
        except OSError as error:
            raise BellowsError(
                f"Output '{target}' can neither be written nor be restored: {error.strerror}. "
                f"What was there is in '{replaced}': rename it.") from None
    shutil.rmtree(work, ignore_errors=True)


def require_target(path: File, is_folder: bool = False) -> Path:
    """
    Return the path of an output without links, checked before its content is computed.

    Raises
    ------
    BellowsError
        If its folder does not exist, or the path is taken by something else.

    """
    target = _without_links(path)
    if not target.parent.is_dir():
        raise BellowsError(
            f"Output '{path}': folder '{target.parent}' does not exist. Make it first.")
    if target.exists() and not (target.is_dir() if is_folder else target.is_file()):
        raise BellowsError(f"Output '{path}' is no {'folder' if is_folder else 'plain file'}. "
                           'Give another name.')
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
        If a folder is missing, a path is not a file, an output is, contains or is inside an input
        or another output, or binary output is for stdout.

    """
    named = list(named)
    outputs = [name for name in named if isinstance(name, Output) and name]
    if [type(name) for name in outputs if name == STDOUT] not in ([], [Output]):
        raise BellowsError(f"'{STDOUT}' is stdout, which has room for one output, of text. Give "
                           'the others, and recordings and pictures, a name.')
    taken = [Path(os.path.realpath(name)) for name in named if isinstance(name, Path)]
    taken = [each.parent if os.path.exists(each.parent / 'metadata.yaml') else each
             for each in taken]  # of a recording
    for name in outputs:
        if name != STDOUT:
            target = _without_links(name)
            for other in taken:
                if target == other or target in other.parents or other in target.parents:
                    raise BellowsError(
                        f"Output '{name}' would change the input or output '{other}'. Give a "
                        'name elsewhere.')
            require_target(name, isinstance(name, Folder))
            require_absent(name, force or not isinstance(name, Folder))
            taken.append(target)


def require_absent(name: File, force: bool = False) -> None:
    """Raise for an output that exists, unless it may be replaced."""
    if name and os.path.exists(name) and not force:
        raise BellowsError(
            f"Output '{name}' exists. Give another name, or replace it with --force; what it "
            'holds is then lost.')


def _without_links(path: File) -> Path:
    """Return the absolute path without links."""
    try:
        target = Path(path).resolve()
        target.exists()  # raises for a name that is too long
    except (OSError, ValueError, RuntimeError) as error:
        raise _failed(path, error) from None
    return target


def _failed(path: File, error: Exception) -> BellowsError:
    """Return the error for output that cannot be written."""
    reason = getattr(error, 'strerror', None) or str(error)
    return BellowsError(f"Output '{path}' cannot be written: {reason}. It is unchanged.")
