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
