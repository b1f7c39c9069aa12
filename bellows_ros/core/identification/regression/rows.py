"""The whitened equations of a fit as rows."""

from collections.abc import Iterable, Iterator

from bellows_ros.core.identification.regression.least_squares import equations, Samples
from bellows_ros.core.identification.structure import Structure
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rows_of(
    recordings: Iterable[Samples], cup_length: float, structure: Structure, whitening: Array
) -> Iterator[Array]:
    """Yield the whitened rows [A b] (6 N, p + 1) of the valid samples, block by block (4.66)."""
    for recording in recordings:
        for block in recording.blocks():
            L, c, _ = equations(block, cup_length, structure)
            rows = np.dstack([whitening @ L, c @ whitening.T])
            yield rows.reshape(-1, rows.shape[2])
