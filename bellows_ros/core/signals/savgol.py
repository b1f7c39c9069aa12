"""
The Savitzky-Golay filter on SO(3) x R^3 (4.15-4.63, appendix G).

Around each sample a polynomial in time is fitted to the positions and to the rotation vectors
log(R(t_w) R(t_k)^T). At a uniform rate the least-squares fit is one constant weight matrix times
these increments (4.19, 4.44).
"""

from collections.abc import Callable
from math import pi

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.errors import BellowsError, require_types
import numpy as np
from numpy.typing import ArrayLike
import scipy  # whose parts are loaded as they are used

from .trajectory import any_within, Filtered, frozen, Trajectory, uniform_rate_hz

# The polynomial must have a second derivative, for the accelerations.
MIN_ORDER = 2
# Rotation between a sample and the centre beyond which a window is invalid, as the logarithm jumps
# at pi, rad.
MAX_ROTATION = 0.75 * pi
# Samples processed at a time: the working arrays stay in the processor's cache, and memory is
# bounded.
BLOCK = 4096


def weights(
    half_window: int, order: int, rate_hz: float, is_tapered: bool = False
) -> Array:
    """
    Return the weights of a Savitzky-Golay fit at the centre of its window (4.19-4.20).

    Parameters
    ----------
    half_window : int
        Samples n on each side of the centre.
    order : int
        Order of the polynomial, from 2 to 2n.
    rate_hz : float
        Samples per second, above zero.
    is_tapered : bool
        Whether errors count less towards the ends of the window, by a squared cosine: the fit then
        passes hardly any noise above its band.

    Returns
    -------
    array (3, 2n+1)
        Rows: value, first (1/s) and second derivative (1/s^2) at the centre.

    Raises
    ------
    BellowsError
        If window and order determine no polynomial.

    """
    if half_window < 1:
        raise BellowsError(
            f'The half window of a filter must be at least 1 sample, not {half_window}.')
    if not MIN_ORDER <= order <= 2 * half_window:
        raise BellowsError(
            f'The order of a filter with half window {half_window} must be from {MIN_ORDER} '
            f'(accelerations need a second derivative) to {2 * half_window} (a window has '
            f'{2 * half_window + 1} samples), not {order}. Change the order or the half window.')
    # Time in half windows keeps the powers within -1..1, so the least-squares problem is well
    # conditioned.
    time = np.arange(-half_window, half_window + 1) / half_window
    root = np.ones(len(time))
    if is_tapered:
        root = np.cos(0.5 * pi * time * half_window / (half_window + 1))
    basis, r_factor = np.linalg.qr(root[:, None] * np.vander(time, order + 1, increasing=True))
    coefficients = np.linalg.solve(r_factor, basis.T * root)[:3]
    scale = rate_hz / half_window
    fitted = coefficients * np.array([[1.0], [scale], [2.0 * scale**2]])
    # Exactly even, odd and even in time, without rounding errors.
    parity = np.array([[1.0], [-1.0], [1.0]])
    return np.asarray(0.5 * (fitted + parity * fitted[:, ::-1]))


def savgol(
    trajectory: Trajectory, half_window: int, order: int, is_tapered: bool = False
) -> Filtered:
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
        Poses at a uniform rate, N samples. Twists are ignored.
    half_window : int
        Samples n on each side of the centre.
    order : int
        Order of the polynomials, from 2 to 2n.
    is_tapered : bool
        Whether errors count less towards the ends of the window, see `weights`.

    Returns
    -------
    Filtered
        The N - 2n samples with a full window. A sample is valid if all samples of its window are
        valid, and if the body rotates by less than `MAX_ROTATION` between the centre and every
        sample of the window.

    Raises
    ------
    BellowsError
        If window and order determine no polynomial, the trajectory is shorter than one window, or
        its rate is not uniform.

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
    require_types(trajectory=(trajectory, Trajectory))
    W = weights_for(trajectory, half_window, order, is_tapered)
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
        trajectory.stamps_ns[half_window:len(trajectory) - half_window], frozen(position),
        frozen(rotation), frozen(twist), frozen(acceleration),
        trusted & whole_windows(trajectory, half_window), weights=frozen(W))


def weights_for(
    trajectory: Trajectory, half_window: int, order: int, is_tapered: bool = False
) -> Array:
    """Return the weights of a filter for a trajectory; raise like `savgol`."""
    if len(trajectory) < 2 * half_window + 1:
        raise BellowsError(
            f'A filter with half window {half_window} needs at least {2 * half_window + 1} '
            f'samples, got {len(trajectory)}. Use a smaller half window or a longer recording.')
    return weights(half_window, order, uniform_rate_hz(trajectory.stamps_ns), is_tapered)


def whole_windows(trajectory: Trajectory, half_window: int) -> Mask:
    """Return a mask (N - 2n,) of the samples whose full window is valid."""
    return ~any_within(~trajectory.valid, 2 * half_window + 1)


def _filter_block(
    position: Array, rotation: Array, W: Array
) -> tuple[Array, Array, Array, Array, Mask]:
    """Return position, rotation, body twist, its derivative and the trusted mask of a block."""
    n = W.shape[1] // 2
    centre = slice(n, len(position) - n)
    # Components are contiguous in memory, which takes a third less time.
    quaternions = np.asfortranarray(lie.rotation_to_quaternion(rotation))
    position = np.asfortranarray(position)
    (o, o_rate, o_rate2), _ = _fit(position, np.subtract, W)
    (e0, e1, e2), largest = _fit(quaternions, _turn, W)
    R = lie.exp_so3(e0) @ rotation[centre]
    R_inverse = np.swapaxes(R, -1, -2)
    spatial_rate = lie.apply(lie.dexp(e0), e1)
    spatial_rate2 = lie.d2exp(e0, e1) + lie.apply(lie.dexp(e0), e2)
    v, w = lie.apply(R_inverse, o_rate), lie.apply(R_inverse, spatial_rate)
    dv = lie.apply(R_inverse, o_rate2) - np.cross(w, v)
    dw = lie.apply(R_inverse, spatial_rate2)
    return position[centre] + o, R, np.hstack([v, w]), np.hstack([dv, dw]), largest < MAX_ROTATION


def _fit(
    samples: Array, difference: Callable[[Array, Array], Array], W: Array
) -> tuple[Array, Array]:
    """
    Return the fit relative to each centre (3, M - 2n, 3), and the largest increments.

    The rows are the value and its first and second derivative. The increment from k to k - j is
    minus the increment from k - j to k, so each pair of samples is computed once. Increments of a
    standstill are exactly zero.
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
    """Return log(R_ahead R_behind^T) of quaternions (4.45)."""
    return lie.log_quaternion(lie.quaternion_product(ahead, lie.quaternion_conjugate(behind)))


def with_filtered_noise(
    motion: Trajectory, noise: ArrayLike, ar1: Array, weights: Array, period: float,
    draw: np.random.Generator,
) -> Trajectory:
    """
    Return a filtered motion with added noise of the distribution of its own noise.

    Parameters
    ----------
    motion : Trajectory
        Motion of a body, with twists.
    noise : array_like (2,)
        Standard deviation of the unfiltered poses, m and rad per axis.
    ar1 : ndarray (2,)
        Correlation between successive samples of the noise of positions and of rotations; 0 if
        white.
    weights : ndarray (3, 2n+1)
        Weights of the filter.
    period : float
        Period of the poses, s.
    draw : Generator
        Generator of random numbers.

    """
    assert motion.twist is not None
    at = period * np.arange(int(motion.seconds[-1] / period) + 2)
    white = np.repeat(noise, 3) * draw.standard_normal((len(at) + weights.shape[1] - 1, 6))
    drawn = np.hstack([correlated(part, lag_1) for part, lag_1 in zip(
        np.hsplit(white, 2), ar1.tolist(), strict=True)])
    (o, phi), (o_rate, phi_rate) = (
        np.hsplit(np.column_stack([np.interp(motion.seconds, at, np.correlate(column, row))
                                   for column in drawn.T]), 2) for row in weights[:2])
    R = lie.exp_so3(phi) @ motion.rotation
    v, w = (lie.apply(np.swapaxes(R, -1, -2), lie.apply(motion.rotation, part) + rate)
            for part, rate in zip(np.hsplit(motion.twist, 2), (o_rate, phi_rate), strict=True))
    return Trajectory(
        motion.stamps_ns, motion.position + o, R, np.hstack([v, w]), valid=motion.valid)


def bridged(poses: Trajectory, half_window: int, order: int) -> Trajectory:
    """
    Return poses whose missing samples are those of polynomials through the poses beside each gap.

    A polynomial is fitted to all valid poses within a half window of its gap; a gap with too few
    of them stays invalid.
    """
    position, rotation, valid = poses.position.copy(), poses.rotation.copy(), poses.valid.copy()
    known = np.flatnonzero(poses.valid)
    for first, last in zip(known[:-1], known[1:], strict=True):
        beside = np.arange(max(first - half_window + 1, 0), min(last + half_window, len(poses)))
        used = beside[poses.valid[beside]]
        if last - first == 1 or len(used) <= order:
            continue
        gap, middle = np.arange(first + 1, last), 0.5 * (first + last)
        design, wanted = (np.vander((at - middle) / half_window, order + 1) for at in (used, gap))
        turns = lie.log_so3(poses.rotation[used] @ poses.rotation[first].T)
        values = wanted @ np.linalg.lstsq(
            design, np.hstack([poses.position[used], turns]), rcond=None)[0]
        position[gap] = values[:, :3]
        rotation[gap] = lie.exp_so3(values[:, 3:]) @ poses.rotation[first]
        valid[gap] = True
    return Trajectory(poses.stamps_ns, position, rotation, valid=valid)


def longest_bridge(half_window: int, order: int) -> int:
    """
    Return the largest number of missing samples whose bridge is as certain as a measured pose.

    Beyond it the variance of a polynomial in the gap exceeds the variance of a pose.
    """
    for count in range(1, 4 * half_window):
        at = np.arange(-half_window, count + half_window)
        in_gap = (at >= 0) & (at < count)
        powers = np.vander((at - 0.5 * (count - 1)) / half_window, order + 1)
        bridge = powers[in_gap] @ np.linalg.pinv(powers[~in_gap])
        if np.sum(bridge**2, axis=1).max() > 1.0:
            return count - 1
    return count


def correlated(white: Array, ar1: float) -> Array:
    """
    Return first-order noise from white noise (N, C), stationary from the first sample on.

    The noise is y_k = ar1 y_{k-1} + sqrt(1 - ar1^2) white_k, with a weight ar1 below 1.
    `scipy.signal.lfilter` would take 0.4 s and 50 MB to load.
    """
    inputs, diagonals = np.sqrt(1.0 - ar1**2) * white, np.ones((2, len(white)))
    inputs[:1], diagonals[1] = white[:1], -ar1
    return np.asarray(
        scipy.linalg.solve_banded((1, 0), diagonals, inputs, check_finite=False))
