"""
Identification of a cup: recordings in, K and P with their uncertainty out.

Every recording is reduced to the statistics of a fit, in this process, in others or on a cluster,
with equal results. Steps that need whole recordings read them in this process.
"""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, contextmanager, ExitStack, nullcontext
from dataclasses import replace
from functools import partial
import importlib
import logging
from operator import itemgetter
import os
import signal
import threading
from typing import Any

from bellows_ros.core import configure_process, no_progress, Progress, usable_cores
from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.estimates import (
    ClockSettings,
    envelope_of,
    estimates_of,
)
from bellows_ros.core.identification.segments import (
    AnyRecording,
    Held,
    here,
    Pool,
    reduced,
    whole_recordings,
)
from bellows_ros.core.identification.verdict import MAX_TESTED, verdict_of
from bellows_ros.core.model import structure
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import BellowsError, install, require_pictures
from bellows_ros.workflows import identification
from bellows_ros.workflows import recordings as reading
from bellows_ros.workflows.recordings import Failed

Poses = Mapping[str, PoseStream]
"""Poses of tool and package."""

FIT_BEGINS = 0.2
"""Fraction of the work at which the fit begins, for the progress display."""

FIT_ENDS = 0.9
"""Fraction of the work at which the fit ends, for the progress display."""

FORCE = "The cup was not fitted; 'bellows identify --force' fits it, and marks it as refused."
"""Remedy for users who accept the faults of a recording."""

CAUSE_TESTS = 'testing possible causes'
"""Name of the diagnosis in the progress display."""


def identify(
    settings: Mapping[str, Any], progress: Progress = no_progress, jobs: int | None = None,
    dask: str = '', force: bool = False, poses: Mapping[str, Poses] | None = None
) -> identification.Identification:
    """
    Identify a cup from the recordings of the parameter `bags`.

    A recording with faults, or with an impossible package, is not fitted.

    Parameters
    ----------
    settings : mapping
        Parameters by name; others have their defaults.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    jobs : int, optional
        Number of processes on this machine that read and keep the recordings, -1 for one per core.
        An unusable recording is then reported and omitted.
    dask : str
        Address of a Dask scheduler whose workers have the recordings at equal paths, instead of
        local processes; '' for none.
    force : bool
        Whether output error is also fitted to wrong data.
    poses : mapping
        Recordings in memory, by their names in `bags`: see `prepare_streams`.

    Raises
    ------
    BellowsError
        If a parameter or a recording is unusable, an extra package is missing, the scheduler does
        not answer, or the recordings do not determine the cup.

    """
    values = resolved(settings)
    conversion.fitted_structure(values)
    bags = [os.fspath(bag) for bag in values.bags]
    each, keep = reading.values_of_each(values), frozenset(bags[:MAX_TESTED])
    failed: Sequence[Failed] = ()
    with _runner(jobs, dask, len(bags)) as run:
        if run:
            measured, parts, failed = _read_elsewhere(bags, each, keep, progress, run)
        else:
            measured, parts = _read_here(bags, each, keep, progress, poses or {})
        if not all(map(reading.is_at_rest, parts)):
            parts = [*map(reading.without_rest, parts)]
        if not force:
            _require_no_faults(parts, values, FORCE)
        return _identify(values, parts, progress, measured, _assumed(settings), failed)


def _runner(jobs: int | None, dask: str, count: int) -> AbstractContextManager['Cluster | None']:
    """Return the workers of this machine or of a cluster, None for this process."""
    if jobs is None and not dask:
        return nullcontext()
    if dask:
        return cluster(dask)
    return processes(min(usable_cores() if jobs == -1 else jobs or 1, count))


def _require_no_faults(parts: Sequence[AnyRecording], values: Values, more: str = '') -> None:
    """Raise for recordings with faults that make a cup wrong."""
    for part in parts:
        reading.require_none(reduced(part, values.cup.length).remarks, 'fit', more)


def resolved(settings: Mapping[str, Any]) -> Values:
    """Return all parameters of a run, or raise BellowsError for missing ones."""
    required = () if settings.get('package.files') else checks.RECORDING_PARAMETERS
    values = checks.resolve(settings, required)
    if not values.recording.package_world and 'package_world' in values.fit.free:
        values = values.replaced({'recording.package_world': checks.ESTIMATE})
    conversion.given_structure(values)
    if values.output.report:
        require_pictures()
    for wrong, words in _mistakes(values):
        if wrong:
            raise BellowsError(words)
    return values


def _mistakes(values: Values) -> Iterator[tuple[Any, str]]:
    """Yield contradictions of parameters, and their remedies."""
    free = sorted(set(values.fit.free) - {'time_offset', 'package_world'})
    names = f'fit.free: {", ".join(free)}: '
    for name, is_asked in ((names[:-2], free),
                           ('fit.relaxation: on', values.fit.relaxation == 'on'),
                           ('fit.stretch: on', values.fit.stretch == 'on')):
        yield (is_asked and values.fit.method == 'least_squares',
               f'{name} needs fit.method: output_error. Set it.')
    yield ({*free} - {'length', 'package_marker', 'clock_rate', 'scale'} and values.package.files,
           f'{names}with package.files each recording has another package. Fit the recordings of '
           'one package alone.')
    yield (not values.bags, 'No recording is given: the parameter bags is empty. Name at least '
           'one rosbag2 folder, or a .mcap or .db3 file.')


def _assumed(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a warning if the cup's length is neither given nor estimated."""
    if 'cup.length' in settings or 'length' in settings.get('fit.free', ()):
        return ()
    return (
        f"cup.length is not set: using the thesis's {structure.THESIS_LENGTH:g} m, on which K "
        'and P depend. Measure yours from the tool tip to the lip, under vacuum and without '
        'load.',)


def read_part(
    keep: Container[str], poses: Mapping[str, Poses], number: int, bag: str, path: str,
    values: Values,
) -> tuple[fitting.Measured, AnyRecording]:
    """
    Read and reduce a recording; return the reduced recording for a fit, and the recording if kept.

    Parameters
    ----------
    keep : container of str
        Names of the recordings that are kept in full.
    poses : mapping
        Recordings in memory, as in `identify`.
    number : int
        Number of the recording.
    bag, path : str
        Name of the recording by the user, and path for the reader.
    values : mapping
        All parameters.

    Raises
    ------
    BellowsError
        If the recording is unusable.

    """
    if bag in poses:
        settings = reading.prepare_settings(values)
        recording = replace(
            reading.prepare_streams(reading.within_interval(poses[bag], values), settings, values),
            name=bag, digest=bag)
    else:
        recording = reading.load(path, values, name=bag, held=True)
    recording = reading.checked(recording)
    part = reduced(recording, values.cup.length)
    measured = fitting.measured_of(recording, values, number)
    return measured, recording if bag in keep else part


def _attempted(
    keep: Container[str], number: int, bag: str, path: str, values: Values
) -> tuple[fitting.Measured | None, AnyRecording | Failed]:
    """Return the result of `read_part`, or the reason to leave the recording out."""
    configure_process()
    try:
        return read_part(keep, {}, number, bag, path, values)
    except BellowsError as error:
        return None, Failed(bag, str(error))
    except Exception as error:  # noqa: BLE001 (of one recording)
        return None, Failed(bag, f'{type(error).__name__}: {error}')


def _read_here(
    bags: Sequence[str], values: Sequence[Values], keep: Container[str], progress: Progress,
    poses: Mapping[str, Poses],
) -> tuple[Held, list[AnyRecording]]:
    """Return recordings read one after the other, all of which must be usable."""
    measured, parts = list[fitting.Measured](), list[AnyRecording]()
    for number, (bag, own) in enumerate(zip(bags, values, strict=True)):
        progress(f'reading {bag}', FIT_BEGINS * number / len(bags))
        own_measured, part = read_part(keep, poses, number, bag, bag, own)
        measured.append(own_measured)
        parts.append(part)
        for _, sentence in reading.duplicates((one.name, one.digest) for one in parts):
            raise BellowsError(sentence)
    return here(measured), parts


def _read_elsewhere(
    bags: Sequence[str], values: Sequence[Values], keep: Container[str], progress: Progress,
    run: 'Cluster',
) -> tuple[Held, list[AnyRecording], list[Failed]]:
    """Return recordings read by workers, and unusable recordings."""
    words = f'reading {len(bags)} recordings'
    progress(words, 0.0)
    read = run.keep(partial(_attempted, keep), range(len(bags)), bags,
                    list(map(os.path.abspath, bags)), values)
    outcomes = run.run(itemgetter(1), read.values)
    for number in run.ended(outcomes):
        progress(words, FIT_BEGINS * number / len(bags))
    outcomes = [Failed(bag, str(error)) if (error := run.error(each)) else run.gather([each])[0]
                for bag, each in zip(bags, outcomes, strict=True)]
    done = [n for n in range(len(bags)) if not isinstance(outcomes[n], Failed)]
    digested = ((outcomes[n].name, outcomes[n].digest) for n in done)
    for place, sentence in reading.duplicates(digested):
        outcomes[done[place]] = Failed(bags[done[place]], sentence)
    failed = [each for each in outcomes if isinstance(each, Failed)]
    usable = [n for n in done if not isinstance(outcomes[n], Failed)]
    if not usable:
        raise BellowsError(
            f'None of {len(failed)} recordings can be used. The first, '
            f"'{failed[0].bag}': {failed[0].reason}")
    measured = run.keep(itemgetter(0), [read.values[n] for n in usable])
    return measured, [outcomes[n] for n in usable], failed


def _identify(
    values: Values, parts: Sequence[AnyRecording], progress: Progress, measured: Held,
    assumed: tuple[str, ...], failed: Sequence[Failed],
) -> identification.Identification:
    """Fit the recordings; return the result."""
    progress('fitting', FIT_BEGINS)
    try:
        fit = fitting.fit(
            parts, values,
            lambda what, part: progress(what, FIT_BEGINS + (FIT_ENDS - FIT_BEGINS) * part),
            measured)
    except BellowsError:
        _require_no_faults(parts, values)
        raise
    if values.fit.structure == structure.AUTO:
        values = values.replaced({'fit.structure': fit.structure})
    recordings = whole_recordings(parts)
    progress(CAUSE_TESTS, FIT_ENDS)
    verdict = verdict_of(fit, recordings, values.cup.length, values)
    reduced_parts = tuple(reduced(part, values.cup.length) for part in parts)
    envelope = envelope_of(verdict.simulations, reduced_parts, values.vacuum.holding)
    identified = identification.Identification(
        fit, values, reduced_parts, estimates_of(
            fit, reduced_parts, recordings, ClockSettings.of(values)),
        envelope, tuple(recordings), verdict, tuple(failed), assumed)
    progress('done', 1.0)
    return identified


# ------------------------------------ workers of a Dask cluster: of this machine, or at an address


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
    with importlib.import_module('dask').config.set(SETTINGS), ExitStack() as stack:
        with signals_deferred():  # a cluster that is interrupted while it starts cannot be closed
            cluster = stack.enter_context(distributed.LocalCluster(
                n_workers=count, threads_per_worker=1, memory_limit=0, host='127.0.0.1',
                dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL))
            client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
        yield Cluster(distributed, client)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Let the signals that end a process wait until the block is left; nothing in a thread."""
    received, previous = list[int](), dict[int, Any]()
    if threading.current_thread() is threading.main_thread():
        previous = {number: signal.signal(number, lambda got, frame: received.append(got))
                    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        for number in received[:1]:
            signal.raise_signal(number)


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
