"""
Checks of a cell before any fit, from a recording with a standstill, tilts and motion.

Each check has a code, its numbers, and the parameters to set. All numbers are approximate: a fit
estimates them with standard errors.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.parameters import checks
from bellows_ros.core.signals import resampling
from bellows_ros.core.signals.resampling import MAD_TO_STD, resample
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.core.signals.trajectory import (
    at_tip,
    earlier,
    NS_PER_S,
    PoseStream,
    Trajectory,
)
from bellows_ros.errors import BellowsError
import numpy as np

from . import alignment
from .outliers import find_outliers
from .pose_faults import MAX_UP, noise_of, tool_up
from .prepared_faults import MAX_EXCURSIONS, seems_tag
from .recording import LOW_RATE_HZ

FLANGE_OUTWARD = '0 0 0 1 0 0 0'
"""Pose of the tool tip in a flange with z out of the arm: a half turn about x."""

MARKER_UP = -0.95
"""Largest vertical component of a tool's z axis, with axes from a standstill, that still indicates
a flange with z out of the arm."""

SWING = (-0.02, 0.08)
"""Range of the delay of a swinging package's rotation behind its tool, s."""

OFFSET_STEPS = 21
"""Number of offsets tried about an approximate one."""

OFFSET_RANGE = 0.1
"""Largest correction of an approximate offset, s."""

STILL_SPEED = np.array([0.01, 0.04])
"""Speeds of a tool at rest, m/s and rad/s."""

SPEED_STEP = 20_000_000
"""Half of the time step for speeds, ns."""

USUAL = 0.75
"""Quantile of deviations that belongs to motion, also of recordings with long rests."""

MAX_COMPARED = 1000
"""Number of poses from which the offset of two clocks is estimated."""

BLUR_RATIO = 2.5
"""Smallest ratio of noise in fast motion to noise at rest that indicates blur."""

FAST_PART = 0.7
"""Quantile of the speeds above which motion is fast."""

MIN_TILT = np.deg2rad(5.0)
"""Smallest tilt that separates world and marker, rad: ten times the error of a tag's pose."""

MIN_TILTS = 2
"""Smallest number of tilt directions that separate world and marker."""

MAX_K_ERROR = 0.1
"""Largest acceptable relative error of an entry of K."""


class Judgement(NamedTuple):
    """
    A check before a fit.

    Parameters
    ----------
    code : str
        Its name in the texts of the room 'commission'.
    passed : bool
        Whether nothing has to be set or changed.
    numbers : mapping
        Measured numbers, SI units.
    settings : mapping
        Parameters to set, by name.

    """

    code: str
    passed: bool
    numbers: Mapping[str, Any]
    settings: Mapping[str, Any] = MappingProxyType({})


def checks_of(
    tool: PoseStream, package: PoseStream, R_world_recorded: Array, depth: float,
    separate: bool = False, aligned: bool = False
) -> tuple[Judgement, ...]:
    """
    Return the checks of a cell, in the order in which they should be settled.

    Parameters
    ----------
    tool, package : PoseStream
        Recorded poses.
    R_world_recorded : ndarray (3, 3)
        Rotation from the tool's recorded axes to a world with z up.
    depth : float
        Approximate distance from the tool tip to the centre of mass below it, m.
    separate : bool
        Whether tool and package are in two worlds.
    aligned : bool
        Whether the axes of tool and package follow from the standstill at the beginning.

    """
    up, angle = tool_up(tool.rotation, R_world_recorded)
    outward = up < (MARKER_UP if aligned else MAX_UP)
    result = list[Judgement]()
    if outward or not aligned:
        result.append(Judgement(
            'tool_z', not outward, {'angle': angle},
            {'tool_pose.offset': FLANGE_OUTWARD} if outward else {}))
    if outward:
        tool = at_tip(tool, np.diag([1.0, -1.0, -1.0, 1.0]))
    outliers = find_outliers(
        package.trajectory(), resampling.timing(package.stamps_ns).longest_step_ns)
    body = package.trajectory().select(outliers.good)
    hand = tool.trajectory()
    try:
        offset = _clock_offset(hand, body)
        hand = earlier(hand, offset)
        pose, marker = _registered(hand, body, separate)
    except BellowsError as error:
        return (*result, Judgement('no_registration', False, {'reason': str(error)}))
    result += [check for check in _registration(pose, marker, offset, separate, depth)
               if not aligned or check.code != 'marker']
    first, last = (stamp + side * SPEED_STEP for stamp, side in zip(
        resampling.common_span(hand, body), (1, -1), strict=True))
    body = body.select((body.stamps_ns >= first) & (body.stamps_ns <= last))
    return (*result, *_detector(body, _speeds(hand, body.stamps_ns), outliers.excursions, package),
            *_motion(hand, body, pose, separate))


def _clock_offset(tool: Trajectory, package: Trajectory) -> float:
    """Return the delay of the tool's stamps behind the package's (s), from both rotations."""
    rough = alignment.rough_offsets(tool, package)[0]
    tried = rough + np.linspace(-OFFSET_RANGE, OFFSET_RANGE, OFFSET_STEPS)
    residuals = [_rotation_residual(earlier(tool, float(offset)), package) for offset in tried]
    best = int(np.argmin(residuals))
    if 0 < best < OFFSET_STEPS - 1:
        before, at, after = residuals[best - 1:best + 2]
        curvature = max(before + after - 2.0 * at, 1e-12)
        return float(tried[best] + 0.5 * (before - after) / curvature * (tried[1] - tried[0]))
    return float(tried[best])


def _rotation_residual(tool: Trajectory, package: Trajectory) -> float:
    """Return the usual squared deviation (rad^2) of the package's orientation in the tool."""
    first, last = resampling.common_span(tool, package)
    eye = package.select((package.stamps_ns >= first) & (package.stamps_ns <= last))
    eye = eye.select(slice(None, None, len(eye) // MAX_COMPARED + 1))
    if not len(eye):  # a shift beyond the ends of a short recording
        return float('inf')
    hand = resample(tool, eye.stamps_ns)
    R = alignment.rotation_of(hand.rotation, eye.rotation)
    relative = np.swapaxes(hand.rotation, 1, 2) @ R @ eye.rotation
    moved = lie.log_so3(lie.mean_rotation(relative).T @ relative)
    return float(np.quantile(np.sum(moved**2, axis=1), USUAL))


def _registered(
    tool: Trajectory, package: Trajectory, separate: bool
) -> tuple[Array, alignment.Alignment]:
    """Return the pose (7,) of the package's world, and the alignment from marker to tool tip."""
    if separate:
        return alignment.hand_eye(tool, package, 0.0, np.zeros(3))
    hand, eye = alignment.slow_poses(tool, package)
    back = np.swapaxes(hand.rotation, 1, 2)
    position = lie.apply(back, eye.position - hand.position)
    R = lie.mean_rotation(back @ eye.rotation)
    return np.array([0.0] * 6 + [1.0]), alignment.Alignment(
        np.eye(3), R.T, -np.median(position, axis=0), np.zeros(3))


def _registration(
    pose: Array, marker: alignment.Alignment, offset: float, separate: bool, depth: float
) -> Iterator[Judgement]:
    """Yield the checks of clocks, frames and the marker."""
    late = separate or not SWING[0] < -offset < SWING[1]
    yield Judgement('clocks', not late, {'offset': -offset, 'swing': SWING[1]},
                    {'fit.time_offset': True} if late else {})
    yield Judgement('frames', not separate, {
        'position': pose[:3].tolist(), 'quaternion': pose[3:].tolist()},
        {'recording.package_world': checks.ESTIMATE} if separate else {})
    position = -marker.origin_to_com + [0.0, 0.0, depth]
    rotation = lie.log_so3(marker.R_package_markers_lip.T)
    turned = float(np.linalg.norm(rotation))
    plain = not separate  # otherwise recording.align_at_rest corrects it
    yield Judgement('marker', plain, {
        'position': position.tolist(), 'angle': turned, 'depth': depth},
        {} if plain else {'fit.free': ('package_marker',), 'recording.package_frame': 'com',
                          'measured.offset': [
            *np.round(position, 3).tolist(), *np.round(rotation, 3).tolist()]})


def _speeds(tool: Trajectory, stamps_ns: Stamps) -> Array:
    """Return the speeds (N, 2) of the tool, m/s and rad/s."""
    before, after = (resample(tool, stamps_ns + shift) for shift in (-SPEED_STEP, SPEED_STEP))
    seconds = 2.0 * SPEED_STEP / NS_PER_S
    return np.column_stack([
        np.linalg.norm(after.position - before.position, axis=1) / seconds,
        np.linalg.norm(lie.log_so3(np.swapaxes(before.rotation, 1, 2) @ after.rotation), axis=1)
        / seconds])


def _detector(
    body: Trajectory, speeds: Array, excursions: int, package: PoseStream
) -> Iterator[Judgement]:
    """Yield the checks of the kind of detector, its noise, excursions, rate and blur."""
    still = np.all(speeds < STILL_SPEED, axis=1)
    fast = speeds[:, 0] > np.quantile(speeds[:, 0], FAST_PART)
    at_rest, in_motion, quick = (noise_of(body, mask) for mask in (still, ~still, fast))
    rate_hz = resampling.timing(package.stamps_ns).rate_hz
    known = np.where(np.isfinite(at_rest), at_rest, in_motion)
    lateral, rotation = (float(np.sqrt(np.mean(part**2))) for part in (known[:2], known[3:]))
    is_tag = seems_tag(known, rate_hz, excursions / len(package))
    moving = np.where(np.isfinite(in_motion), in_motion, known)
    overall = [float(np.sqrt(np.mean(part**2))) for part in (moving[:3], moving[3:])]
    yield Judgement('detector', True, {
        'kind': 'tag' if is_tag else 'body', 'lateral': lateral, 'depth': float(known[2]),
        'rotation': rotation, 'position_moving': overall[0], 'rotation_moving': overall[1]},
        {} if is_tag else {'measured.noise': [float(f'{x:.2g}') for x in overall]})
    yield Judgement('excursions', excursions <= MAX_EXCURSIONS * len(package), {
        'excursions': excursions, 'poses': len(package)})
    slow = rate_hz < LOW_RATE_HZ
    yield Judgement('rate', not slow, {'rate': rate_hz, 'least': LOW_RATE_HZ},
                    {'fit.method': 'output_error'} if slow else {})
    ratio = float(np.max(quick / np.maximum(known, 1e-9)))
    if np.isfinite(ratio):
        yield Judgement('blur', ratio < BLUR_RATIO, {'ratio': ratio})


def _motion(
    tool: Trajectory, package: Trajectory, pose: Array, separate: bool
) -> Iterator[Judgement]:
    """Yield checks on the separation of world and marker, and on the identifiability of K."""
    up = tool.rotation[:, 2, :2] / np.linalg.norm(tool.rotation[:, 2], axis=1)[:, None]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(up.T)), 0.0))
    tilts = int(np.count_nonzero(2.0 * spread > MIN_TILT))
    if separate:
        yield Judgement('tilts', tilts >= MIN_TILTS, {
            'largest': float(2.0 * spread[1]), 'smallest': float(2.0 * spread[0])})
    hand = resample(tool, package.stamps_ns)
    R = lie.quaternion_to_rotation(pose[3:])
    back = np.swapaxes(hand.rotation, 1, 2)
    relative = replace(
        package, position=lie.apply(back, pose[:3] + lie.apply(R, package.position)
                                    - hand.position), rotation=back @ R @ package.rotation)
    mean = lie.mean_rotation(relative.rotation)
    turned = relative.rotation @ mean.T
    lip = relative.position - lie.apply(turned, relative.position.mean(axis=0))
    moved = np.hstack([lip, lie.log_so3(turned)])
    noise = noise_of(replace(relative, position=lip, rotation=turned))
    signal = np.sqrt(np.maximum((MAD_TO_STD * np.median(
        np.abs(moved - np.median(moved, axis=0)), axis=0))**2 - noise**2, 1e-18))
    errors = noise / signal / np.sqrt(len(package))
    if not np.isfinite(noise).all():  # too few poses at uniform steps
        return
    weak = [name for name, error in zip(AXES, errors, strict=True) if not error < MAX_K_ERROR]
    yield Judgement('excitation', not weak, {
        'weak': weak, 'errors': errors.tolist(), 'worst': float(np.max(errors))})
