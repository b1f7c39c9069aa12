"""Structures of K and P: which entries are free, and which are tied by symmetry."""

from dataclasses import dataclass
from functools import cached_property

from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
"""Names of the six directions: translations, then rotations."""


@dataclass(frozen=True)
class Structure:
    """
    A linear family of symmetric 6x6 matrices, the same for K and for P.

    Parameters
    ----------
    name : str
        'axisymmetric', 'diagonal' or 'full'.
    entries : tuple of tuples of (row, column)
        For every free parameter the entries of the upper triangle that it sets.

    """

    name: str
    entries: tuple[tuple[tuple[int, int], ...], ...]

    @property
    def size(self) -> int:
        """Number of free parameters of one matrix."""
        return len(self.entries)

    @cached_property
    def basis(self) -> list[Array]:
        """The symmetric unit matrices (6, 6) of the parameters."""
        matrices = []
        for entries in self.entries:
            unit = np.zeros((6, 6))
            for row, column in entries:
                unit[row, column] = unit[column, row] = 1.0
            matrices.append(unit)
        return matrices

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the parameters, 'K x', 'K rx', 'K x-rz', ..., then those of P."""
        names = []
        for entries in self.entries:
            row, column = entries[0]
            names.append(AXES[row] if row == column else f'{AXES[row]}-{AXES[column]}')
        return tuple(f'{matrix} {name}' for matrix in 'KP' for name in names)

    def matrices(self, x: Array) -> tuple[Array, Array]:
        """Return K and P (6, 6) of the parameters x (2 n,)."""
        basis = np.array(self.basis)
        return (
            np.tensordot(x[: self.size], basis, axes=1),
            np.tensordot(x[self.size:], basis, axes=1),
        )

    def spread(self, errors: Array) -> tuple[Array, Array]:
        """Return errors (2 n,) of the parameters, which may be infinite, as those of K and P."""
        both = np.zeros((2, 6, 6))
        for number, error in enumerate(errors.tolist()):
            matrix, parameter = divmod(number, self.size)
            for row, column in self.entries[parameter]:
                both[matrix, row, column] = both[matrix, column, row] = error
        return both[0], both[1]

    def parameters(self, stiffness: Array, damping: Array) -> Array:
        """Return the parameters x (2 n,) nearest to K and P: the mean of tied entries."""
        return np.array(
            [
                np.mean([matrix[entry] for entry in entries])
                for matrix in (stiffness, damping)
                for entries in self.entries
            ]
        )


_AXISYMMETRIC = ((((0, 0), (1, 1)), ((2, 2),), ((3, 3), (4, 4)), ((5, 5),)))
_DIAGONAL = tuple(((i, i),) for i in range(6))
_FULL = tuple(((i, j),) for i in range(6) for j in range(i, 6))

STRUCTURES = {
    'axisymmetric': Structure('axisymmetric', _AXISYMMETRIC),
    'diagonal': Structure('diagonal', _DIAGONAL),
    'full': Structure('full', _FULL),
}


def structure_named(name: str) -> Structure:
    """Return the structure of a name, or raise BellowsError listing those there are."""
    if name not in STRUCTURES:
        raise BellowsError(f"fit.structure is '{name}'; expected one of {', '.join(STRUCTURES)}.")
    return STRUCTURES[name]
