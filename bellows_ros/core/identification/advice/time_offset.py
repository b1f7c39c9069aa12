"""
By how much the stamps of the tool are behind those of the package, where two clocks made them.

No cup explains the wrenches of a package whose tool is seen too early or too late: the offset is
the one with which least squares leaves the smallest residuals. It is looked for on a raster first,
then between its lines.
"""

from dataclasses import replace
import math

from bellows_ros.core.identification.advice.package_check import smallest_residuals, whitened_rows
from bellows_ros.core.identification.regression.least_squares import (
    regular,
    Samples,
    whitening_of,
    wrench_covariance,
)
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.recording.preparation import TimeOffset
from bellows_ros.core.resampling import resample
from bellows_ros.core.trajectory import Mask, NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_OFFSET = 0.05
"""Time offsets of the streams are looked for up to this, s."""

RASTER = 0.005
"""Time (s) between the offsets tried first: the residuals of motions up to 10 Hz have one dip."""

STEP, PRECISE = 1e-4, 1e-6
"""Change of the offset (s) for derivatives, and how exactly it is found."""

ENOUGH = 2500
"""Samples of a recording that are looked at, some more."""

LARGEST_ERROR = 1e-3
"""An offset whose standard error is larger (s) is not told."""

FEWEST = 8
"""Clusters of residuals that it takes to know the standard error."""

FALLS = 0.9
"""Residuals that fall to this part up to the largest offset tell that the true one is larger."""


def time_offset(
    tool: Trajectory, samples: Samples, cup_length: float, structure: Structure
) -> TimeOffset | None:
    """
    Return the time offset with the smallest residuals; None where the recording does not tell it.

    Parameters
    ----------
    tool : Trajectory
        E in the world with body twists, filtered, from start to end.
    samples : Samples
        The prepared recording.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries of K and P are free.

    Raises
    ------
    BellowsError
        If the offset is larger than those looked for.

    """
    from scipy.optimize import minimize_scalar  # late: most recordings have one clock

    edge = round((LARGEST_OFFSET + STEP) * NS_PER_S)
    stamps = samples.package.stamps_ns
    samples = _selected(
        samples, (stamps >= tool.stamps_ns[0] + edge) & (stamps <= tool.stamps_ns[-1] - edge)
    ).thinned(ENOUGH)
    W = whitening_of(regular(wrench_covariance([samples], structure)))

    def residual(offset: float) -> float:
        """Return the mean square of the residuals with the tool at later stamps (s)."""
        moved = _moved(tool, samples, offset)
        if not moved.count:
            return math.inf
        return smallest_residuals(whitened_rows(moved, cup_length, structure, W))[1] / moved.count

    steps = round(LARGEST_OFFSET / RASTER)
    residuals = {RASTER * i: residual(RASTER * i) for i in range(-steps, steps + 1)}
    best = min(residuals, key=lambda offset: residuals[offset])
    low, high = max(best - RASTER, -LARGEST_OFFSET), min(best + RASTER, LARGEST_OFFSET)
    value = float(minimize_scalar(
        residual, bounds=(low, high), method='bounded', options={'xatol': PRECISE}).x)
    if abs(value) > LARGEST_OFFSET - STEP and residuals[best] < FALLS * max(residuals.values()):
        raise BellowsError(
            f'The stamps of tool and package are {1e3 * LARGEST_OFFSET:g} ms or more apart, and '
            'fit.time_offset looks no further. Shift the stamps of one topic by what is known.'
        )
    std = _error(tool, samples, value, cup_length, structure, W)
    return TimeOffset(value, std) if std < LARGEST_ERROR else None


def _error(
    tool: Trajectory, samples: Samples, offset: float, cup_length: float, structure: Structure,
    W: Array,
) -> float:
    """Return the standard error (s) of an offset, with residuals correlated in clusters."""
    moved = [_moved(tool, samples, offset + side) for side in (-STEP, 0.0, STEP)]
    valid = np.all([part.tool.valid & part.package.valid for part in moved], axis=0)
    if 6 * np.count_nonzero(valid) <= 2 * structure.size:
        return math.inf
    before, (A, b, clusters), after = (
        whitened_rows(_selected(part, valid), cup_length, structure, W) for part in moved)
    Q, _ = np.linalg.qr(A)
    x = smallest_residuals((A, b, clusters))[0]
    slope = (after[0] - before[0]) @ x / (2.0 * STEP)
    slope -= Q @ (Q.T @ slope)  # what the cup explains as well
    left = b - A @ x
    scores = [float(slope[part] @ left[part]) for part in clusters]
    if len(clusters) < FEWEST or not slope.any():
        return math.inf
    return float(np.linalg.norm(scores) / (slope @ slope))


def _moved(tool: Trajectory, samples: Samples, offset: float) -> Samples:
    """Return samples with the tool as it is so much later (s)."""
    stamps = samples.package.stamps_ns
    there = resample(tool, stamps + round(offset * NS_PER_S))
    return replace(samples, tool=replace(there, stamps_ns=stamps))


def _selected(samples: Samples, chosen: Mask) -> Samples:
    """Return some of the samples."""
    return replace(
        samples, tool=samples.tool.select(chosen), package=samples.package.select(chosen))
