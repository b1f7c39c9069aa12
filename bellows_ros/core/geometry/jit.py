"""
Compilation by numba; no other module imports numba.

An entry is called from Python and compiled at its first call, with all kernels that it calls; its
machine code is stored on disk. Python interprets a kernel that it calls itself, and without numba
entries too. A kernel is scalar code on tuples of floats, or loops over arrays. Entries that other
entries call would be compiled with a second interface to Python, which takes as long as the code.
"""

from collections.abc import Callable
from contextlib import suppress
import hashlib
import os
from pathlib import Path
import shutil
from tempfile import TemporaryFile
import time
import traceback
from typing import Any, TypeVar, TypeVarTuple
import warnings

from bellows_ros.errors import install

numba: Any
NOT_COMPILED: str = ''
"""Reason why entries are not compiled, with the remedy if there is one."""
try:
    import numba.core.event
    import numba.extending
    if numba.config.DISABLE_JIT:
        NOT_COMPILED = 'NUMBA_DISABLE_JIT is set'
except ModuleNotFoundError:
    NOT_COMPILED = f'numba is not installed ({install("fast")})'
except (ImportError, OSError) as error:  # a NumPy that numba does not allow; llvmlite's library
    NOT_COMPILED = f'numba cannot be loaded ({error})'

COMPILED: bool = not NOT_COMPILED
"""Whether entries are compiled."""

CORE = Path(__file__).parents[1]
UNUSED = 86_400.0
"""Age from which compiled code of a former version of the source is removed, s."""

OPTIONS = {
    'error_model': 'numpy', 'nogil': True, 'no_cfunc_wrapper': True,
    'fastmath': {'nsz', 'arcp', 'contract', 'reassoc'}}  # NaN and inf keep their meaning
INLINED = {**OPTIONS, 'forceinline': True}

Arrays = TypeVarTuple('Arrays')
Function = TypeVar('Function', bound=Callable[..., Any])


def _folder_of_source() -> Path:
    """
    Return the folder for this version of the source; remove unused folders.

    The folder is in NUMBA_CACHE_DIR if set, otherwise in the user's cache: numba itself only
    notices changes in the file of an entry. The version covers the rooms of core with kernels. A
    folder used within the last day is kept, because a process of another version may use it.
    """
    rooms = {path.parent for path in CORE.rglob('*.py') if b'jit import' in path.read_bytes()}
    source = b''.join(
        path.read_bytes() for room in sorted(rooms) for path in sorted(room.glob('*.py')))
    digest = hashlib.sha256(numba.__version__.encode() + source)
    place = hashlib.sha256(bytes(CORE)).hexdigest()[:8]
    name, given = f'{place}-{digest.hexdigest()[:16]}', os.environ.get('NUMBA_CACHE_DIR')
    caches = Path(given) if given else Path(
        os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'bellows_ros'
    folder = caches if caches.name == name else caches / name  # a parent process has set it
    for older in caches.glob(f'{place}-*'):
        with suppress(OSError):
            if older != folder and older.stat().st_mtime < time.time() - UNUSED:
                shutil.rmtree(older)
    return folder.absolute()


def _use_folder() -> Path | None:
    """Let numba store machine code in a folder, and return it, or None if it is not writable."""
    try:
        folder = _folder_of_source()
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
        os.utime(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home
        warnings.warn(
            f'Compiled code cannot be stored ({error}): each start compiles again. Set '
            'NUMBA_CACHE_DIR to a folder that can be written.', RuntimeWarning, stacklevel=2)
        return None
    os.environ['NUMBA_CACHE_DIR'] = str(folder)
    numba.config.reload_config()
    return folder


FOLDER = _use_folder() if COMPILED else None
"""Folder of the machine code, or None."""


def kernel(function: Function) -> Function:
    """
    Mark a function that compiled entries call. A call from Python runs the function uncompiled.

    Division by zero gives inf or nan in compiled code and raises in interpreted code, so a
    kernel guards its divisors itself.
    """
    if COMPILED:
        numba.extending.register_jitable(**OPTIONS)(function)
    return function


def inlined_kernel(function: Function) -> Function:
    """Mark a kernel whose code becomes part of its callers, which halves the time of a step."""
    if COMPILED:
        numba.extending.register_jitable(**INLINED)(function)
    return function


def entry(function: Function) -> Function:
    """Compile a function that Python calls, or return it unchanged without numba."""
    return numba.njit(cache=FOLDER is not None, **OPTIONS)(function) if COMPILED else function


def announce(tell: Callable[[], object]) -> None:
    """Call a function once, before the first entry is compiled in this process."""
    if not COMPILED:
        return

    class First(numba.core.event.Listener):  # type: ignore[misc]
        """Listener for the first start of the compiler."""

        told = False

        def on_start(self, _: Any) -> None:
            """Tell once."""
            if not self.told:
                self.told = True
                tell()

        def on_end(self, _: Any) -> None:
            """Do nothing."""

    numba.core.event.register(COMPILE, First())


COMPILE = 'numba:compile'
"""Event of numba: an entry that is not stored on disk is compiled."""


def damage(error: BaseException) -> str:
    """Return the remedy if an error is caused by damaged machine code on disk, else ''."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    return any(Path(file).match('numba/core/caching.py') for file in files) * (
        f"Compiled code in '{FOLDER}' cannot be used ({type(error).__name__}: {error}). Remove "
        'that folder, and start again; if this recurs, set NUMBA_CACHE_DIR to another one.')


def as_inputs(*arrays: *Arrays) -> tuple[*Arrays]:
    """Return arrays for kernels: plain Python reads lists several times faster than arrays."""
    lists: Any = (array.tolist() for array in arrays)  # type: ignore[attr-defined]
    return arrays if COMPILED else tuple(lists)
