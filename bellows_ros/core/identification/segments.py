"""
Segments of recordings for a fit by simulation.

Each segment has poses of the tool at a uniform rate, and poses of the package at any stamps. The
tool's path is smooth, with rows at uniform times. Differences of the package belong to bins, of a
row each, or of a pose each if these come slower.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.recording.recording import (
    BodyNoise,
    LOW_RATE_HZ,
    MIN_SEGMENT,
    Recording,
)
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import CornerNoise, TagViews, USUAL_NOISE
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.savgol import bridged, savgol
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import UndeterminedError
import numpy as np

HALF_WINDOW = 1 / 12
"""Half window of the tool's path, s: with the order of its polynomials it preserves motion below
10 Hz."""

PATH_ORDER = 6
"""Order of the polynomials of the tool's path."""

ROW_NS = 10_000_000
"""Time between rows of the tool's path, ns: cubic curves between them follow motion below 10
Hz."""

MIN_POSE_STD = np.repeat([1e-6, 1e-5], 3)
"""Smallest noise of a pose, m and rad: twice the error by rows and means over 10 ms at 25 Hz."""


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
        recording.views)
    motions = []
    for first, last, _ in recording.segments:
        tool, package = (each.select((each.stamps_ns >= first) & (each.stamps_ns <= last))
                         for each in bodies)
        if last - first > MIN_SEGMENT * NS_PER_S and package.valid.any():
            motions.append(MeasuredSegment(tool, package, *context))
    if not motions:
        raise UndeterminedError(
            f'No segment of {MIN_SEGMENT:g} s in which both bodies are tracked: record longer, '
            "and without gaps. 'bellows info' lists them.")
    return motions


class Course(NamedTuple):
    """
    The current likeliest motion of a segment.

    Parameters
    ----------
    rows : ndarray (M, 13)
        States of the tool along its path.
    noise : ndarray (B, 6)
        Noise of the tool's poses at the bins that the path is without, m and rad.
    start : ndarray (12,)
        Change of the package's first state from rest, m, rad, m/s and rad/s.
    std : ndarray (6,)
        Noise of the package's poses, m and rad.
    corners : CornerNoise
        Noise of the corners of a tag.

    """

    rows: Array
    noise: Array
    start: Array
    std: Array
    corners: CornerNoise = USUAL_NOISE


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A part of a recording, prepared for a fit.

    Parameters
    ----------
    measured : MeasuredSegment
        Measured segment.
    rows_ns : int ndarray (M,)
        Stamps of the rows of the path, ns.
    rows : ndarray (M, 13)
        States of the tool along its measured path.
    weights : ndarray (3, 2n+1)
        Weights of the filter of the path.
    span_ns : tuple of (int, int)
        First and last stamp of the recording.

    """

    measured: MeasuredSegment
    rows_ns: Stamps
    rows: Array
    weights: Array
    span_ns: tuple[int, int]

    @classmethod
    def of(cls, measured: MeasuredSegment) -> 'Segment':
        """Return a prepared part of a recording."""
        tool = bridged(measured.tool)
        rate = uniform_rate_hz(tool.stamps_ns)
        path = savgol(tool, max(round(HALF_WINDOW * rate), PATH_ORDER // 2 + 1), PATH_ORDER)
        first, last = path.stamps_ns[[0, -1]].tolist()
        seen = measured.package.stamps_ns[measured.package.valid]
        first = max(first, int(seen[0]) - ROW_NS)
        rows_ns = np.arange(first, last + 1, ROW_NS)
        return cls(measured, rows_ns, simulation.tool_rows(resample(path, rows_ns)), path.weights,
                   (first, last))

    @cached_property
    def package(self) -> Trajectory:
        """The valid poses of the package."""
        return self.measured.package.select(self.measured.package.valid)

    @cached_property
    def views(self) -> TagViews | None:
        """Views of a tag at the valid poses."""
        views = self.measured.views
        return None if views is None else views.at(self.package.stamps_ns)

    @cached_property
    def period(self) -> float:
        """Median time between poses of the package, s."""
        return float(np.median(np.diff(self.measured.package.stamps_ns))) / NS_PER_S

    @property
    def tool_period(self) -> float:
        """Time between poses of the tool, s."""
        return 1.0 / uniform_rate_hz(self.measured.tool.stamps_ns)

    @property
    def is_slow(self) -> bool:
        """Whether the noise of the package's poses is estimated jointly with K and P."""
        return self.measured.views is not None or self.period * LOW_RATE_HZ > 1.0

    @property
    def bin_ns(self) -> int:
        """Time between bins, ns: whole periods of the poses, for equal numbers of poses."""
        period = round(self.period * NS_PER_S)
        return period * -(-ROW_NS // period)

    @cached_property
    def place(self) -> Places:
        """Bin (N,) of each valid pose of the package."""
        since = self.package.stamps_ns - self.bins_ns
        return np.asarray((since + self.bin_ns // 2) // self.bin_ns)

    @property
    def bins_ns(self) -> int:
        """Stamp of the first bin, ns."""
        return int(max(self.rows_ns[0], self.package.stamps_ns[0]))

    @property
    def bins(self) -> int:
        """Number of bins."""
        last = min(int(self.rows_ns[-1]), int(self.package.stamps_ns[-1]))
        return max((last - self.bins_ns + self.bin_ns // 2) // self.bin_ns + 1, 1)

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
    def first(self) -> Course:
        """The motion as measured."""
        views = self.measured.views
        return Course(self.rows, np.zeros((self.bins, 6)), np.zeros(12),
                      self.measured.package_noise.std, views.tag.noise if views else USUAL_NOISE)

    def moved(self, shift: Array) -> Array:
        """
        Return rows of the tool after a change (M, 12) of its path.

        The change is of pose and twist in body axes, m, rad, m/s and rad/s.
        """
        rows, (d, phi, dv, dw) = self.rows, np.split(shift, 4, axis=1)
        v, w = rows[:, 7:10], rows[:, 10:]
        R = lie.quaternion_to_rotation(rows[:, 3:7])
        return np.hstack([
            rows[:, :3] + lie.apply(R, d), lie.rotation_to_quaternion(R @ lie.exp_so3(phi)),
            v + dv + np.cross(w, d) + np.cross(v, phi), w + dw + np.cross(w, phi)])


Segments = tuple[Segment, ...]
"""Those of one recording."""


def segments_of(measured: Sequence[MeasuredSegment]) -> Segments:
    """Return the prepared parts of a recording."""
    parts = list(map(Segment.of, measured))
    span = parts[0].span_ns[0], parts[-1].span_ns[1]
    return tuple(replace(part, span_ns=span) for part in parts)


class Outline(NamedTuple):
    """
    Facts on a recording that a fit needs beside sums over its poses.

    Parameters
    ----------
    payload, world, moves_with_com
        As of its segments.
    is_slow, is_tag : bool
        Whether its poses come slowly, and whether they are of a tag.
    poses : tuple of (int, int)
        Number of poses of the package, and of valid ones.
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
    poses: tuple[int, int]
    begin_ns: int
    ends_ns: tuple[tuple[int, int], ...]


def outline_of(segments: Segments) -> Outline:
    """Return the outline of a recording."""
    measured = segments[0].measured
    return Outline(
        measured.payload, measured.world, measured.moves_with_com,
        any(segment.is_slow for segment in segments), measured.views is not None,
        (sum(len(segment.measured.package) for segment in segments),
         sum(len(segment.package) for segment in segments)),
        int(min(segment.package.stamps_ns[0] for segment in segments)),
        tuple((int(segment.rows_ns[0]), int(segment.rows_ns[-1])) for segment in segments))
