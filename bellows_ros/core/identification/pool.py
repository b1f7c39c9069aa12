"""
Values of recordings, kept by the process that computed them, and functions over the recordings.

The value of a recording is in this process, or is a future of a cluster. The cluster computes a
lost value again, so results do not depend on the workers.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from operator import itemgetter
import time
from typing import Any, NamedTuple

from bellows_ros.core import usable_cores


def in_threads(function: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
    """Return a function's results in the order of its arguments, from threads."""
    if len(columns[0]) == 1:
        return list(map(function, *columns))
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(function, *columns))


class Held(NamedTuple):
    """A value of each recording in a pool, or a part of each value."""

    pool: 'Pool'
    values: Sequence[Any]
    part: int | None = None

    def only(self, places: Sequence[int]) -> 'Held':
        """Return the values of some of the recordings."""
        return self._replace(values=[self.values[place] for place in places])


class Pool:
    """Recordings in this process: functions run in threads, as kernels release the lock."""

    clock: Callable[[], float] = staticmethod(time.process_time)
    """Clock (s) of the work."""

    def run(self, function: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Return a function's values for each recording."""
        return in_threads(function, *columns)

    def gather(self, values: Sequence[Any]) -> list[Any]:
        """Return values in this process, or raise the first error."""
        return list(values)

    def each(self, values: Sequence[Any]) -> Held:
        """Return an argument for each recording."""
        return Held(self, list(values))

    def keep(self, function: Callable[..., Any], *arguments: Any) -> Held:
        """Return a function's value for each recording, where the recording is."""
        held = [each for each in arguments if isinstance(each, Held)]
        slots = tuple(_Slot(each.part) if isinstance(each, Held) else each for each in arguments)
        return Held(self, self.run(partial(_called, function, slots), *(
            each.values for each in held)))

    def results(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return a function's value for each recording, in this process."""
        return self.gather(self.keep(function, *arguments).values)

    def hold(self, function: Callable[..., Any], *arguments: Any) -> tuple[Held, list[Any]]:
        """Return the kept first values of a function, and the second ones in this process."""
        pairs = self.keep(function, *arguments)
        return pairs._replace(part=0), self.gather(self.run(itemgetter(1), pairs.values))


class _Slot(NamedTuple):
    """The place of a recording's value among arguments, and the used part of the value."""

    part: int | None


def _called(function: Callable[..., Any], slots: Sequence[Any], *values: Any) -> Any:
    """Return the value of a function for a recording, with its values in the slots."""
    left = (value if slot.part is None else value[slot.part] for slot, value in zip(
        (slot for slot in slots if isinstance(slot, _Slot)), values, strict=True))
    return function(*(next(left) if isinstance(slot, _Slot) else slot for slot in slots))


def here(values: Sequence[Any]) -> Held:
    """Return values of recordings in this process."""
    return Pool().each(values)
