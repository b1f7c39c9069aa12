"""Runners that keep the recordings of a fit: processes of this machine, or a Dask cluster."""

import asyncio
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed, CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
import importlib
from itertools import chain
import logging
import os
import pickle
import subprocess
import sys
from typing import Any

from bellows_ros.core.identification.pool import carried_out, forget, Reply, Runner, Task
from bellows_ros.errors import BellowsError, install

ANSWER_TIMEOUT = 10.0
"""Longest wait for an answer of the Dask scheduler, s."""

LOOKS = 2.0
"""Time between two looks at the workers of a Dask cluster, s."""

MAX_TRIES = 2
"""Number of workers that a task may end."""

ENDED = ('the process that has it was ended from outside, twice. If memory was short, take fewer '
         'jobs, or a shorter recording.')

PROGRAM = """
import ctypes, os, pickle, sys
if sys.platform == 'linux':
    ctypes.CDLL(None).prctl(1, 15)
from bellows_ros.core import configure_process
configure_process()
from bellows_ros.core.identification.pool import carried_out
answers = os.fdopen(os.dup(1), 'wb')
os.dup2(2, 1)
while sys.stdin.buffer.peek(1):
    try:
        replies = carried_out(pickle.load(sys.stdin.buffer))
    except Exception as error:
        replies = error
    pickle.dump(replies, answers)
    answers.flush()
"""
"""Program of a process that carries out tasks; it ends with its client."""


def shares(
    tasks: Sequence[Task], places: Sequence[Any]
) -> Iterator[tuple[Any, list[Task]]]:
    """Yield parts of tasks by places; a task that reads a recording is a part of its own."""
    of: dict[Any, list[Task]] = {}
    for task, place in zip(tasks, places, strict=True):
        alone = not task.calls[0].needs
        of.setdefault((place, task.recording * alone), []).append(task)
    for (place, _), part in of.items():
        yield place, part


def numbers_of(tasks: Sequence[Task]) -> list[int]:
    """Return the numbers of the recordings of tasks."""
    return [task.recording for task in tasks]


class Process:
    """A process that keeps values of its recordings, started again if it was ended."""

    def __init__(self) -> None:
        """Start."""
        self.messages, self.process = ThreadPoolExecutor(1), self._started()

    def _started(self) -> 'subprocess.Popen[bytes]':
        return subprocess.Popen(
            [sys.executable, '-P', '-c', PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})

    def answer(self, tasks: Sequence[Task]) -> list[Reply]:
        """Return the replies to tasks."""
        for _ in range(MAX_TRIES):
            assert self.process.stdin and self.process.stdout
            with suppress(OSError, EOFError, pickle.UnpicklingError):
                pickle.dump(tasks, self.process.stdin)
                self.process.stdin.flush()
                replies: list[Reply] | Exception = pickle.load(self.process.stdout)
                break
            self.end()
            self.process = self._started()
        else:
            return [Reply(error=BellowsError(ENDED))] * len(tasks)
        if isinstance(replies, Exception):
            raise replies
        return replies

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        with suppress(OSError):
            self.process.communicate()


@contextmanager
def processes(count: int) -> Iterator[Runner]:
    """Yield the runner of a number of processes of this machine."""
    workers = [Process() for _ in range(count)]

    def run(tasks: Sequence[Task]) -> Iterator[tuple[int, Reply]]:
        futures = {
            worker.messages.submit(worker.answer, part): numbers_of(part)
            for worker, part in shares(tasks, [workers[n % count] for n in numbers_of(tasks)])}
        for future in as_completed(futures):
            yield from zip(futures[future], future.result(), strict=True)

    try:
        yield run
    finally:
        for worker in workers:
            worker.messages.shutdown(cancel_futures=True, wait=False)
            worker.end()


@contextmanager
def cluster(address: str) -> Iterator[Runner]:
    """Yield the runner of the workers of a Dask cluster."""
    distributed = _imported('distributed', 'dask', '--dask')
    logging.getLogger('distributed.client').setLevel(logging.CRITICAL)  # errors are reported here
    try:
        # A client without a scheduler cannot be closed: search the scheduler first.
        asyncio.run(_require_scheduler(distributed, address))
        client = distributed.Client(address, timeout=ANSWER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise BellowsError(
            f"No Dask scheduler answers at '{address}': {error}. Start one with 'dask scheduler', "
            'and give the address that it prints.') from None
    with client:
        runner = _Cluster(distributed, client, address)
        try:
            yield runner
        finally:
            with suppress(Exception):  # of a scheduler that was lost
                for session in runner.sessions:
                    client.run(forget, session)


class _Cluster:
    """Runner on the workers of a Dask cluster, each of which keeps its recordings."""

    def __init__(self, distributed: Any, client: Any, address: str) -> None:
        self._distributed, self._client, self._address = distributed, client, address
        self._places, self.sessions = dict[int, str](), set[str]()

    def __call__(self, tasks: Sequence[Task]) -> Iterator[tuple[int, Reply]]:
        """Yield the replies to tasks; other workers replace a lost one."""
        self.sessions.add(tasks[0].session)
        queues, threads = self._queues([tasks])
        tries, waiting = Counter[int](), dict[Any, tuple[str, list[Task]]]()
        while queues or waiting:
            busy = Counter(place for place, _ in waiting.values())
            for place, parts in list(queues.items()):  # what waits is not blamed for a loss
                while parts and busy[place] < threads[place]:
                    part = parts.pop()
                    busy[place] += 1
                    waiting[self._client.submit(
                        carried_out, part, threads[place], workers=[place], pure=False
                    )] = place, part
                if not parts:
                    del queues[place]
            lost = list[list[Task]]()
            for future in self._ended(waiting):
                _, part = waiting.pop(future)
                replies, numbers = self._replies(future, part), numbers_of(part)
                tries.update(numbers)
                if not replies and max(map(tries.__getitem__, numbers)) < MAX_TRIES:
                    lost.append(part)
                    continue
                yield from zip(numbers, replies or [
                    Reply(error=BellowsError(ENDED))] * len(part), strict=True)
            if lost:
                queues, threads = self._queues([*lost, *chain.from_iterable(queues.values())])

    def _queues(
        self, parts: Sequence[Sequence[Task]]
    ) -> tuple[dict[str, list[list[Task]]], dict[str, int]]:
        """Return parts of work by the workers that have their recordings, and their threads."""
        threads, queues = self._workers(), defaultdict[str, list[list[Task]]](list)
        load = dict.fromkeys(threads, 0) | Counter(
            place for place in self._places.values() if place in threads)
        for part in parts:
            for number in numbers_of(part):
                if self._places.get(number) not in threads:
                    self._places[number] = min(load, key=load.__getitem__)
                    load[self._places[number]] += 1
            for place, own in shares(part, [self._places[n] for n in numbers_of(part)]):
                queues[place].append(own)
        return dict(queues), threads

    def _workers(self) -> dict[str, int]:
        """Return the number of threads of each worker."""
        for _ in range(int(ANSWER_TIMEOUT / LOOKS)):
            with suppress(OSError, TimeoutError):
                if threads := dict[str, int](self._client.ncores()):
                    return threads
            with suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=LOOKS)
        raise BellowsError(
            f"The Dask scheduler at '{self._address}' has no workers. Start some with 'dask "
            f"worker {self._address}', and repeat the command.")

    def _ended(self, waiting: Mapping[Any, tuple[str, list[Task]]]) -> list[Any]:
        """Return the ended futures, or else the cancelled futures of lost workers."""
        with suppress(TimeoutError), self._client.as_current():
            return list(self._distributed.wait(
                list(waiting), timeout=LOOKS, return_when='FIRST_COMPLETED').done)
        living = self._workers()
        lost = [future for future, (place, _) in waiting.items()
                if place not in living and not future.done()]
        self._client.cancel(lost)
        return lost

    def _replies(self, future: Any, part: Sequence[Task]) -> list[Reply]:
        """Return the replies of a future that has ended, none if its worker was lost."""
        try:
            replies: list[Reply] = future.result()
        except (CancelledError, self._distributed.scheduler.KilledWorker):
            if self._client.status == 'running':
                return []
            raise self._lost() from None
        except Exception as error:  # noqa: BLE001 (a worker can raise whatever it likes)
            if future.status != 'error':
                raise self._lost() from None
            return [Reply(error=BellowsError(
                f'{type(error).__name__}: {error}'))] * len(part)
        return replies

    def _lost(self) -> BellowsError:
        """Return what to say of a scheduler that was lost."""
        return BellowsError(
            f"The Dask scheduler at '{self._address}' was lost during the work. See in its log "
            'why, start it again, and repeat the command.')


async def _require_scheduler(distributed: Any, address: str) -> None:
    """Connect to a scheduler, and close the connection."""
    comm = await distributed.comm.connect(address, timeout=ANSWER_TIMEOUT)
    await comm.close()


def _imported(module: str, extra: str, option: str) -> Any:
    """Return an optional module; raise BellowsError with its installation."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise BellowsError(
            f"{option} needs '{module}', which is not installed: {install(extra)}.") from None
