"""Rates, jitter, age and computing times of messages, in constant memory."""

from __future__ import annotations

from array import array
import math
from typing import NamedTuple

import numpy as np

KEPT = 2048


class Quantiles(NamedTuple):
    """Median, 99 % quantile and maximum of some numbers; NaN without any."""

    p50: float
    p99: float
    largest: float


class Window:
    """The newest numbers of a series since last taken, at most `KEPT`."""

    def __init__(self) -> None:
        """Reserve the memory."""
        self._values = array('d', bytes(8 * KEPT))  # so that keeping a number takes no memory
        self.count = 0

    def add(self, value: float) -> None:
        """Keep a number."""
        self._values[self.count % KEPT] = value
        self.count += 1

    def take(self) -> Quantiles:
        """Return the quantiles since the last call, and begin again."""
        kept = self._values[:min(self.count, KEPT)]
        self.count = 0
        if len(kept) == 0:
            return Quantiles(math.nan, math.nan, math.nan)
        p50, p99 = np.percentile(kept, (50.0, 99.0))
        return Quantiles(float(p50), float(p99), max(kept))


class Rhythm(NamedTuple):
    """How messages of one topic came; NaN where too few did."""

    messages: int
    rate_hz: float
    jitter: float
    """Standard deviation of the time between two arrivals, s."""
    age: Quantiles
    """Of arrival minus stamp on the node's clock, s."""


class Arrivals:
    """
    Statistics of the arrivals of one topic since last taken.

    Attributes
    ----------
    last_ns : int
        When the newest came, -1 before the first.

    """

    def __init__(self) -> None:
        """Start without arrivals."""
        self.last_ns = -1
        self._ages = Window()
        self._intervals = 0
        self._sum = self._squares = 0.0

    @property
    def is_empty(self) -> bool:
        """Whether nothing has arrived since last taken."""
        return self._ages.count == 0

    def add(self, arrival_ns: int, age: float) -> None:
        """Note a message and how old (s) it is."""
        if self.last_ns >= 0:
            interval = (arrival_ns - self.last_ns) * 1e-9
            self._intervals += 1
            self._sum += interval
            self._squares += interval * interval
        self.last_ns = arrival_ns
        self._ages.add(age)

    def take(self) -> Rhythm:
        """Return how messages came since the last call, and begin again."""
        count, n = self._ages.count, self._intervals
        mean = self._sum / n if n else math.nan
        variance = self._squares / n - mean * mean if n else math.nan
        self._intervals, self._sum, self._squares = 0, 0.0, 0.0
        rate = 1.0 / mean if n and mean > 0.0 else math.nan
        jitter = math.sqrt(variance) if variance > 0.0 else 0.0
        return Rhythm(count, rate, jitter, self._ages.take())
