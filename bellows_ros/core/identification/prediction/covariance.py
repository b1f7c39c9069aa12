"""
How sure the prediction error is of what it found.

To first order the estimates are off by H^-1 g, with H the information and g the gradient at the
truth. What the noise model says of g is H itself; what the recordings say is how they scatter
without one second or another, which needs no noise model (the jackknife, robust by clusters). Few
seconds give variances badly; these lean on what all parameters have in common. Noise that is
left in the motion that is linearised about looks like information: how much it adds is seen by
adding as much again.
"""

from collections.abc import Iterator
from typing import NamedTuple

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.identification.prediction.free import KINDS
from bellows_ros.core.identification.prediction.minimum import Found, Search
from bellows_ros.core.identification.prediction.segments import SMALLEST
from bellows_ros.core.identification.prediction.whitening import Root, Whitened
import numpy as np

CLUSTER = 1.0
"""Length (s) of the parts of a recording whose gradients are kept."""

COMMON = 10.0
"""What all parameters have in common counts as much as so many parts of the recordings."""

LEAST_EXCESS = 0.25
"""Scatter that is less than this part of what the noise model says is of what nothing tells."""

LARGEST_LEVERAGE = 0.999
"""Part of a second that is left out: something is left where one second tells all."""

LARGEST_ERROR = 0.5
"""A parameter with a standard error above this part of its size is not identifiable."""

LEAST_SIGNAL = 0.05
"""A direction whose information is signal to a smaller part is taken to have this part."""

MEDIAN_OF_NORMAL = 0.6744897501960817
"""Of the size of a standard normal variable."""


class Certainty(NamedTuple):
    """
    What is known of m free numbers.

    Covariance (m, m), and which of the numbers (m,) are identifiable. Chi2: squares of the
    innovations per degree of freedom, all of them; robust: as large as their middle makes it.
    """

    covariance: Array
    identifiable: Mask
    chi2: float
    robust_chi2: float


def certainty(search: Search, found: Found) -> Certainty:
    """Return how sure the end of a search is."""
    inverse = _inverse(found.information, _signal(search, found))
    without_one = np.array([
        change for segment, part in zip(search.segments, found.parts, strict=True)
        for change in _left_out(found.information, part, segment.period)])
    claimed = np.diag(inverse @ found.information @ inverse)
    excess = _excess(without_one @ found.information @ inverse, claimed)
    if all(np.all(own.measured.package_noise.ripple <= SMALLEST) for own in search.segments):
        excess = np.maximum(excess, 1.0)  # what is left is no noise: rounding, interpolation
    covariance = inverse @ found.information @ inverse * np.sqrt(np.outer(excess, excess))
    r = np.concatenate([part.innovations for part in found.parts])
    degrees = max(len(r) - len(found.theta), 1)
    untrimmed = sum(
        float(np.sum(Root(own, search.noises(segment, search.kept), missing).whitened(
            own.errors[:, :, None]) ** 2))
        for segment, own, missing in zip(
            search.segments, search.equations(found.theta), search.missing, strict=True))
    identifiable = np.sqrt(np.diag(covariance)) <= _largest_errors(search, found.theta)
    return Certainty(
        covariance, identifiable, untrimmed / degrees,
        float((np.median(np.abs(r)) / MEDIAN_OF_NORMAL) ** 2))


def _signal(search: Search, found: Found) -> Array:
    """Return the information (m, m) less what noise in the motion adds to it."""
    rng = np.random.default_rng(0)
    cup = search.cup(found.theta)
    total = found.information.copy()
    for segment, part, noise in zip(search.segments, found.parts, found.noise, strict=True):
        fresh = rng.standard_normal(noise.shape)
        _, seen = part.root.noise(part.root.errors(fresh))
        left = part.root.accumulated(fresh - seen)
        added = -(part.jacobian.T @ part.jacobian)
        for side in (-1.0, 1.0):
            jacobian, _, _ = segment.linearised(
                cup, noise + side * left, search.free(found.theta, segment))
            J = part.root.whitened(search.by_numbers(segment, jacobian))
            added += 0.5 * J.T @ J
        total -= added
    return total


def _inverse(information: Array, signal: Array) -> Array:
    """Return the inverse of the signal, which is at least a part of the information."""
    root = np.linalg.cholesky(information)
    part = np.linalg.solve(root, np.linalg.solve(root, signal).T)
    values, vectors = np.linalg.eigh(0.5 * (part + part.T))
    half = np.linalg.solve(root.T, vectors)
    return np.asarray((half / np.maximum(values, LEAST_SIGNAL)) @ half.T)


def _left_out(information: Array, part: Whitened, period: float) -> Iterator[Array]:
    """Yield by how much the estimates (m,) change without each second of a segment."""
    length = 6 * max(round(CLUSTER / period), 1)
    for first in range(0, len(part.innovations), length):
        J, r = part.jacobian[first:first + length], part.innovations[first:first + length]
        rest = information - LARGEST_LEVERAGE * (J.T @ J)
        yield np.asarray(np.linalg.solve(rest, J.T @ r), dtype=np.float64)


def _excess(influences: Array, variances: Array) -> Array:
    """
    Return the variance (m,) of the estimates over that of the noise model.

    Influences (c, m) are by how much each part of the recordings moves the estimates.
    """
    count = len(influences)
    if count < 2:
        return np.ones(len(variances))
    own = np.sum(influences**2, axis=0) / variances * count / (count - 1)
    own = np.maximum(own, LEAST_EXCESS)
    common = float(np.median(own))
    return np.asarray((COMMON * common + count * own) / (COMMON + count))


def _largest_errors(search: Search, theta: Array) -> Array:
    """
    Return the standard errors (m,) above which numbers are not identifiable.

    The size of an entry of K or P is the root of the product of its diagonals.
    """
    cup, largest = search.cup(theta), np.empty(len(theta))
    i, j = np.array(search.structure.leads).T
    largest[:search.count] = LARGEST_ERROR * np.concatenate([
        np.sqrt(np.abs(M[i, i] * M[j, j])) for M in (cup.stiffness, cup.damping)])
    for name, places in search.places.items():
        largest[places] = KINDS[name].known
    return np.asarray(largest / search.units)
