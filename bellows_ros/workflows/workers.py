"""Work on single recordings in parallel: in processes on this machine, or on a Dask cluster."""

import asyncio
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
import importlib
import logging
import os
from typing import Any

from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError, install
from bellows_ros.workflows.recordings import Failed

ANSWER_TIMEOUT = 10.0
"""Longest wait for an answer of the Dask scheduler, s."""

Work = tuple[int, str, Values]
"""Index in the parameter `bags`, recording, and its parameters."""
Task = Callable[..., Any]
"""Function of a recording (name, parameters, optionally path)."""
Outcome = tuple[int, Any]
"""Index of a piece of work, and its result, or a `Failed`."""


def on_cores(work: Sequence[Work], jobs: int, task: Task) -> Iterator[Outcome]:
    """Yield the results of processes on this machine, in the order of completion."""
    if jobs == 1 or len(work) == 1:
        yield from (_attempt(task, *item) for item in work)
        return
    joblib = _imported('joblib', 'parallel', '--jobs')
    pending = {item[0]: item for item in work}
    try:
        with closing(_in_pool(joblib, jobs, task, work)) as results:
            for number, result in results:
                del pending[number]
                yield number, result
    except BrokenProcessPool:  # one of them has ended its process; run alone it ends no other
        for item in pending.values():
            try:
                yield from _in_pool(joblib, 2, task, [item])
            except BrokenProcessPool:
                yield item[0], Failed(
                    item[1], 'the process that read it was ended from outside, twice. If '
                    'memory was short, take fewer jobs, or a shorter recording.')


def _in_pool(
    joblib: Any, jobs: int, task: Task, work: Sequence[Work]
) -> Generator[Outcome, None, None]:
    """
    Yield the results of a pool of processes, with one task per process and none waiting.

    Closing the generator ends the processes.
    """
    parallel = joblib.Parallel(
        jobs, backend='loky', return_as='generator_unordered', batch_size=1, pre_dispatch='n_jobs')
    results = parallel(joblib.delayed(_attempt)(task, *item) for item in work)
    try:
        yield from results
    finally:
        results.close()


def _attempt(task: Task, number: int, bag: str, values: Values, **more: Any) -> Outcome:
    """Return the result of a task on a recording, or the reason of its failure."""
    try:
        return number, task(bag, values, **more)
    except BellowsError as error:
        return number, Failed(bag, str(error))
    except Exception as error:  # noqa: BLE001 (one recording must not end the work on others)
        return number, Failed(bag, f'{type(error).__name__}: {error}')


def on_dask(work: Sequence[Work], address: str, task: Task) -> Iterator[Outcome]:
    """Yield the results of a Dask cluster's workers."""
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
        futures = [
            client.submit(_attempt, task, *item, path=os.path.abspath(item[1]), pure=False)
            for item in work]
        for future, (number, bag, _) in zip(futures, work, strict=True):
            try:
                result: Outcome = future.result()
            except Exception as error:  # noqa: BLE001 (a worker can raise whatever it likes)
                if future.status != 'error':
                    raise BellowsError(
                        f"The Dask scheduler at '{address}' was lost during the work. See in its "
                        'log why, start it again, and repeat the command.') from None
                result = number, Failed(bag, f'{type(error).__name__}: {error}')
            yield result
            future.release()


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
