"""
Trajectories at other stamps, at a uniform rate, and filtered: on SO(3) x R^3, never extrapolated.

The filter needs uniform samples. Stamps that are uniform but for their rounding keep their samples
as they are; others are interpolated along geodesics. What lies in a gap gets an interpolated pose,
so that arrays stay finite, and is invalid.

The filter is that of Savitzky and Golay (4.15-4.63, appendix G). Around each sample a polynomial
in time is fitted to the positions and to the rotation vectors log(R(t_w) R(t_k)^T). At a uniform
rate the least-squares fit is one constant weight matrix times these increments (4.19, 4.44).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.lie import (
    apply,
    d2exp,
    dexp,
    dexp_inverse,
    exp_so3,
    log_quaternion,
    log_so3,
    quaternion_conjugate,
    quaternion_product,
    rotation_to_quaternion,
)
from bellows_ros.core.trajectory import (
    any_within,
    checked_stamps,
    Filtered,
    frozen,
    NS_PER_S,
    Trajectory,
    uniform_rate_hz,
    UNIFORM_WITHIN,
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
    turn = log_so3(np.swapaxes(R_start, -1, -2) @ trajectory.rotation[after])
    return start + s * (end - start), R_start @ exp_so3(s * turn)


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
        apply(R_start, start[:, :3]),
        trajectory.position[after] - origin,
        apply(R_end, end[:, :3]),
    )
    turn = log_so3(np.swapaxes(R_start, -1, -2) @ R_end)
    c, c_rate = _cubic(s, start[:, 3:], turn, apply(dexp_inverse(-turn), end[:, 3:]))
    rotation = R_start @ exp_so3(c)
    linear = apply(np.swapaxes(rotation, -1, -2), step_rate)
    angular = apply(dexp(-c), c_rate)
    return origin + step, rotation, np.concatenate([linear, angular], axis=-1) / interval_s


def _cubic(s: Array, rate_start: Array, end: Array, rate_end: Array) -> tuple[Array, Array]:
    """Return the cubic over 0..1 from zero to `end` with these end rates, and its derivative."""
    quadratic = 3.0 * end - 2.0 * rate_start - rate_end
    cubic = rate_start + rate_end - 2.0 * end
    value = s * (rate_start + s * (quadratic + s * cubic))
    return value, rate_start + s * (2.0 * quadratic + s * 3.0 * cubic)


# A step of more than this many periods is a gap: at least one sample is missing. Jitter of the
# stamps adds to it, as many of its standard deviations as here.
GAP_PERIODS = 1.5
GAP_DEVIATIONS = 3.0
# Steps within this part of the period count as uniform; `savgol` allows twice as much, measured
# from the mean step instead of the period estimated here.
COPIED_WITHIN = 0.5 * UNIFORM_WITHIN
# Stamps come in bursts where the mean of so many steps is mostly not within these factors
# of the usual step: half the samples may be lost, but none is there twice.
STEPS_TOGETHER = 20
MEAN_WITHIN = (0.8, 2.5)
# A grid may have this many samples, or this many per message: a stamp far away is no recording.
LARGEST_GRID = 1_000_000
LARGEST_GRID_PER_MESSAGE = 10
# Standard deviation of a normal distribution per median absolute deviation.
MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class Gap:
    """
    A time without samples.

    Parameters
    ----------
    index : int
        Sample before the gap, among those the stream has.
    start_ns : int
        Its stamp.
    duration_s : float
        Time to the next sample, s.

    """

    index: int
    start_ns: int
    duration_s: float


@dataclass(frozen=True)
class Timing:
    """
    How the stamps of a stream lie in time.

    Parameters
    ----------
    rate_hz : float
        Samples per second where none is missing.
    jitter_s : float
        Robust standard deviation of the steps between samples, s.
    uniform : bool
        Whether the stamps are uniform, so that no sample needs interpolation.
    gaps : tuple of Gap
        In order of time.

    """

    rate_hz: float
    jitter_s: float
    uniform: bool
    gaps: tuple[Gap, ...]

    @property
    def longest_step_ns(self) -> int:
        """Longest time between samples that is not a gap, ns."""
        return int(_longest_step(NS_PER_S / self.rate_hz, self.jitter_s * NS_PER_S))


def timing(stamps_ns: Stamps) -> Timing:
    """
    Estimate the rate and jitter of stamps, and find the gaps.

    The rate comes from the stamps alone, by medians, so that neither gaps nor a clock that runs
    fast or slow misleads it.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Strictly increasing, ns.

    Returns
    -------
    Timing

    Raises
    ------
    BellowsError
        With fewer than three stamps.

    """
    if len(stamps_ns) < 3:
        raise BellowsError(
            f'A rate needs at least 3 samples, got {len(stamps_ns)}. Record longer, or choose '
            'the topic with the poses.'
        )
    steps = np.diff(stamps_ns)
    period = _period(steps)
    jitter = MAD_TO_STD * float(np.median(np.abs(steps - period)))
    slots = np.maximum(np.rint(steps / period), 1.0)
    uniform = bool(np.all(np.abs(steps / (slots * period) - 1.0) <= COPIED_WITHIN))
    long = np.flatnonzero(steps > _longest_step(period, jitter))
    gaps = tuple(Gap(int(i), int(stamps_ns[i]), float(steps[i] / NS_PER_S)) for i in long)
    return Timing(NS_PER_S / period, jitter / NS_PER_S, uniform, gaps)


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


def _period(steps: Stamps) -> float:
    """
    Return the time between samples without gaps, ns.

    The median step knows the period to the stamps' resolution; the mean of the steps near it,
    which average that out, knows it better. Of stamps in pairs or bursts only the mean over many
    steps is the period.
    """
    together = min(STEPS_TOGETHER, max(len(steps) // 4, 1))
    usual = _usual(steps)
    mean = _usual(np.convolve(steps, np.ones(together), 'valid')) / together
    few, many = MEAN_WITHIN
    return usual if few * usual <= mean <= many * usual else mean


def _usual(values: Array | Stamps) -> float:
    """Return the mean of the values near their median, or the median if there are none."""
    median = float(np.median(values))
    near = values[np.abs(values - median) < 0.5 * median]
    return float(np.mean(near)) if len(near) else median


def _longest_step(period: float, jitter: float) -> float:
    """Return the longest step that is not a gap."""
    return GAP_PERIODS * period + GAP_DEVIATIONS * jitter


def subdivided(stamps_ns: Stamps, parts: Stamps) -> Stamps:
    """
    Return stamps with more of them put in between.

    Parameters
    ----------
    stamps_ns : int array (N,)
        ns.
    parts : int array (N - 1,)
        Into how many parts each step is cut.

    """
    last = len(parts) - 1
    step = np.append(np.repeat(np.arange(len(parts)), parts), last)
    number = np.arange(len(step)) - (np.cumsum(parts) - parts)[step]
    return np.asarray(stamps_ns[step] + number * np.diff(stamps_ns)[step] // parts[step])


# The polynomial must have a second derivative, for the accelerations.
LOWEST_ORDER = 2
# rad. Beyond pi the logarithm jumps to the opposite side; a window in which the body turns as far
# as this from the centre is not trusted.
LARGEST_TURN = 0.75 * pi
# Samples filtered at a time: the working arrays stay in the processor's cache, and memory is
# bounded.
BLOCK = 4096


def weights(half_window: int, order: int, rate_hz: float) -> Array:
    """
    Return the weights of a Savitzky-Golay fit at the centre of its window (4.19-4.20).

    Parameters
    ----------
    half_window : int
        Samples n on each side of the centre.
    order : int
        Order of the polynomial, from 2 to 2n.
    rate_hz : float
        Samples per second.

    Returns
    -------
    array (3, 2n+1)
        Rows: value, first (1/s) and second derivative (1/s^2) at the centre.

    Raises
    ------
    BellowsError
        If the window or the order leaves no such polynomial, or the rate is not positive.

    """
    if half_window < 1:
        raise BellowsError(
            f'The half window of a filter must be at least 1 sample, not {half_window}.'
        )
    if not LOWEST_ORDER <= order <= 2 * half_window:
        raise BellowsError(
            f'The order of a filter with half window {half_window} must be from '
            f'{LOWEST_ORDER} (accelerations need a second derivative) to {2 * half_window} '
            f'(a window has {2 * half_window + 1} samples), not {order}. '
            'Change the order or the half window.'
        )
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise BellowsError(f'The rate of a filter must be positive, in Hz, not {rate_hz}.')
    # Time in half windows keeps the powers within -1..1, so the least-squares problem is well
    # conditioned.
    time = np.arange(-half_window, half_window + 1) / half_window
    basis, r_factor = np.linalg.qr(np.vander(time, order + 1, increasing=True))
    coefficients = np.linalg.solve(r_factor, basis.T)[:3]
    scale = rate_hz / half_window
    fitted = coefficients * np.array([[1.0], [scale], [2.0 * scale**2]])
    # Exactly even, odd and even in time, as they are before rounding.
    parity = np.array([[1.0], [-1.0], [1.0]])
    return np.asarray(0.5 * (fitted + parity * fitted[:, ::-1]))


def savgol(trajectory: Trajectory, half_window: int, order: int) -> Filtered:
    """
    Filter the poses of a trajectory and estimate its twists and accelerations.

    With the polynomials' values, first and second derivatives at the centre, o, o', o''
    (4.26-4.28) and e0, e1, e2 (4.50-4.52), the estimates are

    - R = exp(e0) R_k (4.53), w = dexp(e0) e1 (4.54), dw = d2exp(e0)(e1, e1) + dexp(e0) e2 (4.55),
      both spatial;
    - body rate w_B = R^T w and dw_B = R^T dw: the derivative of R^T w is R^T (dw - w x w), and w x
      w = 0;
    - v_B = R^T o' (4.30) and dv_B = R^T o'' - w_B x v_B (4.31).

    Parameters
    ----------
    trajectory : Trajectory
        Poses at a uniform rate, N samples. Its own twists are not used.
    half_window : int
        Samples n on each side of the centre.
    order : int
        Order of the polynomials, from 2 to 2n.

    Returns
    -------
    Filtered
        The N - 2n samples with a full window, the first and last such included. A sample is valid
        if its whole window is, and if the body turns by less than `LARGEST_TURN` between the
        centre and every sample in it.

    Raises
    ------
    BellowsError
        If the window or the order leaves no such polynomial, the trajectory is shorter than one
        window, or its rate is not uniform.

    Examples
    --------
    A point on a parabola, at 100 Hz: the filter gives its acceleration.

    >>> t = np.arange(50) / 100
    >>> poses = bellows_ros.Trajectory(
    ...     stamps_ns=np.arange(50) * 10_000_000,
    ...     position=np.column_stack([2.0 * t**2, 0.0 * t, 0.0 * t]),
    ...     rotation=np.broadcast_to(np.eye(3), (50, 3, 3)))
    >>> filtered = bellows_ros.savgol(poses, half_window=8, order=4)
    >>> len(filtered), filtered.acceleration[0, :3].round(6).tolist()
    (34, [4.0, 0.0, 0.0])

    """
    if len(trajectory) < 2 * half_window + 1:
        raise BellowsError(
            f'A filter with half window {half_window} needs at least {2 * half_window + 1} '
            f'samples, got {len(trajectory)}. Use a smaller half window or a longer recording.'
        )
    W = weights(half_window, order, uniform_rate_hz(trajectory.stamps_ns))
    count = len(trajectory) - 2 * half_window
    position, rotation = np.empty((count, 3)), np.empty((count, 3, 3))
    twist, acceleration = np.empty((count, 6)), np.empty((count, 6))
    trusted = np.empty(count, dtype=np.bool_)
    for start in range(0, count, BLOCK):  # overlapping by a window less one
        samples = slice(start, min(start + BLOCK + 2 * half_window, len(trajectory)))
        block = _filter_block(trajectory.position[samples], trajectory.rotation[samples], W)
        centres = slice(start, samples.stop - 2 * half_window)
        position[centres], rotation[centres] = block[:2]
        twist[centres], acceleration[centres], trusted[centres] = block[2:]
    return Filtered(
        trajectory.stamps_ns[half_window:len(trajectory) - half_window],
        frozen(position),
        frozen(rotation),
        frozen(twist),
        frozen(acceleration),
        trusted & ~any_within(~trajectory.valid, 2 * half_window + 1),
        weights=frozen(W),
    )


def _filter_block(
    position: Array, rotation: Array, W: Array
) -> tuple[Array, Array, Array, Array, Mask]:
    """Return position, rotation, body twist, its derivative and the trusted mask of a block."""
    n = W.shape[1] // 2
    centre = slice(n, len(position) - n)
    # Component by component in memory, which the same arithmetic takes a third less time for.
    position, quaternions = map(np.asfortranarray, (position, rotation_to_quaternion(rotation)))
    (o, o_rate, o_rate2), _ = _fit(position, np.subtract, W)
    (e0, e1, e2), largest = _fit(quaternions, _turn, W)
    R = exp_so3(e0) @ rotation[centre]
    R_inverse = np.swapaxes(R, -1, -2)
    spatial_rate = apply(dexp(e0), e1)
    spatial_rate2 = d2exp(e0, e1, e1) + apply(dexp(e0), e2)
    v, w = apply(R_inverse, o_rate), apply(R_inverse, spatial_rate)
    dv = apply(R_inverse, o_rate2) - np.cross(w, v)
    dw = apply(R_inverse, spatial_rate2)
    return (
        position[centre] + o,
        R,
        np.concatenate([v, w], axis=-1),
        np.concatenate([dv, dw], axis=-1),
        largest < LARGEST_TURN,
    )


def _fit(
    samples: Array, difference: Callable[[Array, Array], Array], W: Array
) -> tuple[Array, Array]:
    """
    Return the fit relative to each centre (3, M - 2n, 3), and the largest increments.

    The rows are the value and its first and second derivative. The increment from k to k - j is
    minus the one from k - j to k, so each pair of samples is visited once. The increment from a
    sample to itself is zero: a standstill gives zeros, exactly.
    """
    n = W.shape[1] // 2
    end = len(samples) - n
    fitted = np.zeros((3, 3, end - n)).transpose(0, 2, 1)
    largest = np.zeros(end - n)
    for j in range(1, n + 1):
        step = difference(samples[j:], samples[:-j])
        ahead, behind = step[n:end], step[n - j:end - j]
        # W is even, odd and even in time.
        change, total = ahead - behind, ahead + behind
        for part, weight, pair in zip(fitted, W[:, n + j], (change, total, change), strict=True):
            part += weight * pair
        length = np.sqrt(np.einsum('ij,ij->i', step, step))
        np.maximum(largest, length[n:end], out=largest)
        np.maximum(largest, length[n - j:end - j], out=largest)
    return fitted, largest


def _turn(ahead: Array, behind: Array) -> Array:
    """Return log(R_ahead R_behind^T) of quaternions, as in (4.45)."""
    return log_quaternion(quaternion_product(ahead, quaternion_conjugate(behind)))
