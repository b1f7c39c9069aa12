"""The weight of wrenches: their mean and covariance, in a form in which parts can be added."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

from bellows_ros.core.arrays import Array
from bellows_ros.core.structure import Structure
import numpy as np

LEVER = 0.01
"""Moments are taken to be at least forces at such a lever, m, where they are compared."""

NO_WRENCH, FLOOR = 1e-10, 1e-8
"""Variances of a wrench (parts of their mean) that are none, and what is then added."""


@dataclass(frozen=True, eq=False)
class Moments:
    """
    First and second moments of six-vectors, such as wrenches (N and N m).

    Parameters
    ----------
    count : int
        How many.
    mean : ndarray (6,)
        In their units.
    scatter : ndarray (6, 6)
        Sum of the products of the deviations from the mean.

    """

    count: int
    mean: Array
    scatter: Array

    @classmethod
    def of(cls, vectors: Array) -> 'Moments':
        """Return the moments of six-vectors (N, 6)."""
        if not len(vectors):
            return cls(0, np.zeros(6), np.zeros((6, 6)))
        mean = np.mean(vectors, axis=0)
        deviation = vectors - mean
        return cls(len(vectors), mean, deviation.T @ deviation)

    def joined(self, other: 'Moments') -> 'Moments':
        """Return the moments of both together; what cancels are deviations, not raw squares."""
        count = self.count + other.count
        if not count:
            return self
        apart = other.mean - self.mean
        return Moments(
            count,
            self.mean + apart * (other.count / count),
            self.scatter + other.scatter
            + np.outer(apart, apart) * (self.count * other.count / count),
        )

    @property
    def std(self) -> Array:
        """Standard deviations (6,), nan of none."""
        return np.sqrt(np.diag(self.scatter) / (self.count or np.nan))

    def covariance(self, structure: Structure) -> Array:
        """Return Q (6, 6) of wrenches in the form that a structure gives it (4.69, 4.80)."""
        return structure.covariance(self.count, self.mean, self.scatter)


def joined(parts: Iterable[Moments]) -> Moments:
    """Return the moments of all parts together."""
    return reduce(Moments.joined, parts, Moments.of(np.empty((0, 6))))


def regular(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches that has a root where none act in some direction."""
    force, moment = (float(np.mean(np.diag(covariance)[part]))
                     for part in (slice(0, 3), slice(3, 6)))
    scale = np.repeat([max(force, moment), max(moment, LEVER**2 * force)], 3)
    if not scale[0] > 0.0:
        return np.eye(6)
    unit = np.sqrt(np.outer(scale, scale))
    if np.linalg.eigvalsh(covariance / unit)[0] > NO_WRENCH:
        return covariance
    return np.asarray(covariance + FLOOR * np.diag(scale))


def whitening_of(covariance: Array) -> Array:
    """Return the root of the weight W that makes a covariance (6, 6) the identity."""
    whitening: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return whitening
