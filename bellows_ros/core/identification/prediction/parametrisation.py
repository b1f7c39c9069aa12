"""Free numbers of K and P: definite by construction to search among, linear to judge by."""

from dataclasses import dataclass
from typing import Protocol

from bellows_ros.core.identification.structure import Structure
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_FACTOR = 1e-3
"""Eigenvalues of a start below this part of the largest, in scaled units, are lifted to it."""


class Chart(Protocol):
    """What turns free numbers into K and P."""

    @property
    def size(self) -> int:
        """Number of free numbers, of K and P together."""

    def matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P (6, 6) of the free numbers (size,)."""


@dataclass(frozen=True, eq=False)
class Neighbourhood:
    """
    K and P near given ones, linear in the parameters of a structure.

    Parameters
    ----------
    structure : Structure
        Which entries are free.
    origin, scale : ndarray (size,)
        The given parameters, and what one unit of a free number is.

    """

    structure: Structure
    origin: Array
    scale: Array

    @property
    def size(self) -> int:
        """Number of free numbers, of K and P together."""
        return 2 * self.structure.size

    def matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P (6, 6) of the free numbers (size,)."""
        return self.structure.matrices(self.origin + self.scale * theta)


@dataclass(frozen=True, eq=False)
class Parametrisation:
    """
    A chart of the matrices of a structure near a start.

    A diagonal entry is scale * exp(theta). A full matrix is D C C^T D with D the root of the
    scale and C lower triangular, the logarithms of its diagonal among theta.

    Parameters
    ----------
    structure : Structure
        Which entries are free.
    stiffness_scale, damping_scale : ndarray (6,)
        Typical diagonals, so that all numbers are near one.

    """

    structure: Structure
    stiffness_scale: Array
    damping_scale: Array

    @property
    def size(self) -> int:
        """Number of free numbers, of K and P together."""
        return 2 * self.structure.size

    def matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P (6, 6) of the free numbers (size,)."""
        half = self.structure.size
        return (
            self._matrix(theta[:half], self.stiffness_scale),
            self._matrix(theta[half:], self.damping_scale),
        )

    def numbers(self, stiffness: Array, damping: Array) -> Array:
        """Return the free numbers of K and P; what is not definite is lifted to nearly so."""
        return np.concatenate(
            [
                self._numbers(stiffness, self.stiffness_scale),
                self._numbers(damping, self.damping_scale),
            ]
        )

    def near(self, theta: Array) -> Neighbourhood:
        """Return the linear neighbourhood of the free numbers, in units of the scales."""
        units = [
            [np.sqrt(scale[i] * scale[j]) for ((i, j), *_) in self.structure.entries]
            for scale in (self.stiffness_scale, self.damping_scale)
        ]
        origin = self.structure.parameters(*self.matrices(theta))
        return Neighbourhood(self.structure, origin, np.concatenate(units))

    def _matrix(self, theta: Array, scale: Array) -> Array:
        if self.structure.name != 'full':
            free = np.exp(theta)
            diagonal = np.tensordot(free, np.array(self.structure.basis), axes=1)
            return np.asarray(diagonal * scale)
        C = np.zeros((6, 6))
        C[np.tril_indices(6)] = theta
        C[np.diag_indices(6)] = np.exp(np.diag(C))
        root = np.sqrt(scale)
        return np.asarray(root[:, None] * (C @ C.T) * root)

    def _numbers(self, matrix: Array, scale: Array) -> Array:
        root = np.sqrt(scale)
        scaled = matrix / np.outer(root, root)
        if self.structure.name != 'full':
            means = [np.mean([scaled[i] for i in entries]) for entries in self.structure.entries]
            return np.log(np.maximum(means, SMALLEST_FACTOR))
        values, vectors = np.linalg.eigh(scaled)
        lifted = np.maximum(values, SMALLEST_FACTOR * max(values[-1], SMALLEST_FACTOR))
        C = np.linalg.cholesky((vectors * lifted) @ vectors.T)
        C[np.diag_indices(6)] = np.log(np.diag(C))
        return np.asarray(C[np.tril_indices(6)])


def semidefinite(matrix: Array) -> Array:
    """Return the nearest symmetric matrix without negative eigenvalues, in units of its scale."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    unit = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(matrix / unit)
    if values[0] >= 0.0:
        return matrix
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * unit)
