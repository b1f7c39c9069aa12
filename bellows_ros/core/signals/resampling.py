"""
Trajectories at other stamps, and at a uniform rate: on SO(3) x R^3, never extrapolated.

The filter needs uniform samples. Stamps that are uniform but for their rounding keep their samples
as they are; others are interpolated along geodesics. What lies in a gap gets an interpolated pose,
so that arrays stay finite, and is invalid.
"""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.signals.timing import subdivided, Timing
from bellows_ros.core.signals.trajectory import (
    checked_stamps,
    frozen,
    NS_PER_S,
    Trajectory,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike


def resample(
    trajectory: Trajectory, stamps_ns: ArrayLike, longest_gap_ns: int | None = None
) -> Trajectory:
    """
    Interpolate a trajectory at other stamps, without extrapolating.

    With twists the interpolant is the cubic Hermite polynomial on SO(3) x R^3: in the position,
    with the end velocities R v, and in the rotation vector c of R = R_0 exp(c), with c(0) = 0,
    c'(0) = h w_0, c(1) = log(R_0^T R_1) and c'(1) = dexp(-c(1))^-1 h w_1, where w is the body rate
    and h the interval. It is once differentiable and of fourth order; its own body twist is
    returned. Without twists positions go straight and rotations along the geodesic, and no twist
    is returned. A stamp of the trajectory itself returns that very sample. The result has no
    accelerations.

    Parameters
    ----------
    trajectory : Trajectory
        Samples at any stamps, with twists or without.
    stamps_ns : int array (M,)
        Wanted stamps, strictly increasing, ns, inside the trajectory's first and last.
    longest_gap_ns : int, optional
        A stamp between two samples further apart than this is not valid, ns.

    Returns
    -------
    Trajectory
        Its sample is valid when the sample it repeats, or both samples it lies between, are.

    Raises
    ------
    BellowsError
        If a stamp lies outside the trajectory.

    """
    wanted = checked_stamps(stamps_ns, 'Wanted stamps')
    known = trajectory.stamps_ns
    if len(wanted) and not (len(known) and known[0] <= wanted[0] and wanted[-1] <= known[-1]):
        span = f'{known[0]} to {known[-1]} ns' if len(known) else 'no time (it is empty)'
        raise BellowsError(
            f'The requested stamps cover {wanted[0]} to {wanted[-1]} ns, the trajectory only '
            f'{span}. Poses are never extrapolated; request stamps inside the trajectory.'
        )
    before = np.searchsorted(trajectory.stamps_ns, wanted, side='right') - 1
    same = slice(before[0], before[-1] + 1) if len(before) else slice(0)
    if np.array_equal(trajectory.stamps_ns[same], wanted):  # nothing to interpolate, or to copy
        return replace(trajectory.select(same), acceleration=None)
    position, rotation = trajectory.position[before], trajectory.rotation[before]
    twist = None if trajectory.twist is None else trajectory.twist[before]
    valid = trajectory.valid[before]
    between = np.flatnonzero(wanted != trajectory.stamps_ns[before])
    start, end = before[between], before[between] + 1
    interval = trajectory.stamps_ns[end] - trajectory.stamps_ns[start]
    fraction = ((wanted[between] - trajectory.stamps_ns[start]) / interval)[:, None]
    if trajectory.twist is None or twist is None:
        position[between], rotation[between] = _geodesic(trajectory, start, end, fraction)
    else:
        position[between], rotation[between], twist[between] = _hermite(
            trajectory, trajectory.twist, start, end, fraction, (interval / NS_PER_S)[:, None]
        )
    near = longest_gap_ns is None or interval <= longest_gap_ns
    valid[between] &= trajectory.valid[end] & near
    return Trajectory(
        frozen(wanted), frozen(position), frozen(rotation),
        None if twist is None else frozen(twist), None, valid,
    )


def _geodesic(
    trajectory: Trajectory, before: Stamps, after: Stamps, s: Array
) -> tuple[Array, Array]:
    """Return positions and rotations at fractions s (M, 1) of the geodesics between samples."""
    start, end = trajectory.position[before], trajectory.position[after]
    R_start = trajectory.rotation[before]
    turn = lie.log_so3(np.swapaxes(R_start, -1, -2) @ trajectory.rotation[after])
    return start + s * (end - start), R_start @ lie.exp_so3(s * turn)


def _hermite(
    trajectory: Trajectory,
    twist: Array,
    before: Stamps,
    after: Stamps,
    s: Array,
    interval_s: Array,
) -> tuple[Array, Array, Array]:
    """Return positions, rotations and body twists of the cubic Hermite interpolant at s (M, 1)."""
    R_start, R_end = trajectory.rotation[before], trajectory.rotation[after]
    start, end = twist[before] * interval_s, twist[after] * interval_s
    origin = trajectory.position[before]
    step, step_rate = _cubic(
        s,
        lie.apply(R_start, start[:, :3]),
        trajectory.position[after] - origin,
        lie.apply(R_end, end[:, :3]),
    )
    turn = lie.log_so3(np.swapaxes(R_start, -1, -2) @ R_end)
    c, c_rate = _cubic(s, start[:, 3:], turn, lie.apply(lie.dexp_inverse(-turn), end[:, 3:]))
    rotation = R_start @ lie.exp_so3(c)
    linear = lie.apply(np.swapaxes(rotation, -1, -2), step_rate)
    angular = lie.apply(lie.dexp(-c), c_rate)
    return origin + step, rotation, np.concatenate([linear, angular], axis=-1) / interval_s


def _cubic(s: Array, rate_start: Array, end: Array, rate_end: Array) -> tuple[Array, Array]:
    """Return the cubic over 0..1 from zero to `end` with these end rates, and its derivative."""
    quadratic = 3.0 * end - 2.0 * rate_start - rate_end
    cubic = rate_start + rate_end - 2.0 * end
    value = s * (rate_start + s * (quadratic + s * cubic))
    return value, rate_start + s * (2.0 * quadratic + s * 3.0 * cubic)


# A grid may have this many samples, or this many per message: a stamp far away is no recording.
LARGEST_GRID = 1_000_000
LARGEST_GRID_PER_MESSAGE = 10


def on_grid(trajectory: Trajectory, timing: Timing) -> Trajectory:
    """
    Return poses at a uniform rate.

    Parameters
    ----------
    trajectory : Trajectory
        Poses as recorded, with what is known to be wrong marked invalid.
    timing : Timing
        Of its stamps.

    Returns
    -------
    Trajectory
        Uniform stamps. Samples are copied where the recorded stamps are uniform and interpolated
        where they are not; those in gaps, or beside an invalid sample they were interpolated
        from, are invalid.

    Raises
    ------
    BellowsError
        If the stamps cover far more time than the samples fill.

    """
    span = float(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    count = span * timing.rate_hz / NS_PER_S
    if count > max(LARGEST_GRID, LARGEST_GRID_PER_MESSAGE * len(trajectory)):
        raise BellowsError(
            f'{len(trajectory)} poses at {timing.rate_hz:.6g} Hz should cover '
            f'{len(trajectory) / timing.rate_hz:.6g} s, but their stamps cover '
            f'{span / NS_PER_S:.6g} s. Cut the recording to the part with poses.'
        )
    if timing.uniform:
        slots = np.rint(np.diff(trajectory.stamps_ns) * (timing.rate_hz / NS_PER_S))
        stamps = subdivided(trajectory.stamps_ns, np.maximum(slots, 1.0).astype(np.int64))
    else:
        period = NS_PER_S / timing.rate_hz
        stamps = trajectory.stamps_ns[0] + np.rint(
            np.arange(int(span / period) + 1) * period).astype(np.int64)
    return resample(trajectory, stamps, timing.longest_step_ns)
