"""Mean and covariance of six-vectors, in a form in which parts can be added."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

from bellows_ros.core.identification.structure import Structure
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
        )  # fmt: skip

    @property
    def std(self) -> Array:
        """Standard deviations (6,), nan of none."""
        return np.sqrt(np.diag(self.scatter) / (self.count or np.nan))

    def covariance(self, structure: Structure) -> Array:
        """
        Return Q (6, 6) of wrenches: full (4.69), or pooled variances otherwise (4.80).

        Both lateral forces share a variance, and both lateral moments, when the structure ties
        them.
        """
        if structure.name == 'full':
            return self.scatter / (self.count - 1)
        if structure.name == 'diagonal':
            return np.diag(np.diag(self.scatter)) / (self.count - 1)
        pools = [self._variance(axes) for axes in ((0, 1), (2,), (3, 4), (5,))]
        return np.diag(np.array(pools)[[0, 0, 1, 2, 2, 3]])

    def _variance(self, axes: tuple[int, ...]) -> float:
        """Return the variance of all numbers of some axes about their common mean."""
        index = list(axes)
        means, about_own = self.mean[index], np.diag(self.scatter)[index]
        about_common = about_own + self.count * (means - np.mean(means)) ** 2
        return float(np.sum(about_common)) / (len(index) * self.count - 1)


def joined(parts: Iterable[Moments]) -> Moments:
    """Return the moments of all parts together."""
    return reduce(Moments.joined, parts, Moments.of(np.empty((0, 6))))
