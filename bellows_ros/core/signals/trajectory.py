"""
Recorded streams and trajectories: stamped poses and twists.

All classes check themselves on construction, and are read-only. Stamps are integer nanoseconds;
only differences become seconds. With tool_pose.offset, the tool tip E has this pose in the
recorded or received frame.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask, real_numbers, Stamps
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Largest entry of R^T R - I by rounding of a recorded rotation.
ORTHONORMALITY_TOLERANCE = 1e-6
# Largest deviation of a step from the mean step of a uniform rate, relative. At 360 Hz and 1 m/s
# it shifts a sample by 28 um, less than the noise of a motion capture system.
UNIFORMITY_TOLERANCE = 0.01
NS_PER_S = 1_000_000_000
# Number of rotations checked at a time, with entries in the processor's cache.
CHECK_BLOCK = 2048


class _Stamped:
    """Data with stamps."""

    stamps_ns: Stamps

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, eq=False)
class PoseStream(_Stamped):
    """
    Poses of one body as recorded on one topic.

    Parameters
    ----------
    name : str
        Topic or other source, for messages.
    frame_id : str
        Frame of the poses.
    stamps_ns : int array (N,)
        Header stamps, strictly increasing, ns.
    position : array (N, 3)
        Origin of the body in the frame, m.
    rotation : array (N, 3, 3)
        R_world_body.
    refused : mapping of str to tuple of int
        Indices of the omitted messages by reason, in the order of the topic.
    covariance : array (N, 6, 6), optional
        Covariance of position (m) and rotation (rad) about axes of the frame, as in messages.
    corners : array (N, 8), optional
        Corners of a detected tag in the image of an undistorted camera of unit focal length.
    calibration : str
        Topic of the camera's calibration, if corners are recorded.
    focal : float
        Focal length of this camera, pixels; 0 if unknown.
    clock_steps : tuple of (int, float)
        Steps of the clock that stamps, by arrivals: stamp before each (ns), and size (s).

    Raises
    ------
    BellowsError
        If shapes disagree, stamps do not increase, a number is not finite or a rotation is not
        orthonormal.

    """

    name: str
    frame_id: str
    stamps_ns: Stamps
    position: Array
    rotation: Array
    refused: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    covariance: Array | None = None
    clock_steps: tuple[tuple[int, float], ...] = ()
    corners: Array | None = None
    calibration: str = ''
    focal: float = 0.0

    def __post_init__(self) -> None:
        _freeze_arrays(
            self, f"Poses '{self.name}'", position=(3,), rotation=(3, 3), corners=(8,))

    def trajectory(self) -> 'Trajectory':
        """Return the poses as a trajectory whose samples are all valid."""
        return Trajectory(self.stamps_ns, self.position, self.rotation)


@dataclass(frozen=True, eq=False)
class TwistStream(_Stamped):
    """
    Twists of one body as recorded on one topic, in the recorded axes.

    Parameters
    ----------
    name : str
        Topic or other source, for messages.
    frame_id : str
        Frame named by the recording.
    stamps_ns : int array (N,)
        Header stamps, strictly increasing, ns.
    linear, angular : array (N, 3)
        m/s and rad/s.
    refused : mapping of str to tuple of int
        Indices of the omitted messages by reason, in the order of the topic.

    Raises
    ------
    BellowsError
        If shapes disagree, stamps do not increase or a number is not finite.

    """

    name: str
    frame_id: str
    stamps_ns: Stamps
    linear: Array
    angular: Array
    refused: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _freeze_arrays(self, f"Twists '{self.name}'", linear=(3,), angular=(3,))


@dataclass(frozen=True, eq=False)
class Trajectory(_Stamped):
    """
    Poses of one body over time, with body twists and their derivatives if given.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Strictly increasing, ns.
    position : array (N, 3)
        Origin of the body in the world, m.
    rotation : array (N, 3, 3) or scipy Rotation
        R_world_body.
    twist : array (N, 6), optional
        Body twist, linear first: R^T do/dt (m/s) and body rate (rad/s) (4.30).
    acceleration : array (N, 6), optional
        Time derivative of the body twist, m/s^2 and rad/s^2.
    valid : bool array (N,) or bool, optional
        False for samples that must not be used; one value stands for all. Invalid samples also
        have finite poses.

    Raises
    ------
    BellowsError
        If shapes disagree, stamps do not increase, a number is not finite or a rotation is not
        orthonormal.

    Examples
    --------
    >>> poses = bellows_ros.Trajectory(
    ...     stamps_ns=[0, 10_000_000], position=np.zeros((2, 3)), rotation=[np.eye(3)] * 2)
    >>> poses.seconds.tolist()
    [0.0, 0.01]

    """

    stamps_ns: Stamps
    position: Array
    rotation: Array
    twist: Array | None = None
    acceleration: Array | None = None
    valid: Mask = field(default_factory=lambda: np.array(True))

    def __post_init__(self) -> None:
        _freeze_arrays(self, 'Trajectory', position=(3,), rotation=(3, 3), twist=(6,),
                       acceleration=(6,))
        mask = np.array(self.valid)
        if mask.ndim == 0:
            mask = np.full(len(self), mask)
        if mask.shape != (len(self),) or mask.dtype != np.bool_:
            raise BellowsError(
                f'Trajectory: valid must be booleans of shape ({len(self)},), not {mask.dtype} '
                f'of shape {mask.shape}.')
        _store(self, 'valid', mask)

    @property
    def seconds(self) -> Array:
        """Times since the first sample, s (N,)."""
        return (self.stamps_ns - self.stamps_ns[:1]) / NS_PER_S

    def select(self, index: slice | Mask | Stamps) -> 'Trajectory':
        """
        Return the samples selected by a slice, a mask or increasing indices.

        Samples are not checked again, and a slice copies nothing.
        """
        picked = copy(self)
        _store(picked, 'stamps_ns', checked_stamps(self.stamps_ns[index], 'Picked samples'))
        for name in ('position', 'rotation', 'twist', 'acceleration', 'valid'):
            array = getattr(self, name)
            _store(picked, name, None if array is None else array[index])
        return picked

    def between(self, first_ns: int, last_ns: int) -> 'Trajectory':
        """Return the samples from one stamp to another, both included."""
        first = int(np.searchsorted(self.stamps_ns, first_ns))
        return self.select(slice(first, int(np.searchsorted(self.stamps_ns, last_ns, 'right'))))


@dataclass(frozen=True, eq=False)
class Filtered(Trajectory):
    """
    A trajectory whose twists and accelerations were estimated from poses.

    Parameters
    ----------
    weights : array (3, 2n+1), keyword only
        Weights of the positions and relative rotation vectors in the value, first and second
        derivative (rows; 1, 1/s, 1/s^2) at a sample, from n samples before to n after it.
        Independent noise of standard deviation sigma contributes sigma times the Euclidean norm of
        a row.

    Notes
    -----
    The other fields are as in `Trajectory`; twist and acceleration are always present.

    """

    twist: Array
    acceleration: Array
    weights: Array = field(kw_only=True)


def same_frame(*frame_ids: str) -> bool:
    """
    Return whether frames may be one.

    A message without frame_id is in the expected frame; tf2 ignores a slash before a name.
    """
    return len({name.removeprefix('/') for name in frame_ids} - {''}) < 2


def uniform_rate_hz(stamps_ns: Stamps) -> float:
    """
    Return the rate of uniformly spaced stamps.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Strictly increasing, ns.

    Returns
    -------
    float
        Hz.

    Raises
    ------
    BellowsError
        With fewer than two stamps, or where a step differs from the mean step by more than
        `UNIFORMITY_TOLERANCE` of it.

    """
    if len(stamps_ns) < 2:
        raise BellowsError(f'A rate needs at least 2 stamps, not {len(stamps_ns)}.')
    steps = np.diff(stamps_ns)
    mean = float(stamps_ns[-1] - stamps_ns[0]) / len(steps)
    worst = int(np.argmax(np.abs(steps - mean)))
    if abs(steps[worst] - mean) > UNIFORMITY_TOLERANCE * mean:
        raise BellowsError(
            f'A uniform rate is needed, but sample {worst + 1} comes {steps[worst]} ns after the '
            f'one before, and the mean step is {mean:.1f} ns. Resample the poses to a uniform '
            'rate first.')
    return NS_PER_S / mean


def any_within(mask: Mask, width: int) -> Mask:
    """Return whether any of each `width` consecutive samples is set (N - width + 1,)."""
    total = np.concatenate([[0], np.cumsum(mask)])
    return np.asarray(total[width:] > total[:-width])


Stamped = TypeVar('Stamped', PoseStream, TwistStream, Trajectory)
Posed = TypeVar('Posed', PoseStream, Trajectory)


def pose_rows(poses: Trajectory | PoseStream) -> Array:
    """Return poses as rows (N, 7): position, quaternion (x, y, z, w)."""
    return np.hstack([poses.position, lie.rotation_to_quaternion(poses.rotation)])


def earlier(stream: Stamped, seconds: float) -> Stamped:
    """Return a stream with stamps earlier by some seconds."""
    return replace(stream, stamps_ns=stream.stamps_ns - round(seconds * NS_PER_S))


def checked_stamps(stamps_ns: ArrayLike, of: str) -> Stamps:
    """Return stamps as a read-only int64 array, or raise an error."""
    stamps = np.asarray(stamps_ns)
    if stamps.ndim != 1 or not (stamps.size == 0 or np.issubdtype(stamps.dtype, np.integer)):
        raise BellowsError(
            f'{of}: stamps must be integers (ns) of shape (N,), not '
            f'{stamps.dtype} of shape {stamps.shape}.')
    if not (_is_frozen(stamps) and stamps.dtype == np.int64):
        stamps = stamps.astype(np.int64)
    backward = np.diff(stamps) <= 0
    if backward.any():
        i = int(np.argmax(backward))
        raise BellowsError(
            f'{of}: stamps must increase strictly, but sample {i + 1} has {stamps[i + 1]} ns '
            f'after {stamps[i]} ns. Sort the samples and leave repeated stamps out.')
    return stamps


def _freeze_arrays(owner: Any, of: str, **shapes: tuple[int, ...]) -> None:
    """Check and freeze the owner's stamps and arrays, given the number of entries per sample."""
    _store(owner, 'stamps_ns', checked_stamps(owner.stamps_ns, of))
    for name, of_one in shapes.items():
        given, shape = getattr(owner, name), (len(owner), *of_one)
        if given is None:
            continue
        source = given.as_matrix() if hasattr(given, 'as_matrix') else given
        is_ready = getattr(source, 'dtype', None) == np.float64 and _is_frozen(source)
        array = source if is_ready else real_numbers(source, f'{name} of {of}')
        if array.shape != shape:
            raise BellowsError(
                f'{of}: {name} must have shape {shape} for {shape[0]} stamps, not {array.shape}.')
        if not np.all(np.isfinite(array)):
            finite = np.isfinite(array).reshape(shape[0], -1).all(axis=1)
            raise BellowsError(
                f'{of}: {name} of sample {int(np.argmin(finite))} is not finite. '
                'Leave such samples out.')
        if name == 'rotation':
            _require_rotations(array, of)
        _store(owner, name, array)


def frozen(array: NDArray[Any]) -> Any:
    """Return a read-only view of an array, which objects need not copy."""
    array.setflags(write=False)
    return array


def _is_frozen(array: NDArray[Any]) -> bool:
    """Return whether an array, and the array that it views, is read-only."""
    base = array.base
    owner_frozen = base is None or (isinstance(base, np.ndarray) and not base.flags.writeable)
    return owner_frozen and not array.flags.writeable


def _store(owner: object, name: str, array: NDArray[Any] | None) -> None:
    """Make an array read-only and set it on a frozen owner."""
    object.__setattr__(owner, name, None if array is None else frozen(array))


def _require_rotations(rotation: Array, of: str) -> None:
    """Raise BellowsError for matrices that are not rotations."""
    for start in range(0, len(rotation), CHECK_BLOCK):
        # Loops over entries are twenty times faster than loops over samples.
        x, y, z = rotation[start:start + CHECK_BLOCK].transpose(1, 2, 0).copy()
        across = x[[1, 2, 0]] * y[[2, 0, 1]] - x[[2, 0, 1]] * y[[1, 2, 0]]
        error = np.max(np.abs([
            np.sum(x * x, axis=0) - 1.0, np.sum(y * y, axis=0) - 1.0, np.sum(x * y, axis=0),
            *(across - z)]), axis=0)
        if np.any(bad := error > ORTHONORMALITY_TOLERANCE):
            i = int(np.argmax(bad))
            raise BellowsError(
                f'{of}: the rotation of sample {start + i} is not orthonormal and right-handed '
                f'to {ORTHONORMALITY_TOLERANCE:g} (off by {error[i]:.3g}). '
                'Normalise the quaternions before converting them.')


def at_tip(motion: Posed, tip: Array | None) -> Posed:
    """Return the motion of frames with poses (4, 4) or (N, 4, 4) in a moving frame."""
    if tip is None:
        return motion
    X, rates = lie.adjoint(lie.inverse_transform(tip)), ('twist', 'acceleration')
    changed: dict[str, Any] = {
        name: lie.apply(X, getattr(motion, name)) for name in rates
        if getattr(motion, name, None) is not None}
    return replace(
        motion, position=motion.position + lie.apply(motion.rotation, tip[..., :3, 3]),
        rotation=motion.rotation @ tip[..., :3, :3], **changed)


def from_tip(motion: Trajectory, tip: Array | None) -> Trajectory:
    """Return the motion of the frame in which E has a pose (4, 4), from the motion of E."""
    return at_tip(motion, None if tip is None else lie.inverse_transform(tip))


def streams_at_tip(
    poses: PoseStream, twists: TwistStream | None, tip: Array | None, in_world: bool
) -> tuple[PoseStream, TwistStream | None]:
    """Return poses and twists of E from recorded poses and twists of another tool frame."""
    moved = at_tip(poses, tip)
    if tip is None or twists is None:
        return moved, twists
    R, lever = tip[:3, :3], np.broadcast_to(tip[:3, 3], twists.linear.shape)
    if in_world:  # orientation of the nearest pose
        later = np.searchsorted(poses.stamps_ns, twists.stamps_ns).clip(1, len(poses) - 1)
        before = twists.stamps_ns - poses.stamps_ns[later - 1]
        nearest = np.where(before < poses.stamps_ns[later] - twists.stamps_ns, later - 1, later)
        R, lever = np.eye(3), lie.apply(poses.rotation[nearest], tip[:3, 3])
    return moved, replace(
        twists, linear=(twists.linear + np.cross(twists.angular, lever)) @ R,
        angular=twists.angular @ R)
