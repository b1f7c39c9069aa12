"""
A pool of recordings, each kept by the process that read it, and maps of functions over the pool.

A map calls a function in the process of each recording. One part of the result may stay in that
process, the other part returns to the caller. Each kept value has the calls that compute it, by
which another worker computes the value if the first worker is lost: results do not depend on the
workers.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
import copy
from itertools import count
import time
from typing import Any, NamedTuple
import uuid
import weakref

from bellows_ros.core import usable_cores
from bellows_ros.errors import BellowsError

_KEPT: dict[str, dict[int, dict[int, Any]]] = {}
"""Values in this process, by session, recording and number."""


class Each(dict[int, Any]):
    """An argument of its own for each recording, by its number."""


class Kept(NamedTuple):
    """A kept value of the same recording as an argument."""

    number: int


class Call(NamedTuple):
    """A call, and the number under which its first result stays; 0 for an only result."""

    number: int
    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    @property
    def needs(self) -> set[int]:
        """Numbers of the values that it takes."""
        return {each.number for each in self.arguments if isinstance(each, Kept)}

    def of(self, recording: int) -> 'Call':
        """Return the call for one recording."""
        return self._replace(arguments=tuple(
            each[recording] if isinstance(each, Each) else each for each in self.arguments))


class Task(NamedTuple):
    """Calls for a recording, the last one asked for, and the numbers of values in use."""

    session: str
    recording: int
    calls: tuple[Call, ...]
    used: frozenset[int]


class Reply(NamedTuple):
    """Result or error of a task, or the absence of a value that it needs."""

    result: Any = None
    error: BellowsError | None = None
    is_missing: bool = False


Runner = Callable[[Sequence[Task]], Iterable[tuple[int, Reply]]]
"""Function that carries out tasks, with a reply for each recording in any order."""


def carried_out(tasks: Sequence[Task], threads: int = 1) -> list[Reply]:
    """Return the replies to tasks in this process."""
    return in_threads(_reply, tasks, threads=threads)


def in_threads(
    function: Callable[..., Any], *columns: Sequence[Any], threads: int = 0
) -> list[Any]:
    """Return a function's results in the order of its arguments, from threads."""
    if len(columns[0]) == 1 or threads == 1:
        return list(map(function, *columns))
    with ThreadPoolExecutor(threads or usable_cores()) as pool:
        return list(pool.map(function, *columns))


def forget(session: str) -> None:
    """Release all values of a session in this process."""
    _KEPT.pop(session, None)


def _reply(task: Task) -> Reply:
    """Return the reply to a task, from values that are kept."""
    kept = _KEPT.setdefault(task.session, {}).setdefault(task.recording, {})
    needed, run = {task.calls[-1].number}, list[Call]()
    for number in kept.keys() - (task.used - needed):
        del kept[number]
    for call in reversed(task.calls):
        if call.number in needed - kept.keys():
            needed |= call.needs
            run.append(call)
    if needed - kept.keys() - {call.number for call in run}:
        return Reply(is_missing=True)
    values = dict(kept)
    try:
        while run:
            call = run.pop()
            result = call.function(*(
                values[each.number] if isinstance(each, Kept) else each
                for each in call.arguments))
            if call.number:
                values[call.number], result = result
                if call.number in task.used:
                    kept[call.number] = values[call.number]
            later = {number for each in run for number in each.needs}
            values = {number: value for number, value in values.items() if number in later}
    except BellowsError as error:
        return Reply(error=error)
    return Reply(result)


class Held:
    """
    A value of each recording of a pool, kept as long as this object.

    Parameters
    ----------
    pool : Pool
        Recordings.
    calls : tuple of Call
        Calls that compute the value, in an order in which they can be carried out.

    """

    def __init__(self, pool: 'Pool', calls: tuple[Call, ...]) -> None:
        """Count as in use."""
        self.pool, self.calls = pool, calls
        pool.used.add(self)

    @property
    def number(self) -> int:
        """Number of the value."""
        return self.calls[-1].number

    def only(self, places: Sequence[int]) -> 'Held':
        """Return the values of some of the recordings."""
        return Held(self.pool.only(places), self.calls)


class Pool:
    """
    Recordings with values kept in one or several processes.

    Parameters
    ----------
    run : Runner
        Carries out tasks.
    size : int
        Number of recordings.

    """

    def __init__(self, run: Runner, size: int) -> None:
        """Begin a session, which ends with the last pool of its recordings."""
        self.run, self.recordings = run, tuple(range(size))
        self.session, self.numbers, self.used = uuid.uuid4().hex, count(1), weakref.WeakSet[Held]()
        weakref.finalize(self.used, forget, self.session)

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self.recordings)

    @property
    def clock(self) -> Callable[[], float]:
        """Clock (s) of the work: of this process alone, its processor time."""
        return time.process_time if self.run is _in_this_process else time.monotonic

    def only(self, places: Sequence[int]) -> 'Pool':
        """Return the pool of some of the recordings."""
        pool = copy.copy(self)
        pool.recordings = tuple(self.recordings[place] for place in places)
        return pool

    def each(self, values: Sequence[Any]) -> Each:
        """Return an argument for each recording."""
        return Each(zip(self.recordings, values, strict=True))

    def results(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return a function's result for each recording; no value is kept."""
        return self._results(_calls(0, function, arguments))

    def hold(self, function: Callable[..., Any], *arguments: Any) -> tuple[Held, list[Any]]:
        """Return the kept first results of a function, and the second ones of each recording."""
        held = self.begun(function, *arguments)
        return held, self._results(held.calls)

    def keep(self, function: Callable[..., Any], *arguments: Any) -> Held:
        """Return the kept results of a function."""
        return self.hold(_kept, function, *arguments)[0]

    def begun(self, function: Callable[..., Any], *arguments: Any) -> Held:
        """Return the kept first results of a function, which are not computed yet."""
        return Held(self, _calls(next(self.numbers), function, arguments))

    def replies(self, calls: tuple[Call, ...]) -> Iterator[tuple[int, Reply]]:
        """Yield the replies as they come, by the number of the recording."""
        used = frozenset(held.number for held in self.used)
        waiting, sent = self.recordings, calls[-1:]
        while waiting:
            missing = []
            for number, reply in self.run([
                    Task(self.session, each, tuple(call.of(each) for call in sent), used)
                    for each in waiting]):
                if reply.is_missing:
                    missing.append(number)
                else:
                    yield number, reply
            waiting, sent = tuple(missing), calls

    def _results(self, calls: tuple[Call, ...]) -> list[Any]:
        """Return the results of the last call, or raise its first error."""
        replies = dict(self.replies(calls))
        ordered = [replies[number] for number in self.recordings]
        for reply in ordered:
            if reply.error:
                raise reply.error
        return [reply.result for reply in ordered]


def _calls(
    number: int, function: Callable[..., Any], arguments: Sequence[Any]
) -> tuple[Call, ...]:
    """Return a call after the calls that compute its arguments."""
    before = {call.number: call
              for each in arguments if isinstance(each, Held) for call in each.calls}
    return *(before[each] for each in sorted(before)), Call(number, function, tuple(
        Kept(each.number) if isinstance(each, Held) else each for each in arguments))


def here(values: Sequence[Any]) -> Held:
    """Return values of recordings, kept in this process, where functions of the values run."""
    pool = Pool(_in_this_process, len(values))
    return pool.keep(_given, pool.each(values))


def _in_this_process(tasks: Sequence[Task]) -> Iterator[tuple[int, Reply]]:
    """Return the replies to tasks from threads of this process."""
    return zip((task.recording for task in tasks), carried_out(tasks, usable_cores()),
               strict=True)


def _given(value: Any) -> Any:
    return value


def _kept(function: Callable[..., Any], *arguments: Any) -> tuple[Any, None]:
    """Return the result of a function to be kept, and nothing to be returned."""
    return function(*arguments), None
