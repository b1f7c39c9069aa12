"""
From recorded marker frames to tool tip E, lip S and centre of mass B (4.1-4.13).

Motion capture gives poses of marker bodies whose axes are rotated relative to E and S, and the
package hangs with a lateral offset from the cup's axis. At rest the axes of E and S are parallel
to the axes of the world, and S lies below E. Constant rigid transformations of each body remove
the deviations from this pose at the first standstill.

The offset of two clocks follows from the correlation of both bodies' rotations.

If tool and package are tracked in two worlds, the package's poses are first transformed into the
frame of the tool's poses.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.signals.resampling import common_span, MAD_TO_STD, MAX_GRID_SAMPLES, resample
from bellows_ros.core.signals.trajectory import at_tip, frozen, NS_PER_S, PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of gravity in a world with z up."""

# Rotation part of A_H_M (4.1): Motive's y points up, and its x is reversed.
R_WORLD_MOTIVE = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
WORLDS = {'z_up': np.eye(3), 'motive_y_up': R_WORLD_MOTIVE}
"""Rotations from axes of a recording to axes with z up, by the value of recording.world."""

MIN_SAMPLES_AT_REST = 10
"""Smallest number of valid samples of a standstill."""

MIN_PART_AT_REST = 0.5
"""Smallest fraction of valid samples of a standstill."""

START_SECONDS = 0.2
"""Duration of the averaged poses at the beginning, s."""

MIN_REST = 0.5
"""Shortest standstill at the beginning that aligns the marker frames, s."""

REST_PART = 0.9
"""Fraction of a standstill whose poses are averaged."""

MIN_FRAME_ANGLE = np.deg2rad(1.5)
"""Smallest relative rotation of marker frames that no weight of a package explains, rad."""

MIN_ANGLE_TO_TILT = 0.5
"""Smallest ratio of this rotation to the tilt of the tool, by which a package bends the cup."""

MAX_TURN = 1.0
"""Largest rotation of a package on a cup at rest, rad: 60 degrees, beyond any bending."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """
    Constant transformations from recorded marker frames to the frames of the model.

    Parameters
    ----------
    R_tool_markers_tool : array (3, 3)
        Rotation from axes of the tool E to axes of its recorded pose (4.4); the origins coincide.
    R_package_markers_lip : array (3, 3)
        Rotation from axes of the lip S to axes of the package's recorded pose (4.5).
    origin_to_com : array (3,)
        Vector from the origin of the recorded package pose to the centre of mass B, in axes of S,
        m.
    lateral_offset : array (3,)
        Lateral correction of the lip's position (4.10) in axes of S, at rest parallel to E, m; z
        is 0; included in `origin_to_com`.

    """

    R_tool_markers_tool: Array
    R_package_markers_lip: Array
    origin_to_com: Array
    lateral_offset: Array

    def tool(self, markers: Trajectory) -> Trajectory:
        """
        Return the poses of E from recorded poses in the world (4.12).

        Parameters
        ----------
        markers : Trajectory
            Poses of the tool's marker frame.

        Returns
        -------
        Trajectory
            Without twists.

        """
        return at_tip(markers, lie.transform(self.R_tool_markers_tool, np.zeros(3)))

    def package(self, markers: Trajectory) -> Trajectory:
        """
        Return the poses of B from recorded poses in the world (4.13), (4.64).

        The lateral offset is constant in S, as for a package that is gripped off-centre. In (4.10)
        the offset is constant in E, which differs in motion by the offset times the bending angle.

        Parameters
        ----------
        markers : Trajectory
            Poses of the package's marker frame.

        Returns
        -------
        Trajectory
            Without twists.

        """
        R = self.R_package_markers_lip
        return at_tip(markers, lie.transform(R, R @ self.origin_to_com))


class MeanPose(NamedTuple):
    """Mean position (3,), m, and rotation (3, 3) of a body during a standstill."""

    position: Array
    rotation: Array


def world_rotation(world: str, gravity_direction: ArrayLike = DOWN) -> Array:
    """
    Return the rotation (3, 3) from axes of a recording to axes of a world A whose z is up.

    Parameters
    ----------
    world : str
        'z_up': the recording's frame is the world; 'motive_y_up': Motive's axes, y up (4.1).
    gravity_direction : array_like (3,)
        Direction of gravity in that world, if not -z.

    """
    return np.asarray(levelling(gravity_direction) @ WORLDS[world])


def in_world(poses: Trajectory, R_world_recorded: Array) -> Trajectory:
    """Return recorded poses of any body in the world; see `world_rotation`."""
    return replace(poses, position=frozen(lie.apply(R_world_recorded, poses.position)),
                   rotation=frozen(R_world_recorded @ poses.rotation))


def aligned_at_rest(
    tool: MeanPose, package: MeanPose, package_frame: str, com: ArrayLike
) -> Alignment:
    """
    Return the alignment with which a standstill has the nominal pose (4.2-4.13).

    Parameters
    ----------
    tool, package : MeanPose
        Mean poses of the recorded frames in the world, z up, at the same time.
    package_frame : str
        Frame of the package's poses, 'com' or 'lip', with respect to the origin.
    com : array (3,)
        Centre of mass B in S, m.

    Returns
    -------
    Alignment

    Raises
    ------
    BellowsError
        If the lateral offset of the lip from the tool tip exceeds the vertical offset.

    """
    origin = np.zeros(3) if package_frame == 'lip' else -np.asarray(com, dtype=np.float64)
    # (4.6) at rest, with parallel axes of E, S and the world.
    E_o_S = package.position + origin - tool.position
    if float(np.linalg.norm(E_o_S[:2])) >= -E_o_S[2]:
        raise BellowsError(
            'At rest the lip should hang below the tool tip, but relative to the tip it is at '
            f'({", ".join(f"{1e3 * x:.1f}" for x in E_o_S)}) mm in world axes, z up: more aside '
            'than below. Check recording.world, recording.package_frame, package.com, and that '
            'the tool and package topics are not exchanged.')
    # (4.4) and (4.5) with A_R_E = A_R_S = I at rest (4.2), (4.3).
    aside = E_o_S * [1.0, 1.0, 0.0]
    return Alignment(
        tool.rotation.T, package.rotation.T, origin - aside + np.asarray(com), aside)  # (4.64)


def standstill(poses: Trajectory, start_ns: int, duration_s: float, body: str) -> MeanPose:
    """
    Return the mean pose of a body during a standstill, without the samples far from the median.

    Parameters
    ----------
    poses : Trajectory
        Recorded poses; invalid samples are ignored.
    start_ns : int
        Begin of the standstill, ns.
    duration_s : float
        Duration of the standstill, s.
    body : str
        Name for messages.

    Raises
    ------
    BellowsError
        If the standstill is short, or there are too few valid samples.

    """
    poses = poses.between(start_ns, start_ns + int(REST_PART * duration_s * NS_PER_S))
    rest = poses.select(poses.valid)
    wrong = ''
    if duration_s < MIN_REST:
        wrong = f'both bodies stand still only for the first {duration_s:.1f} s or so'
    elif len(rest) < max(MIN_SAMPLES_AT_REST, MIN_PART_AT_REST * len(poses)):
        wrong = (f'only {len(rest)} of the {len(poses)} poses there are usable; expected at least '
                 f'{MIN_SAMPLES_AT_REST} and half of them')
    if wrong:
        raise BellowsError(
            f'Alignment needs the {body} at rest in the first {MIN_REST:g} s, but {wrong}. Record '
            'a longer standstill, or set recording.align_at_rest to false.')
    reference = _median_rotation(rest.rotation)
    used = _is_typical(rest.position - np.median(rest.position, axis=0)) & _is_typical(
        lie.log_so3(reference.T @ rest.rotation))
    return MeanPose(rest.position[used].mean(axis=0), lie.mean_rotation(rest.rotation[used]))


class Rest(NamedTuple):
    """
    Initial rest of both bodies: duration (s), tilts and relative rotation (rad).

    Tilts of tool and package are from the vertical.
    """

    seconds: float
    tilts: tuple[float, ...]
    turned: float

    @property
    def is_turned(self) -> bool:
        """Whether the marker frames' relative rotation is larger than a cup's bending."""
        return (self.seconds >= MIN_REST
                and bool(self.turned > max(MIN_FRAME_ANGLE, MIN_ANGLE_TO_TILT * self.tilts[0])))

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Finding on the relative rotation of the marker frames, if it is large."""
        if not self.is_turned:
            return ()
        tool, package = self.tilts
        return (Finding('turned', Level.WARN, {
            'tool': tool, 'package': package, 'turned': self.turned}),)


def rest_of(tool: Trajectory, package: Trajectory) -> Rest:
    """Return the initial rest of both bodies from their first common samples; world with z up."""
    begin, _ = common_span(tool, package)
    spans = [body.between(begin, begin + 20 * NS_PER_S) for body in (tool, package)]
    if not all(body.valid.any() for body in spans):
        return Rest(0.0, (0.0, 0.0), 0.0)
    R, still = zip(*(_beginning(body.select(body.valid)) for body in spans), strict=True)
    tilts = tuple(float(np.arccos(np.clip(each[2, 2], -1.0, 1.0))) for each in R)
    return Rest(min(still), tilts, float(np.linalg.norm(lie.log_so3(R[0].T @ R[1]))))


def _beginning(body: Trajectory) -> tuple[Array, float]:
    """Return the median orientation (3, 3) at the beginning, and its duration, s."""
    start = body.select(body.seconds <= START_SECONDS)
    reference = _median_rotation(start.rotation)
    moves = np.zeros(len(body), dtype=bool)
    for change, smallest in (
            (body.position - np.median(start.position, axis=0), 1e-3),  # m, rad
            (lie.log_so3(reference.T @ body.rotation), 5e-3)):
        size = np.linalg.norm(change, axis=1)
        # Smooth motion hardly affects second differences: their median is the noise.
        noise = np.median(np.abs(np.diff(size, 2))) if len(size) > 2 else 0.0
        moves |= size > smallest + 3.0 * noise
    # A jump of tracking ends at once, a motion does not.
    lasting = moves & np.roll(moves, -max(1, len(start) // 4))
    return reference, float(
        body.seconds[int(np.argmax(lasting))] if lasting.any() else body.seconds[-1])


def _median_rotation(rotation: Array) -> Array:
    """Return the median rotation (3, 3), axis by axis, of rotations (N, 3, 3)."""
    reference = rotation[len(rotation) // 2]
    from_reference = np.median(lie.log_so3(reference.T @ rotation), axis=0)
    return np.asarray(reference @ lie.exp_so3(from_reference))


def _is_typical(deviation: Array) -> Mask:
    """Return the mask of samples within five robust deviations of the median in every axis."""
    typical = MAD_TO_STD * np.median(np.abs(deviation), axis=0)
    # Without noise the median is a rounding error: the constant tolerates such deviations.
    return np.asarray(np.all(np.abs(deviation) <= 5.0 * typical + 1e-6, axis=1))


def levelling(direction: ArrayLike) -> Array:
    """
    Return the smallest rotation (3, 3) that maps a direction to -z.

    The rotation maps poses of a world with gravity in this direction to a world with z up; for
    gravity along z, the half turn is about x.
    """
    down = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    axis = np.cross(down, DOWN)
    sine, cosine = float(np.linalg.norm(axis)), float(down @ DOWN)
    if sine < 1e-12:
        return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(lie.exp_so3(axis / sine * np.arctan2(sine, cosine)))


ROTATION_RATE_HZ = 50.0
"""Rate at which rotations of the bodies are compared, Hz."""

ROTATION_SAMPLES = 15
"""Number of samples of each compared rotation."""

MIN_CORRELATION = 0.3
"""Smallest correlation of the rotations with aligned clocks; with wrong clocks the correlation is
below 0.2."""


def rotation_correlation(
    tool: Trajectory, package: Trajectory, one_world: bool = False
) -> tuple[Array, Array]:
    """
    Return lags (K,), s, of the tool's stamps behind the package's, and the rotations' correlation.

    Angles of rotations are correlated or, if both bodies have one world, rotations in axes of this
    world. The result is empty if a body hardly rotates, or its time span is too short or
    implausibly long (damaged stamps).
    """
    rotations = []
    for body in (tool, package):
        count = int((body.stamps_ns[-1] - body.stamps_ns[0]) / NS_PER_S * ROTATION_RATE_HZ)
        if not ROTATION_SAMPLES < count <= MAX_GRID_SAMPLES:
            return np.empty(0), np.empty(0)
        stamps = body.stamps_ns[0] + np.rint(
            np.arange(count) * (NS_PER_S / ROTATION_RATE_HZ)).astype(np.int64)
        R = resample(body, stamps).rotation
        rotation = lie.log_so3(R[ROTATION_SAMPLES:] @ np.swapaxes(R[:-ROTATION_SAMPLES], 1, 2))
        rotation = rotation if one_world else np.linalg.norm(rotation, axis=1, keepdims=True)
        rotation -= rotation.mean(axis=0)
        size = float(np.linalg.norm(rotation))
        if size < 0.01 * np.sqrt(len(rotation)):  # rad; the body hardly rotates
            return np.empty(0), np.empty(0)
        rotations.append(rotation / size)
    count, before = sum(map(len, rotations)) - 1, len(rotations[1]) - 1
    of_tool, of_package = (np.fft.rfft(rotation, count, axis=0) for rotation in rotations)
    correlation = np.fft.irfft(np.sum(of_tool * np.conj(of_package), axis=1), count)
    lags = (np.arange(count) - before) / ROTATION_RATE_HZ
    return (lags + float(tool.stamps_ns[0] - package.stamps_ns[0]) / NS_PER_S,
            np.roll(correlation, before))


def rough_offsets(tool: Trajectory, package: Trajectory) -> list[float]:
    """
    Return the likely delays (s) of the tool's stamps behind the package's, by their rotations.

    A repetitive motion has several lags of similar correlation, and a swinging package can have a
    larger correlation at a wrong lag. The lag nearest to 0 is the first of the result.

    Raises
    ------
    BellowsError
        If the rotations agree at no lag, or, with little rotation, the streams do not overlap.

    """
    lags, correlation = rotation_correlation(tool, package)
    largest = float(np.max(correlation, initial=0.0))
    if largest >= MIN_CORRELATION:
        is_peak = correlation >= np.maximum(np.roll(correlation, 1), np.roll(correlation, -1))
        highest = np.argsort(-np.where(is_peak, correlation, 0.0))[:3]
        is_similar = correlation[highest] >= 0.9 * largest
        return sorted(lags[highest[is_similar]].tolist(), key=abs)
    first, last = common_span(tool, package)
    if not len(lags) and first < last:
        return [0.0]
    raise BellowsError(
        'The stamps of tool and package cannot be aligned: the two do not turn alike at any '
        f'offset (correlation {largest:.2f}). Check the topics, or turn the tool more.')


MIN_ROTATION = 0.02
"""Smallest rotation between two poses that determines the rotation between the worlds, rad."""


def pose_of(text: str) -> Array:
    """Return the seven numbers (7,) of recording.package_world."""
    return np.array([float(part) for part in text.split()])


def in_tool_world(package: PoseStream, pose: Array, frame_id: str) -> PoseStream:
    """Return the package's poses in the frame of the tool's, from the pose (7,) of their world."""
    R = lie.quaternion_to_rotation(pose[3:])
    return replace(package, frame_id=frame_id, position=pose[:3] + lie.apply(R, package.position),
                   rotation=R @ package.rotation)


def hand_eye(
    tool: Trajectory, package: Trajectory, length: float, com: Array,
    origin_to_lip: Array | None = None,
) -> tuple[Array, Alignment | None]:
    """
    Return initial guesses of the pose (7,) of the package's world, and of an unknown marker.

    The slowest poses are treated as poses of one rigid body (hand-eye calibration).

    Parameters
    ----------
    tool, package : Trajectory
        Poses of E, and of the marker, each in the frame of its world.
    length : float
        Length of the cup, m.
    com : ndarray (3,)
        Position of B in the lip frame, m.
    origin_to_lip : ndarray (3,), optional
        Vector from the origin of a known marker with axes of S to the lip, m.

    Raises
    ------
    BellowsError
        If there are too few common poses, or the tool's rotation is too small for an unknown
        marker.

    """
    hand, eye = slow_poses(tool, package)
    lip = np.array([0.0, 0.0, -length])
    if origin_to_lip is not None:
        R = lie.mean_rotation(hand.rotation @ np.swapaxes(eye.rotation, 1, 2))
        origin = (hand.position + lie.apply(hand.rotation, lip - origin_to_lip)
                  - lie.apply(R, eye.position)).mean(axis=0)
        return np.concatenate([origin, lie.rotation_to_quaternion(R)]), None
    R = rotation_of(hand.rotation, eye.rotation)
    R_marker_lip = lie.mean_rotation(np.swapaxes(eye.rotation, 1, 2) @ R.T @ hand.rotation)
    # o + R o_M + R_E c = o_E + R_E (lip + com)
    A = np.concatenate([np.tile(np.eye(3), (len(hand), 1, 1)), hand.rotation], axis=2)
    b = hand.position + lie.apply(hand.rotation, com + lip) - lie.apply(R, eye.position)
    x = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=1e-6)[0]
    return np.concatenate([x[:3], lie.rotation_to_quaternion(R)]), Alignment(
        np.eye(3), R_marker_lip, x[3:], np.zeros(3))


def shifted_pose(pose: Array, R_world_recorded: Array, middle: Array, theta: Array) -> Array:
    """
    Return a pose (7,) of a world after a small motion theta (6,) of the world.

    The motion is about a point (3,) and in axes of the levelled world, m and rad.
    """
    level = lie.transform(R_world_recorded, np.zeros(3))
    R = lie.exp_so3(theta[3:])
    move = lie.transform(R, middle + theta[:3] - R @ middle)
    T = lie.inverse_transform(level) @ move @ level @ lie.transform(
        lie.quaternion_to_rotation(pose[3:]), pose[:3])
    return np.concatenate([T[:3, 3], lie.rotation_to_quaternion(T[:3, :3])])


def motion_words(theta: Array, std: Array | None = None) -> str:
    """Return words for the difference of the worlds (6,), m and rad, with its errors (6,)."""
    sizes = []
    for part, scale, unit in ((slice(3, 6), np.rad2deg(1.0), 'degrees'), (slice(0, 3), 1e3, 'mm')):
        size = float(np.linalg.norm(theta[part]))
        error = '' if std is None else (
            f' ± {scale * np.linalg.norm(theta[part] * std[part]) / max(size, 1e-12):.2g}')
        sizes.append(f'{scale * size:.{2 if scale < 1e3 else 1}f}{error} {unit}')
    return f', turned by {sizes[0]} and apart by {sizes[1]}'


def slow_poses(tool: Trajectory, package: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return valid poses of both bodies at common stamps, the slower half."""
    first, last = common_span(tool, package)
    count = int((last - first) / NS_PER_S * 50.0)  # Hz
    if count < 20:
        raise BellowsError(
            'The poses of tool and package overlap too little to estimate '
            'recording.package_world. Record longer, or give its seven numbers.')
    stamps = first + np.linspace(0, last - first, count).astype(np.int64)  # exact to 1 ns
    hand, eye = (resample(body, stamps) for body in (tool, package))
    rotation = np.zeros((count, 3))
    rotation[1:] = lie.log_so3(np.swapaxes(hand.rotation[:-1], 1, 2) @ hand.rotation[1:])
    sizes = [np.linalg.norm(change, axis=1)
             for change in (np.gradient(hand.position, axis=0), rotation)]
    speed = sum(size / max(float(np.median(size)), 1e-9) for size in sizes)
    slow = (speed <= np.quantile(speed, 0.5)) & hand.valid & eye.valid  # the slower half
    return hand.select(slow), eye.select(slow)


def rotation_of(R_tool: Array, R_package: Array) -> Array:
    """Return the rotation between the worlds with which the rotations of both bodies agree."""
    step = len(R_tool) // 15 + 1
    a, b = (np.concatenate([lie.log_so3(R[first::step] @ R[first].T)
                            for first in range(0, len(R), step)]) for R in (R_tool, R_package))
    if np.quantile(np.linalg.norm(a, axis=1), 0.9) < MIN_ROTATION:
        raise BellowsError(
            'recording.package_world cannot be estimated: the tool hardly turns in this '
            'recording. Tilt and turn it, best with standstills in between, or give the seven '
            'numbers.')
    return lie.nearest_rotation(a.T @ b)
