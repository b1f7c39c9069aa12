"""
A pool of recordings, each kept by the process that read it, and maps of functions over the pool.

A map calls a function in the process of each recording. One part of the result may stay in that
process, the other part returns to the caller. Each kept value has a recipe, by which another
worker computes the value if the first worker is lost: results do not depend on the workers.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import copy
from itertools import count
import time
from typing import Any, NamedTuple
import uuid
import weakref

from bellows_ros.core.geometry.jit import usable_cores
from bellows_ros.errors import BellowsError

_KEPT: dict[str, dict[int, dict[int, Any]]] = {}
"""Values in this process, by session, recording and number."""


class Each(NamedTuple):
    """An argument of its own for each recording, by its number."""

    values: Mapping[int, Any]


class KeptValue(NamedTuple):
    """A kept value of the same recording."""

    number: int


class Step(NamedTuple):
    """A call, and the number under which its value stays, 0 for none."""

    number: int
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    """Arguments; a kept value stands as the step that computes it, in a batch as `KeptValue`."""

    @property
    def needs(self) -> set[int]:
        """Numbers of the values that it takes."""
        return {each.number for each in self.arguments if isinstance(each, KeptValue)}

    @property
    def sent(self) -> 'Step':
        """The step in a batch."""
        return self._replace(arguments=tuple(
            KeptValue(each.number) if isinstance(each, Step) else each for each in self.arguments))


class Reply(NamedTuple):
    """Result or error of a step for a recording, or the absence of a value that the step needs."""

    result: Any = None
    error: BellowsError | None = None
    is_missing: bool = False


class Batch(NamedTuple):
    """Steps for some recordings, the last one asked for, and the numbers of values in use."""

    session: str
    recordings: tuple[int, ...]
    steps: tuple[Step, ...]
    used: frozenset[int] = frozenset()

    def of(self, recordings: Sequence[int]) -> 'Batch':
        """Return the part of some recordings."""
        return self._replace(recordings=tuple(recordings), steps=tuple(
            step._replace(arguments=tuple(
                Each({number: each.values[number] for number in recordings})
                if isinstance(each, Each) else each for each in step.arguments))
            for step in self.steps))


Runner = Callable[[Batch], Iterable[tuple[int, Reply]]]
"""Function that carries out a batch, with a reply for each recording in any order."""


def carried_out(batch: Batch, threads: int = 1) -> list[Reply]:
    """Return the replies to a batch in this process."""
    kept = _KEPT.setdefault(batch.session, {})
    return in_threads(
        lambda number: _reply(batch, number, kept.setdefault(number, {})), batch.recordings,
        threads=threads)


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


def _reply(batch: Batch, recording: int, kept: dict[int, Any]) -> Reply:
    """Return the reply to a batch for a recording, from values that are kept."""
    for number in kept.keys() - batch.used:
        del kept[number]
    *_, asked = batch.steps
    needed, run = asked.needs, [asked]
    for step in reversed(batch.steps[:-1]):
        if step.number in needed - kept.keys():
            needed |= step.needs
            run.append(step)
    values = dict(kept)
    if needed - values.keys() - {step.number for step in run}:
        return Reply(is_missing=True)
    try:
        while run:
            step = run.pop()
            result = step.function(*(_resolved(each, recording, values)
                                     for each in step.arguments))
            if step.number:
                values[step.number], result = result
                if step.number in batch.used:
                    kept[step.number] = values[step.number]
            for number in values.keys() - batch.used - {
                    number for later in run for number in later.needs}:
                del values[number]
    except BellowsError as error:
        return Reply(error=error)
    return Reply(result)


def _resolved(argument: Any, recording: int, values: Mapping[int, Any]) -> Any:
    """Return the argument of a step for a recording."""
    if isinstance(argument, Each):
        return argument.values[recording]
    return values[argument.number] if isinstance(argument, KeptValue) else argument


class Held:
    """A value of each recording of a pool, kept as long as this object."""

    def __init__(self, pool: 'Pool', recipe: Step) -> None:
        """Count as in use."""
        self.pool, self.recipe = pool, recipe
        pool.session.used.add(self)


class Session:
    """Numbers and values that pools of the same recordings share."""

    def __init__(self, run: Runner) -> None:
        """Release the values at the end."""
        self.name, self.run, self.numbers = uuid.uuid4().hex, run, count(1)
        self.used = weakref.WeakSet[Held]()
        weakref.finalize(self, forget, self.name)


class Pool:
    """
    Recordings with values kept in one or several processes.

    Parameters
    ----------
    run : Runner
        Carries out batches.
    count : int
        Number of recordings.

    """

    def __init__(self, run: Runner, count: int) -> None:
        """Begin a session."""
        self.session, self.recordings = Session(run), tuple(range(count))

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self.recordings)

    @property
    def clock(self) -> Callable[[], float]:
        """Clock (s) of the work: of this process alone, its processor time."""
        return time.process_time if self.session.run is _in_this_process else time.monotonic

    def only(self, places: Sequence[int]) -> 'Pool':
        """Return the pool of some of the recordings."""
        pool = copy.copy(self)
        pool.recordings = tuple(self.recordings[place] for place in places)
        return pool

    def each(self, values: Sequence[Any]) -> Each:
        """Return an argument for each recording."""
        return Each(dict(zip(self.recordings, values, strict=True)))

    def put(self, values: Sequence[Any]) -> Held:
        """Return a value of each recording that the caller has."""
        return self.hold(_given, self.each(values))[0]

    def results(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return a function's result for each recording; no value is kept."""
        return self._all(_recipe(0, function, arguments))

    def hold(self, function: Callable[..., Any], *arguments: Any) -> tuple[Held, list[Any]]:
        """Return the kept first results of a function, and the second ones of each recording."""
        held = self.begun(function, *arguments)
        return held, self._all(held.recipe)

    def begun(self, function: Callable[..., Any], *arguments: Any) -> Held:
        """Return the kept first results of a function, which are not computed yet."""
        return Held(self, _recipe(next(self.session.numbers), function, arguments))

    def replies(self, recipe: Step) -> Iterator[tuple[int, Reply]]:
        """Yield the replies as they come, by the number of the recording."""
        batch = Batch(self.session.name, self.recordings, (recipe.sent,), frozenset(
            held.recipe.number for held in self.session.used))
        while batch.recordings:
            missing = []
            for number, reply in self.session.run(batch.of(batch.recordings)):
                if reply.is_missing:
                    missing.append(number)
                else:
                    yield number, reply
            batch = batch._replace(recordings=tuple(missing), steps=tuple(_steps(recipe)))

    def _all(self, recipe: Step) -> list[Any]:
        """Return the results of a recipe's step, raising the first error of it."""
        replies = dict(self.replies(recipe))
        ordered = [replies[number] for number in self.recordings]
        for reply in ordered:
            if reply.error:
                raise reply.error
        return [reply.result for reply in ordered]


def _recipe(number: int, function: Callable[..., Any], arguments: Sequence[Any]) -> Step:
    """Return the recipe of a call."""
    return Step(number, function, tuple(
        each.recipe if isinstance(each, Held) else each for each in arguments))


def _steps(recipe: Step) -> Iterator[Step]:
    """Yield the steps of a recipe in an order in which they can be carried out."""
    found, pending = dict[int, Step](), [recipe]
    while pending:
        one = pending.pop()
        if one.number not in found:
            found[one.number] = one.sent
            pending += [each for each in one.arguments if isinstance(each, Step)]
    own = found.pop(recipe.number)
    yield from (found[number] for number in sorted(found))
    yield own


def here(values: Sequence[Any]) -> Held:
    """Return values of recordings, kept in this process, where functions of the values run."""
    return Pool(_in_this_process, len(values)).put(values)


def _in_this_process(batch: Batch) -> Iterator[tuple[int, Reply]]:
    """Return the replies to a batch from threads of this process."""
    return zip(batch.recordings, carried_out(batch, usable_cores()), strict=True)


def _given(value: Any) -> tuple[Any, None]:
    """Return a value to be kept."""
    return value, None
