"""
Registration: estimates of world, marker, clock and scale of recorded poses, before a fit.

A first guess needs no cup; then the free quantities are estimated jointly with K and P, and the
poses are prepared anew with the estimates.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.least_squares import likely_delay
from bellows_ros.core.identification.unknowns import KINDS, weak_prior
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment as frames
from bellows_ros.core.recording.preparation import prepare, with_tool_earlier
from bellows_ros.core.recording.recording import (
    PackageWorld,
    PrepareSettings,
    Recording,
    TimeOffset,
)
from bellows_ros.core.sensors.body import middle_of
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.residuals import DISPLAY_FACTORS
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import UndeterminedError
import numpy as np


class RegistrationSettings(NamedTuple):
    """
    Free quantities of a registration, and given values.

    Parameters
    ----------
    free : frozenset of str
        Names of fit.free.
    world : ndarray (7,) or None
        Given pose of the package's world in the tool's; None for an estimated or a common world.
    is_world_free : bool
        Whether this pose is estimated.
    is_exact : bool
        Whether the fit takes the estimated pose as exact.
    scale : float
        Factor by which the recorded positions of the package were multiplied.
    structure : Structure
        Structure of K and P.
    cup : Cup
        Initial cup.

    """

    free: frozenset[str]
    world: Array | None
    is_world_free: bool
    is_exact: bool
    scale: float
    structure: Structure
    cup: Cup

    @classmethod
    def of(cls, values: Values) -> 'RegistrationSettings':
        """Return the settings of parameters."""
        world = values.recording.package_world
        is_given = world not in ('', checks.ESTIMATE)
        return cls(
            frozenset(values.fit.free), frames.pose_of(world) if is_given else None,
            world == checks.ESTIMATE, values.fit.method == 'least_squares',
            values.measured.scale, conversion.given_structure(values),
            conversion.one_cup_of(values))

    def is_marked(self, settings: PrepareSettings) -> bool:
        """Return whether the marker is free: at rest an unknown world prevents its alignment."""
        return 'package_marker' in self.free or settings.align_at_rest and self.is_world_free


class Streams(NamedTuple):
    """Recorded poses of tool and package, and twists of the tool, if any."""

    tool: PoseStream
    package: PoseStream
    twist: TwistStream | None

    def with_tool_earlier(self, seconds: float) -> 'Streams':
        """Return the streams with earlier stamps of the tool."""
        return self._replace(
            tool=trajectory.earlier(self.tool, seconds),
            twist=self.twist and trajectory.earlier(self.twist, seconds))

    def prepared(
        self, settings: PrepareSettings, world: Array | None, alignment: frames.Alignment | None
    ) -> Recording:
        """Return the prepared streams, with a pose (7,) of the package's world if not common."""
        package = self.package
        if world is not None:
            package = frames.in_tool_world(package, world, self.tool.frame_id)
            settings = settings.in_world(world)
        return prepare(self.tool, package, settings, self.twist, alignment)


def registered_recording(
    streams: Streams, settings: PrepareSettings, given: RegistrationSettings
) -> Recording:
    """
    Return prepared streams, in the world of the tool and on its clock.

    Raises
    ------
    UndeterminedError
        If the poses do not determine the free quantities.

    """
    if 'time_offset' not in given.free:
        return _registered(streams, settings, given, 0.0)
    failures = []
    for rough_s in frames.rough_offsets(streams.tool.trajectory(), streams.package.trajectory()):
        try:
            return _registered(streams.with_tool_earlier(rough_s), settings, given, rough_s)
        except UndeterminedError as error:
            failures.append(error)
    raise failures[0]


def _registered(
    streams: Streams, settings: PrepareSettings, given: RegistrationSettings, rough_s: float
) -> Recording:
    """Return prepared streams, the tool's stamps of which are already earlier by rough_s, s."""
    world, alignment = _first_guess(streams, settings, given)
    recording = streams.prepared(settings, world, alignment)
    is_late, tells_clock = 'time_offset' in given.free, False
    if is_late:
        late_s = likely_delay(recording)
        if late_s:
            streams, rough_s = streams.with_tool_earlier(late_s), rough_s + late_s
            recording = streams.prepared(settings, world, alignment)
        tells_clock = late_s is not None or _turns_alike(streams)
    estimates = _estimates(recording, given, tells_clock)
    changes = dict[str, Any]()
    (scale,), _ = estimates.get('scale', (np.zeros(1), None))
    if scale and world is not None:
        streams, world, settings = _scaled(streams, world, settings, 1.0 + scale)
        changes['scale'] = float(1.0 + scale) * given.scale
    motion, motion_std = estimates.get('package_world', (None, np.zeros(6)))
    if given.is_exact:
        _require_world(motion_std)
    if motion is not None and world is not None:
        middle = middle_of(recording.tracked_package)[:3]
        world = frames.shifted_pose(world, settings.R_world_recorded, middle, motion)
        changes['package_world'] = PackageWorld(world, motion_std)
    marker, _ = estimates.get('package_marker', (np.zeros(6), None))
    recording = streams.prepared(settings, world, _realigned(recording.alignment, marker))
    if is_late:
        recording, more = _on_one_clock(recording, rough_s, *estimates.get(
            'time_offset', (np.zeros(1), np.array([np.inf]))))
        changes |= more
    return replace(recording, report=replace(recording.report, **changes))


def _turns_alike(streams: Streams) -> bool:
    """Return whether the rotations of both bodies can be compared."""
    lags, _ = frames.rotation_correlation(
        streams.tool.trajectory(), streams.package.trajectory())
    return len(lags) > 0


def _first_guess(
    streams: Streams, settings: PrepareSettings, given: RegistrationSettings
) -> tuple[Array | None, frames.Alignment | None]:
    """Return the pose (7,) of the package's world, and the alignment of a marker, or None."""
    is_marked, com = given.is_marked(settings), settings.payload.com
    if not (is_marked or given.is_world_free):
        return given.world, None
    to_lip = None
    if not is_marked:
        to_lip = np.zeros(3) if settings.package_frame == 'lip' else -com
    guess, grip = frames.hand_eye(
        streams.tool.trajectory(), streams.package.trajectory(), given.cup.length, com, to_lip)
    return guess if given.is_world_free else given.world, grip


def _estimates(
    recording: Recording, given: RegistrationSettings, tells_clock: bool
) -> Mapping[str, tuple[Array, Array]]:
    """Return the free ones of clock, world, marker and scale, estimated jointly with K and P."""
    is_free = {
        'time_offset': tells_clock, 'package_world': given.is_world_free,
        'package_marker': given.is_marked(recording.settings), 'scale': 'scale' in given.free}
    names = [name for name, free in is_free.items() if free]
    if not names:
        return {}
    found = fitting.registered(recording, given.structure, given.cup, weak_prior(names))
    return {name: found.estimate(name) for name in found.problem.places} if found else {}


def _scaled(
    streams: Streams, world: Array, settings: PrepareSettings, scale: float
) -> tuple[Streams, Array, PrepareSettings]:
    """Return streams, pose (7,) of the camera and settings, lengths scaled about the camera."""
    tag = settings.tag and replace(settings.tag, side=scale * settings.tag.side)
    origin = world[:3] if tag else scale * world[:3]
    package = replace(streams.package, position=scale * streams.package.position)
    return (streams._replace(package=package), np.append(origin, world[3:]),
            replace(settings, tag=tag))


def _realigned(alignment: frames.Alignment, marker: Array) -> frames.Alignment:
    """Return the alignment with the estimated error (6,) of the marker's frame."""
    R = lie.exp_so3(marker[3:])  # origin_to_com is in lip axes, rotated by R
    return replace(
        alignment, R_package_markers_lip=alignment.R_package_markers_lip @ R,
        origin_to_com=R.T @ (alignment.origin_to_com + marker[:3]))


def _on_one_clock(
    recording: Recording, rough_s: float, offset: Array, std: Array
) -> tuple[Recording, dict[str, Any]]:
    """Return a recording without the estimated offset (1,) of its clocks, s, and the report."""
    if std[0] < KINDS['time_offset'].max_std:
        return with_tool_earlier(recording, float(offset[0])), {
            'time_offset': TimeOffset(rough_s + float(offset[0]), float(std[0]))}
    return recording, {'remarks': (*recording.report.remarks, Finding('not_identifiable', numbers={
        'label': 'The time offset', 'why': 'the recorded stamps are used unchanged',
        'how': 'Record a motion that is richer in all directions'}))}


def _require_world(std: Array) -> None:
    """Raise for standard errors (6,) of an unidentifiable world, m and rad."""
    if np.any(std > KINDS['package_world'].max_std):
        each = [f'{x:.2g}' for x in DISPLAY_FACTORS * std]
        raise UndeterminedError(
            'recording.package_world is not identifiable from this recording: the standard '
            f'errors are {", ".join(each[:3])} mm and {", ".join(each[3:])} degrees. Tilt '
            'and turn the tool more, best with three standstills tilted to different sides, '
            'or set its seven numbers.')
