"""
What a process writes before it is finished, under names that say whose it is.

A process that is killed cannot remove it; so the next one does that writes beside it. The names
hold the process, and the machine or container, as processes elsewhere cannot be seen.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
import os
from pathlib import Path
import platform
import re
import secrets
import shutil
import tempfile
import zlib

PREFIX = '.bellows-'
REPLACED = 'replaced'
"""What is so called in a hidden folder is no copy: it is not removed."""


def hidden_name() -> str:
    """Return a name that nobody else uses, and that tells what is to be removed later."""
    return f'{PREFIX}{os.getpid()}-{_machine()}-{secrets.token_hex(4)}.tmp'


def remove_abandoned(folder: str | os.PathLike[str]) -> None:
    """Remove what processes of this machine have left in a folder that are dead by now."""
    pattern = re.compile(rf'{re.escape(PREFIX)}(\d{{1,9}})-{_machine()}-\w+\.tmp')
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            found = pattern.fullmatch(entry.name)
            if not found or _alive(int(found[1])):
                continue
            if not entry.is_dir(follow_symlinks=False):
                with suppress(OSError):
                    os.unlink(entry.path)
            elif not os.path.lexists(os.path.join(entry.path, REPLACED)):
                shutil.rmtree(entry.path, ignore_errors=True)


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Provide a folder among the system's temporary files, removed with what is in it."""
    place = Path(tempfile.gettempdir())
    remove_abandoned(place)
    folder = place / hidden_name()
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _machine() -> str:
    """Return a number for where processes are numbered: this machine, or this container."""
    namespace = ''
    with suppress(OSError):
        namespace = os.readlink('/proc/self/ns/pid')
    return f'{zlib.crc32(f"{platform.node()} {namespace}".encode()):08x}'


def _alive(pid: int) -> bool:
    """Return whether there is such a process, and not only what nobody has waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    with suppress(OSError):
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] not in 'ZX'
    return True
