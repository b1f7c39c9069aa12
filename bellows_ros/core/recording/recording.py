"""
A recording after reading and preparation: the input of everything that follows.

It is never changed. What is expensive and asked for more than once, such as its noise or the
statistics of a fit, is computed when it is first asked for and kept with it.
"""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.model import Package, STANDARD_GRAVITY
from bellows_ros.core.parameter_table import short
from bellows_ros.core.parameters import ESTIMATE
from bellows_ros.core.recording.alignment import Alignment, BodyStandstill, world_rotation
from bellows_ros.core.recording.noise import (
    Colour,
    colours_of,
    FilterNoise,
    Noise,
    noise_of,
    resampled_weights,
)
from bellows_ros.core.recording.outliers import Outliers
from bellows_ros.core.resampling import Timing
from bellows_ros.core.trajectory import NS_PER_S, PoseStream, Trajectory, TwistStream
from bellows_ros.errors import BellowsError
import numpy as np

T = TypeVar('T')


@dataclass(frozen=True)
class PrepareSettings:
    """
    How recorded streams become a recording; the names of the parameters they stand for.

    Parameters
    ----------
    world : str
        recording.world: 'z_up' or 'motive_y_up' (4.1).
    gravity_direction : tuple of 3 floats
        gravity.direction in that world.
    package_frame : str
        recording.package_frame: 'com' or 'lip'.
    align_at_rest : bool
        recording.align_at_rest: whether (4.2-4.13) are applied.
    rest_duration : float
        recording.rest_duration, s.
    payload : Package
        package.*: mass, inertia and centre of mass B in S of the package.
    gravity : float
        gravity.magnitude, m/s^2 along -z of the world once it is level.
    tool_half_window, tool_order, package_half_window, package_order : int
        filter.tool.half_window and so on; a half window of 0 is chosen from the rate.
    relative : bool
        filter.relative: whether `Recording.samples` are of the lip's filtered motion in the tool.
    tool_twist_frame : str
        tool_twist.frame: axes of a recorded tool twist, 'world' or 'tool'; its linear part is the
        velocity of the tool tip.

    """

    world: str = 'z_up'
    gravity_direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    package_frame: str = 'com'
    align_at_rest: bool = False
    rest_duration: float = 1.0
    payload: Package = Package(1.0, np.eye(3), np.zeros(3))
    gravity: float = STANDARD_GRAVITY
    tool_half_window: int = 0
    tool_order: int = 6
    package_half_window: int = 0
    package_order: int = 6
    relative: bool = False
    tool_twist_frame: str = 'world'

    @cached_property
    def R_world_recorded(self) -> Array:
        """The rotation from recorded axes to a world whose z is up."""
        return world_rotation(self.world, self.gravity_direction)


@dataclass(frozen=True, eq=False)
class StreamReport:
    """
    What became of the poses of one topic.

    Parameters
    ----------
    name : str
        Topic.
    samples : int
        Poses the stream has.
    refused : mapping of str to tuple of int
        Reason to the indices of the messages that were left out when reading.
    timing : Timing
        Rate, jitter, and gaps by sample.
    outliers : Outliers
        Excursions, frozen poses and steps, by sample, and the noise.
    filled : int
        Samples missing in gaps, put in as invalid.
    touched : int
        Filtered samples left out because their windows touch invalid ones.
    standstill : BodyStandstill or None
        What alignment found, in the world, of the recorded frame.

    """

    name: str
    samples: int
    refused: Mapping[str, tuple[int, ...]]
    timing: Timing
    outliers: Outliers
    filled: int
    touched: int
    standstill: BodyStandstill | None

    @property
    def marked(self) -> int:
        """Poses marked as wrong."""
        return int(np.count_nonzero(~self.outliers.good))

    def as_json(self) -> dict[str, Any]:
        """Return what became of the topic's messages, for a JSON file."""
        return {
            'topic': self.name,
            'poses': self.samples,
            'rate_hz': self.timing.rate_hz,
            'refused': {reason: list(where) for reason, where in self.refused.items()},
            'outliers': self.marked,
            'gaps': [{'start_ns': gap.start_ns, 'duration_s': gap.duration_s}
                     for gap in self.timing.gaps],
            'filtered_samples_left_out': self.touched,
        }


class PackageWorld(NamedTuple):
    """
    The pose of the package's world in the tool's, as it was found.

    Position (m) and quaternion (x y z w) (7,), and standard errors (6,) of the position at the
    middle of the package's way (m) and of the rotation (rad), in axes of the tool's world.
    """

    pose: Array
    std: Array

    def as_json(self) -> dict[str, Any]:
        """Return it with its units, for a JSON file."""
        return {
            'position': self.pose[:3], 'quaternion_xyzw': self.pose[3:],
            'position_std': self.std[:3], 'rotation_std': self.std[3:],
            'units': {'position': 'm', 'quaternion_xyzw': '1', 'position_std': 'm',
                      'rotation_std': 'rad'},
        }


class TimeOffset(NamedTuple):
    """Time by which the stamps of the tool are behind those of the package, and its error, s."""

    value: float
    std: float

    def as_json(self) -> dict[str, Any]:
        """Return it with its unit, for a JSON file."""
        return {**self._asdict(), 'unit': 's'}


@dataclass(frozen=True, eq=False)
class Report:
    """
    What became of a recording.

    Parameters
    ----------
    tool, package : StreamReport
        Of the two topics.
    samples, valid : int
        Common samples, and those of them to be used.
    warnings : tuple of str
        What the user should know, in words.
    time_offset : TimeOffset or None
        What was taken from the tool's stamps, where that was wanted and could be found.
    package_world : PackageWorld or None
        The transform between two worlds, where that was to be found.

    """

    tool: StreamReport
    package: StreamReport
    samples: int
    valid: int
    warnings: tuple[str, ...]
    time_offset: TimeOffset | None = None
    package_world: PackageWorld | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """
    Motion of tool and package at common stamps, at the package's rate.

    Parameters
    ----------
    settings : PrepareSettings
        How it was prepared; it holds the package.
    tool_pose, package_pose : PoseStream
        As recorded, but for a time offset that was taken from the tool's stamps.
    tool_twist : TwistStream or None
        The same of the tool's twists, where there are any.
    tool : Trajectory
        Tool tip E in the world, filtered, with body twists of the filter.
    package : Trajectory
        Centre of mass B in the world, filtered, with body twists and their derivatives.
    measured_tool, measured_package : Trajectory
        E and B aligned but not filtered. The tool has the recorded body twists where there are
        any; where poses or twists are missing or wrong, samples are not valid.
    aligned_tool, aligned_package : Trajectory
        E and B aligned but not filtered, each at its own uniform rate, from start to end.
    tool_weights, package_weights : array (3, 2n+1)
        Weights of the filters (see `Filtered`).
    alignment : Alignment
        From the recorded frames to E and B.
    report : Report
        What was left out, and why.
    name : str
        What the user calls it: the path of a rosbag2 folder or file; '' for one of no file.
    digest : str
        Of its messages as stored, the same wherever they lie; '' where nobody asked for it.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.

    """

    settings: PrepareSettings
    tool_pose: PoseStream
    package_pose: PoseStream
    tool_twist: TwistStream | None
    tool: Trajectory
    package: Trajectory
    measured_tool: Trajectory
    measured_package: Trajectory
    aligned_tool: Trajectory
    aligned_package: Trajectory
    tool_weights: Array
    package_weights: Array
    alignment: Alignment
    report: Report
    name: str = ''
    digest: str = ''
    files: tuple[Mapping[str, Any], ...] = ()
    _kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return what is made of the recording for a key: made when it is first asked for."""
        if key not in self._kept:
            self._kept[key] = make()
        found: T = self._kept[key]
        return found

    @property
    def payload(self) -> Package:
        """The package in this recording."""
        return self.settings.payload

    @property
    def valid(self) -> Mask:
        """Where both filtered poses are to be used (N,)."""
        return self.tool.valid & self.package.valid

    @property
    def measured(self) -> Mask:
        """Where both unfiltered poses are to be used (N,)."""
        return self.measured_tool.valid & self.measured_package.valid

    @cached_property
    def noise(self) -> FilterNoise:
        """White noise of the poses as they were measured, and the filters that it went through."""
        return FilterNoise(
            noise_of(self.aligned_tool),
            noise_of(self.aligned_package),
            resampled_weights(
                self.aligned_tool.stamps_ns, self.tool.stamps_ns, self.tool_weights),
            self.package_weights,
            self.tool_weights.shape[1] // 2,
        )

    @cached_property
    def colours(self) -> tuple[tuple[Colour, Colour], tuple[Colour, Colour]]:
        """Noise of tool and package as it is correlated in time, of positions and rotations."""
        return (colours_of(self.aligned_tool, self.noise.tool),
                colours_of(self.aligned_package, self.noise.package))

    @cached_property
    def measured_noise(self) -> tuple[Noise, Noise]:
        """White noise of tool and package at the common stamps."""
        return noise_of(self.measured_tool), noise_of(self.measured_package)

    @property
    def start_ns(self) -> int:
        """First stamp of what was recorded, ns; the filters begin half a window later."""
        streams = (self.tool_pose, self.package_pose, self.tool_twist)
        return min(int(stream.stamps_ns[0]) for stream in streams if stream is not None)

    def since_start(self, stamps_ns: Stamps) -> Array:
        """Return times from the first recorded stamp, s (N,)."""
        return (stamps_ns - self.start_ns) / NS_PER_S

    def as_json(self) -> dict[str, Any]:
        """Return what became of the recording, for a JSON file."""
        noise, payload, offset = self.noise, self.payload, self.report.time_offset
        world = self.report.package_world
        return {
            'bag': self.name,
            'samples': self.report.samples,
            'valid': self.report.valid,
            'tool_pose': self.report.tool.as_json(),
            'package_pose': self.report.package.as_json(),
            'time_offset': offset and offset.as_json(),
            'package_world': world and world.as_json(),
            'package': {
                'mass': payload.mass, 'inertia': payload.inertia, 'com': payload.com,
                'units': {'mass': 'kg', 'inertia': 'kg m^2', 'com': 'm'},
            },
            'noise': {
                body: {**own._asdict(), 'units': {'position': 'm', 'rotation': 'rad'}}
                for body, own in (('tool', noise.tool), ('package', noise.package))
            },
            'lateral_offset': {'value': self.alignment.lateral_offset, 'unit': 'm'},
            'warnings': self.report.warnings,
        }


def require_one_frame(tool: PoseStream, package: PoseStream) -> None:
    """
    Refuse poses in two frames between which no transform is given.

    Raises
    ------
    BellowsError
        With the remedy.

    """
    if tool.frame_id and package.frame_id and tool.frame_id != package.frame_id:
        raise BellowsError(
            f"The poses of '{tool.name}' are in frame '{short(tool.frame_id)}', those of "
            f"'{package.name}' in '{short(package.frame_id)}', and the transform between the two "
            f'is unknown. Set recording.package_world: {ESTIMATE} to estimate it, or give its '
            "seven numbers (x y z qx qy qz qw); '0 0 0 0 0 0 1' if both names mean one frame."
        )
