"""
Values of recordings, kept by the process that computed them, and functions over the recordings.

The value of a recording is in this process, or is a future of a cluster. The cluster computes a
lost value again, so results do not depend on the workers.
A reduced recording has the facts without rows and poses.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from operator import itemgetter
import time
from typing import Any, NamedTuple

from bellows_ros.core import usable_cores
from bellows_ros.core.findings import Finding
from bellows_ros.core.identification.least_squares import envelope, samples_of
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.recording import PackageWorld, Recording, TimeOffset


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


class ReducedRecording(NamedTuple):
    """
    Facts on a recording, without its rows and poses.

    Parameters
    ----------
    report : mapping
        Report on the recording, as in the JSON file of a fit.
    digest : str
        Digest of its stored messages.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.
    payload : Package
        The package in it.
    time_offset : TimeOffset or None
        Offset subtracted from the tool's stamps, None if not requested or not identifiable.
    package_world : PackageWorld or None
        Transform between two worlds, if estimated.
    rate_hz : float
        Rate of the package's poses.
    cup_length : float
        Cup length l0 of the validity range, m.
    envelope : Envelope
        Its validity range.
    remarks : tuple of Finding
        Findings of the preparation and of the checks.

    """

    report: Mapping[str, Any]
    digest: str
    files: tuple[Mapping[str, Any], ...]
    payload: Package
    time_offset: TimeOffset | None
    package_world: PackageWorld | None
    rate_hz: float
    cup_length: float
    envelope: Envelope
    remarks: tuple[Finding, ...] = ()

    @property
    def name(self) -> str:
        """Name of the recording as the user gave it."""
        return str(self.report['bag'])


AnyRecording = Recording | ReducedRecording


def whole_recordings(recordings: Sequence[AnyRecording]) -> list[Recording]:
    """Return the recordings that are not reduced."""
    return [recording for recording in recordings if isinstance(recording, Recording)]


def reduced(recording: AnyRecording, cup_length: float) -> ReducedRecording:
    """
    Return a recording reduced, if it is not.

    Raises
    ------
    BellowsError
        If the recording has no valid samples, or the package is not below the tool.

    """
    if isinstance(recording, ReducedRecording):
        return recording
    whole = recording
    return whole.cached(('reduced', cup_length), lambda: _reduced(whole, cup_length))


def envelope_of(recording: Recording, cup_length: float) -> Envelope:
    """Return the validity range of a recording."""
    return recording.cached(
        ('envelope', cup_length), lambda: envelope(samples_of(recording), cup_length))


def _reduced(recording: Recording, length: float) -> ReducedRecording:
    """Return a recording reduced."""
    return ReducedRecording(
        recording.as_json(), recording.digest, recording.files, recording.payload,
        recording.report.time_offset, recording.report.package_world,
        recording.report.package.timing.rate_hz, length, envelope_of(recording, length),
        recording.report.remarks)
