"""
The one place that knows numba.

A kernel is scalar code on tuples of floats. Where numba is installed it is compiled (and the
machine code kept on disk), where it is not the very same source is interpreted.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
import warnings

numba: Any
try:
    import numba
except ImportError:
    numba = None

COMPILED: bool = numba is not None and not numba.config.DISABLE_JIT
"""Whether kernels are machine code."""

FORCE_INLINE = True
"""
Whether kernels become part of their callers.

Left to itself the compiler calls the larger ones, with all 80 numbers of a model on the stack:
0.67 us for a step of the integrator instead of 0.41 us (C: 0.41 us), and compiling takes as long.
"""

Function = TypeVar('Function', bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """
    Compile a scalar function on tuples, or return it as it is where numba is missing.

    Division by zero gives inf or nan in compiled code and raises in interpreted code, so a
    kernel guards its divisors itself.
    """
    if not COMPILED:
        return function
    options = {'error_model': 'numpy', 'nogil': True, 'forceinline': FORCE_INLINE}
    try:
        compiled = numba.njit(cache=True, **options)(function)
        _let_cache_see_all_kernels(compiled)
        compiled._cache = _TolerantCache(compiled._cache)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        compiled = numba.njit(**options)(function)
    return compiled  # type: ignore[no-any-return]


@cache
def _kernel_sources_stamp() -> tuple[float, int]:
    """Return the newest change time and the summed size of all modules that hold kernels."""
    stats = [path.stat() for path in sorted(Path(__file__).parent.rglob('*.py'))]
    return max(stat.st_mtime for stat in stats), sum(stat.st_size for stat in stats)


def _let_cache_see_all_kernels(compiled: Any) -> None:
    """
    Make a change in any kernel invalidate the compiled code of all of them.

    numba watches only the file of the function itself, but a compiled kernel holds the code of
    those it calls, which stand in other files: without this a stale one would be loaded.
    """
    cache_file: Any = getattr(getattr(compiled, '_cache', None), '_cache_file', None)
    if hasattr(cache_file, '_source_stamp'):
        cache_file._source_stamp = _kernel_sources_stamp()


class _TolerantCache:
    """
    The cache of a kernel, done without where it cannot be used.

    By itself numba fails on an index or a file that is damaged, or cannot be read or written, as
    on a disk that is full. And where two processes keep code for different arguments at once,
    one's file can stand under the name of the other's.

    Parameters
    ----------
    cache : numba.core.caching.FunctionCache

    """

    def __init__(self, cache: Any) -> None:
        """Take the cache."""
        self._cache = cache

    def __getattr__(self, name: str) -> Any:
        """Return whatever else numba asks its cache for."""
        return getattr(self._cache, name)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return what was compiled for these arguments, or None for it to be compiled now."""
        try:
            found = self._cache.load_overload(signature, context)
            if found is None or tuple(found.signature.args) == tuple(signature):
                return found
            raise ValueError('the code is for other arguments')
        except Exception as error:  # noqa: BLE001 (a damaged pickle can raise anything)
            self._warn(error)
            self._start_afresh()
            return None

    def save_overload(self, signature: Any, code: Any) -> None:
        """Keep what was compiled, if that can be."""
        try:
            self._cache.save_overload(signature, code)
        except Exception as error:  # noqa: BLE001 (what is compiled works all the same)
            self._warn(error)
            self._cache.disable()

    def _start_afresh(self) -> None:
        """Empty the index, so that what is compiled now can be kept."""
        try:
            self._cache.flush()
        except OSError:
            self._cache.disable()

    def _warn(self, error: Exception) -> None:
        """Say that the folder should be looked at."""
        warnings.warn(
            f'Compiled code in {self._cache.cache_path} cannot be used '
            f'({type(error).__name__}): compiling again. If this is said at every start, remove '
            'that folder.', RuntimeWarning, stacklevel=2)
