"""
Segments of recordings for a fit by simulation.

Each segment has poses of the tool at a uniform rate, and poses of the package at any stamps. The
tool's path is smooth, with rows at uniform times. Differences of the package belong to bins, of a
row each, or of a pose each if these come slower.

A pool has a value of each recording in the process that computed it, or as a future of a cluster,
which computes a lost value again, so that results do not depend on the workers. A reduced
recording has the facts without rows and poses.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
import math
from operator import itemgetter
from typing import Any, NamedTuple

from bellows_ros.core import usable_cores
from bellows_ros.core.findings import Finding
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.identification.least_squares import envelope
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.recording import (
    BodyNoise,
    LONGEST_GAP,
    LOW_RATE_HZ,
    MIN_SEGMENT,
    PackageWorld,
    Recording,
    TimeOffset,
)
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import CornerNoise, TagViews, USUAL_NOISE
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.residuals import spectrum
from bellows_ros.core.signals.savgol import bridged, longest_bridge, savgol, weights
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import UndeterminedError
import numpy as np

HALF_WINDOW = 1 / 12
"""Half window of the tool's path, s: with the order of its polynomials it preserves motion below
10 Hz."""

PATH_ORDER = 6
"""Order of the polynomials of the tool's path."""

MIN_SIGNAL = 3.0
"""Smallest ratio of spectral densities of the tool's twist and of its noise that is motion: six
axes of noise alone over one second exceed it in 1 of 3000."""

TRANSITION = 1.5
"""Ratio of the frequency from which on all motion is noise, and of the highest one of motion."""

MAX_LOSS = 0.01
"""Largest share of the tool's motion that its path may lose, at the end of its band, where the
motion is hardly more than noise."""

MAX_END = 0.05
"""Largest share of a segment that its path lacks at each end, where no window is whole."""


def path_half_window(tool: Trajectory) -> int:
    """Return the half window of the tool's path, in samples."""
    return max(round(HALF_WINDOW * uniform_rate_hz(tool.stamps_ns)), PATH_ORDER // 2 + 1)


ROW_NS = 10_000_000
"""Time between rows of the tool's path, ns: cubic curves between them follow motion below 10
Hz."""

MIN_POSE_STD = np.repeat([1e-6, 1e-5], 3)
"""Smallest noise of a pose, m and rad: twice the error by rows and means over 10 ms at 25 Hz."""


class Course(NamedTuple):
    """
    The current likeliest motion of a segment.

    Parameters
    ----------
    rows : ndarray (M, 13)
        States of the tool along its path.
    stamps_ns, change : ndarray (N,), (N, 6)
        Stamps, ns, and change of the measured path there, m and rad in body axes.
    start : ndarray (12,)
        Change of the package's first state from rest, m, rad, m/s and rad/s.
    std : ndarray (6,)
        Noise of the package's poses, m and rad.
    corners : CornerNoise
        Noise of the corners of a tag.

    """

    rows: Array
    stamps_ns: Stamps
    change: Array
    start: Array
    std: Array
    corners: CornerNoise = USUAL_NOISE


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A part of a recording with a measured tool.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world at a uniform rate; missing or wrong ones are invalid.
    package : Trajectory
        Valid poses of B, at any stamps.
    payload : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float or array (3,)
        m/s^2 along -z of the world, or as a vector there.
    tool_noise, package_noise : BodyNoise
        Noise of the measured poses.
    recording : int
        Index of the recording.
    moves_with_com : tuple of 3 bool
        Components of the com that shift the poses of B, as poses of the lip are measured.
    of_recording : tuple, optional
        Point (m) about which the package's world may rotate, with the start (s) of its possible
        drift (4,), see `body.middle_of`; and the first and last stamp (ns) of the recording.
        Default: those of the segment.
    views : TagViews or None
        Corners of a tag on the package, at stamps of its poses; None for a tracked body.
    rejected : int
        Number of invalid poses of the package.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: Array | float
    tool_noise: BodyNoise
    package_noise: BodyNoise
    recording: int = 0
    moves_with_com: tuple[bool, bool, bool] = (False, False, False)
    of_recording: tuple[Array, int, int] | None = None
    views: TagViews | None = None
    rejected: int = 0

    @cached_property
    def _poses(self) -> Trajectory:
        """Poses of the tool with gaps bridged."""
        return bridged(self.tool, path_half_window(self.tool), PATH_ORDER)

    @cached_property
    def band(self) -> float:
        """Highest frequency at which the twist of the tool is not noise, Hz."""
        rate = 1.0 / self.tool_period
        motion = savgol(self._poses, path_half_window(self.tool), PATH_ORDER)
        assert motion.twist is not None
        found = spectrum(motion.twist, rate)
        noise = 2.0 * np.abs(_response(motion.weights[1], rate, found.frequency)[:, None]) ** 2 * (
            noise_spectrum(self.tool_noise, self.tool_period, found.frequency))
        noise = np.maximum(noise, noise.mean(axis=0))  # as a filter has zeros
        is_motion = np.mean(found.density / noise, axis=1) > MIN_SIGNAL
        return float(found.frequency[is_motion].max(initial=found.frequency[1]))

    @cached_property
    def _half_window(self) -> int:
        """Half window of the longest filter that preserves the motion of the tool, in samples."""
        usual = path_half_window(self.tool)
        longest, count = max(round(MAX_END * len(self._poses)), usual), usual
        while count <= longest and self._loss(count, self.band) < MAX_LOSS:
            count = math.ceil(1.1 * count)
        return max(math.floor(count / 1.1), usual)

    def _loss(self, half_window: int, frequency: float) -> float:
        """Return the share of an oscillation that a path of the tool loses."""
        rate = 1.0 / self.tool_period
        kernel = weights(half_window, PATH_ORDER, rate, True)[0]
        return float(np.abs(1.0 - _response(kernel, rate, np.array([frequency]))[0]))

    @cached_property
    def _path(self) -> tuple[Stamps, Array, Array]:
        path = savgol(self._poses, self._half_window, PATH_ORDER, is_tapered=True)
        first, last = path.stamps_ns[[0, -1]].tolist()
        rows_ns = np.arange(max(first, int(self.package.stamps_ns[0]) - ROW_NS), last + 1, ROW_NS)
        return rows_ns, simulation.tool_rows(resample(path, rows_ns)), path.weights

    @property
    def rows_ns(self) -> Stamps:
        """Stamps (M,) of the rows of the path, ns."""
        return self._path[0]

    @property
    def rows(self) -> Array:
        """States (M, 13) of the tool along its measured path."""
        return self._path[1]

    @property
    def weights(self) -> Array:
        """Weights (3, 2n+1) of the filter of the path."""
        return self._path[2]

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last stamp of the recording, ns."""
        ends = self.tool.stamps_ns[[0, -1]].tolist() if self.of_recording is None else (
            self.of_recording[1:])
        return ends[0], ends[1]

    @cached_property
    def middle(self) -> Array:
        """Middle of the package, see `body.middle_of`."""
        return body.middle_of(self.package) if self.of_recording is None else self.of_recording[0]

    @cached_property
    def period(self) -> float:
        """Median time between poses of the package, s."""
        return float(np.median(np.diff(self.package.stamps_ns))) / NS_PER_S

    @property
    def tool_period(self) -> float:
        """Time between poses of the tool, s."""
        return 1.0 / uniform_rate_hz(self.tool.stamps_ns)

    @property
    def is_slow(self) -> bool:
        """Whether the noise of the package's poses is estimated jointly with K and P."""
        return self.views is not None or self.period * LOW_RATE_HZ > 1.0

    @property
    def poses_per_bin(self) -> int:
        """Number of the package's poses in a bin without missing ones."""
        return -(-ROW_NS // round(self.period * NS_PER_S))

    @property
    def bin_ns(self) -> int:
        """Time between bins, ns: whole periods of the poses, for equal numbers of poses."""
        return round(self.period * NS_PER_S) * self.poses_per_bin

    @cached_property
    def bins_ns(self) -> Stamps:
        """Stamps of the bins, ns."""
        stamps = self.package.stamps_ns
        first = int(stamps[np.searchsorted(stamps[:-1], self.rows_ns[0])]) + (
            self.bin_ns - round(self.period * NS_PER_S)) // 2
        last = int(min(self.rows_ns[-1], self.package.stamps_ns[-1]))
        return np.arange(first, max(first, last) + self.bin_ns // 2 + 1, self.bin_ns)

    @property
    def context(self) -> body.Context:
        """Context of the nuisances of poses."""
        camera = self.views.tag.T_world_camera[:3, 3] if self.views else 0.0
        return np.array(self.moves_with_com, float), self.middle, camera

    @cached_property
    def first(self) -> Course:
        """The motion as measured."""
        return Course(self.rows, self.rows_ns[[0, -1]], np.zeros((2, 6)), np.zeros(12),
                      self.package_noise.std, self.views.tag.noise if self.views else USUAL_NOISE)

    def moved(self, shift: Array) -> Array:
        """Return rows of the tool after a change (M, 12) of its path, see `moved`."""
        return moved(self.rows, shift)

    def smooth(self, rows: Array) -> Array:
        """
        Return states (M, 13) of the tool without motion above its band, which is noise.

        Such motion is that of the distance travelled in body axes, and that of the twist. It
        stays at the ends of the path.
        """
        R = lie.quaternion_to_rotation(rows[:, 3:7])
        back = np.swapaxes(R[:-1], 1, 2)
        steps = np.hstack([
            lie.apply(back, np.diff(rows[:, :3], axis=0)), lie.log_so3(back @ R[1:])])
        travelled = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
        period = ROW_NS / NS_PER_S
        count = np.arange(len(rows))
        to_end = period * self.band * np.minimum(count, count[::-1])
        noise = _above(self.band, np.hstack([travelled, rows[:, 7:]]), period)
        return moved(rows, -noise * np.minimum(to_end, 1.0)[:, None])


def moved(rows: Array, shift: Array) -> Array:
    """
    Return states (M, 13) of the tool after a change (M, 12) or (12,) of its path.

    The change is of pose and twist in body axes, m, rad, m/s and rad/s.
    """
    d, phi, dv, dw = np.split(np.broadcast_to(shift, (len(rows), 12)), 4, axis=1)
    v, w = rows[:, 7:10], rows[:, 10:]
    R = lie.quaternion_to_rotation(rows[:, 3:7])
    return np.hstack([
        rows[:, :3] + lie.apply(R, d), lie.rotation_to_quaternion(R @ lie.exp_so3(phi)),
        v + dv + np.cross(w, d) + np.cross(v, phi), w + dw + np.cross(w, phi)])


def _above(limit: float, values: Array, period: float) -> Array:
    """
    Return the part of values (M, C), one a period (s), above a frequency (Hz).

    The values are continued by odd reflections; the part is whole from `TRANSITION` times the
    frequency on.
    """
    first, last = values[:1], values[-1:]
    continued = np.vstack([2.0 * first - values[:0:-1], values, 2.0 * last - values[-2::-1]])
    frequency = np.fft.rfftfreq(len(continued), period)
    share = np.clip((frequency / limit - 1.0) / (TRANSITION - 1.0), 0.0, 1.0)
    spectra = np.sin(0.5 * np.pi * share)[:, None] ** 2 * np.fft.rfft(continued, axis=0)
    above = np.fft.irfft(spectra, len(continued), axis=0)
    return np.asarray(above[len(values) - 1:2 * len(values) - 1])


def _response(kernel: Array, rate: float, frequency: Array) -> Array:
    """Return the response (F,) of weights (2n+1,) of poses at a rate (Hz)."""
    lags = np.arange(len(kernel)) - len(kernel) // 2
    return np.asarray(kernel @ np.exp(2j * np.pi / rate * np.outer(lags, frequency)))


def noise_spectrum(noise: BodyNoise, period: float, frequency: Array) -> Array:
    """Return spectra (F, 6) of noise of poses, m^2/Hz and rad^2/Hz, at frequencies (F,)."""
    memory = noise.correlation
    turn = np.abs(1.0 - memory * np.exp(-2j * np.pi * period * frequency)[:, None]) ** 2
    return np.asarray(period * noise.std**2 * (1.0 - memory**2) / turn)


Segments = tuple[Segment, ...]
"""Those of one recording."""


def _longest_gap(tool: Trajectory) -> float:
    """Return the longest time between poses of the tool (s) that its path bridges."""
    missing = longest_bridge(path_half_window(tool), PATH_ORDER)
    return min((missing + 1.5) / uniform_rate_hz(tool.stamps_ns), LONGEST_GAP)


def segments_of(recording: Recording, number: int = 0) -> Segments:
    """
    Return the parts of a recording between gaps of the tool that cannot be bridged.

    Raises
    ------
    UndeterminedError
        If no part is long enough.

    """
    tool, package = recording.aligned_tool, recording.tracked_package
    of_tool, of_package = (noise._replace(std=np.maximum(noise.std, MIN_POSE_STD))
                           for noise in recording.body_noise)
    views, parts = recording.views, []
    spans = recording.segments(_longest_gap(tool))
    for first, last, _ in spans:
        poses, seen = (each.select((each.stamps_ns >= first) & (each.stamps_ns <= last))
                       for each in (tool, package))
        if last - first > MIN_SEGMENT * NS_PER_S and np.count_nonzero(seen.valid) > 1:
            valid = seen.select(seen.valid)
            parts.append(Segment(
                poses, valid, recording.payload, recording.settings.gravity, of_tool, of_package,
                number, recording.settings.moves_with_com,
                (body.middle_of(package), spans[0].first_ns, spans[-1].last_ns),
                views and views.at(valid.stamps_ns), len(seen) - len(valid)))
    if not parts:
        raise UndeterminedError(
            f'No segment of {MIN_SEGMENT:g} s in which both bodies are tracked: record longer, '
            "and without gaps. 'bellows info' lists them.")
    return tuple(parts)


class Outline(NamedTuple):
    """
    Facts on a recording that a fit needs beside sums over its poses.

    Parameters
    ----------
    payload : Package
        The package in the recording.
    is_slow : bool
        Whether its poses come slowly.
    poses : tuple of (int, int)
        Number of poses of the package, and of valid ones.
    begin_ns : int
        Stamp of the first pose.
    ends_ns : tuple of (int, int)
        First and last stamp of the paths of the tool.

    """

    payload: Package
    is_slow: bool
    poses: tuple[int, int]
    begin_ns: int
    ends_ns: tuple[int, int]


def outline_of(segments: Segments) -> Outline:
    """Return the outline of a recording."""
    used = sum(len(segment.package) for segment in segments)
    return Outline(
        segments[0].payload, any(segment.is_slow for segment in segments),
        (used + sum(segment.rejected for segment in segments), used),
        int(segments[0].package.stamps_ns[0]),
        (int(segments[0].rows_ns[0]), int(segments[-1].rows_ns[-1])))


def in_threads(function: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
    """Return a function's results in the order of its arguments, from threads."""
    if len(columns[0]) == 1:
        return list(map(function, *columns))
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(function, *columns))


class Held(NamedTuple):
    """A value of each recording in a pool."""

    pool: 'Pool'
    values: Sequence[Any]

    def only(self, number: int) -> 'Held':
        """Return the value of one recording."""
        return Held(self.pool, self.values[number:number + 1])


class Pool:
    """Recordings in this process: functions run in threads, as kernels release the lock."""

    def run(self, function: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
        """Return a function's values for each recording."""
        return in_threads(function, *columns)

    def gather(self, values: Sequence[Any]) -> list[Any]:
        """Return values in this process, or raise the first error."""
        return list(values)

    def keep(self, function: Callable[..., Any], *columns: Held | Sequence[Any]) -> Held:
        """Return a function's value for each recording, where the recording is."""
        return Held(self, self.run(function, *(
            each.values if isinstance(each, Held) else each for each in columns)))

    def results(self, function: Callable[..., Any], *columns: Held | Sequence[Any]) -> list[Any]:
        """Return a function's value for each recording, in this process."""
        return self.gather(self.keep(function, *columns).values)

    def hold(
        self, function: Callable[..., Any], *columns: Held | Sequence[Any]
    ) -> tuple[Held, list[Any]]:
        """Return the kept first values of a function, and the second ones in this process."""
        pairs = self.keep(function, *columns)
        return self.keep(itemgetter(0), pairs), self.results(itemgetter(1), pairs)


def here(values: Sequence[Any]) -> Held:
    """Return values of recordings in this process."""
    return Held(Pool(), list(values))


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
    report = recording.report
    return ReducedRecording(
        recording.as_json(), recording.digest, recording.files, recording.payload,
        report.time_offset, report.package_world, report.package.timing.rate_hz, cup_length,
        envelope(recording.tool, recording.package, recording.payload, cup_length),
        report.remarks)
