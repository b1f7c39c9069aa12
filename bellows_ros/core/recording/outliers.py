"""
Detection of tracking errors: excursions and lasting steps (appendix H).

A body with finite speed cannot jump. The jump between two samples is the smallest distance between
two straight lines in the interval between the samples: the line through the two earlier samples,
and the line through the two later ones. Constant acceleration and sudden changes of velocity cause
no jump. A Hampel filter detects jumps above a multiple of the local median. Jumps that cancel each
other enclose an excursion, whose samples are all marked. A jump without a cancelling one is a
lasting step. Positions (m) and rotation vectors (rad) have the same treatment.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
import numpy as np
from scipy.ndimage import median_filter

THRESHOLD_FACTOR = 4.5
"""Ratio of threshold and local median; the largest of 2 million samples of white noise is 4.0
times their median."""

MIN_JUMP = np.array([1e-3, 4e-3])
"""Smallest detected jump (m, rad); the fit treats smaller ones as noise."""

MEDIAN_SAMPLES = 51
"""Number of samples of the running median."""

MIN_SAMPLES = 30
"""Number of jumps below which no outlier can be detected."""

MAX_EXCURSION = 2.0
"""Longest excursion, s."""

MIN_EXCURSION_SAMPLES = 15
"""Number of samples that an excursion may have at any rate."""

LONG_GAP = 0.05
"""Longest gap over which a jump is estimated, s."""

LONG_GAP_SAMPLES = 5
"""Longest gap over which a jump is estimated, samples."""

MIN_RUN = 3
"""Smallest number of consecutive good samples; shorter runs are marked."""

SIDE_SAMPLES = 6
"""Number of compared samples on each side of a lasting step."""

SIDES = slice(SIDE_SAMPLES), slice(SIDE_SAMPLES, None)
"""Samples before and after a jump."""


class LastingStep(NamedTuple):
    """A jump without a return: index of the sample before it, and its size, m and rad."""

    before: int
    position: float
    rotation: float


@dataclass(frozen=True, eq=False)
class Outliers:
    """
    The faults in the poses of a stream.

    Parameters
    ----------
    good : bool array (N,)
        False for excursions, the two samples beside a lasting step, and isolated samples between
        marked or missing ones.
    steps : tuple of LastingStep
        Jumps without a return.

    """

    good: Mask
    steps: tuple[LastingStep, ...]


class _Jumps(NamedTuple):
    """Jumps over the interval after each sample but the last, and their thresholds (2, M)."""

    size: Array  # (2, M, 3) position in the world, rotation in body axes
    threshold: Array
    steps: Array  # (M,) duration in periods, at least 1; acceleration grows with its square

    @property
    def strength(self) -> Array:
        """Ratio (M,) of each jump to its threshold."""
        return np.asarray((np.linalg.norm(self.size, axis=2) / self.threshold).max(axis=0))


def increments_of(poses: Trajectory | PoseStream) -> Array:
    """Return differences of positions, and body rotation vectors, between samples (2, M, 3)."""
    return np.stack([
        np.diff(poses.position, axis=0),
        log_so3(np.swapaxes(poses.rotation[:-1], -1, -2) @ poses.rotation[1:])])


def find_outliers(poses: Trajectory, longest_step_ns: int) -> Outliers:
    """
    Find the poses of a stream that do not belong to the body.

    Parameters
    ----------
    poses : Trajectory
        Recorded poses, not necessarily at uniform stamps, without filling.
    longest_step_ns : int
        Longest time between two samples that is not a gap, ns.

    """
    good = np.full(len(poses), True)
    if len(poses) < 2 * MIN_RUN:
        return Outliers(good, ())
    jumps = _jumps(poses)
    excursions, steps = _paired(poses, jumps)
    _exclude(good, [*excursions, *(slice(step.before, step.before + 2) for step in steps)])
    _exclude(good, _isolated(good, np.diff(poses.stamps_ns) > longest_step_ns))
    return Outliers(good, tuple(steps))


def _jumps(poses: Trajectory) -> _Jumps:
    """Return the jumps between samples; zero over a long gap."""
    increments, steps = increments_of(poses), np.diff(poses.stamps_ns)
    _cancel_half_turns(increments[1])
    period = float(np.median(steps))
    velocity = increments / steps[:, None]
    start, end = np.zeros((2, *increments.shape))  # errors of the continuation of each side
    start[:, :-1] = increments[:, :-1] - velocity[:, 1:] * steps[:-1, None]
    end[:, 1:] = increments[:, 1:] - velocity[:, :-1] * steps[1:, None]
    if len(steps) > 2:  # constant acceleration at the ends
        start[:, 0], end[:, -1] = start[:, 0] - start[:, 1], end[:, -1] - end[:, -2]
    start[:, -1], end[:, 0] = end[:, -1], start[:, 0]
    change = end - start
    squared = np.sum(change**2, axis=2)
    along = np.divide(
        -np.sum(start * change, axis=2), squared, out=np.zeros_like(squared), where=squared > 0.0)
    size = start + np.clip(along, 0.0, 1.0)[..., None] * change
    size[:, steps > max(LONG_GAP * NS_PER_S, LONG_GAP_SAMPLES * period)] = 0.0
    middle = 0.5 * (start + end)
    surroundings = np.array([_surroundings(np.linalg.norm(part, axis=1)) for part in middle])
    return _Jumps(size, np.maximum(THRESHOLD_FACTOR * surroundings, MIN_JUMP[:, None]),
                  np.maximum(steps / period, 1.0))


def _cancel_half_turns(rotation: Array) -> None:
    """
    Choose the signs of large rotation vectors (M, 3) such that opposite jumps cancel.

    A rotation near 180 degrees has two rotation vectors, and noise selects one of them.
    """
    total = np.zeros(3)
    for i in np.flatnonzero(np.linalg.norm(rotation, axis=1) > 2.5):  # rad
        vector = rotation[i]
        other = vector * (1.0 - 2.0 * np.pi / np.linalg.norm(vector))
        if np.linalg.norm(total + other) < np.linalg.norm(total + vector):
            rotation[i] = other
        total += rotation[i]


def _surroundings(values: Array) -> Array:
    """Return the running median before or after each value, whichever is larger."""
    if len(values) < MIN_SAMPLES:
        return np.full_like(values, np.inf)
    median, half = median_filter(values, size=MEDIAN_SAMPLES, mode='mirror'), MEDIAN_SAMPLES // 2
    place = np.arange(len(values))  # the onset of a motion is compared with the motion
    return np.asarray(np.maximum(*(
        median[np.clip(place + shift, 0, len(values) - 1)] for shift in (-half, half))))


def _paired(poses: Trajectory, jumps: _Jumps) -> tuple[list[slice], list[LastingStep]]:
    """Return the excursions between jumps that cancel, and the lasting steps."""
    strength, seconds = jumps.strength, poses.seconds
    edges = np.flatnonzero(strength >= 0.5).tolist()  # may cancel another jump
    cuts = np.flatnonzero(np.diff(seconds) > max(
        LONG_GAP, LONG_GAP_SAMPLES * float(np.median(np.diff(seconds)))))
    ends = np.concatenate([[0], cuts + 1, [len(poses)]])
    excursions, steps = list[slice](), list[LastingStep]()
    done = -1
    for k, i in enumerate(edges):
        if strength[i] < jumps.steps[i] ** 2:
            continue
        part = int(np.searchsorted(ends, i, side='right'))
        if i <= done:  # a second excursion may begin in the first, and end after it
            overlapping = _excursion(poses, jumps, edges, k, (i, int(ends[part])))
            if overlapping and overlapping.stop - 1 > done:
                excursions.append(overlapping)
                done = overlapping.stop - 1
            continue
        run = _excursion(poses, jumps, edges, k, (done, int(ends[part]))) or _to_an_end(
            i, int(ends[part - 1]), int(ends[part]), seconds)
        if run is None and not _lasts(poses, jumps, i):
            run = slice(i, i + 2)
        if run is None:
            steps.append(LastingStep(i, *np.linalg.norm(jumps.size[:, i], axis=1).tolist()))
        else:
            excursions.append(run)
            done = run.stop - 1
    lasting = [step for step in steps if not any(  # successive steps are not lasting
        0 < abs(other.before - step.before) <= MIN_EXCURSION_SAMPLES
        or 0.0 < abs(seconds[other.before] - seconds[step.before]) < MAX_EXCURSION
        for other in steps)]
    excursions += [slice(step.before, step.before + 2) for step in steps if step not in lasting]
    return excursions, lasting


def _excursion(
    poses: Trajectory, jumps: _Jumps, edges: list[int], k: int, within: tuple[int, int]
) -> slice | None:
    """Return the samples between a jump and the nearest jumps that cancel it, if any."""
    i, seconds = edges[k], poses.seconds
    for direction in (1, -1):
        total = _forms(poses, jumps, i, direction > 0)
        first, sizes = total.copy(), np.linalg.norm(total[:, 0], axis=1)
        allowed = np.where(sizes >= jumps.threshold[:, i], 0.4 * sizes, 0.0)
        for j in edges[k + 1:] if direction > 0 else edges[:k][::-1]:
            if not within[0] < j < within[1] - 1 or abs(j - i) > MIN_EXCURSION_SAMPLES and (
                    abs(seconds[j] - seconds[i]) > MAX_EXCURSION):
                break
            other = _forms(poses, jumps, j, direction < 0)
            least = allowed + 0.5 * jumps.steps[j] * jumps.threshold[:, i]
            cancels = any(np.all(np.linalg.norm(each + other, axis=2).min(axis=1) < least)
                          for each in (first, total))
            is_near = abs(j - i) <= SIDE_SAMPLES and (
                jumps.strength[j] >= 0.5 * jumps.steps[j] ** 2)
            if cancels and (is_near or jumps.strength[j] >= 1.0 and (
                    _lasts(poses, jumps, i) and _lasts(poses, jumps, j))):
                return slice(min(i, j) + 1, max(i, j) + 1)
            total += other
    return None


def _forms(poses: Trajectory, jumps: _Jumps, i: int, before: bool) -> Array:
    """Return a jump (2, 2, 3) in axes of the world and of the body, before or after the jump."""
    position, rotation = jumps.size[:, i]
    R = poses.rotation[i if before else i + 1]
    return np.array([[position, R.T @ position], [R @ rotation, rotation]])


def _to_an_end(i: int, first: int, last: int, seconds: Array) -> slice | None:
    """Return the samples between a jump and the nearer end of its part, if they are few."""
    before, after = float(seconds[i] - seconds[first]), float(seconds[last - 1] - seconds[i + 1])
    if min(before, after) >= 1.0:  # s
        return None
    return slice(first, i + 1) if before < after else slice(i + 1, last)


def _lasts(poses: Trajectory, jumps: _Jumps, i: int) -> bool:
    """Return whether two lines, fitted to the samples before and after, also have the jump."""
    around = np.arange(i + 1 - SIDE_SAMPLES, i + 1 + SIDE_SAMPLES)
    if around[0] < 0 or around[-1] >= len(poses):
        return True
    t = poses.seconds[around] - 0.5 * (poses.seconds[i] + poses.seconds[i + 1])
    paths = np.hstack([poses.position[around] - poses.position[i],
                       log_so3(poses.rotation[i].T @ poses.rotation[around])])
    lines = [np.polyfit(t[side], paths[side], 1) for side in SIDES]
    misfit = np.concatenate([paths[side] - np.vander(t[side], 2) @ line
                             for side, line in zip(SIDES, lines, strict=True)])
    seen, misfit = (np.linalg.norm(part.reshape(-1, 2, 3), axis=2) for part in (
        lines[1][1] - lines[0][1], misfit))
    sizes = np.linalg.norm(jumps.size[:, i], axis=1)
    least = np.maximum(jumps.threshold[:, i], 0.5 * sizes)
    return bool(np.any(seen[0] >= np.maximum(
        least, 3.0 * np.sqrt(np.mean(misfit**2, axis=0)))))  # a swing reaches 2


def _exclude(good: Mask, runs: Iterable[slice]) -> None:
    for run in runs:
        good[run] = False


def _isolated(good: Mask, gap: Mask) -> list[slice]:
    """Return the runs of good samples, without a gap, that are too short."""
    begins = np.concatenate([[True], gap | (good[1:] != good[:-1])])
    first = np.append(np.flatnonzero(begins), len(good)).tolist()
    return [slice(i, after) for i, after in pairwise(first) if good[i] and after - i < MIN_RUN]
