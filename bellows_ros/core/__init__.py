"""
Hold the numbers: model, integration, filtering, identification, prediction.

Needs numpy and scipy, and numba where present. Reads no files, logs nothing, knows no ROS.
"""

from collections.abc import Callable
from contextlib import suppress
import ctypes
import gc
import os
from pathlib import Path
import sys
import warnings

from bellows_ros.errors import UnitWarning

Progress = Callable[..., None]
"""Callback with the current step and its completed fraction (0 to 1, default 0)."""

M_MMAP_THRESHOLD = -3
"""Option of glibc's allocator: smallest size of an array with memory pages of its own."""

M_ARENA_MAX = -8
"""Option of glibc's allocator: largest number of separate heaps."""

LARGE = 2 * 2**20
"""Size from which an array gets memory pages of its own, bytes."""


def configure_process(is_node: bool = False) -> None:
    """
    Set threads of linear algebra, allocator and garbage collector, before NumPy is imported.

    On two busy cores least squares with several threads takes two to seven times as long. By
    default glibc keeps the memory of freed arrays, a tenth of the memory of a long recording, and
    the garbage collector takes a third of the time of a compilation. Settings of the user prevail.
    """
    gc.set_threshold(10_000, 20, 20)
    warnings.simplefilter('ignore', UnitWarning)  # commands and nodes show these themselves
    for variable in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')
    if sys.platform == 'linux' and 'MALLOC_MMAP_THRESHOLD_' not in os.environ:
        set_option = getattr(ctypes.CDLL(None), 'mallopt', None)  # not in musl
        if set_option:
            set_option(M_MMAP_THRESHOLD, LARGE)
            if not is_node:
                set_option(M_ARENA_MAX, 1)


def no_progress(what: str, part: float = 0.0) -> None:
    """Ignore the progress."""


def usable_cores() -> int:
    """Return the number of cores that CPU affinity and the limit of a container allow."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
        os.cpu_count() or 1)
    limit = Path('/sys/fs/cgroup/cpu.max')
    with suppress(OSError, ValueError):  # no container, or no limit
        quota, period = map(int, limit.read_text().split())
        cores = min(cores, -(-quota // period))
    return max(cores, 1)
