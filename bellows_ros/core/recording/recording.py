"""
A prepared recording: the input of fits, predictions and reports.

A recording is immutable. Expensive results, such as its noise or the statistics of a fit, are
computed at their first use and cached.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

from bellows_ros.core.findings import Finding
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import (
    apply,
    inverse_transform,
    log_so3,
    quaternion_to_rotation,
    transform,
)
from bellows_ros.core.model.cup_package import Package, STANDARD_GRAVITY
from bellows_ros.core.parameters.checks import ESTIMATE
from bellows_ros.core.recording.alignment import (
    Alignment,
    in_world,
    rest_of,
    REST_PART,
    world_rotation,
)
from bellows_ros.core.recording.outliers import Outliers
from bellows_ros.core.sensors.corners import CornerNoise, Tag, TagViews
from bellows_ros.core.signals import resampling, trajectory
from bellows_ros.core.signals.savgol import savgol, weights, whole_windows
from bellows_ros.core.signals.trajectory import (
    Filtered,
    PoseStream,
    same_frame,
    Trajectory,
    TwistStream,
)
from bellows_ros.errors import BellowsError, shown, UndeterminedError
import numpy as np

HALF_WINDOW = 4
"""Half window of a quartic that follows the motion of a package up to noise, samples."""

MAX_STEP_ERROR = 0.2
"""Largest relative deviation of uniform steps."""

NOISE_SAMPLES = 20_000
"""Smallest number of windows or samples for the noise, which gives the noise to 1 %."""

LOW_RATE_HZ = 100.0
"""Rate of poses below which polynomials do not follow the motion on a cup, Hz."""

MIN_SAMPLES_AT_REST = 10
"""Smallest number of poses at rest for their noise."""

MIN_STILL = 100
"""Smallest number of poses of a body at rest for the memory of the noise."""

MIN_CORRELATION = 0.2
"""Smallest correlation of neighbours that counts as memory of the noise."""


class PoseNoise(NamedTuple):
    """Standard deviation per axis of white noise: position (m) and rotation vector (rad)."""

    position: float
    rotation: float


def ripple(poses: Trajectory, half_window: int = HALF_WINDOW) -> tuple[Array, Array]:
    """
    Return residuals and rotations at the centres of polynomials through 2 n + 1 poses.

    Parameters
    ----------
    poses : Trajectory
        Poses, possibly with invalid samples; only windows of uniform steps are used, and of many
        windows only every second, third, ...
    half_window : int
        Number n of poses on each side, at least 2, of a quartic, or a cubic for 2.

    Returns
    -------
    array (M, 6), array (M, 3, 3)
        Position in the world (m) and rotation vector in body axes (rad); of valid windows.

    Raises
    ------
    UndeterminedError
        If there is no window of valid samples.

    """
    n, steps = half_window, np.diff(poses.stamps_ns)
    usual = float(np.median(steps)) if len(steps) else 1.0
    whole = ~(trajectory.any_within(~poses.valid, 2 * n + 1) | trajectory.any_within(
        np.abs(steps / usual - 1.0) > MAX_STEP_ERROR, 2 * n))
    step = max(len(whole) // NOISE_SAMPLES, 1)
    centres = n + step * np.flatnonzero(whole[::step])
    if not len(centres):
        raise UndeterminedError(
            f'The measurement noise cannot be estimated: no {2 * n + 1} valid samples in a row. '
            'Check the gaps and outliers in the report.')
    position, rotation = poses.position[centres], poses.rotation[centres]
    total = np.zeros((len(centres), 6))
    for j, weight in enumerate(weights(n, min(n + 1, 4), 1.0)[0].tolist(), start=-n):
        total += weight * np.hstack([
            poses.position[centres + j] - position,
            log_so3(np.swapaxes(rotation, 1, 2) @ poses.rotation[centres + j])])
    return total, rotation


def ripple_part(ar1: Array | float, half_window: int = HALF_WINDOW) -> Array:
    """Return the ratio of the ripple's variance and the noise's variance for first-order noise."""
    residue = -weights(half_window, min(half_window + 1, 4), 1.0)[0]
    residue[half_window] += 1.0
    steps = np.arange(len(residue))
    lags = np.abs(np.subtract.outer(steps, steps))
    return np.asarray(np.asarray(ar1)[..., None, None] ** lags @ residue @ residue)


def pose_noise(poses: Trajectory, ar1: Array | float) -> Array:
    """
    Return the standard deviations (6,) of poses at a uniform rate, in body axes, m and rad.

    The noise is of first order, with correlations (6,) from pose to pose. A recording without a
    valid window raises UndeterminedError.
    """
    residuals, rotation = ripple(poses)
    residuals[:, :3] = apply(np.swapaxes(rotation, 1, 2), residuals[:, :3])
    rms = np.sqrt(np.mean(_clipped(residuals) ** 2, axis=0))
    return np.asarray(rms / np.sqrt(ripple_part(ar1)))


def noise_at_rest(poses: Trajectory) -> 'BodyNoise':
    """Return the noise of poses of a body at rest; correlated poses count as fewer."""
    moved = _at_rest(poses)
    kept = max(_correlation(moved, 1), 0.0)
    count = max(len(moved) * (1.0 - kept) / (1.0 + kept), 2.0)
    return BodyNoise(
        np.sqrt(count / (count - 1.0) * np.mean(moved**2, axis=0)), independent=count)


def _correlation(moved: Array, lag: int) -> float:
    """Return the mean over axes of the autocorrelation of noise (N, 6) at a lag."""
    squares = np.maximum(np.sum(moved**2, axis=0), 1e-30)
    return float(np.mean(np.sum(moved[lag:] * moved[:-lag], axis=0) / squares))


def _at_rest(poses: Trajectory) -> Array:
    """Return shifts and rotations (N, 6) of a body at rest from its mean pose."""
    back = poses.rotation[0].T
    moved = np.hstack([apply(back, poses.position - poses.position[0]),
                       log_so3(back @ poses.rotation)])
    return _clipped(moved - moved.mean(axis=0))


def _clipped(residuals: Array) -> Array:
    """Return residuals (N, 6) clipped at five robust deviations."""
    limit = 5.0 * resampling.MAD_TO_STD * np.median(np.abs(residuals), axis=0)
    return np.clip(residuals, -limit, limit)


def noise_of(poses: Trajectory) -> PoseNoise:
    """
    Estimate the white noise of poses at a uniform rate.

    The estimate is the median residual of a local polynomial, insensitive to outliers. A
    noise-free recording gives its rounding. A recording without a valid window raises
    UndeterminedError.
    """
    scale = resampling.MAD_TO_STD / np.sqrt(ripple_part(0.0))  # the centre is part of the fit
    return PoseNoise(*(float(scale * np.median(part))
                       for part in np.hsplit(np.abs(ripple(poses)[0]), 2)))


class AR1Noise(NamedTuple):
    """Noise of first order: its standard deviation, and its correlation at lag 1."""

    size: float
    correlation: float


def ar1_noise_of(
    poses: Trajectory, noise: PoseNoise, still: Trajectory
) -> tuple[AR1Noise, AR1Noise]:
    """
    Return the noise of positions (m) and of rotations (rad) of poses at a uniform rate.

    The correlation is estimated while the body is still, unless the body swings or the rate is
    low. Otherwise the noise is white, or has the correlation time that explains the ratio of the
    noise of poses a stride apart to the given noise of neighbours; long times are uncertain.
    """
    rate_hz = trajectory.NS_PER_S / float(np.median(np.diff(poses.stamps_ns)))
    if LOW_RATE_HZ < rate_hz and len(still) > MIN_STILL:
        moved = _at_rest(still)
        kept, later = _correlation(moved, 1), _correlation(moved, 2)
        if kept > MIN_CORRELATION and later < 0.5 * kept * (1.0 + kept):
            part = float(np.sqrt(ripple_part(kept) / ripple_part(0.0)))
            return AR1Noise(noise.position / part, kept), AR1Noise(noise.rotation / part, kept)
    stride = max(round(0.06 * rate_hz / (2 * HALF_WINDOW)), 1)  # samples in 0.06 s
    try:
        wide = noise_of(poses.select(slice(None, None, stride))) if stride > 1 else noise
    except UndeterminedError:
        wide = noise
    times = np.array([1e-12, *np.geomspace(1.0, 200.0, 24)]) / 1e3  # the first is nearly white
    ar1 = np.exp(-1.0 / (times * rate_hz))
    sizes = np.sqrt(ripple_part(np.stack([ar1, ar1**stride], axis=1)) / ripple_part(0.0))
    ratios = sizes[:, 1] / sizes[:, 0]

    def fitted(one: float, other: float) -> AR1Noise:
        """Return the noise with given sizes in neighbours and in poses a stride apart."""
        ratio = other / one if one > 0.0 else 1.0
        at = int(np.argmin(np.abs(ratios - ratio))) if ratio > 1.15 else 0  # less is chance
        return AR1Noise(one / float(sizes[at, 0]), float(ar1[at]))

    return fitted(noise.position, wide.position), fitted(noise.rotation, wide.rotation)


class BodyNoise(NamedTuple):
    """
    Noise of a body's poses: standard deviations (6,), and correlations (6,) from pose to pose.

    `independent` is the equivalent number of independent poses of the estimate.
    """

    std: Array
    correlation: Array | float = 0.0
    independent: float = np.inf


T = TypeVar('T')


@dataclass(frozen=True)
class PrepareSettings:
    """
    Settings of the preparation, named as their parameters.

    Parameters
    ----------
    world : str
        recording.world: 'z_up' or 'motive_y_up' (4.1).
    gravity_direction : tuple of 3 floats
        Direction of gravity in that world, gravity.direction.
    package_frame : str
        recording.package_frame: 'com' or 'lip'.
    align_at_rest : bool
        recording.align_at_rest: whether (4.2-4.13) are applied.
    payload : Package
        Mass, inertia and centre of mass B in S of the package, package.*.
    gravity : float
        Magnitude of gravity along -z of the levelled world, gravity.magnitude, m/s^2.
    tool_half_window, tool_order, package_half_window, package_order : int
        Filters of the poses; a half window of 0 is chosen from the rate.
    tool_twist_frame : str
        Axes of a recorded tool twist, 'world' or 'tool' (tool_twist.frame); its linear part is the
        velocity of the tool tip.
    tag : Tag or None
        The detected tag of which the package's poses are, and its camera (measured.*).

    """

    world: str = 'z_up'
    gravity_direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    package_frame: str = 'com'
    align_at_rest: bool = False
    payload: Package = Package(1.0, 0.01 * np.eye(3), np.zeros(3))
    gravity: float = STANDARD_GRAVITY
    tool_half_window: int = 0
    tool_order: int = 6
    package_half_window: int = 0
    package_order: int = 6
    tool_twist_frame: str = 'world'
    tag: Tag | None = None

    @property
    def moves_with_com(self) -> tuple[bool, bool, bool]:
        """Components of the centre of mass that shift the poses of B."""
        lip = self.package_frame == 'lip'
        return (lip or self.align_at_rest, lip or self.align_at_rest, lip)

    def in_world(self, pose: Array) -> 'PrepareSettings':
        """Return the settings for a package whose world has a pose (7,) in the tool's world."""
        T = transform(quaternion_to_rotation(pose[3:]), pose[:3])
        return replace(self, tag=self.tag and self.tag.moved(T))

    @cached_property
    def R_world_recorded(self) -> Array:
        """Rotation from recorded axes to a world with z up."""
        return world_rotation(self.world, self.gravity_direction)


@dataclass(frozen=True, eq=False)
class StreamReport:
    """
    The report on the poses of one topic.

    Parameters
    ----------
    recorded : PoseStream
        The recorded poses, and the omitted messages.
    timing : Timing
        Rate, jitter and gaps.
    outliers : Outliers
        Marked poses, lasting steps and noise.
    overlapping_gap : int
        Number of filtered samples omitted because their windows contain invalid ones.
    interpolated : int
        Number of lost or marked poses, at most two in succession, interpolated by the filter.
    arrival_jitter : float
        Jitter of times of arrival that times of sampling replaced, s; 0 if none were replaced.

    """

    recorded: PoseStream
    timing: resampling.Timing
    outliers: Outliers
    overlapping_gap: int = 0
    interpolated: int = 0
    arrival_jitter: float = 0.0

    @property
    def repeated_stamps(self) -> int:
        """Number of messages omitted because of repeated stamps."""
        return len(self.recorded.refused.get('duplicate_stamp', ()))

    @property
    def marked(self) -> int:
        """Number of poses marked as wrong."""
        return int(np.count_nonzero(~self.outliers.good))

    def as_json(self) -> dict[str, Any]:
        """Return the report on the topic's messages, for a JSON file."""
        return {
            'topic': self.recorded.name, 'poses': len(self.recorded),
            'rate_hz': self.timing.rate_hz,
            'refused': {reason: list(where) for reason, where in self.recorded.refused.items()},
            'outliers': self.marked,
            'arrival_stamps_replaced': len(self.recorded) if self.arrival_jitter > 0.0 else 0,
            'gaps': [{'start_ns': gap.start_ns, 'duration_s': gap.duration_s}
                     for gap in self.timing.gaps],
            'interpolated_poses': self.interpolated,
            'filtered_samples_left_out': self.overlapping_gap}


class PackageWorld(NamedTuple):
    """
    The estimated pose of the package's world in the tool's.

    Position (m) and quaternion (x y z w) (7,), and standard errors (6,) of the position at the
    middle of the package's path (m) and of the rotation (rad), in axes of the tool's world.
    """

    pose: Array
    std: Array

    def as_json(self) -> dict[str, Any]:
        """Return the report for a JSON file."""
        return {
            'position': self.pose[:3], 'quaternion_xyzw': self.pose[3:],
            'position_std': self.std[:3], 'rotation_std': self.std[3:]}


class TimeOffset(NamedTuple):
    """Delay of the tool's stamps behind the package's, and its standard error, s."""

    value: float
    std: float


@dataclass(frozen=True, eq=False)
class RecordingReport:
    """
    The report on a recording.

    Parameters
    ----------
    tool, package : StreamReport
        Reports on the two topics.
    remarks : tuple of Finding
        Facts on the poses and on their alignment.
    time_offset : TimeOffset or None
        Offset subtracted from the tool's stamps, None if not requested or not identifiable.
    package_world : PackageWorld or None
        Estimated transform between two worlds, None if not requested.
    scale : float
        Estimated factor of the package's positions about the camera.

    """

    tool: StreamReport
    package: StreamReport
    remarks: tuple[Finding, ...] = ()
    time_offset: TimeOffset | None = None
    package_world: PackageWorld | None = None
    scale: float = 1.0


MIN_SEGMENT = 1.0
"""Shortest segment, s."""

LONGEST_GAP = 0.15
"""Longest gap of the tool that a prediction bridges, s: 1 mm in a motion of 10 mm at 3 Hz."""


class Span(NamedTuple):
    """First and last stamp (ns) of a segment, and its range of common stamps."""

    first_ns: int
    last_ns: int
    samples: slice


@dataclass(frozen=True, eq=False)
class Filter:
    """Aligned poses at a uniform rate, and their filter (4.15-4.63)."""

    poses: Trajectory
    half_window: int
    order: int
    weights: Array
    """See `trajectory.Filtered`."""

    @property
    def stamps_ns(self) -> Stamps:
        """Stamps of the filtered poses, ns."""
        return self.poses.stamps_ns[self.half_window:-self.half_window]

    @property
    def whole(self) -> Mask:
        """Mask of the filtered poses without gaps and outliers in their windows."""
        return whole_windows(self.poses, self.half_window)

    def is_whole_at(self, stamps_ns: Stamps) -> Mask:
        """Return whether the filtered poses next to some stamps are `whole`."""
        before = np.searchsorted(self.stamps_ns, stamps_ns, side='right') - 1
        return np.asarray(
            self.whole[before] & self.whole[np.searchsorted(self.stamps_ns, stamps_ns)])

    def filtered(self) -> Filtered:
        """Return the filtered poses, 0.2 kB per sample."""
        return savgol(self.poses, self.half_window, self.order)


@dataclass(frozen=True, eq=False)
class Recording:
    """
    Motion of tool and package at common stamps, at the package's rate.

    Parameters
    ----------
    settings : PrepareSettings
        Settings of the preparation, with the package.
    tool_pose, package_pose : PoseStream
        Recorded poses, with a time offset subtracted from the tool's stamps.
    tool_twist : TwistStream or None
        Recorded twists of the tool, None without any.
    filters : (Filter, Filter)
        Filters of tool and package, each at a uniform rate, from start to end.
    measured_tool, measured_package : Trajectory
        E and B aligned but not filtered. The tool has the recorded body twists, if any; samples
        with missing or wrong poses or twists are invalid.
    tracked_package : Trajectory
        B aligned but not filtered, from start to end, at the stamps of the measurements. Uniform
        stamps include missing, invalid ones. Others are not interpolated: the motion between the
        poses of a slow camera is unknown.
    alignment : Alignment
        Transformations from the recorded frames to E and B.
    report : RecordingReport
        Omitted data, and the reasons.
    name : str
        Path of a rosbag2 folder or file as given by the user; '' without a file.
    digest : str
        Digest of its stored messages, independent of the path; '' if not requested.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.
    seen : TagViews, optional
        Views of a tag with the estimates of a fit, instead of the settings.

    """

    settings: PrepareSettings
    tool_pose: PoseStream
    package_pose: PoseStream
    tool_twist: TwistStream | None
    filters: tuple[Filter, Filter]
    measured_tool: Trajectory
    measured_package: Trajectory
    tracked_package: Trajectory
    alignment: Alignment
    report: RecordingReport
    name: str = ''
    digest: str = ''
    files: tuple[Mapping[str, Any], ...] = ()
    seen: TagViews | None = None
    _cache: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def cached(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return a result, computed at the first request and cached."""
        if key not in self._cache:
            self._cache[key] = make()
        result: T = self._cache[key]
        return result

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings of the preparation and of the checks."""
        return self.report.remarks

    @cached_property
    def tool(self) -> Trajectory:
        """Tool tip E in the world, filtered, with body twists of the filter."""
        return resampling.resample(
            self.filters[0].filtered(), self.measured_tool.stamps_ns,
            self.report.tool.timing.longest_step_ns)

    @cached_property
    def package(self) -> Trajectory:
        """Centre of mass B in the world, filtered, with body twists and their derivatives."""
        return self.filters[1].filtered().between(*self.measured_tool.stamps_ns[[0, -1]])

    @property
    def aligned_tool(self) -> Trajectory:
        """E aligned but not filtered, at a uniform rate, from start to end."""
        return self.filters[0].poses

    @property
    def aligned_package(self) -> Trajectory:
        """B aligned but not filtered, at a uniform rate, from start to end."""
        return self.filters[1].poses

    @property
    def payload(self) -> Package:
        """The package in this recording."""
        return self.settings.payload

    @property
    def valid(self) -> Mask:
        """Samples (N,) with usable filtered poses of both bodies."""
        return self.tool.valid & self.package.valid

    @property
    def whole(self) -> Mask:
        """Samples (N,) with windows of both filters free of gaps and outliers."""
        of_tool, of_package = (
            body.is_whole_at(self.measured_tool.stamps_ns) for body in self.filters)
        return of_tool & of_package

    @property
    def measured(self) -> Mask:
        """Mask (N,) of the valid unfiltered samples of both bodies."""
        return self.measured_tool.valid & self.measured_package.valid

    def segments(self, longest_gap: float = LONGEST_GAP) -> tuple[Span, ...]:
        """
        Return the segments between gaps of the tool above a length (s), each with its own start.

        In a gap of the package alone its motion follows from the tool's. Segments without a pose
        of the package are omitted.
        """
        stamps, common = self.aligned_tool.stamps_ns, self.measured_tool.stamps_ns
        stamps = stamps[self.aligned_tool.valid & (stamps >= common[0]) & (stamps <= common[-1])]
        cuts = np.flatnonzero(np.diff(stamps) > longest_gap * trajectory.NS_PER_S)
        spans = [Span(first, last, slice(*np.searchsorted(common, [first, last + 1]).tolist()))
                 for first, last in zip(stamps[np.append(0, cuts + 1)].tolist(),
                                        stamps[np.append(cuts, -1)].tolist(), strict=True)]
        return tuple(
            span for span in spans
            if span.last_ns - span.first_ns >= MIN_SEGMENT * trajectory.NS_PER_S
            and self.measured_package.valid[span.samples].any())

    @cached_property
    def noise(self) -> tuple[PoseNoise, PoseNoise]:
        """White noise of the measured poses of tool and package, each at its own stamps."""
        return noise_of(self.aligned_tool), noise_of(self.aligned_package)

    @cached_property
    def ar1_noise(self) -> tuple[tuple[AR1Noise, AR1Noise], tuple[AR1Noise, AR1Noise]]:
        """Time correlation of the noise of tool and package, in position and rotation."""
        tool, package = (
            ar1_noise_of(poses, noise, self._still(poses)) for poses, noise in zip(
                (self.aligned_tool, self.aligned_package), self.noise, strict=True))
        return tool, package

    @cached_property
    def body_noise(self) -> tuple[BodyNoise, BodyNoise]:
        """
        Noise of tool and package per axis, each at the stamps of the body.

        Polynomials do not follow a package between slow poses; the noise is then estimated at
        rest.
        """
        of_tool, of_package = (
            BodyNoise(pose_noise(poses, ar1), ar1) for poses, ar1 in zip(
                (self.aligned_tool, self.aligned_package),
                (np.repeat([part.correlation for part in body], 3) for body in self.ar1_noise),
                strict=True))
        if self.report.package.timing.rate_hz < LOW_RATE_HZ:
            still = self._still(self.tracked_package)
            if len(still) >= MIN_SAMPLES_AT_REST:
                of_package = noise_at_rest(still)
        return of_tool, of_package

    @cached_property
    def views(self) -> TagViews | None:
        """The corners of a tag at the stamps of the measurements; None for a tracked body."""
        if self.seen is not None or self.settings.tag is None:
            return self.seen
        level = transform(self.settings.R_world_recorded, np.zeros(3))
        origin = self.alignment.package(Trajectory(
            np.zeros(1, np.int64), np.zeros((1, 3)), np.eye(3)[None]))
        poses = in_world(self.package_pose.trajectory(), level[:3, :3])
        return TagViews.of(
            self.settings.tag.moved(level),
            replace(self.package_pose, position=poses.position, rotation=poses.rotation),
            inverse_transform(transform(origin.rotation[0], origin.position[0])))

    def with_noise(self, noise: Array) -> 'Recording':
        """Return the recording of a tag with another `CornerNoise` (2,)."""
        assert self.views is not None
        return replace(self, seen=replace(self.views, tag=replace(
            self.views.tag, noise=CornerNoise(*noise.tolist()))))

    def poses_near(self, package: Trajectory) -> tuple[Trajectory, Array]:
        """
        Return the measured poses of B at stamps of simulated ones, with errors (6,), m and rad.

        A flat tag has two solutions; the pose near the simulation is returned.
        """
        if self.views:
            return self.views.at(package.stamps_ns).poses_near(package)
        return self.tracked_package.between(
            *package.stamps_ns[[0, -1]]), self.body_noise[1].std

    def _still(self, poses: Trajectory) -> Trajectory:
        """Return the valid poses of a body while both bodies are at rest at the beginning."""
        tool, package = self.aligned_tool, self.tracked_package
        first = max(tool.stamps_ns[0], package.stamps_ns[0])
        rest_ns = REST_PART * rest_of(tool, package).seconds * trajectory.NS_PER_S
        still = poses.between(first, first + int(rest_ns))
        return still.select(still.valid)

    @property
    def start_ns(self) -> int:
        """First stamp of the recording, ns; the filtered part begins half a window later."""
        streams = (self.tool_pose, self.package_pose, self.tool_twist)
        return min(int(stream.stamps_ns[0]) for stream in streams if stream is not None)

    def since_start(self, stamps_ns: Stamps) -> Array:
        """Return times from the first recorded stamp, s (N,)."""
        return (stamps_ns - self.start_ns) / trajectory.NS_PER_S

    def as_json(self) -> dict[str, Any]:
        """Return the report on the recording, for a JSON file."""
        payload = self.payload
        return {
            'bag': self.name,
            'samples': len(self.valid), 'valid': int(np.count_nonzero(self.valid)),
            'tool_pose': self.report.tool.as_json(), 'package_pose': self.report.package.as_json(),
            'time_offset': self.report.time_offset, 'package_world': self.report.package_world,
            'package': {'mass': payload.mass, 'inertia': payload.inertia, 'com': payload.com},
            'noise': dict(zip(('tool', 'package'), self.noise, strict=True)),
            'lateral_offset': self.alignment.lateral_offset,
            'findings': self.report.remarks}


def require_one_frame(tool: PoseStream, package: PoseStream) -> None:
    """
    Raise BellowsError for poses in two frames without a transform between them.

    Raises
    ------
    BellowsError
        The error has the remedy.

    """
    if not same_frame(tool.frame_id, package.frame_id):
        raise BellowsError(
            f"The poses of '{tool.name}' are in frame '{shown(tool.frame_id)}', those of "
            f"'{package.name}' in '{shown(package.frame_id)}', and the transform between the two "
            f'is unknown. Set recording.package_world: {ESTIMATE} to estimate it, or give its '
            "seven numbers (x y z qx qy qz qw); '0 0 0 0 0 0 1' if both names mean one frame.")
