"""
Faults of recorded poses and stamps, detected without a preparation or a fit.

Each test takes milliseconds. Tool and package on a cup move nearly as one rigid body; each fault
of one of the two poses breaks this relation in a specific manner. `faults` has the table of tests.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.signals.resampling import common_span, MAD_TO_STD, resample, timing
from bellows_ros.core.signals.screening import MAX_TOOL_SPEED
from bellows_ros.core.signals.trajectory import (
    any_within,
    NS_PER_S,
    PoseStream,
    same_frame,
    Trajectory,
    TwistStream,
)
from bellows_ros.errors import UndeterminedError
import numpy as np

from .outliers import find_outliers
from .recording import ripple, ripple_part

SAMPLES = 300
"""Number of compared pairs of poses."""

MIN_FROZEN_PART = 0.95
"""Smallest fraction of steps with a new position and an unchanged rotation of a frozen rotation:
a topic of two trackers repeats at most every second one."""

MIN_SHIFT = 5e-3
"""Smallest motion of a body whose unchanged rotation is a fault, m: ten times the noise of a
tracked body at rest."""

FIXED = np.repeat([1e-4, 5e-4], 3)
"""Smallest deflection of an identifiable cup, standard deviations in m and rad: the noise of one
pose of a motion capture."""

AT_REST = np.repeat([5e-4, 5e-3], 3)
"""Largest motion of a body at rest, standard deviations in m and rad: the noise of a detected
tag."""

MOVING = np.repeat([0.02, 0.1], 3)
"""Smallest motion of a tool that shakes its package, standard deviations in m and rad: twenty
times the largest motion at rest."""

MIN_TILT_RATIO = 0.02
"""
Smallest ratio of the rotation of a package on a cup to the tilt of its tool, by its weight.

The ratio is m g d / K: 0.03 for 0.5 kg, 25 mm below a cup of 4 N m/rad, and 0.2 for 1.8 kg, 45 mm
below.
"""

SWAPPED_SECONDS = 0.02
"""Shortest exchange of two bodies, s: two poses at 100 Hz, as a single one is an outlier."""

MAX_SWAPS = 3
"""Largest number of reported exchanges of two bodies."""

STEP_MARGIN = 5e-3
"""Time left out beside a step of a clock, s: a half of the last digit that is shown."""

UPRIGHT = 0.5
"""Smallest cosine between the tool's z axis and the direction of a package that is surely above or
below it: 60 degrees, beyond any bending of a cup."""

MIN_NEAR_PART = 0.9
"""Smallest fraction of poses with the usual distance of two bodies of one clock: with 5 s between
the clocks of bags/identification the fraction is below a half."""

NOISE_DEVIATIONS = 2.0
"""Smallest ratio of the standard deviations of motion and noise of a moving body: twice the error
of an estimate from 20 poses."""

NOISE_RANGE = 8.0
"""Largest ratio of range (1 to 99 %) and standard deviation of the noise of a body at rest: 4.7
for white noise."""

SHORT_HALF_WINDOW = 2
"""Half window of a cubic that follows a package between poses of 30 Hz, samples."""

MIN_SAMPLES = 20
"""Smallest number of windows for an estimate of noise, which is then accurate to 25 %."""

IN_DEGREES = ', but would with angles in degrees per second'
"""Cause of twists that do not fit the poses."""

MAX_UP = -0.5
"""Largest vertical component of the tool's z axis (median) that points out of the arm: 120 degrees
from the vertical, beyond any tilt of a recording."""

MAX_AXIS_ANGLE = np.deg2rad(20.0)
"""Largest angle of a vertical axis of the tool from the vertical, rad (median of the motion)."""

UPRIGHT_OFFSETS = {
    (0, True): '0 0 0 0 0.7071 0 0.7071', (0, False): '0 0 0 0 -0.7071 0 0.7071',
    (1, True): '0 0 0 -0.7071 0 0 0.7071', (1, False): '0 0 0 0.7071 0 0 0.7071',
    (2, False): '0 0 0 1 0 0 0'}
"""Poses of an E with z up, by the vertical axis of the tool's frame (0 for x) and its sense."""

TWIST_WINDOW = 0.05
"""Time over which a twist is compared with poses, s: a sixth of a swing."""

MIN_TWIST_SHIFT = 2e-3
"""Smallest motion within this time that is compared, m: twenty times the noise of a pose."""

MIN_TWIST_ROTATION = 5e-3
"""Smallest rotation within this time that is compared, rad: ten times the noise of a pose."""

TWIST_TOLERANCE = 0.3
"""Largest relative difference of matching twists and poses; in degrees they differ 57 times."""

MIN_TWISTS = 10
"""Smallest number of twists that are compared."""

MAX_MOTION = 20.0
"""Largest motion of a body, m: a larger one is in millimetres."""

MIN_REACH = 1e-3
"""Smallest distance of a package on a cup from the tool, m; nearer ones are of one body."""

MAX_REACH = 0.5
"""Largest distance of a package on a cup from the tool, m: a long cup and half a box."""

MAX_CHANGE = 0.25
"""Largest relative variation of this distance: a cup stretched by a quarter."""

MAX_MISFIT_RATIO = 0.4
"""Largest ratio of relative motion after and before the correction of a convention."""

SIMPLER = 0.9
"""Ratio of misfits below which a later candidate replaces an earlier one."""

HANGING = 0.2
"""Largest misalignment of a package that hangs below its tool, a sum of two cosines from 1: 36
degrees of one of the two."""

TILTED = 0.5
"""Smallest misalignment for which another order of quaternions is tested; 60 degrees of one
body."""

Bodies = tuple[Trajectory, Trajectory]

WRONG = {'package': (False, True), 'tool': (True, False), 'both': (True, True)}
"""Whether tool and package are wrong, by the name of the body."""


@dataclass(frozen=True, eq=False)
class RecordedPoses:
    """
    Recorded poses of a tool and its package, in one frame or in two, and the given package.

    Parameters
    ----------
    tool, package : PoseStream
    R_world_recorded : ndarray (3, 3)
        Rotation from the tool's recorded axes to a world with z up.
    payload : Package or None
        Mass, inertia and centre of mass as given.
    aligned : bool
        Whether the axes of both follow from the standstill at the beginning.
    twist : TwistStream or None
        Recorded twists of the tool.
    twist_frame : str
        Axes of the twists as given: 'world' or 'tool'.

    """

    tool: PoseStream
    package: PoseStream
    R_world_recorded: Array
    payload: Package | None = None
    aligned: bool = False
    twist: TwistStream | None = None
    twist_frame: str = 'world'

    @cached_property
    def bodies(self) -> Bodies | None:
        """Pairs of poses at common stamps; None if the streams do not overlap."""
        first, last = common_span(self.tool, self.package)
        if last <= first:
            return None
        stamps = np.unique(np.linspace(0, last - first, SAMPLES).astype(np.int64)) + first
        return resample(self.tool.trajectory(), stamps), resample(
            self.package.trajectory(), stamps)

    @property
    def one_frame(self) -> bool:
        """Whether both bodies are in one frame, as far as they name it."""
        return same_frame(self.tool.frame_id, self.package.frame_id)


def clock_steps(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield the steps of the clocks that stamp the topics, as by NTP."""
    start = min(int(poses.tool.stamps_ns[0]), int(poses.package.stamps_ns[0]))
    for body, stream in (('tool', poses.tool), ('package', poses.package)):
        for at_ns, size in stream.clock_steps:
            at = (at_ns - start) / NS_PER_S
            yield Finding('clock_step', Level.ERROR, {
                'at': at, 'size': size, 'until': at + min(size, 0.0) - STEP_MARGIN,
                'since': at + STEP_MARGIN}, body)


def frozen_orientations(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield a rotation that stays while the body, and the other one, move."""
    for body, stream, other in (
            ('tool', poses.tool, poses.package), ('package', poses.package, poses.tool)):
        if (part := _frozen_part(stream)) > MIN_FROZEN_PART and (
                body == 'package' or _deviation(other.trajectory())[3:].max() > MOVING[3]):
            yield Finding('frozen_orientation', Level.ERROR, {'part': part}, body)


def swapped_bodies(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield the times in which two bodies, one below the other, are exchanged, or are one."""
    if not (poses.one_frame and poses.bodies):
        return
    tool, package = poses.tool.trajectory(), poses.package.trajectory()
    first, last = common_span(tool, package)
    package = package.select((package.stamps_ns >= first) & (package.stamps_ns <= last))
    tool = resample(tool, package.stamps_ns)
    offset = package.position - tool.position
    distance = np.linalg.norm(offset, axis=1)
    usual = float(np.median(distance))
    # cosine of the package's direction from the tool's z axis, which points up or is turned up
    above = np.einsum('ni,ni->n', offset, tool.rotation[:, :, 2]) / np.maximum(distance, 1e-9)
    up, _ = tool_up(tool.rotation, poses.R_world_recorded)
    above *= np.sign(up if abs(up) > UPRIGHT else -np.median(above))
    is_near = np.abs(distance - usual) < MAX_CHANGE * usual
    is_one = distance < MAX_CHANGE * usual
    has_one_cup = 1e-3 < usual < MAX_REACH and np.mean(is_near | is_one) >= MIN_NEAR_PART
    hangs = np.mean(is_near & (above < -UPRIGHT)) >= 1.0 - MIN_NEAR_PART
    if not (has_one_cup and hangs):
        return
    is_swapped = is_near & (above > UPRIGHT) | is_one
    start = min(int(poses.tool.stamps_ns[0]), int(poses.package.stamps_ns[0]))
    for stream in (poses.tool, poses.package):  # outliers are left out in any case
        is_swapped &= _are_good(stream, package.stamps_ns)
    lasting = [(begin, end) for begin, end in _spans_of(is_swapped, package.stamps_ns - start)
               if end - begin >= SWAPPED_SECONDS]
    for begin, end in lasting[:MAX_SWAPS]:
        yield Finding('swapped', Level.ERROR, {'begin': begin, 'end': end}, 'both')


def _are_good(stream: PoseStream, stamps_ns: Stamps) -> Mask:
    """Return whether the poses of a stream about stamps (N,) are no outliers."""
    good = find_outliers(stream.trajectory(), timing(stream.stamps_ns).longest_step_ns).good
    after = np.searchsorted(stream.stamps_ns, stamps_ns).clip(1, len(good) - 1)
    return np.asarray(good[after - 1] & good[after])


def _spans_of(chosen: Mask, times_ns: Stamps) -> list[tuple[float, float]]:
    """Return first and last time (s) of each run of chosen samples (N,)."""
    edges = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    begins, ends = times_ns[edges[0::2]] / NS_PER_S, times_ns[edges[1::2] - 1] / NS_PER_S
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def _frozen_part(stream: PoseStream) -> float:
    """Return the fraction of steps of a moving body with exactly unchanged rotation."""
    moves = np.any(stream.position[1:] != stream.position[:-1], axis=1)
    if not moves.any() or np.ptp(stream.position, axis=0).max() < MIN_SHIFT:
        return 0.0
    same = np.all(stream.rotation[1:] == stream.rotation[:-1], axis=(1, 2))
    return float(np.mean(same[moves]))


def _deviation(body: Trajectory) -> Array:
    """Return the robust standard deviation (6,) of a body's pose, m and rad."""
    middle = body.rotation[len(body) // 2].T
    moved = np.hstack([body.position, lie.log_so3(middle @ body.rotation)])
    return np.asarray(0.5 * np.subtract(*np.percentile(moved, (84, 16), axis=0)))


def fixed_packages(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield a package that is fixed to its tool, or rests under a moving tool."""
    if poses.bodies is None:
        return
    tool, package = poses.bodies
    noises = np.array([noise_of(body.trajectory()) for body in (poses.tool, poses.package)])
    package_motion, moves = _deviation(package), bool(np.any(_deviation(tool) >= MOVING))
    if moves and np.all(package_motion < np.fmax(AT_REST, NOISE_DEVIATIONS * noises[1])):
        yield Finding('no_swing', Level.ERROR, {
            'fixed': 'rests while the tool moves', **_sizes(package_motion)}, 'package')
        return
    back, noise = np.swapaxes(tool.rotation, 1, 2), np.hypot(*noises)
    relative = replace(package, position=lie.apply(back, package.position - tool.position),
                       rotation=back @ package.rotation)
    deviation = _deviation(relative)
    tilt = float(np.linalg.norm(np.std(tool.rotation[:, 2, :2], axis=0)))
    distance = float(np.median(np.linalg.norm(relative.position, axis=1)))
    if poses.one_frame and distance < MAX_REACH and (
            moves or float(noise[3:].max()) < MIN_TILT_RATIO * tilt) and np.all(
            deviation < np.fmax(FIXED, NOISE_DEVIATIONS * noise)) and np.all(
            noise < MOVING / 10.0):
        yield Finding('no_swing', Level.ERROR, {
            'fixed': 'is fixed to the tool' if distance >= 1e-3 else 'has the poses of the tool',
            **_sizes(deviation)}, 'package')


def _sizes(deviation: Array) -> dict[str, float]:
    """Return the largest deviations of a pose (6,), m and rad."""
    return {'position': float(deviation[:3].max()), 'rotation': float(deviation[3:].max())}


def noise_of(body: Trajectory) -> Array:
    """Return the standard deviation (6,) of the noise of poses, m and rad, nan for too few."""
    try:
        change, _ = ripple(body, SHORT_HALF_WINDOW)
    except UndeterminedError:
        return np.full(6, np.nan)
    scale = MAD_TO_STD / np.sqrt(ripple_part(0.0, SHORT_HALF_WINDOW))
    return np.asarray(scale * np.median(np.abs(change), axis=0)) if len(
        change) >= MIN_SAMPLES else np.full(6, np.nan)


def wrong_conventions(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield positions in millimetres, and quaternions that explain non-rigid motion."""
    is_near = poses.one_frame and poses.bodies and distance_of(poses.bodies)[0] < MAX_REACH
    wrong = [body for body, stream in (('tool', poses.tool), ('package', poses.package))
             if not is_near and in_millimetres(stream.trajectory())]
    yield from (Finding('millimetres', Level.ERROR, topic=body) for body in wrong)
    if poses.one_frame and poses.bodies and not wrong and (
            body := wrong_order(poses.bodies)):
        yield Finding('quaternions', Level.ERROR, topic=body)


def in_millimetres(body: Trajectory) -> bool:
    """Return whether a body moves so far that its positions are in millimetres."""
    low, high = np.percentile(body.position, (1, 99), axis=0)
    return bool(np.linalg.norm(high - low) > MAX_MOTION)


def w_last(body: Trajectory) -> Trajectory:
    """Return poses from poses of quaternions with w first."""
    q = np.roll(lie.rotation_to_quaternion(body.rotation), -1, axis=-1)
    return replace(body, rotation=lie.quaternion_to_rotation(q))


def wrong_order(bodies: Bodies) -> str:
    """Return the body with w first in its quaternions, 'both', or '' for none."""
    distance, change = distance_of(bodies)
    if not (MIN_REACH < distance < MAX_REACH and change < MAX_CHANGE):
        return ''
    moved, tilted = motion_in_tool(*bodies)
    found, least = '', float('inf')
    for body, wrong in WRONG.items():
        moves, tilt = motion_in_tool(*(w_last(each) if is_wrong else each
                                       for each, is_wrong in zip(bodies, wrong, strict=True)))
        is_righted = moves < SIMPLER * moved and tilt < HANGING and TILTED < tilted
        if (is_righted or moves < MAX_MISFIT_RATIO * moved) and moves < SIMPLER * least:
            found, least = body, moves
    return found


def distance_of(bodies: Bodies) -> tuple[float, float]:
    """Return the median distance of the bodies, m, and its relative variation."""
    tool, package = bodies
    distance = np.linalg.norm(package.position - tool.position, axis=1)
    low, middle, high = np.percentile(distance, (25, 50, 75))
    return float(middle), float((high - low) / max(middle, 1e-12))


def motion_in_tool(tool: Trajectory, package: Trajectory) -> tuple[float, float]:
    """
    Return the motion of the package in the tool, and its misalignment with the tool's z axis.

    The motion is a rotation (rad) plus a path in units of the distance, the misalignment a sum of
    two deviations of cosines from 1.
    """
    back = np.swapaxes(tool.rotation, 1, 2)
    offset, turned = lie.apply(back, package.position - tool.position), back @ package.rotation
    offset = offset / max(float(np.median(np.linalg.norm(offset, axis=1))), 1e-12)
    rotation = lie.log_so3(turned[len(turned) // 2].T @ turned)
    return (sum(float(np.linalg.norm(np.subtract(*np.percentile(values, (75, 25), axis=0))))
                for values in (offset, rotation)),
            2.0 + float(np.mean(offset[:, 2]) - np.mean(turned[:, 2, 2])))


def exchanged_topics(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield topics of which the package is above the tool, in its axes and in the world."""
    if not (poses.one_frame and poses.bodies):
        return
    tool, package = poses.bodies
    offset = package.position - tool.position
    in_tool = float(np.median(lie.apply(np.swapaxes(tool.rotation, 1, 2), offset)[:, 2]))
    upward = float(np.median(offset @ poses.R_world_recorded[2]))
    if np.median(np.linalg.norm(offset, axis=1)) < MAX_REACH and (
            min(in_tool, upward) > 0.0):
        yield Finding('exchanged', Level.ERROR, {'in_tool': in_tool, 'upward': upward}, 'both')


def tool_z(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield a z axis of the tool that points down, out of the arm, or sideways."""
    up, angle = tool_up(poses.tool.rotation, poses.R_world_recorded)
    if up < MAX_UP and not poses.aligned:
        yield Finding('tool_z', Level.ERROR, {'angle': angle}, 'tool')
    elif up < UPRIGHT and not poses.aligned:
        offset = upright_offset(poses.tool.rotation, poses.R_world_recorded)
        yield Finding('sideways', Level.ERROR, {
            'angle': angle, 'offset': f" to '{offset}', as another axis is vertical" * bool(offset)
            }, 'tool')


def upright_offset(rotation: Array, R: Array) -> str:
    """Return the tool_pose.offset with z along the vertical axis of the tool; '' for none or z."""
    vertical = np.median(R[2] @ rotation, axis=0)  # in axes of the tool
    axis = int(np.argmax(np.abs(vertical)))
    is_axis = abs(vertical[axis]) > np.cos(MAX_AXIS_ANGLE)
    return UPRIGHT_OFFSETS.get((axis, vertical[axis] > 0.0), '') if is_axis else ''


def tool_up(rotation: Array, R: Array) -> tuple[float, float]:
    """Return the vertical component of the tool's z axis (median), and its angle, rad."""
    up = float(np.median(rotation[:, :, 2] @ R[2]))
    return up, float(np.arccos(np.clip(up, -1.0, 1.0)))


def resting_tools(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield a tool that rests throughout, so that its package does not swing."""
    body = poses.tool.trajectory()
    turned = lie.log_so3(body.rotation[len(body) // 2].T @ body.rotation)
    ranges = np.ptp(np.percentile(np.hstack([body.position, turned]), (1, 99), axis=0), axis=0)
    if np.all(ranges < np.fmax(AT_REST, NOISE_RANGE * noise_of(body))):
        yield Finding('tool_at_rest', Level.ERROR, _sizes(ranges), 'tool')


def impossible_packages(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield a mass, an inertia or a centre of mass that no package of a cup has."""
    if poses.payload is None:
        return
    moments = np.diag(poses.payload.inertia).tolist()
    for doubt in structure.unit_doubts(poses.payload.mass, moments, poses.payload.com.tolist()):
        yield Finding('implausible', Level.ERROR, {'sentence': doubt})


def wrong_twists(poses: RecordedPoses) -> Iterator[Finding]:
    """Yield the correct axes or unit of the tool's recorded twists, if not as given."""
    if poses.twist is None:
        return
    errors, in_degrees = twist_errors(poses.tool, poses.twist)
    if in_degrees:
        yield Finding('twists', Level.ERROR, {'cause': IN_DEGREES})
    elif errors and errors[poses.twist_frame] > TWIST_TOLERANCE > min(errors.values()):
        axes = min(errors, key=lambda axes: errors[axes])
        yield Finding('twists', Level.ERROR, {'cause': f', but would in axes of the {axes}'})


def twist_errors(tool: PoseStream, twist: TwistStream) -> tuple[dict[str, float], bool]:
    """
    Compare a twist, integrated over `TWIST_WINDOW`, with the change of the poses.

    Return the relative errors by axes, 'world' and 'tool', empty for too little motion, and
    whether angles are in degrees.
    """
    inside = (tool.stamps_ns[0] <= twist.stamps_ns) & (twist.stamps_ns <= tool.stamps_ns[-1])
    if np.count_nonzero(inside) < MIN_TWISTS:
        return {}, False
    body = resample(tool.trajectory(), twist.stamps_ns[inside])
    steps = np.diff(body.stamps_ns)[:, None] / NS_PER_S
    window = max(1, round(TWIST_WINDOW / float(np.median(steps))))
    if len(body) <= 2 * window:
        return {}, False

    def integrated(rates: Array) -> Array:
        sums = np.cumsum(np.vstack([np.zeros(3), 0.5 * steps * (rates[1:] + rates[:-1])]), axis=0)
        return np.asarray(sums[window:] - sums[:-window])[whole]

    distances = np.linalg.norm(np.diff(body.position, axis=0), axis=1)
    whole = ~any_within(distances > MAX_TOOL_SPEED * steps[:, 0], window)
    shift = (body.position[window:] - body.position[:-window])[whole]
    if not len(shift):
        return {}, False
    linear, angular = twist.linear[inside], np.radians(twist.angular[inside])
    angle = _rms(lie.log_so3(
        np.swapaxes(body.rotation[:-window], 1, 2) @ body.rotation[window:])[whole])
    in_degrees = angle > MIN_TWIST_ROTATION and (
        abs(_rms(integrated(angular)) / angle - 1.0) < TWIST_TOLERANCE)
    return ({axes: _rms(integrated(rates) - shift) / _rms(shift) for axes, rates in (
        ('world', linear), ('tool', lie.apply(body.rotation, linear)))}
        if _rms(shift) > MIN_TWIST_SHIFT else {}), in_degrees


def _rms(vectors: Array) -> float:
    """Return the root mean square of the lengths of vectors (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
