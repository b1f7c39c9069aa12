"""
Segments of recordings for a fit by simulation.

Each segment has poses of the tool at a uniform rate, and poses of the package at any stamps. The
course of a segment has the current likeliest path of the tool. Quick poses are averaged in small
groups.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask, Places, Stamps
from bellows_ros.core.identification import quantities, whitening
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.kernels import State
from bellows_ros.core.recording.recording import (
    BodyNoise,
    LOW_RATE_HZ,
    MIN_SEGMENT,
    Recording,
    UNSEEN_STD,
)
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import CornerNoise, TagViews, USUAL_NOISE
from bellows_ros.core.sensors.readings import Readings
from bellows_ros.core.signals.resampling import subdivided
from bellows_ros.core.signals.residuals import relative_coordinates
from bellows_ros.core.signals.savgol import bridged, savgol
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError, UndeterminedError
import numpy as np

HALF_WINDOWS = (1 / 6, 1 / 8, 1 / 12)
"""Half windows of the tool's path, longest first, s."""

PATH_ORDER = 6
"""Order of the polynomials of the tool's path."""

MAX_REMOVED_POWER = 1.5
"""Largest ratio of the additional power that a longer window removes to the power of its noise."""

MIN_POSE_STD = np.repeat([2e-7, 2e-6], 3)
"""Smallest noise of a pose, by interpolation and rounding, m and rad."""

MAX_SEGMENT = 15.0
"""
Longest segment, s; longer ones are split for parallel processing.

Two segments in 26 s increase standard errors by 1 %.
"""

MEAN_HALF_WINDOW = 5
"""Half window of the path for means of poses, in lengths of a mean."""

MAX_STEP_CHANGE = 0.1
"""Largest relative change of a uniform step."""

MIN_IN_MEANS = 0.85
"""Smallest fraction of valid poses in the means."""

BRIDGED_STD = np.repeat([5e-3, 5e-2], 3)
"""Standard deviation of a bridged pose of the tool, m and rad."""

SIMULTANEITY_TOLERANCE = 2e-4
"""Largest time difference, s, of poses of package and tool that count as simultaneous; the
difference is bridged by the twist."""

MAX_NODE_STEP = 0.01
"""Longest step between nodes of the linearised model, and duration of a mean of poses, s."""


@dataclass(frozen=True, eq=False)
class MeasuredSegment:
    """
    A part of a recording with a measured tool.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world at a uniform rate; missing or wrong ones are invalid.
    package : Trajectory
        Poses of B, at any stamps.
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
    middle : ndarray (4,), optional
        Point (m) about which the package's world may rotate, and start (s) of its possible drift;
        see `body.middle_of`.
    world : str
        World of the recording, the parameter recording.world.
    views : TagViews or None
        Corners of a tag on the package, at stamps of all its poses; None for a tracked body.
    further : tuple of Readings
        Measurements of further sensors in the whole recording.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: Array | float
    tool_noise: BodyNoise
    package_noise: BodyNoise
    recording: int = 0
    moves_with_com: tuple[bool, bool, bool] = (False, False, False)
    middle: Array | None = None
    world: str = 'z_up'
    views: TagViews | None = None
    further: tuple[Readings, ...] = ()


def measured_segments(recording: Recording, number: int = 0) -> list[MeasuredSegment]:
    """
    Return the parts of a recording between gaps of the tool that cannot be bridged.

    Raises
    ------
    UndeterminedError
        If no part is long enough.

    """
    bodies = tool, package = recording.aligned_tool, recording.tracked_package
    noises = (noise._replace(std=np.maximum(noise.std, MIN_POSE_STD))
              for noise in recording.body_noise)
    context: tuple[Any, ...] = (
        recording.payload, recording.settings.gravity, *noises, number,
        recording.settings.moves_with_com, body.middle_of(package), recording.settings.world,
        recording.views, recording.further)
    motions = []
    for start, end, _ in recording.segments:
        count = int((end - start) / NS_PER_S / MAX_SEGMENT) + 1 if recording.is_seen else 1
        edges = start + np.linspace(0, end - start, count + 1).astype(np.int64)
        for first, last in pairwise(edges):
            poses = [body.select((body.stamps_ns >= first) & (body.stamps_ns <= last))
                     for body in bodies]
            if last - first > MIN_SEGMENT * NS_PER_S and poses[1].valid.any():
                motions.append(MeasuredSegment(poses[0], poses[1], *context))
    if not motions:
        raise UndeterminedError(
            f'No segment of {MIN_SEGMENT:g} s in which both bodies are tracked: record longer, '
            "and without gaps. 'bellows info' lists them.")
    return motions


class Nodes(NamedTuple):
    """
    Stamps of the samples of tool and package.

    Parameters
    ----------
    stamps : int ndarray (M,)
        Stamps by the tool's clock, ns.
    samples : int ndarray (S,)
        First node for which each of the tool's samples is the nearest.
    place : int ndarray (M,)
        Index of the package's pose at each node, -1 for none.
    sampled, used : bool ndarray
        Masks of the used samples of the tool and poses of the package.
    delays : ndarray (N,)
        Delays (s) of the used poses after their nodes, nonzero at a sample of the tool.

    """

    stamps: Stamps
    samples: Places
    place: Places
    sampled: Mask
    used: Mask
    delays: Array

    @property
    def lengths(self) -> Array:
        """Times (M - 1,) between nodes, s."""
        return np.diff(self.stamps) / NS_PER_S


class Course(NamedTuple):
    """
    The current likeliest motion of a segment.

    Parameters
    ----------
    path : Trajectory
        Smooth path of the tool.
    deviation : ndarray (S, 6)
        Deviation of the path from the tool's samples, m and rad.
    start : State
        First state of the package.
    std : ndarray (6,)
        Noise of the package's poses, m and rad.
    corners : CornerNoise
        Noise of the corners of a tag.

    """

    path: Trajectory
    deviation: Array
    start: State
    std: Array
    corners: CornerNoise = USUAL_NOISE


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A part of a recording, prepared for a fit.

    Parameters
    ----------
    measured : MeasuredSegment
        Measured segment, with means of quick poses.
    tool : Trajectory
        Poses of the tool, with gaps bridged.
    half_window : int
        Half window of the filter of the tool's path, samples.
    span_ns : (int, int), optional
        First and last stamp of the recording, by default of the segment.

    """

    measured: MeasuredSegment
    tool: Trajectory
    half_window: int
    span_ns: tuple[int, int] | None = None

    @classmethod
    def of(cls, measured: MeasuredSegment, half_window: int = 0) -> 'Segment':
        """Return a prepared part of a recording, by default with the best half window."""
        first_ns = int(measured.tool.stamps_ns[0])  # means of equal rates have equal stamps
        tool, tool_noise = _means(measured.tool, measured.tool_noise, first_ns)
        package, package_noise = measured.package, measured.package_noise
        if measured.views is None:
            package, package_noise = _means(package, package_noise, first_ns)
        smooth = bridged(tool)
        return cls(
            replace(measured, tool=tool, tool_noise=tool_noise, package=package,
                    package_noise=package_noise),
            smooth, half_window or _half_window_of(smooth, tool_noise.correlation))

    @cached_property
    def inner(self) -> slice:
        """The samples of the tool inside the windows at both ends."""
        return slice(self.half_window, len(self.tool) - self.half_window)

    @cached_property
    def period(self) -> float:
        """Median time between poses of the package, s."""
        return float(np.median(np.diff(self.measured.package.stamps_ns))) / NS_PER_S

    @property
    def is_slow(self) -> bool:
        """Whether the noise of the package's poses is estimated jointly with K and P."""
        return self.measured.views is not None or self.period * LOW_RATE_HZ > 1.0

    @cached_property
    def variance(self) -> Array:
        """Variances (S, 6) of the inner samples of the tool, m^2 and rad^2."""
        valid = self.measured.tool.valid[:, None]
        return np.where(valid, self.measured.tool_noise.std, BRIDGED_STD)[self.inner] ** 2

    @cached_property
    def package(self) -> Trajectory:
        """The valid poses of the package."""
        return self.measured.package.select(self.measured.package.valid)

    @cached_property
    def views(self) -> TagViews | None:
        """Views of a tag at the valid poses."""
        views = self.measured.views
        return None if views is None else views.at(self.package.stamps_ns)

    @property
    def context(self) -> body.Context:
        """Context of the nuisances of poses."""
        views = self.measured.views
        camera = views.tag.T_world_camera[:3, 3] if views else 0.0
        return np.array(self.measured.moves_with_com, float), self.middle, camera

    @cached_property
    def middle(self) -> Array:
        """Middle of the package, see `body.middle_of`."""
        own = self.measured.middle
        return body.middle_of(self.package) if own is None else own

    @cached_property
    def expected_start(self) -> State:
        """First pose of the package, at rest."""
        first = self.package.select(slice(1))
        return simulation.state_row(
            first.position[0], lie.rotation_to_quaternion(first.rotation)[0])

    @cached_property
    def first(self) -> Course:
        """The motion as measured."""
        views = self.measured.views
        return self.course(
            np.zeros((len(self.variance), 6)), self.expected_start,
            self.measured.package_noise.std, views.tag.noise if views else USUAL_NOISE)

    @property
    def ends_ns(self) -> tuple[int, int]:
        """First and last stamp of the smooth path."""
        first, last = self.tool.stamps_ns[self.inner][[0, -1]].tolist()
        return first, last

    def course(
        self, change: Array, start: State, std: Array, of_corners: CornerNoise = USUAL_NOISE
    ) -> Course:
        """Return the motion after changes (S, 6) of the tool's samples, in body axes."""
        tool, shift = self.tool, np.zeros((len(self.tool), 6))
        shift[self.inner] = change
        path = savgol(Trajectory(
            tool.stamps_ns, tool.position + lie.apply(tool.rotation, shift[:, :3]),
            tool.rotation @ lie.exp_so3(shift[:, 3:])), self.half_window, PATH_ORDER)
        return Course(
            path, relative_coordinates(path, tool.select(self.inner)), start, std,
            of_corners)

    def nodes(self, delay: float, rate: float = 0.0) -> Nodes:
        """Return the nodes for the delay (s) and the relative rate of the tool's clock."""
        since = self.package.stamps_ns - round(self.middle[3] * NS_PER_S)
        grid, poses = self.tool.stamps_ns[self.inner], self.package.stamps_ns + np.rint(
            delay * NS_PER_S + rate * since).astype(np.int64)
        after = np.clip(np.searchsorted(grid, poses), 1, len(grid) - 1)
        nearest = np.where(2 * poses < grid[after - 1] + grid[after], grid[after - 1], grid[after])
        tolerance = np.min(np.diff(poses) // 4, initial=round(SIMULTANEITY_TOLERANCE * NS_PER_S))
        stamps = np.where(np.abs(poses - nearest) <= tolerance, nearest, poses)
        used = (stamps >= grid[0]) & (stamps <= grid[-1])
        if not used.any():
            raise BellowsError('No package pose lies within the motion of the tool.')
        both = np.union1d(grid, stamps[used])
        both = both[both >= stamps[used][0]]
        parts = np.ceil(np.diff(both) / (MAX_NODE_STEP * NS_PER_S)).astype(np.int64)
        nodes = subdivided(both, parts)
        sampled = grid >= nodes[0]
        place = np.full(len(nodes), -1)
        place[np.searchsorted(nodes, stamps[used])] = np.arange(np.count_nonzero(used))
        middles = (grid[sampled][1:] + grid[sampled][:-1]) // 2
        return Nodes(nodes, np.append(0, np.searchsorted(nodes, middles)), place, sampled, used,
                     (poses - stamps)[used] / NS_PER_S)

    def tool_noise(self, deviation: Array, nodes: Nodes) -> whitening.ToolNoise:
        """Return the noise of the tool's samples at the nodes, from its deviation (S, 6)."""
        correlation, count = self.measured.tool_noise.correlation, len(nodes.stamps)
        noise = whitening.ToolNoise(
            np.zeros((count, 6)), np.zeros((count, 6)), np.ones(count))
        noise.innovations[nodes.samples] = _innovations(
            deviation[nodes.sampled], correlation)
        noise.variances[nodes.samples] = self.variance[nodes.sampled] * (1.0 - correlation**2)
        noise.variances[nodes.samples[0]] /= 1.0 - correlation**2
        noise.correlations[nodes.samples] = correlation
        return noise


Segments = tuple[Segment, ...]
"""Those of one recording."""


def segments_of(measured: Sequence[MeasuredSegment], like: Segments = ()) -> Segments:
    """Return the prepared parts of a recording, with the half windows of other parts if any."""
    windows = [each.half_window for each in like] or [0] * len(measured)
    parts = list(map(Segment.of, measured, windows))
    span = parts[0].ends_ns[0], parts[-1].ends_ns[1]
    return tuple(replace(part, span_ns=span) for part in parts)


class Outline(NamedTuple):
    """
    Facts on a recording that a fit needs beside sums over its poses.

    Parameters
    ----------
    payload, world, moves_with_com
        As of its segments.
    is_slow, is_tag, is_seen : bool
        Whether its poses come slowly, whether they are of a tag, and whether the poses of its
        package are measured.
    further : mapping
        Standard deviations of the quantities of further sensors.
    poses : int
        Number of poses of the package.
    begin_ns : int
        Stamp of the first pose.
    ends_ns : tuple of (int, int)
        First and last stamp of each segment.

    """

    payload: Package
    world: str
    moves_with_com: tuple[bool, bool, bool]
    is_slow: bool
    is_tag: bool
    is_seen: bool
    further: quantities.Free
    poses: int
    begin_ns: int
    ends_ns: tuple[tuple[int, int], ...]


def outline_of(segments: Segments) -> Outline:
    """Return the outline of a recording."""
    measured = segments[0].measured
    return Outline(
        measured.payload, measured.world, measured.moves_with_com,
        any(segment.is_slow for segment in segments),
        measured.views is not None,
        bool(np.all(measured.package_noise.std < 0.1 * UNSEEN_STD)),
        quantities.deviations_of(measured.further),
        sum(len(segment.measured.package) for segment in segments),
        int(min(segment.package.stamps_ns[0] for segment in segments)),
        tuple(segment.ends_ns for segment in segments))


def _half_window_of(tool: Trajectory, correlation: float) -> int:
    """
    Return the half window (samples) of the tool's path: the longest that preserves the motion.

    Noise in the path is noise in the derivatives: slow noise needs a long window. Noise with a
    memory below one sample is small even with the shortest.
    """
    rate = uniform_rate_hz(tool.stamps_ns)
    shortest = PATH_ORDER // 2 + 1
    *longer, short = (max(round(duration * rate), shortest) for duration in HALF_WINDOWS)
    if correlation < math.exp(-1.0):
        return short
    removed, share = _removed(tool, short, correlation)
    noise = np.mean(removed**2, axis=0) / (1.0 - share)
    for half_window in longer:
        more, more_share = _removed(tool, half_window, correlation)
        power = np.mean((more - removed[half_window - short:][:len(more)]) ** 2, axis=0)
        if np.all(power <= MAX_REMOVED_POWER * (share - more_share) * noise):
            return half_window
    return short


def _means(poses: Trajectory, noise: BodyNoise, first_ns: int) -> tuple[Trajectory, BodyNoise]:
    """
    Return means of quick poses at a uniform rate, with their noise.

    Each is the mean of an odd number of poses, at most `MAX_NODE_STEP` long, relative to a smooth
    path, so that no motion is lost. Poses are kept if means would lose too many, or if noise has a
    memory, which quick differences determine best.
    """
    steps, correlation = np.diff(poses.stamps_ns), noise.correlation
    period = float(np.median(steps))
    half = int((MAX_NODE_STEP * NS_PER_S / period - 1.0) / 2.0)
    count = 2 * half + 1
    n = MEAN_HALF_WINDOW * count
    start = n + (round((first_ns - poses.stamps_ns[0]) / period) - half - n) % count
    groups = (len(poses) - n - start) // count
    if half < 1 or groups < 1 or correlation**count > math.exp(-1.0) or (
            np.ptp(steps) > MAX_STEP_CHANGE * period):
        return poses, noise
    inner = slice(start, start + groups * count)
    valid = np.asarray(poses.valid[inner].reshape(groups, count).all(axis=1))
    if count * np.count_nonzero(valid) < MIN_IN_MEANS * np.count_nonzero(poses.valid[inner]):
        return poses, noise
    smooth = bridged(poses)
    path = savgol(smooth, n, PATH_ORDER).select(slice(start - n, start - n + groups * count))
    mean = relative_coordinates(path, smooth.select(inner)).reshape(groups, count, 6).mean(axis=1)
    path = path.select(slice(half, None, count))
    lags = np.arange(1, count)
    variance = (1.0 + 2.0 * np.sum((1.0 - lags / count) * correlation**lags)) / count
    again = correlation * np.mean(correlation ** np.arange(count)) ** 2 / variance
    return Trajectory(
        path.stamps_ns, path.position + lie.apply(path.rotation, mean[:, :3]),
        path.rotation @ lie.exp_so3(mean[:, 3:]), valid=valid,
    ), noise._replace(std=np.sqrt(variance) * noise.std, correlation=float(again))


def _removed(tool: Trajectory, half_window: int, correlation: float) -> tuple[Array, float]:
    """Return the innovations (N, 6) of the motion removed by a window, and the remaining noise."""
    path = savgol(tool, half_window, PATH_ORDER)
    removed = relative_coordinates(path, tool.select(slice(half_window, len(tool) - half_window)))
    return _innovations(removed, correlation)[1:], float(path.weights[0, half_window])


def _innovations(noise: Array, correlation: float) -> Array:
    """Return the innovations of noise (S, 6) that is correlated between samples."""
    return np.vstack([noise[:1], noise[1:] - correlation * noise[:-1]])
