"""Registration of recorded streams: estimates of world, marker and clock that are not given."""

from dataclasses import replace
from typing import Any

from bellows_ros.core.findings import Finding
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import output_error
from bellows_ros.core.identification.estimate import Solution
from bellows_ros.core.identification.quantities import KINDS, weak_prior
from bellows_ros.core.identification.samples import likely_delay
from bellows_ros.core.parameters import checks
from bellows_ros.core.parameters.conversion import given_structure, one_cup_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment as frames
from bellows_ros.core.recording import recording as prepared
from bellows_ros.core.recording.preparation import prepare, with_tool_earlier
from bellows_ros.core.recording.recording import PrepareSettings, Recording, TimeOffset
from bellows_ros.core.sensors.body import middle_of
from bellows_ros.core.sensors.corners import CornerNoise
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.residuals import DISPLAY_FACTORS
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import UndeterminedError
import numpy as np


def registered_recording(
    tool: PoseStream, package: PoseStream, twist: TwistStream | None, settings: PrepareSettings,
    values: Values,
) -> Recording:
    """Return prepared streams, in the world of the tool and on its clock."""
    failures, is_late = [], 'time_offset' in values.fit.free
    for rough_s in frames.rough_offsets(
            tool.trajectory(), package.trajectory()) if is_late else (0.0,):
        try:
            return _registered(
                trajectory.earlier(tool, rough_s), package,
                twist and trajectory.earlier(twist, rough_s), settings, values, rough_s)
        except UndeterminedError as error:
            failures.append(error)
    raise failures[0]


def _registered(
    tool: PoseStream, package: PoseStream, twist: TwistStream | None, settings: PrepareSettings,
    values: Values, rough_s: float,
) -> Recording:
    """Return prepared streams with clocks that differ by about rough_s, s."""
    marked = _is_marked(settings, values)
    pose, alignment = _first_guess(tool, package, settings, values, marked)

    def filtered(alignment: frames.Alignment | None) -> Recording:
        if pose is None:
            return prepare(tool, package, settings, twist, alignment)
        moved = frames.in_tool_world(package, pose, tool.frame_id)
        return prepare(tool, moved, settings.in_world(pose), twist, alignment)

    recording = filtered(alignment)
    is_late = 'time_offset' in values.fit.free
    late_s = likely_delay(recording) if is_late else None
    if late_s:
        tool = trajectory.earlier(tool, late_s)
        twist = twist and trajectory.earlier(twist, late_s)
        rough_s, recording = rough_s + late_s, filtered(alignment)
    tells_clock = is_late and (late_s is not None or _turn(tool, package))
    found = _estimated(recording, values, tells_clock, marked)
    changes, estimates = dict[str, Any](), {
        name: found.estimate(name) for name in found.problem.places} if found else {}
    world, world_std = estimates.get('package_world', (None, np.zeros(6)))
    _require_world(values.fit.method, world_std)
    (scale,), _ = estimates.get('scale', (np.zeros(1), None))
    if scale and pose is not None:
        package, pose, settings = _scaled(package, pose, settings, 1.0 + scale)
        changes['scale'] = float(1.0 + scale) * values.measured.scale
    if world is not None and pose is not None:
        pose = frames.shifted_pose(pose, settings.R_world_recorded, middle_of(
            recording.tracked_package)[:3], world)
        changes['package_world'] = prepared.PackageWorld(pose, world_std)
    if settings.tag and found:
        settings = replace(settings, tag=replace(
            settings.tag, noise=CornerNoise(*found.noise_in_motion[0].tolist())))
    marker, _ = estimates.get('package_marker', (np.zeros(6), None))
    recording = filtered(_realigned(recording.alignment, marker))
    (offset,), (std,) = estimates.get('time_offset', (np.zeros(1), np.array([np.inf])))
    if std < KINDS['time_offset'].max_std:
        recording = with_tool_earlier(recording, float(offset))
        changes['time_offset'] = TimeOffset(rough_s + float(offset), float(std))
    elif is_late:
        changes['remarks'] = (*recording.report.remarks, Finding('no_offset'))
    return replace(recording, report=replace(recording.report, **changes))


def _is_marked(settings: PrepareSettings, values: Values) -> bool:
    """Return whether the marker is free: at rest none can be aligned with an unknown world."""
    return 'package_marker' in values.fit.free or settings.align_at_rest and (
        values.recording.package_world == checks.ESTIMATE)


def _turn(tool: PoseStream, package: PoseStream) -> bool:
    """Return whether the bodies turn enough to tell their clocks."""
    return len(frames.rotation_correlation(tool.trajectory(), package.trajectory())[0]) > 0


def _estimated(
    recording: Recording, values: Values, tells_clock: bool, marked: bool
) -> Solution | None:
    """Return the fit of K and P with the free ones of clock, world, marker and scale, if any."""
    names = [name for name, free in (
        ('time_offset', tells_clock),
        ('package_world', values.recording.package_world == checks.ESTIMATE),
        ('package_marker', marked), ('scale', 'scale' in values.fit.free)) if free]
    return output_error.registered(
        recording, given_structure(values), one_cup_of(values), weak_prior(names),
    ) if names else None


def _scaled(
    package: PoseStream, pose: Array, settings: PrepareSettings, scale: float
) -> tuple[PoseStream, Array, PrepareSettings]:
    """Return poses, camera pose (6,) and settings with lengths scaled about the camera."""
    tag = settings.tag and replace(settings.tag, side=scale * settings.tag.side)
    origin = pose[:3] if tag else scale * pose[:3]
    return (replace(package, position=scale * package.position), np.append(origin, pose[3:]),
            replace(settings, tag=tag))


def _realigned(alignment: frames.Alignment, marker: Array) -> frames.Alignment:
    """Return the alignment with the estimated error (6,) of the marker's frame."""
    R = lie.exp_so3(marker[3:])  # origin_to_com is in lip axes, rotated by R
    return replace(
        alignment, R_package_markers_lip=alignment.R_package_markers_lip @ R,
        origin_to_com=R.T @ (alignment.origin_to_com + marker[:3]))


def _require_world(method: str, std: Array) -> None:
    """Raise if the world is unidentifiable, for least squares, which take it as exact."""
    if method == 'least_squares' and np.any(std > KINDS['package_world'].max_std):
        each = [f'{x:.2g}' for x in DISPLAY_FACTORS * std]
        raise UndeterminedError(
            'recording.package_world is not identifiable from this recording: the standard '
            f'errors are {", ".join(each[:3])} mm and {", ".join(each[3:])} degrees. Tilt '
            'and turn the tool more, best with three standstills tilted to different sides, '
            'or set its seven numbers.')


def _first_guess(
    tool: PoseStream, package: PoseStream, settings: PrepareSettings, values: Values, marked: bool,
) -> tuple[Array | None, frames.Alignment | None]:
    """Return the pose (7,) of the package's world, and the alignment of a marker, or None."""
    world, com = values.recording.package_world, settings.payload.com
    estimate = world == checks.ESTIMATE
    pose = None if estimate or not world else frames.pose_of(world)
    if not (marked or estimate):
        return pose, None
    poses = tool.trajectory(), package.trajectory(), values.cup.length
    if marked:
        guess, grip = frames.hand_eye(*poses, com)
        return guess if estimate else pose, grip
    return frames.closed_form(
        *poses, np.zeros(3) if settings.package_frame == 'lip' else -com), None
