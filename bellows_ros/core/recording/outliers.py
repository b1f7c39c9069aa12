"""
Finding poses that tracking got wrong: excursions, steps and frozen poses (appendix H).

Jumps of a pose that cancel each other enclose an excursion, of which all samples are marked; a
jump that nothing cancels is a step. Exact repeats of a pose are marked where the body moved.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.recording.excursions import (
    edges_over_gaps,
    edges_seen,
    Excursion,
    paired,
    Step,
)
from bellows_ros.core.recording.jumps import (
    increments_of,
    Indices,
    long_look,
    MEDIAN_PER_DEVIATION,
    short_look,
    SMALLEST_JUMP,
    SMOOTH,
    strength_of,
    uneven,
)
from bellows_ros.core.trajectory import PoseStream, Trajectory
import numpy as np

# Fewer samples than this between gaps and marked samples cannot be judged, and are marked.
SHORTEST_RUN = 3
# A frozen pose ends with a step that is larger than its neighbours' by this factor.
CATCHES_UP = 1.5
# ... and has so many moves among so many intervals on each side.
NEARBY = 5
MOVES_NEARBY = 3
# A pose that is published twice is followed by a step larger than the smallest ones, which are
# rounding, by this factor, and than this (m or rad).
BEYOND_ROUNDING, LEAST_STEP = 4.0, 1e-9


@dataclass(frozen=True, eq=False)
class Outliers:
    """
    What is wrong with the poses of a stream.

    Parameters
    ----------
    good : bool array (N,)
        False for the samples marked.
    excursions : tuple of Excursion
        Jumps away and back.
    frozen : tuple of Excursion
        Exact repeats of a pose while the body moved.
    isolated : tuple of Excursion
        Single samples between others marked or missing.
    steps : tuple of Step
        Jumps without a return; only the samples beside one are marked.
    noise : dict of str to float
        Standard deviation of the white noise per axis, 'position' in m and 'rotation' in rad; from
        samples that follow each other, so that fast motion without noise adds to it.

    """

    good: Mask
    excursions: tuple[Excursion, ...]
    frozen: tuple[Excursion, ...]
    isolated: tuple[Excursion, ...]
    steps: tuple[Step, ...]
    noise: dict[str, float]


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
    frozen = _frozen(poses)
    moving = np.full(len(poses), True)
    _mark(moving, frozen)
    kept = np.flatnonzero(moving)
    if len(kept) < 2 * SHORTEST_RUN:
        return Outliers(moving, (), frozen, (), (), {'position': 0.0, 'rotation': 0.0})
    found = _find_jumps(poses.select(kept), longest_step_ns)
    good = moving.copy()
    good[kept] = found.good
    return replace(
        found,
        good=good,
        frozen=frozen,
        excursions=tuple(_reindexed(run, kept) for run in found.excursions),
        isolated=tuple(_reindexed(run, kept) for run in found.isolated),
        steps=tuple(replace(step, index=int(kept[step.index])) for step in found.steps),
    )


def repeats_in_motion(poses: PoseStream | Trajectory) -> int:
    """
    Count the poses that repeat the one before while others near them, on both sides, do not.

    A slow motion recorded without noise repeats its poses too, by rounding; these do not count.

    Parameters
    ----------
    poses : PoseStream or Trajectory
        As recorded.

    Returns
    -------
    int

    """
    repeats = _repeats(poses)
    moved = np.concatenate([[0], np.cumsum(~repeats)])
    at = np.flatnonzero(repeats)
    before = moved[at] > moved[np.maximum(at - NEARBY, 0)]
    after = moved[np.minimum(at + 1 + NEARBY, len(repeats))] > moved[at + 1]
    moves = np.append(np.flatnonzero(~repeats), -1)
    next_move = moves[moved[at + 1].astype(int)]
    seen = np.zeros(len(at), dtype=bool)
    whole = poses if isinstance(poses, Trajectory) else poses.trajectory()
    for increment in increments_of(whole).values():
        length = np.linalg.norm(increment, axis=1)
        smallest = length[length > 0.0].min(initial=np.inf)
        seen |= length[next_move] > max(BEYOND_ROUNDING * smallest, LEAST_STEP)
    return int(np.count_nonzero(before & after & seen))


def _repeats(poses: PoseStream | Trajectory) -> Mask:
    """Return after which samples the very same pose comes again (M,)."""
    same: Mask = np.all(poses.position[1:] == poses.position[:-1], axis=1)
    same &= np.all(poses.rotation[1:] == poses.rotation[:-1], axis=(1, 2))
    return same


def _reindexed(run: Excursion, kept: Indices) -> Excursion:
    """Return a run of kept samples with their indices among all."""
    return replace(run, first=int(kept[run.first]), last=int(kept[run.last]))


def _find_jumps(poses: Trajectory, longest_step_ns: int) -> Outliers:
    """Find the jumps of poses that are not frozen, and what lies between them."""
    steps_ns = np.diff(poses.stamps_ns)
    gap = steps_ns > longest_step_ns
    increments = increments_of(poses)
    short = [short_look(increments[q], steps_ns, gap, q) for q in increments]
    breaks = gap | (strength_of(short) >= 1.0)
    long = [long_look(increments[q], breaks | uneven(steps_ns), q) for q in increments]
    edges = edges_seen(poses, short, long, breaks & ~gap)
    excursions, steps = paired(edges + edges_over_gaps(poses, increments, gap, breaks), poses)
    good = np.full(len(poses), True)
    _mark(good, excursions)
    for step in steps:
        good[step.index:step.index + 2] = False
    isolated = _isolated(good, gap, poses.stamps_ns)
    _mark(good, isolated)
    deviations = (jumps.usual / MEDIAN_PER_DEVIATION for jumps in short)
    noise = dict(zip(increments, deviations, strict=True))
    return Outliers(good, tuple(excursions), (), isolated, tuple(steps), noise)


def _mark(good: Mask, runs: Iterable[Excursion]) -> None:
    """Take the samples of runs out of the good ones."""
    for run in runs:
        good[run.first:run.last + 1] = False


def _runs(mask: Mask) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each run of set ones."""
    change = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    for first, after in change.reshape(-1, 2):
        yield int(first), int(after) - 1


def _isolated(good: Mask, gap: Mask, stamps_ns: Stamps) -> tuple[Excursion, ...]:
    """Return the runs of good samples that are too short to be judged."""
    group = np.concatenate([[0], np.cumsum(gap | (good[1:] != good[:-1]))])
    first = np.searchsorted(group, np.arange(group[-1] + 1))
    length = np.diff(np.append(first, len(good)))
    return tuple(
        Excursion(int(i), int(i + n - 1), int(stamps_ns[i]), int(stamps_ns[i + n - 1]), 0.0, 0.0)
        for i, n in zip(first, length, strict=True)
        if good[i] and n < SHORTEST_RUN
    )


def _frozen(poses: Trajectory) -> tuple[Excursion, ...]:
    """
    Return the exact repeats that end with a step too large for the motion around.

    A body at rest, recorded without noise or coarsely, repeats its pose too, but comes to it and
    goes on from it with small steps, or with the one or two of an outlier.
    """
    repeats = _repeats(poses)
    moves = np.flatnonzero(~repeats)
    if len(moves) in (0, len(repeats)):
        return ()
    lengths = [np.linalg.norm(increment, axis=1) for increment in increments_of(poses).values()]
    found = []
    for first, last in _runs(repeats):
        around = (repeats[max(first - NEARBY, 0):first], repeats[last + 1:last + 1 + NEARBY])
        if any(np.sum(~near) < MOVES_NEARBY for near in around if len(near) or not first):
            continue
        k = int(np.searchsorted(moves, last))
        sizes, excess = _catch_up(lengths, moves, k, last - first + 1)
        if any(e > floor for e, floor in zip(excess, SMALLEST_JUMP.values(), strict=True)):
            stamps = poses.stamps_ns
            run = (first + 1, last + 1, int(stamps[first + 1]), int(stamps[last + 1]))
            found.append(Excursion(*run, *sizes))
    return tuple(found)


def _catch_up(
    lengths: list[Array], moves: Indices, k: int, repeats: int
) -> tuple[list[float], list[float]]:
    """Return the lengths of the step after some repeats, and by how much they are too large."""
    if k == len(moves):
        sizes = _lost_by_the_end(lengths, moves, repeats)
        return sizes, sizes
    near = moves[max(k - SMOOTH // 2, 0):k + SMOOTH // 2 + 1]
    sizes = [float(length[moves[k]]) for length in lengths]
    usual = [float(np.median(length[near])) for length in lengths]
    return sizes, [size - CATCHES_UP * u for size, u in zip(sizes, usual, strict=True)]


def _lost_by_the_end(lengths: list[Array], moves: Indices, repeats: int) -> list[float]:
    """Return how far a body that froze till the end would have gone; zero if it slowed down."""
    last = moves[-1 - SMOOTH:]
    gone = []
    for length in lengths:
        usual = float(np.median(length[last]))
        stopped_at_once = float(length[last[-1]]) * CATCHES_UP > usual
        gone.append(repeats * usual if stopped_at_once else 0.0)
    return gone
