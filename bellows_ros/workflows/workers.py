"""Recordings of a fit on workers of a Dask cluster: of this machine, or at an address."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
import importlib
import logging
import time
from typing import Any

from bellows_ros.core.identification.pool import Pool
from bellows_ros.errors import BellowsError, install

ANSWER_TIMEOUT = 10.0
"""Longest wait for an answer of the Dask scheduler, s."""

SETTINGS = {'distributed.scheduler.work-stealing': False,
            'distributed.scheduler.allowed-failures': 1,
            'distributed.scheduler.worker-saturation': 1.0}
"""
Settings of a cluster of this machine.

Recordings stay where they were read, and what waits is not blamed for the loss of a worker.
"""

ENDED = 'its process was ended from outside, twice; if memory was short, take fewer jobs'


class Cluster(Pool):
    """Recordings on the workers of a Dask cluster, which computes lost values again."""

    clock = staticmethod(time.monotonic)

    def __init__(self, distributed: Any, client: Any) -> None:
        """Use a client of the module `distributed`."""
        self._distributed, self._client = distributed, client

    def run(self, function: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Return the futures of a function's values."""
        return list(self._client.map(function, *columns, pure=False))

    def gather(self, values: Sequence[Any]) -> list[Any]:
        """Return the values of futures, or raise the first error."""
        for value in values:
            if error := self.error(value):
                raise error
        return list(self._client.gather(list(values)))

    def ended(self, values: Sequence[Any]) -> Iterator[int]:
        """Yield the number of ended futures, as they end."""
        with self._client.as_current():
            for number, _ in enumerate(self._distributed.as_completed(values), 1):
                yield number

    def error(self, future: Any) -> BellowsError | None:
        """Return the error of a future, None for a value."""
        try:
            error = future.exception()
        except (CancelledError, OSError, TimeoutError):
            return BellowsError('The Dask scheduler was lost during the work. See in its log why, '
                                'start it again, and repeat the command.')
        if error is None or isinstance(error, BellowsError):
            return error
        return BellowsError(
            ENDED if isinstance(error, self._distributed.scheduler.KilledWorker) else
            f'{type(error).__name__}: {error}')


@contextmanager
def processes(count: int) -> Iterator[Cluster]:
    """Yield the recordings of a number of processes of this machine."""
    distributed = _distributed('--jobs')
    with importlib.import_module('dask').config.set(SETTINGS), distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, memory_limit=0, host='127.0.0.1',
            dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL,
    ) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield Cluster(distributed, client)


@contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """Yield the recordings of the workers of a Dask cluster."""
    distributed = _distributed('--dask')
    logging.getLogger('distributed.client').setLevel(logging.CRITICAL)  # errors are reported here
    try:
        client = distributed.Client(address, timeout=ANSWER_TIMEOUT, set_as_default=False)
        client.wait_for_workers(1, timeout=ANSWER_TIMEOUT)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise BellowsError(
            f"No Dask scheduler with workers answers at '{address}': {error}. Start it with "
            "'dask scheduler', and 'dask worker' with the address that it prints.") from None
    with client:
        yield Cluster(distributed, client)


def _distributed(option: str) -> Any:
    """Return the module; raise BellowsError with its installation."""
    try:
        return importlib.import_module('distributed')
    except ImportError:
        raise BellowsError(
            f"{option} needs 'distributed', which is not installed: {install('dask')}.") from None
