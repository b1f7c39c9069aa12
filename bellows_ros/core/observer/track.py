"""The recent samples of the tool."""

from __future__ import annotations

from bellows_ros.core.geometry.jit import as_inputs
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import first_after, write_row
from bellows_ros.core.observer.filter import Samples
import numpy as np

MIN_SAMPLES = 4096
"""Smallest size of the buffer of tool samples, a few seconds."""


class Track:
    """
    The recent tool samples and the package at each, as the kernels take them.

    Attributes
    ----------
    rows : tuple of array or list
        Stamp (ns), tool at begin and end of the motion from the previous sample, and package (with
        internal strains, if any), of each sample.
    count, newest_ns : int
        Number of samples, and stamp of the newest.

    """

    def __init__(self) -> None:
        self._allocate(MIN_SAMPLES)
        self.count = self.newest_ns = 0

    def _allocate(self, size: int) -> None:
        stamps, (starts, ends) = np.zeros(size, np.int64), np.zeros((2, size, 13))
        self.rows = as_inputs(stamps, starts, ends, np.zeros((size, 25)))

    def begin(self, stamp_ns: int, tool: State, body: State) -> None:
        """Discard all but the start of a motion."""
        self.count = 0
        self.add(stamp_ns, tool, tool, body)

    def add(self, stamp_ns: int, start: State, end: State, body: State) -> None:
        """Store a sample of tool and package."""
        stamps, starts, ends, bodies = self.rows
        stamps[self.count] = stamp_ns
        for rows, state in ((starts, start), (ends, end), (bodies, body)):
            write_row(rows[self.count], state)
        self.count, self.newest_ns = self.count + 1, stamp_ns

    @property
    def samples(self) -> Samples:
        """All samples, as kernels take them."""
        return *self.rows, self.count

    def after(self, stamp_ns: int) -> int:
        """Return the index of the first sample after a stamp."""
        return int(first_after(self.rows[0], stamp_ns, self.count))

    def discard_before(self, since_ns: int) -> None:
        """Make room for another sample by discarding samples before a stamp."""
        if self.count < len(self.rows[0]):
            return
        before, first, end = self.rows, self.after(since_ns) - 1, self.count
        self.count = end - first
        self._allocate(max(MIN_SAMPLES, 4 * self.count))
        for old, new in zip(before, self.rows, strict=True):
            new[:self.count] = old[first:end]
