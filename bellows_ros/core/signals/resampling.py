"""
Rates and gaps of stamps; trajectories at other stamps, on SO(3) x R^3, never extrapolated.

The filter needs uniform samples. If stamps are uniform up to rounding, samples are kept; otherwise
samples are interpolated along geodesics. Samples in a gap get interpolated poses, so that arrays
stay finite, and are invalid.

Poses that arrive over a network in bursts, and are stamped on arrival, have delayed stamps: a
moving body seems to oscillate. For a sensor that samples uniformly, the delay of each pose follows
from all stamps. The delays are corrected if the corrected motion is smoother: delays of 1 to 3 ms
make K from poses at 240 Hz wrong by 7 % and more.
"""

from dataclasses import dataclass, replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike
import scipy  # whose parts are loaded as they are used

from .trajectory import checked_stamps, frozen, NS_PER_S, PoseStream, Trajectory

# A step of more than this many periods is a gap: at least one sample is missing.
GAP_PERIODS = 1.5
# Range of the ratio of the mean step to the typical step without bursts: up to half of the samples
# may be lost, but none is repeated.
MEAN_RANGE = (0.8, 2.5)
# Ratio of the mean step to the typical step above which steps may alternate, and the smallest
# fraction of sums over many steps that then are equal up to one step.
EVEN_RATIO, MIN_EVEN_PART = 1.1, 0.8
# Standard deviation of a normal distribution per median absolute deviation.
MAD_TO_STD = 1.4826

MAX_RELATIVE_JITTER = 0.1
"""Jitter above which a warning is given, as a fraction of the period."""

MIN_CLOCK_STEP = 5e-3
"""Smallest detected step of a clock, s: 1 mm of a tool at 0.2 m/s."""

CLOCK_WINDOW = 1.0
"""Time compared before and after a step, s; usual stalls of a recorder are shorter."""

MAX_CLOCK_STEPS = 20
"""Number of examined jumps of the delay, from the largest on."""

CLOCK_DEVIATIONS = 10.0
"""Smallest step of a clock, in median absolute deviations of the delays before and after it. The
ramp of delays of a stalling recorder has 4 median absolute deviations."""

SAMPLES_BESIDE_GAP = 30
"""Number of samples compared on both sides of a gap."""


@dataclass(frozen=True)
class Gap:
    """
    A time without samples.

    Parameters
    ----------
    start_ns : int
        Stamp of the sample before the gap.
    duration_s : float
        Time to the next sample, s.

    """

    start_ns: int
    duration_s: float


@dataclass(frozen=True)
class Timing:
    """
    Rate, jitter and gaps of the stamps of a stream.

    Parameters
    ----------
    rate_hz : float
        Samples per second without gaps.
    jitter_s : float
        Robust standard deviation of the durations between samples, s.
    uniform : bool
        Whether the stamps are uniform, so that no sample needs interpolation.
    gaps : tuple of Gap
        Gaps in the order of time.

    """

    rate_hz: float
    jitter_s: float
    uniform: bool
    gaps: tuple[Gap, ...]

    @property
    def longest_step_ns(self) -> int:
        """Longest time between samples that is not a gap, ns."""
        return int(NS_PER_S * (GAP_PERIODS / self.rate_hz + 3.0 * self.jitter_s))


def timing(stamps_ns: Stamps) -> Timing:
    """
    Estimate the rate and jitter of stamps, and find the gaps.

    The rate is computed from medians of the steps, so that gaps and a drifting clock do not bias
    the rate.

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
        If there are fewer than three stamps.

    """
    if len(stamps_ns) < 3:
        raise BellowsError(
            f'A rate needs at least 3 samples, got {len(stamps_ns)}. Record longer, or choose '
            'the topic with the poses.')
    steps = np.diff(stamps_ns)
    period = _period(steps)
    jitter = MAD_TO_STD * float(np.median(np.abs(steps - period)))
    slots = np.maximum(np.rint(steps / period), 1.0)
    # half of the tolerance of `savgol`
    uniform = bool(np.all(np.abs(steps / (slots * period) - 1.0) <= 0.005))
    result = Timing(NS_PER_S / period, jitter / NS_PER_S, uniform, ())
    long = np.flatnonzero(steps > result.longest_step_ns)
    return replace(result, gaps=tuple(
        Gap(int(stamps_ns[i]), float(steps[i] / NS_PER_S)) for i in long))


def clock_steps(stamps_ns: Stamps, arrivals_ns: Stamps) -> tuple[tuple[int, float], ...]:
    """
    Return the steps of the stamping clock: the stamp before each step (ns), and its size (s).

    At a step, the difference of stamp and arrival changes permanently, while arrivals are regular:
    otherwise the recorder's clock steps, or a delay changes.

    Parameters
    ----------
    stamps_ns, arrivals_ns : int array (N,)
        Header stamps and times of recording, in the order of arrival.

    """
    arrival = (arrivals_ns - arrivals_ns[:1]) / NS_PER_S
    ahead = (stamps_ns - stamps_ns[:1]) / NS_PER_S - arrival
    jumps, late = np.diff(ahead), np.diff(arrival)
    late = late - np.median(late) if len(late) else late
    found = list[tuple[int, float]]()
    largest = np.argsort(np.abs(jumps))[-MAX_CLOCK_STEPS:]
    for k in np.sort(largest[np.abs(jumps[largest]) > MIN_CLOCK_STEP]).tolist():
        first, last = np.searchsorted(arrival, arrival[k] + [-CLOCK_WINDOW, CLOCK_WINDOW])
        before, after = ahead[first:k + 1], ahead[k + 1:last]
        if min(len(before), len(after)) < 5 or arrival[last - 1] - arrival[k] < 0.5 * CLOCK_WINDOW:
            continue
        middle = float(np.median(before)), float(np.median(after))
        size = middle[1] - middle[0]
        spread = max(float(np.median(np.abs(part - level)))
                     for part, level in zip((before, after), middle, strict=True))
        if abs(size) > max(MIN_CLOCK_STEP, CLOCK_DEVIATIONS * spread) and (
                max(abs(jumps[k] - size), abs(late[k])) < 0.5 * abs(size)):
            found.append((int(stamps_ns[k]), size))
    return tuple(found)


def in_bursts(stamps_ns: Stamps, timing: Timing) -> bool:
    """
    Return whether samples come in bursts, like messages after a delay.

    In bursts, most steps between samples are short, and each gap is as long as the samples of the
    next burst should take. Lost samples leave gaps of any length.
    """
    steps = np.diff(stamps_ns) / NS_PER_S
    if np.mean(steps * timing.rate_hz < 0.2) > 0.3:  # no sensor samples this early
        return True
    begins = np.flatnonzero(steps > timing.longest_step_ns / NS_PER_S) + 1
    gaps = steps[begins - 1]
    if len(begins) < 5 or 2.0 * gaps.sum() < steps.sum() or np.median(gaps) > 0.5:  # s
        return False
    low, middle, high = np.percentile(np.diff(stamps_ns[begins]) / np.diff(begins), (25, 50, 75))
    return bool(high - low < 0.5 * middle)


def _period(steps: Stamps) -> float:
    """
    Return the time between samples without gaps, ns.

    The median step is as accurate as the resolution of the stamps; the mean of the steps near the
    median is more accurate. For stamps in pairs or bursts the period is the mean over many steps,
    also for steps of one and of two messages that alternate: lost samples leave less even sums.
    """
    count = min(20, max(len(steps) // 4, 1))  # number of averaged steps
    typical, sums = _typical_value(steps), np.convolve(steps, np.ones(count), 'valid')
    mean = _typical_value(sums) / count
    is_even = np.mean(np.abs(sums - count * mean) <= typical) > MIN_EVEN_PART
    if typical * EVEN_RATIO < mean and is_even:
        return mean
    return typical if MEAN_RANGE[0] * typical <= mean <= MEAN_RANGE[1] * typical else mean


def _typical_value(values: Array | Stamps) -> float:
    """Return the mean of the values near their median, or the median if none is near."""
    median = float(np.median(values))
    typical = values[np.abs(values - median) < 0.5 * median]
    return float(np.mean(typical)) if len(typical) else median


def common_span(one: PoseStream | Trajectory, other: PoseStream | Trajectory) -> tuple[int, int]:
    """Return first and last stamp (ns) of the overlap of two trajectories."""
    starts, ends = zip(*(body.stamps_ns[[0, -1]].tolist() for body in (one, other)), strict=True)
    return max(starts), min(ends)


def subdivided(stamps_ns: Stamps, parts: Stamps) -> Stamps:
    """
    Return stamps with additional stamps between them.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Stamps, ns.
    parts : int array (N - 1,)
        Number of parts of each step.

    """
    last = len(parts) - 1
    step = np.append(np.repeat(np.arange(len(parts)), parts), last)
    number = np.arange(len(step)) - (np.cumsum(parts) - parts)[step]
    return np.asarray(stamps_ns[step] + number * np.diff(stamps_ns)[step] // parts[step])


def at_sampling(stream: PoseStream) -> tuple[PoseStream, float]:
    """
    Return poses with times of sampling instead of times of arrival, and the removed jitter (s).

    The stamps are kept, with a jitter of 0, unless the poses between two others are then clearly
    nearer to the interpolated ones.
    """
    recorded = timing(stream.stamps_ns)
    is_regular = recorded.jitter_s * recorded.rate_hz < MAX_RELATIVE_JITTER
    sampled = None if is_regular else _sampling_stamps(stream.stamps_ns)
    if sampled is None:
        return stream, 0.0
    before, after = (_roughness(replace(stream, stamps_ns=stamps).trajectory())
                     for stamps in (stream.stamps_ns, sampled))
    if not np.prod(after / np.maximum(before, 1e-12)) ** 2 < 0.8:
        return stream, 0.0
    return (replace(stream, stamps_ns=sampled),
            float(np.std(stream.stamps_ns - sampled)) / NS_PER_S)


def _roughness(poses: Trajectory) -> Array:
    """Return the median distance (2,) of poses from those interpolated between others, m, rad."""
    seen = poses.select(slice(1, -1, 2))
    between = resample(poses.select(slice(None, None, 2)), seen.stamps_ns)
    return np.array([np.median(np.linalg.norm(part, axis=1)) for part in (
        seen.position - between.position,
        lie.log_so3(np.swapaxes(between.rotation, 1, 2) @ seen.rotation))])


def _sampling_stamps(stamps_ns: Stamps) -> Stamps | None:
    """
    Return the latest possible times of sampling (ns) from times of arrival; None if unknown.

    No sample arrives before its time of sampling, so the uniform times are the line below all
    arrivals with the least mean distance. Lost samples delay all later samples by whole periods.
    Frequent losses, or jitter of many periods, make the times unknown.
    """
    n = SAMPLES_BESIDE_GAP
    if len(stamps_ns) < 4 * n:
        return None
    since, number = (stamps_ns - stamps_ns[0]).astype(np.float64), np.arange(len(stamps_ns))
    period = float(np.quantile(since[2 * n:] - since[:-2 * n], 0.25)) / (2 * n)
    for _ in range(200):  # gaps
        delay = since - period * number
        earliest = np.min(np.lib.stride_tricks.sliding_window_view(delay, n), axis=1)
        steps = earliest[n:] - earliest[:-n]
        drift = float(np.median(steps))
        period += drift / n
        i = int(np.argmax(steps))
        missing = int((steps[i] - drift) / period + 0.35)  # a loss is assumed from 0.65 periods on
        if missing < 1:
            basis: Array = np.column_stack([number, np.ones(len(number))])
            line = scipy.optimize.linprog(
                -basis.mean(axis=0), basis, since / period, bounds=(None, None))
            sampled = period * (basis @ np.asarray(line.x, dtype=np.float64))
            return np.asarray(stamps_ns[0] + np.rint(sampled).astype(np.int64))
        before = np.flatnonzero(delay[i:i + 3 * n] < earliest[i] + (missing - 0.1) * period)
        number[i + before[-1] + 1:] += missing
    return None


def resample(
    trajectory: Trajectory, stamps_ns: ArrayLike, longest_gap_ns: int | None = None
) -> Trajectory:
    """
    Interpolate a trajectory at other stamps, without extrapolating.

    With twists the interpolant is the cubic Hermite polynomial on SO(3) x R^3: in the position,
    with the end velocities R v, and in the rotation vector c of R = R_0 exp(c), with c(0) = 0,
    c'(0) = h w_0, c(1) = log(R_0^T R_1) and c'(1) = dexp(-c(1))^-1 h w_1, where w is the body rate
    and h the interval. The interpolant is once differentiable and of fourth order; its body twist
    is returned. Without twists, positions are interpolated linearly, rotations along the geodesic,
    and no twist is returned. A sample whose stamp is wanted is returned unchanged. The result has
    no accelerations.

    Parameters
    ----------
    trajectory : Trajectory
        Samples at any stamps, with twists or without.
    stamps_ns : int array (M,)
        Wanted stamps, strictly increasing, ns, inside the trajectory's first and last.
    longest_gap_ns : int, optional
        Longest interval (ns) in which an interpolated sample is valid.

    Returns
    -------
    Trajectory
        Copied samples keep their validity; an interpolated sample is valid if both neighbours are
        valid.

    Raises
    ------
    BellowsError
        If a stamp lies outside the trajectory.

    """
    wanted = checked_stamps(stamps_ns, 'Wanted stamps')
    stamps = trajectory.stamps_ns
    if len(wanted) and not (len(stamps) and stamps[0] <= wanted[0] and wanted[-1] <= stamps[-1]):
        span = f'{stamps[0]} to {stamps[-1]} ns' if len(stamps) else 'no time (it is empty)'
        raise BellowsError(
            f'The requested stamps cover {wanted[0]} to {wanted[-1]} ns, the trajectory only '
            f'{span}. Poses are never extrapolated; request stamps inside the trajectory.')
    before = np.searchsorted(stamps, wanted, side='right') - 1
    same = slice(before[0], before[-1] + 1) if len(before) else slice(0)
    if np.array_equal(stamps[same], wanted):  # nothing to interpolate
        return replace(trajectory.select(same), acceleration=None)
    position, rotation = trajectory.position[before], trajectory.rotation[before]
    twist = None if trajectory.twist is None else trajectory.twist[before]
    valid = trajectory.valid[before]
    between = np.flatnonzero(wanted != stamps[before])
    start, end = before[between], before[between] + 1
    position[between], rotation[between], twists = _interpolated(
        trajectory, start, end, wanted[between])
    if twist is not None:
        twist[between] = twists
    is_bridged = longest_gap_ns is None or stamps[end] - stamps[start] <= longest_gap_ns
    valid[between] &= trajectory.valid[end] & is_bridged
    return Trajectory(frozen(wanted), frozen(position), frozen(rotation), twist, valid=valid)


def _interpolated(
    trajectory: Trajectory, before: Stamps, after: Stamps, wanted_ns: Stamps
) -> tuple[Array, Array, Array | None]:
    """Return positions, rotations and body twists of the interpolant between samples."""
    interval_s = (trajectory.stamps_ns[after] - trajectory.stamps_ns[before])[:, None] / NS_PER_S
    s = (wanted_ns - trajectory.stamps_ns[before])[:, None] / (NS_PER_S * interval_s)
    R_start, R_end = trajectory.rotation[before], trajectory.rotation[after]
    origin = trajectory.position[before]
    step = trajectory.position[after] - origin
    phi = lie.log_so3(np.swapaxes(R_start, -1, -2) @ R_end)
    if trajectory.twist is None:
        return origin + s * step, R_start @ lie.exp_so3(s * phi), None
    start, end = (trajectory.twist[index] * interval_s for index in (before, after))
    o, o_rate = cubic(s, lie.apply(R_start, start[:, :3]), step, lie.apply(R_end, end[:, :3]))
    c, c_rate = cubic(s, start[:, 3:], phi, lie.apply(lie.dexp_inverse(-phi), end[:, 3:]))
    rotation = R_start @ lie.exp_so3(c)
    linear = lie.apply(np.swapaxes(rotation, -1, -2), o_rate)
    angular = lie.apply(lie.dexp(-c), c_rate)
    return origin + o, rotation, np.concatenate([linear, angular], axis=-1) / interval_s


def cubic(s: Array, rate_start: Array, end: Array, rate_end: Array) -> tuple[Array, Array]:
    """Return the cubic over 0..1 from zero to `end` with given end rates, and its derivative."""
    quadratic = 3.0 * end - 2.0 * rate_start - rate_end
    cubic = rate_start + rate_end - 2.0 * end
    value = s * (rate_start + s * (quadratic + s * cubic))
    return value, rate_start + s * (2.0 * quadratic + s * 3.0 * cubic)


MAX_GRID_SAMPLES = 1_000_000
"""Largest number of samples of a grid with at least 10 samples per message."""


def on_grid(trajectory: Trajectory, timing: Timing) -> Trajectory:
    """
    Return poses at a uniform rate.

    Parameters
    ----------
    trajectory : Trajectory
        Poses as recorded, with faulty ones marked invalid.
    timing : Timing
        Timing of its stamps.

    Returns
    -------
    Trajectory
        Uniform stamps. Samples at uniform recorded stamps are copied, others interpolated; samples
        in gaps, or interpolated from an invalid sample, are invalid.

    Raises
    ------
    BellowsError
        If the stamps cover far more time than the samples.

    """
    span = float(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    count = span * timing.rate_hz / NS_PER_S
    if count > max(MAX_GRID_SAMPLES, 10 * len(trajectory)):  # an isolated stamp
        raise BellowsError(
            f'{len(trajectory)} poses at {timing.rate_hz:.6g} Hz should cover '
            f'{len(trajectory) / timing.rate_hz:.6g} s, but their stamps cover '
            f'{span / NS_PER_S:.6g} s. Cut the recording to the part with poses.')
    if timing.uniform:
        slots = np.rint(np.diff(trajectory.stamps_ns) * (timing.rate_hz / NS_PER_S))
        stamps = subdivided(trajectory.stamps_ns, np.maximum(slots, 1.0).astype(np.int64))
    else:
        period = NS_PER_S / timing.rate_hz
        stamps = trajectory.stamps_ns[0] + np.rint(
            np.arange(int(span / period) + 1) * period).astype(np.int64)
    return resample(trajectory, stamps, timing.longest_step_ns)


def filled(poses: Trajectory, known: Trajectory, longest_gap_ns: int | None = None) -> Trajectory:
    """Return poses with missing samples interpolated by `resample`."""
    missing = ~poses.valid & (
        poses.stamps_ns > known.stamps_ns[0]) & (poses.stamps_ns < known.stamps_ns[-1])
    between = resample(known, poses.stamps_ns[missing], longest_gap_ns)
    position, rotation, valid = poses.position.copy(), poses.rotation.copy(), poses.valid.copy()
    position[missing], rotation[missing] = between.position, between.rotation
    valid[missing] = between.valid
    return Trajectory(poses.stamps_ns, position, rotation, valid=valid)
