"""
Sizes and significance of jumps between samples of a pose (appendix H).

A body with finite speed cannot jump. How far it does is the least distance, over the time between
two samples, of two straight continuations: of the samples before, and of the samples after. Honest
motion leaves next to nothing, not even where its velocity or its acceleration changes at once,
since the continuations meet where it did. Two samples on each side find short excursions,
`LONG_SIDE` on each side find small ones. Positions (m) and rotation vectors (rad) are treated
alike.
"""

from dataclasses import dataclass
from math import sqrt

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.trajectory import any_within, NS_PER_S, PoseStream, Trajectory
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter

Indices = Stamps

# Samples on each side of the second, longer look, and how even their times must be.
LONG_SIDE = 5
EVEN_WITHIN = 0.1
# A jump counts from this many times the median of its surroundings on. Of white noise, the largest
# in two million samples reaches 4.0.
THRESHOLD_FACTOR = 4.5
# It must be at least this large: far below what matters, far above rounding and quantisation.
SMALLEST_JUMP = {'position': 0.5e-3, 'rotation': 1e-3}
# Motion whose velocity changes at once is no jump: parabolas through the samples on each side, if
# they are smooth to this part of the jump, then meet to within that part of it.
SMOOTH_WITHIN = 0.5
MEETING_DISTANCE = 0.3
# In the longer look, the lines must fit their samples to this part of the jump.
LINE_MISFIT = 0.6
# A jump that may be the other end of one that counts may be weaker, by this factor.
PARTNER_STRENGTH = 0.5
# Among fewer jumps than this nothing stands out.
MIN_SAMPLES = 30
# Samples of the running median of the surroundings, and of the one that follows the acceleration.
MEDIAN_SAMPLES = 51
ACCELERATION_SAMPLES = 7
# Median size along an axis of the jump in the middle per standard deviation of white noise, from
# two samples on each side: that of a normal distribution, times the norm of (1, -3, 3, -1) / 2.
MEDIAN_PER_DEVIATION = 0.6745 * sqrt(5.0)


@dataclass(frozen=True, eq=False)
class Jumps:
    """Jumps (M,) of one quantity, over the interval after each sample but the last."""

    jump: Array  # (M, 3)
    threshold: Array  # (M,)
    typical: Array  # (3,) median size along each axis of the jump in the middle of the interval

    @property
    def strength(self) -> Array:
        """Jump over threshold (M,)."""
        return np.asarray(np.linalg.norm(self.jump, axis=1) / self.threshold)


def increments_of(poses: Trajectory | PoseStream) -> dict[str, Array]:
    """Return the differences of positions and the body rotation vectors between samples (M, 3)."""
    return {
        'position': np.diff(poses.position, axis=0),
        'rotation': log_so3(np.swapaxes(poses.rotation[:-1], -1, -2) @ poses.rotation[1:]),
    }


def short_window(increment: Array, step_ns: Stamps, gap: Mask, quantity: str) -> Jumps:
    """
    Return the jumps seen from two samples on each side, at any stamps.

    The end of an interval is predicted with the velocity before it, the start with the velocity
    after it; the first and the last interval have only one of both.
    """
    step_s = step_ns[:, None] / NS_PER_S
    velocity = increment / step_s
    start = np.zeros_like(increment)
    end = np.zeros_like(increment)
    start[:-1] = increment[:-1] - velocity[1:] * step_s[:-1]
    end[1:] = increment[1:] - velocity[:-1] * step_s[1:]
    start[-1], end[0] = -end[-1], -start[0]
    start, end = _without_acceleration(start, end, ACCELERATION_SAMPLES)
    start[-1], end[0] = end[-1], start[0]
    jumps = _jumps(start, end, gap, SMALLEST_JUMP[quantity])
    jumps.jump[_bends(increment, jumps, gap)] = 0.0
    return jumps


def _bends(increment: Array, jumps: Jumps, gap: Mask) -> Indices:
    """Return where an apparent jump is a bend of a motion that is smooth on both sides."""
    tried = np.flatnonzero(jumps.strength >= PARTNER_STRENGTH)
    inside = (tried >= 3) & (tried < len(increment) - 3)
    i = tried[inside]
    around = i[:, None] + np.arange(-3, 4)
    path = np.concatenate([np.zeros((len(i), 1, 3)), np.cumsum(increment[around], axis=1)], axis=1)
    before, after = path[:, :4], path[:, :3:-1]  # each from far to near
    size = np.linalg.norm(jumps.jump[i], axis=1)
    rough = [np.linalg.norm(np.diff(side, 3, axis=1)[:, 0], axis=1) for side in (before, after)]
    smooth = np.maximum(*rough) < SMOOTH_WITHIN * size
    # Parabolas through samples at -2, -1 and 0, from each side, at times from 0 to 1.
    time, through = np.linspace(0.0, 1.0, 21), np.linalg.inv(np.vander([-2.0, -1.0, 0.0]))
    ahead, behind = (np.vander(t, 3) @ through for t in (time, 1.0 - time))
    apart = np.linalg.norm(ahead @ before[:, 1:] - behind @ after[:, 1:], axis=2)
    meets = apart.min(axis=1) < MEETING_DISTANCE * size
    return np.asarray(i[smooth & meets & ~gap[around].any(axis=1)])


def long_window(increment: Array, breaks: Mask, quantity: str) -> Jumps:
    """Return the jumps seen from lines through `LONG_SIDE` samples without breaks on each side."""
    m = LONG_SIDE
    start, end = np.zeros_like(increment), np.zeros_like(increment)
    misfit = np.zeros(len(increment))
    count = len(increment) - 2 * m + 2  # intervals with so many samples on each side
    unobserved = np.full(len(increment), True)
    if count > 0:
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(increment, axis=0)])
        sides = sliding_window_view(path, m, axis=0)
        before, after = sides[:count], sides[m:m + count, :, ::-1]
        here, beyond, left = _line_weights(m)
        inside = slice(m - 1, m - 1 + count)
        start[inside] = after @ beyond - before @ here
        end[inside] = after @ here - before @ beyond
        misfit[inside] = np.sqrt(np.sum((before @ left) ** 2 + (after @ left) ** 2, axis=(1, 2)))
        unobserved[inside] = any_within(breaks, 2 * m - 1)
    start, end = _without_acceleration(start, end, 2 * m + 1)
    jumps = _jumps(start, end, unobserved, SMALLEST_JUMP[quantity])
    jumps.jump[misfit > LINE_MISFIT * np.linalg.norm(jumps.jump, axis=1)] = 0.0
    jumps.jump[_bends(increment, jumps, breaks)] = 0.0
    return jumps


def _line_weights(count: int) -> tuple[Array, Array, Array]:
    """
    Return the weights of samples in a line at the last one and one after it, and the residual.

    The last is (count, count - 2): orthonormal combinations that vanish on every line.
    """
    time = np.arange(1.0 - count, 1.0)
    basis, _ = np.linalg.qr(np.vander(time, count, increasing=True))
    value, slope = np.linalg.pinv(np.stack([np.ones(count), time], axis=1))
    return value, value + slope, basis[:, 2:]


def _without_acceleration(start: Array, end: Array, width: int) -> tuple[Array, Array]:
    """Subtract half the difference where it varies smoothly, since it is due to acceleration."""
    smooth = np.empty_like(start)
    for axis in range(3):  # two to three times faster than one filter of size (width, 1)
        half = 0.5 * (end[:, axis] - start[:, axis])
        smooth[:, axis] = median_filter(half, size=width, mode='mirror')
    return start + smooth, end - smooth


def _jumps(start: Array, end: Array, unobserved: Mask, smallest: float) -> Jumps:
    """Return the least of the jumps from those at the start to those at the end of intervals."""
    change = end - start
    squared = np.sum(change**2, axis=1)
    along = np.divide(
        -np.sum(start * change, axis=1), squared, out=np.zeros_like(squared), where=squared > 0.0
    )
    jump = start + np.clip(along, 0.0, 1.0)[:, None] * change
    jump[unobserved] = 0.0
    middle = 0.5 * (start + end)
    typical = _surroundings(np.linalg.norm(middle, axis=1), unobserved)
    threshold = np.maximum(THRESHOLD_FACTOR * typical, smallest)
    return Jumps(jump, threshold, np.median(np.abs(middle), axis=0))


def _surroundings(values: Array, unobserved: Mask) -> Array:
    """
    Return the running median before or after each sample, whichever is larger.

    So the first samples of a motion are compared with the motion, not with the rest before it.
    """
    seen = np.flatnonzero(~unobserved)
    if len(seen) < MIN_SAMPLES:
        return np.full_like(values, np.inf)
    median = median_filter(values[seen], size=MEDIAN_SAMPLES, mode='mirror')
    shift = MEDIAN_SAMPLES // 2
    place = np.searchsorted(seen, np.arange(len(values)))
    before = median[np.clip(place - shift, 0, len(seen) - 1)]
    after = median[np.clip(place + shift, 0, len(seen) - 1)]
    return np.asarray(np.maximum(before, after))


def strength_of(look: list[Jumps]) -> Array:
    """Return how strong the stronger one of the jumps in position and rotation is (M,)."""
    return np.asarray(np.max([jumps.strength for jumps in look], axis=0))
