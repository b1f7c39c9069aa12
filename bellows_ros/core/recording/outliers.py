"""
Detection of tracking errors: excursions, steps and frozen poses (appendix H).

Jumps of a pose that cancel each other enclose an excursion, of which all samples are marked; in
axes of the world or of the body. A jump over a gap is one as well, as far as the motion lets it be
known. What nothing cancels is a step, or, near an end of the recording, the one end of an
excursion that is visible. Exact repeats of a pose are marked where the body moved.

A body with finite speed cannot jump. How far it does is the least distance, over the time between
two samples, of two straight continuations: of the samples before, and of the samples after. Real
motion leaves next to nothing, not even where its velocity or its acceleration changes at once,
since the continuations meet where it did. Two samples on each side find short excursions,
`LONG_SIDE` on each side find small ones. Positions (m) and rotation vectors (rad) are treated
alike.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import sqrt
from operator import attrgetter
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.trajectory import any_within, NS_PER_S, PoseStream, Trajectory
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import find_objects, label, median_filter

Indices = Stamps

# Samples on each side of the second, long window, and how even their times must be.
LONG_SIDE, MAX_UNEVENNESS = 5, 0.1
# A jump counts from this many times the median of its surroundings on. Of white noise, the largest
# in two million samples reaches 4.0.
THRESHOLD_FACTOR = 4.5
# It must be at least this large: far below what matters, far above rounding and quantisation.
QUANTITIES, MIN_JUMP = ('position', 'rotation'), np.array([0.5e-3, 1e-3])
# Motion whose velocity changes at once is no jump: parabolas through the samples on each side, if
# they are smooth to this part of the jump, then meet to within that part of it.
MAX_ROUGHNESS, MEETING_DISTANCE = 0.5, 0.3
# In the long window, the lines must fit their samples to this part of the jump.
MAX_LINE_MISFIT = 0.6
# A jump that may be the other end of one that counts may be weaker, by this factor.
PARTNER_STRENGTH = 0.5
# Among fewer jumps than this nothing stands out.
MIN_SAMPLES = 30
# Samples of the running median of the surroundings, and of the one that follows the acceleration.
MEDIAN_SAMPLES, ACCELERATION_SAMPLES = 51, 7
# Median size along an axis of the jump in the middle per standard deviation of white noise, from
# two samples on each side: that of a normal distribution, times the norm of (1, -3, 3, -1) / 2.
MEDIAN_PER_DEVIATION = 0.6745 * sqrt(5.0)


class Jumps(NamedTuple):
    """Jumps of positions and rotations over the interval after each sample but the last."""

    jump: Array  # (2, M, 3)
    threshold: Array  # (2, M)
    typical: Array  # (2, 3) median size along each axis of the jump in the middle of the interval

    @property
    def strengths(self) -> Array:
        """Jumps over thresholds (2, M)."""
        return np.asarray(np.linalg.norm(self.jump, axis=2) / self.threshold)

    @property
    def strength(self) -> Array:
        """How strong the stronger one of the jumps in position and rotation is (M,)."""
        return np.asarray(np.max(self.strengths, axis=0))


def increments_of(poses: Trajectory | PoseStream) -> Array:
    """Return differences of positions, and body rotation vectors, between samples (2, M, 3)."""
    return np.stack([
        np.diff(poses.position, axis=0),
        log_so3(np.swapaxes(poses.rotation[:-1], -1, -2) @ poses.rotation[1:])])


def short_window(increments: Array, step_ns: Stamps, gap: Mask) -> Jumps:
    """
    Return the jumps between two samples on each side, at any stamps.

    The end of an interval is predicted with the velocity before it, the start with the velocity
    after it; the first and the last interval have only one of both.
    """
    step_s = step_ns[:, None] / NS_PER_S
    velocity = increments / step_s
    start, end = np.zeros((2, *increments.shape))
    start[:, :-1] = increments[:, :-1] - velocity[:, 1:] * step_s[:-1]
    end[:, 1:] = increments[:, 1:] - velocity[:, :-1] * step_s[1:]
    start[:, -1], end[:, 0] = -end[:, -1], -start[:, 0]
    start, end = _without_acceleration(start, end, ACCELERATION_SAMPLES)
    start[:, -1], end[:, 0] = end[:, -1], start[:, 0]
    return _without_bends(increments, _jumps(start, end, gap), gap)


def _without_bends(increments: Array, jumps: Jumps, gap: Mask) -> Jumps:
    """Return jumps without those that are bends of a motion that is smooth on both sides."""
    # Parabolas through samples at -2, -1 and 0, from each side, at times from 0 to 1.
    time, through = np.linspace(0.0, 1.0, 21), np.linalg.inv(np.vander([-2.0, -1.0, 0.0]))
    ahead, behind = (np.vander(t, 3) @ through for t in (time, 1.0 - time))
    for jump, increment, strength in zip(jumps.jump, increments, jumps.strengths, strict=True):
        i = np.flatnonzero(strength >= PARTNER_STRENGTH)
        i = i[(i >= 3) & (i < len(increment) - 3)]
        around = i[:, None] + np.arange(-3, 4)
        path = np.pad(np.cumsum(increment[around], axis=1), ((0, 0), (1, 0), (0, 0)))
        before, after = path[:, :4], path[:, :3:-1]  # each from far to near
        size = np.linalg.norm(jump[i], axis=1)
        rough = [np.linalg.norm(np.diff(side, 3, axis=1)[:, 0], axis=1)
                 for side in (before, after)]
        smooth = np.maximum(*rough) < MAX_ROUGHNESS * size
        apart = np.linalg.norm(ahead @ before[:, 1:] - behind @ after[:, 1:], axis=2)
        meets = apart.min(axis=1) < MEETING_DISTANCE * size
        jump[i[smooth & meets & ~gap[around].any(axis=1)]] = 0.0
    return jumps


# Powers of the time of `LONG_SIDE` samples before a jump; the weights of samples in a line at the
# last one and one after it; and orthonormal combinations of samples that vanish on every line.
POWERS = np.vander(np.arange(1.0 - LONG_SIDE, 1.0), LONG_SIDE, increasing=True)
HERE, SLOPE = np.linalg.pinv(POWERS[:, :2])
BEYOND, CURVED = HERE + SLOPE, np.linalg.qr(POWERS)[0][:, 2:]


def long_window(increments: Array, breaks: Mask) -> Jumps:
    """Return the jumps between lines through `LONG_SIDE` samples without breaks on each side."""
    m = LONG_SIDE
    start, end = np.zeros((2, *increments.shape))
    misfit, unobserved = np.zeros(increments.shape[:2]), np.full(len(breaks), True)
    count = len(breaks) - 2 * m + 2  # intervals with so many samples on each side
    if count > 0:
        path = np.pad(np.cumsum(increments, axis=1), ((0, 0), (1, 0), (0, 0)))
        sides = sliding_window_view(path, m, axis=1)
        before, after = sides[:, :count], sides[:, m:m + count, :, ::-1]
        inside = slice(m - 1, m - 1 + count)
        start[:, inside] = after @ BEYOND - before @ HERE
        end[:, inside] = after @ HERE - before @ BEYOND
        misfit[:, inside] = np.sqrt(np.sum(
            (before @ CURVED) ** 2 + (after @ CURVED) ** 2, axis=(2, 3)))
        unobserved[inside] = any_within(breaks, 2 * m - 1)
    jumps = _jumps(*_without_acceleration(start, end, 2 * m + 1), unobserved)
    jumps.jump[misfit > MAX_LINE_MISFIT * np.linalg.norm(jumps.jump, axis=2)] = 0.0
    return _without_bends(increments, jumps, breaks)


def _without_acceleration(start: Array, end: Array, width: int) -> tuple[Array, Array]:
    """Subtract half the difference where it varies smoothly, since it is due to acceleration."""
    smooth = np.empty_like(start)
    for q, axis in np.ndindex(2, 3):  # two to three times faster than one filter of all
        half = 0.5 * (end[q, :, axis] - start[q, :, axis])
        smooth[q, :, axis] = median_filter(half, size=width, mode='mirror')
    return start + smooth, end - smooth


def _jumps(start: Array, end: Array, unobserved: Mask) -> Jumps:
    """Return the least of the jumps from those at the start to those at the end of intervals."""
    change = end - start
    squared = np.sum(change**2, axis=2)
    along = np.divide(
        -np.sum(start * change, axis=2), squared, out=np.zeros_like(squared), where=squared > 0.0)
    jump = start + np.clip(along, 0.0, 1.0)[..., None] * change
    jump[:, unobserved] = 0.0
    middle = 0.5 * (start + end)
    surroundings = np.array([_surroundings(np.linalg.norm(part, axis=1), unobserved)
                             for part in middle])
    return Jumps(jump, np.maximum(THRESHOLD_FACTOR * surroundings, MIN_JUMP[:, None]),
                 np.median(np.abs(middle), axis=1))


def _surroundings(values: Array, unobserved: Mask) -> Array:
    """
    Return the running median before or after each sample, whichever is larger.

    So the first samples of a motion are compared with the motion, not with the rest before it.
    """
    observed = np.flatnonzero(~unobserved)
    if len(observed) < MIN_SAMPLES:
        return np.full_like(values, np.inf)
    median = median_filter(values[observed], size=MEDIAN_SAMPLES, mode='mirror')
    place = np.searchsorted(observed, np.arange(len(values)))
    before, after = (median[np.clip(place + shift, 0, len(observed) - 1)]
                     for shift in (-(MEDIAN_SAMPLES // 2), MEDIAN_SAMPLES // 2))
    return np.asarray(np.maximum(before, after))


# Two jumps cancel when their sum is below this part of the larger one, ...
MAX_REMAINDER = 0.5
# ... or this, when more samples than that lie between.
MAX_LATE_REMAINDER, LATE_SAMPLES = 0.2, 210
# Noise adds this part of the threshold, and sums of what does not stand out are below that part.
NOISE_PART, MAX_NOISE_SUM = 0.35, 0.85
# A jump lasts if lines through so many samples on each side see this part of it. Those of an
# excursion of more samples than that must last, the smaller being this part of the larger one;
# what nothing cancels is a step only if it lasts. Bursts of noise, as real tracks have, do not.
LINE_SIDE, MIN_LASTING_PART, MIN_SIZE_RATIO = 5, 0.5, 0.5
# So many others of at least half its strength, within so many samples, show that tracking flickers
# there, for instance with a marker that is seen and lost in turn. Such a jump is no step, and no
# end of a longer excursion.
FLICKER_COUNT, FLICKER_SAMPLES = 3, 25
# How many of the jumps around one are tried for cancelling it.
MAX_PARTNERS = 50
# Without a cancelling jump, what lies between a jump and an end of the recording, or a gap that is
# too long to show one, is marked up to this time, s.
MAX_END_SECONDS = 1.0
# A jump over a gap counts when it is larger by this factor than any over equally long parts of
# the same recording; so many of these are looked at, and at least so many must there be.
GAP_THRESHOLD_FACTOR, GAPS_SAMPLED, MIN_GAPS_SAMPLED = 2.0, 2000, 20


class LastingStep(NamedTuple):
    """A jump without a return: the sample before it, and its size, m and rad."""

    before: int
    position: float
    rotation: float


class Edge(NamedTuple):
    """One jump that may be the end of an excursion, after a sample."""

    before: int
    strength: float
    # Position and rotation, in world and in body axes (the body before, the body after the jump).
    forms: Array  # (2, 3, 3)
    thresholds: Array  # (2,)
    lasting: Array | None = None  # (2,) size that lines on each side see, where they can

    @property
    def sizes(self) -> Array:
        """Size of the jump (2,), m and rad."""
        return np.asarray(np.linalg.norm(self.forms[:, 0], axis=1))


def edges_seen(poses: Trajectory, short: Jumps, long: Jumps, certain: Mask) -> list[Edge]:
    """Return the jumps that may be ends of excursions, by both windows, but none over gaps."""
    from_short, from_long = short.strength, long.strength
    strength = np.maximum(from_short, from_long)
    at = np.flatnonzero(certain | (strength >= PARTNER_STRENGTH))
    edges = []
    for i, lasting in zip(at.tolist(), _lasting(poses, at), strict=True):
        jumps = short if certain[i] or from_short[i] > from_long[i] else long
        edges.append(Edge(
            i, float(strength[i]), _forms(poses, i, *jumps.jump[:, i]), jumps.threshold[:, i],
            None if np.isnan(lasting).any() else lasting))
    return edges


def _lasting(poses: Trajectory, at: Indices) -> Array:
    """
    Return sizes (K, 2) of jumps after samples (K,) that lines through some on each side see.

    A sample or two that are off, as in a burst of noise, hardly move a line. NaN near the ends.
    """
    m = LINE_SIDE
    result = np.full((len(at), 2), np.nan)
    inside = (at >= m - 1) & (at < len(poses) - m)
    i = at[inside]
    around = i[:, None] + np.arange(1 - m, m + 1)
    middle = 0.5 * (poses.stamps_ns[i + 1] - poses.stamps_ns[i]) / NS_PER_S
    t = (poses.stamps_ns[around] - poses.stamps_ns[i, None]) / NS_PER_S - middle[:, None]
    back = np.swapaxes(poses.rotation[i], -1, -2)[:, None]
    paths = poses.position[around] - poses.position[i, None], log_so3(
        back @ poses.rotation[around])
    for q, path in enumerate(paths):
        before, after = (_extrapolated_to_zero(t[:, side], path[:, side])
                         for side in (slice(m), slice(m, None)))
        result[inside, q] = np.linalg.norm(after - before, axis=1)
    return result


def _extrapolated_to_zero(t: Array, y: Array) -> Array:
    """Return lines through values y (K, m, 3) at times t (K, m), at time zero (K, 3)."""
    centre = t.mean(axis=1, keepdims=True)
    slope = np.einsum('km,kmi->ki', t - centre, y) / np.sum((t - centre) ** 2, axis=1)[:, None]
    return np.asarray(y.mean(axis=1) - centre * slope)


def _forms(poses: Trajectory, i: int, position: Array, rotation: Array) -> Array:
    """
    Return a jump in world axes and in those of the body before and after it.

    Of an excursion that is constant in the world or on the body, these are what cancels.
    """
    R_before, R_after = poses.rotation[i], poses.rotation[i + 1]
    return np.array([[position, R_before.T @ position, R_after.T @ position],
                     [R_before @ rotation, rotation, rotation]])


def edges_over_gaps(poses: Trajectory, increments: Array, gap: Mask, breaks: Mask) -> list[Edge]:
    """Return the jumps over gaps, strong where larger than any over like parts without a gap."""
    edges = []
    steps_ns = np.diff(poses.stamps_ns)
    slots = np.maximum(np.rint(steps_ns / np.median(steps_ns)), 1.0).astype(int)
    thresholds_of = cache(lambda count: np.maximum(
        _thresholds_over(poses, increments, breaks, count), MIN_JUMP))
    for i in (np.flatnonzero(gap[1:-1]) + 1).tolist():
        # A velocity with a jump in it is none, nor is one over a gap; the other side must do.
        beside = [k for k in (i - 1, i + 1) if not breaks[k]]
        if beside:
            jump = _jump_over(poses, increments, np.array([i]), np.array([i + 1]),
                              np.array([[beside[0], beside[-1]]]))
            edge = Edge(i, 0.0, _forms(poses, i, *jump[:, 0]), thresholds_of(int(slots[i])))
            edges.append(edge._replace(strength=float((edge.sizes / edge.thresholds).max())))
    return edges


def _jump_over(
    poses: Trajectory, increments: Array, i: Indices, j: Indices, around: Indices
) -> Array:
    """
    Return the jumps (2, K, 3) between samples i and j (K,), in the middle of the time between.

    `around` (K, 2) are the intervals that tell the velocity before and after.
    """
    moved = np.stack([
        poses.position[j] - poses.position[i],
        log_so3(np.swapaxes(poses.rotation[i], -1, -2) @ poses.rotation[j])])
    stamps = poses.stamps_ns
    periods = ((stamps[j] - stamps[i])[:, None] / (stamps[around + 1] - stamps[around]))[..., None]
    return np.asarray(moved - np.mean(periods * increments[:, around], axis=2))


def _thresholds_over(poses: Trajectory, increments: Array, breaks: Mask, slots: int) -> Array:
    """Return the thresholds (2,) of jumps over gaps of several periods; infinite if unknown."""
    free = np.flatnonzero(~any_within(breaks, slots + 2)) + 1
    if len(free) < MIN_GAPS_SAMPLED * slots:  # parts that overlap tell little more than one
        return np.full(2, np.inf)
    tried = free[:: len(free) // GAPS_SAMPLED + 1]
    around = tried[:, None] + np.array([-1, slots])
    jumps = _jump_over(poses, increments, tried, tried + slots, around)
    return np.asarray(GAP_THRESHOLD_FACTOR * np.linalg.norm(jumps, axis=2).max(axis=1))


def paired(edges: list[Edge], poses: Trajectory) -> tuple[list[slice], list[LastingStep]]:
    """Return the excursions between jumps that cancel, and the remaining steps."""
    edges, seconds = sorted(edges, key=attrgetter('before')), poses.seconds
    flickers = _flickering(edges)
    excursions: list[slice] = []
    used: set[int] = set()
    single = []
    for k, edge in enumerate(edges):
        if edge.strength < 1.0 or k in used:
            continue
        ends = [(a, b) for a, b in (
            *_cancelled_ahead(edges, k, used), *_cancelled_behind(edges, k, used))
            if edges[b].before - edges[a].before <= LINE_SIDE
            or not (flickers[a] or flickers[b]) and _persist_alike(edges[a], edges[b])
            and (min(edges[a].strength, edges[b].strength) >= PARTNER_STRENGTH
                 or seconds[edges[b].before] - seconds[edges[a].before] < MAX_END_SECONDS)]
        if not ends:
            single.append((edge, flickers[k]))
            continue
        first, last = min(ends, key=lambda end: edges[end[1]].before - edges[end[0]].before)
        used.update(range(first, last + 1))
        excursions.append(slice(edges[first].before + 1, edges[last].before + 1))
    steps = []
    for edge, flickering in single:
        run = _span_to_end(edge, poses) if not flickering and _persists(edge) else slice(
            edge.before, edge.before + 2)
        if run is None:
            steps.append(LastingStep(edge.before, *edge.sizes))
        else:
            excursions.append(run)
    return excursions, steps


def _flickering(edges: list[Edge]) -> Mask:
    """Return which jumps, in the order of their samples, are among others as strong."""
    at = np.array([edge.before for edge in edges])
    strength = np.array([edge.strength for edge in edges])
    first = np.searchsorted(at, at - FLICKER_SAMPLES)
    after = np.searchsorted(at, at + FLICKER_SAMPLES, side='right')
    return np.array([
        np.count_nonzero(strength[i:j] >= PARTNER_STRENGTH * each) > FLICKER_COUNT
        for i, j, each in zip(first, after, strength, strict=True)], dtype=bool)


def _persists(edge: Edge) -> bool:
    """Return whether a jump persists beyond the neighbouring samples, or this is undecidable."""
    return edge.lasting is None or bool(np.any(
        (edge.sizes >= PARTNER_STRENGTH * edge.thresholds)
        & (edge.lasting >= MIN_LASTING_PART * edge.sizes)))


def _persist_alike(one: Edge, other: Edge) -> bool:
    """Return whether two jumps persist with one size, or this is undecidable."""
    if one.lasting is None or other.lasting is None:
        return _persists(one) and _persists(other)
    stronger = max(one, other, key=attrgetter('strength'))
    q = int(np.argmax(stronger.sizes / stronger.thresholds))
    smaller, larger = sorted((one.lasting[q], other.lasting[q]))
    return _persists(stronger) and bool(smaller >= MIN_SIZE_RATIO * larger)


def _cancelled_ahead(edges: list[Edge], k: int, used: set[int]) -> Iterator[tuple[int, int]]:
    """Yield the pair (k, b) of a jump and the first after it with which the sum cancels."""
    total = edges[k].forms
    for b in range(k + 1, min(k + 1 + MAX_PARTNERS, len(edges))):
        other = edges[b]
        is_late = other.before - edges[k].before > LATE_SAMPLES
        if b in used or (is_late and other.strength < 1.0):
            continue
        summed = _summed_forms(total, other.forms)
        if _cancels(edges[k], other, summed, MAX_LATE_REMAINDER if is_late else MAX_REMAINDER):
            yield k, b
            return
        if other.strength >= 1.0:
            total = summed


def _cancelled_behind(edges: list[Edge], k: int, used: set[int]) -> Iterator[tuple[int, int]]:
    """Yield the pair (b, k) of a jump and the nearest weaker one before it that it cancels."""
    for b in range(k - 1, max(k - 1 - MAX_PARTNERS, -1), -1):
        other = edges[b]
        if b in used or edges[k].before - other.before > LATE_SAMPLES:
            return
        summed = _summed_forms(other.forms, edges[k].forms)
        if other.strength < 1.0 and _cancels(edges[k], other, summed):
            yield b, k
            return


def _summed_forms(first: Array, second: Array) -> Array:
    """Return the sums of jumps in each form; on the body, before the first and after the last."""
    total = first + second
    total[0, 1:] = first[0, 1] + second[0, 2]
    return np.asarray(total)


def _cancels(edge: Edge, last: Edge, summed: Array, within: float = MAX_REMAINDER) -> bool:
    """Return whether a jump and others to a last one cancel when summed, in the best form."""
    threshold = np.maximum(edge.thresholds, last.thresholds) if last.lasting is None else (
        edge.thresholds)  # over a gap it is less certain
    allowed = np.where(
        edge.sizes >= edge.thresholds, within * edge.sizes + NOISE_PART * edge.thresholds,
        MAX_NOISE_SUM * threshold)
    return bool(np.all(np.linalg.norm(summed, axis=2).min(axis=1) < allowed))


def _span_to_end(edge: Edge, poses: Trajectory) -> slice | None:
    """Return the part between a jump and an end of the recording, if short, else nothing."""
    seconds, first = poses.seconds, edge.before + 1
    before, after = float(seconds[edge.before]), float(seconds[-1] - seconds[first])
    if before < min(after, MAX_END_SECONDS):
        return slice(0, edge.before + 1)
    if after < min(before, MAX_END_SECONDS):
        return slice(first, len(poses))
    return None


# Fewer samples than this between gaps and marked samples cannot be judged, and are marked.
MIN_RUN = 3
# A frozen pose ends with a step that is larger than its neighbours' by this factor.
CATCH_UP_FACTOR = 1.5
# ... and has so many moves among so many intervals on each side.
NEIGHBOUR_SAMPLES, MIN_NEIGHBOUR_MOVES = 5, 3
# A pose that is published twice is followed by a step larger than the smallest ones, which are
# rounding, by this factor, and than this (m or rad).
ROUNDING_FACTOR, MIN_STEP = 4.0, 1e-9


@dataclass(frozen=True, eq=False)
class Outliers:
    """
    The faults in the poses of a stream.

    Parameters
    ----------
    good : bool array (N,)
        False for the samples marked: jumps away and back, exact repeats of a pose while the body
        moved, and single samples between others marked or missing.
    steps : tuple of LastingStep
        Jumps without a return; only the samples beside one are marked.
    noise : dict of str to array (3,)
        Standard deviation of the white noise along each axis, 'position' in m in the world and
        'rotation' in rad on the body; from samples that follow each other, so that fast motion
        without noise adds to it.

    """

    good: Mask
    steps: tuple[LastingStep, ...]
    noise: dict[str, Array]


def find_outliers(poses: Trajectory, longest_step_ns: int) -> Outliers:
    """
    Find the poses of a stream that are not those of the body.

    Parameters
    ----------
    poses : Trajectory
        As recorded, at stamps that need not be uniform, without filling.
    longest_step_ns : int
        Longest time between two samples that is not a gap, ns.

    Returns
    -------
    Outliers

    """
    usable = np.full(len(poses), True)
    _exclude(usable, _frozen(poses))
    moving = np.flatnonzero(usable)
    if len(moving) < 2 * MIN_RUN:
        return Outliers(usable, (), dict.fromkeys(QUANTITIES, np.zeros(3)))
    poses = poses.select(moving)
    steps_ns = np.diff(poses.stamps_ns)
    gap = steps_ns > longest_step_ns
    uneven = np.abs(steps_ns / np.median(steps_ns) - 1.0) > MAX_UNEVENNESS
    increments = increments_of(poses)
    short = short_window(increments, steps_ns, gap)
    breaks = gap | (short.strength >= 1.0)
    long = long_window(increments, breaks | uneven)
    edges = edges_seen(poses, short, long, breaks & ~gap)
    excursions, steps = paired(edges + edges_over_gaps(poses, increments, gap, breaks), poses)
    good = np.full(len(poses), True)
    _exclude(good, [*excursions, *(slice(step.before, step.before + 2) for step in steps)])
    _exclude(good, _isolated(good, gap))
    usable[moving] = good
    return Outliers(
        usable, tuple(step._replace(before=int(moving[step.before])) for step in steps),
        dict(zip(QUANTITIES, short.typical / MEDIAN_PER_DEVIATION, strict=True)))


def repeats_in_motion(poses: Trajectory | PoseStream) -> int:
    """
    Count the poses that repeat the one before while others near them, on both sides, do not.

    A slow motion recorded without noise repeats its poses too, by rounding; these do not count.

    Parameters
    ----------
    poses : Trajectory or PoseStream
        As recorded.

    Returns
    -------
    int

    """
    repeats = _repeats(poses)
    if not repeats.any():
        return 0
    moved = np.concatenate([[0], np.cumsum(~repeats)])
    at = np.flatnonzero(repeats)
    before = moved[at] > moved[np.maximum(at - NEIGHBOUR_SAMPLES, 0)]
    after = moved[np.minimum(at + 1 + NEIGHBOUR_SAMPLES, len(repeats))] > moved[at + 1]
    next_move = np.append(np.flatnonzero(~repeats), -1)[moved[at + 1].astype(int)]
    is_beyond = np.zeros(len(at), dtype=bool)
    for length in np.linalg.norm(increments_of(poses), axis=2):
        smallest = length[length > 0.0].min(initial=np.inf)
        is_beyond |= length[next_move] > max(ROUNDING_FACTOR * smallest, MIN_STEP)
    return int(np.count_nonzero(before & after & is_beyond))


def _repeats(poses: Trajectory | PoseStream) -> Mask:
    """Return the samples after which the identical pose comes again (M,)."""
    return np.asarray(np.all(poses.position[1:] == poses.position[:-1], axis=1)
                      & np.all(poses.rotation[1:] == poses.rotation[:-1], axis=(1, 2)))


def _exclude(good: Mask, runs: Iterable[slice]) -> None:
    """Take the samples of runs out of the good ones."""
    for run in runs:
        good[run] = False


def _isolated(good: Mask, gap: Mask) -> list[slice]:
    """Return the runs of good samples, without a gap in them, that are too short to be judged."""
    begins = np.concatenate([[True], gap | (good[1:] != good[:-1])])
    first = np.append(np.flatnonzero(begins), len(good)).tolist()
    return [slice(i, after) for i, after in pairwise(first)
            if good[i] and after - i < MIN_RUN]


def _frozen(poses: Trajectory) -> list[slice]:
    """
    Return the exact repeats that end with a step too large for the motion around.

    A body at rest, recorded without noise or coarsely, repeats its pose too, but comes to it and
    goes on from it with small steps, or with the one or two of an outlier.
    """
    repeats = _repeats(poses)
    moves = np.flatnonzero(~repeats)
    if len(moves) in (0, len(repeats)):
        return []
    lengths = np.linalg.norm(increments_of(poses), axis=2)
    frozen = []
    for (run,) in find_objects(label(repeats)[0]):
        first, last = run.start, run.stop - 1
        around = (repeats[max(first - NEIGHBOUR_SAMPLES, 0):first],
                  repeats[last + 1:last + 1 + NEIGHBOUR_SAMPLES])
        if any(np.sum(~side) < MIN_NEIGHBOUR_MOVES for side in around if len(side) or not first):
            continue
        k = int(np.searchsorted(moves, last))
        excess = [_catch_up(length, moves, k, last - first + 1) for length in lengths]
        if np.any(excess > MIN_JUMP):
            frozen.append(slice(first + 1, last + 2))
    return frozen


def _catch_up(length: Array, moves: Indices, k: int, repeats: int) -> float:
    """
    Return by how much the step after repeated poses exceeds the typical step around.

    A body that froze till the end would have gone on, unless it slowed down before.
    """
    if k == len(moves):
        typical = float(np.median(length[moves[-1 - ACCELERATION_SAMPLES:]]))
        return repeats * typical if float(length[moves[-1]]) * CATCH_UP_FACTOR > typical else 0.0
    around = moves[max(k - ACCELERATION_SAMPLES // 2, 0):k + ACCELERATION_SAMPLES // 2 + 1]
    return float(length[moves[k]] - CATCH_UP_FACTOR * np.median(length[around]))
