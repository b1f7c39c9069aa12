"""From decoded messages to streams: what cannot be used is left out, and counted by reason."""

from collections.abc import Mapping
from types import MappingProxyType

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.lie import quaternion_to_rotation
from bellows_ros.core.recording.screening import unusable_stamps
from bellows_ros.core.trajectory import PoseStream, TwistStream
from bellows_ros.files.cdr import Decoded
import numpy as np

Refused = dict[str, tuple[int, ...]]

# A quaternion shorter than this is zero; one whose norm is off by more than that is no unit
# quaternion. Smaller deviations are the rounding of drivers that send single precision or a few
# decimals.
ZERO_QUATERNION_BELOW = 1e-6
NOT_UNIT_ABOVE = 0.01
# No robot is further away (m), or faster (m/s, rad/s), than this; a damaged message may say so.
LARGEST_VALUE = 1e6

REASONS: Mapping[str, str] = MappingProxyType(
    {
        'malformed': 'could not be decoded',
        'zero_stamp': 'have no stamp',
        'nan': 'hold NaN or infinity',
        'out_of_range': f'hold a number above {LARGEST_VALUE:g}',
        'zero_quaternion': 'have a quaternion of zero',
        'not_unit': f'have a quaternion whose norm is off by more than {NOT_UNIT_ABOVE:.0%}',
        'frame_id': 'name another frame than most',
        'duplicate_stamp': 'repeat the stamp before',
        'backward_stamp': 'have a stamp before an earlier one',
        'future_stamp': 'have a stamp ahead of its time',
    }
)

_ROTATIONS_AT_ONCE = 65536


def describe(refused: Mapping[str, tuple[int, ...]]) -> str:
    """Return the refusals in words: how many of each reason, and where the first is."""
    parts = [
        f'{len(indices)} {REASONS.get(reason, reason)} (first: message {indices[0]})'
        for reason, indices in refused.items()
        if indices
    ]
    return ', '.join(parts) or 'none'


def pose_stream(name: str, decoded: Decoded) -> PoseStream:
    """
    Return the usable poses.

    Parameters
    ----------
    name : str
        Topic.
    decoded : Decoded
        In the recording's order; values are x, y, z and the quaternion (x, y, z, w).

    Returns
    -------
    PoseStream
        Its `refused` holds only the reasons that occur; each message is counted once, under the
        first that applies.

    """
    norm = _norm(decoded.values[:, 3:])
    unusable = {
        'zero_quaternion': norm < ZERO_QUATERNION_BELOW,
        'not_unit': np.abs(norm - 1.0) > NOT_UNIT_ABOVE,
    }
    used, frame_id, refused = _sift(decoded, decoded.values[:, :3], unusable)
    return PoseStream(
        name=name,
        frame_id=frame_id,
        stamps_ns=decoded.stamps_ns[used],
        position=decoded.values[used, :3],
        rotation=_rotations(decoded.values[used, 3:]),
        refused=refused,
    )


def twist_stream(name: str, decoded: Decoded, in_child_frame: bool) -> TwistStream:
    """
    Return the usable twists, in the axes they were recorded in.

    Parameters
    ----------
    name : str
        Topic.
    decoded : Decoded
        In the recording's order; values are linear, then angular.
    in_child_frame : bool
        True for Odometry, whose twist is in its child frame: that frame becomes the stream's.

    Returns
    -------
    TwistStream
        With `refused` as in `pose_stream`.

    """
    used, frame_id, refused = _sift(decoded, decoded.values, {}, -1 if in_child_frame else 0)
    return TwistStream(
        name=name,
        frame_id=frame_id,
        stamps_ns=decoded.stamps_ns[used],
        linear=decoded.values[used, :3],
        angular=decoded.values[used, 3:],
        refused=refused,
    )


def _norm(values: Array) -> Array:
    """Return the norms of rows; infinite where the square overflows."""
    with np.errstate(over='ignore', invalid='ignore'):
        return np.asarray(np.linalg.norm(values, axis=1))


def _sift(
    decoded: Decoded, lengths: Array, unusable: Mapping[str, Mask], frame_name: int = 0
) -> tuple[Stamps, str, Refused]:
    """Return the indices of the usable messages, their frame, and the others by reason."""
    finite = np.isfinite(decoded.values).all(axis=1)
    tests = {
        'malformed': decoded.frame < 0,
        'zero_stamp': decoded.stamps_ns == 0,
        'nan': ~finite,
        'out_of_range': finite & (np.abs(lengths) > LARGEST_VALUE).any(axis=1),
        **unusable,
    }
    left = np.arange(len(decoded.stamps_ns))
    refused: Refused = {}
    for reason, bad in tests.items():
        left = _refuse(refused, reason, left, bad[left])
    frame = _most_common(decoded.frame[left])
    left = _refuse(refused, 'frame_id', left, decoded.frame[left] != frame)
    arrivals = None if decoded.arrivals_ns is None else decoded.arrivals_ns[left]
    unusable = unusable_stamps(decoded.stamps_ns[left], arrivals)
    for reason, bad in unusable.items():
        _refuse(refused, reason, left, bad)
    left = left[~np.logical_or.reduce(list(unusable.values()))]
    return left, decoded.frames[frame][frame_name] if len(left) else '', refused


def _refuse(
    refused: Refused, reason: str, left: Stamps, bad: Mask
) -> Stamps:
    """Note the bad ones of the messages left, and return the others."""
    if bad.any():
        refused[reason] = tuple(int(i) for i in left[bad])
    return left[~bad]


def _most_common(frame: Stamps) -> int:
    """Return the frame most messages have; of equals, the one met first."""
    return int(np.argmax(np.bincount(frame))) if len(frame) else 0


def _rotations(quaternion_xyzw: Array) -> Array:
    """Return rotation matrices, converted in parts to spare memory."""
    rotation = np.empty((len(quaternion_xyzw), 3, 3))
    for start in range(0, len(quaternion_xyzw), _ROTATIONS_AT_ONCE):
        part = slice(start, start + _ROTATIONS_AT_ONCE)
        rotation[part] = quaternion_to_rotation(quaternion_xyzw[part])
    return rotation
