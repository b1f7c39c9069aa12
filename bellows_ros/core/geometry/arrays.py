"""Type aliases for arrays in signatures."""

from typing import Any

from bellows_ros.errors import BellowsError, shown
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers in SI units; the docstring gives shape and frame."""

Mask = NDArray[np.bool_]
"""Selection of samples."""

Places = NDArray[np.intp]
"""Indices."""

Stamps = NDArray[np.int64]
"""Times, ns."""


def real_numbers(values: Any, what: str) -> Array:
    """
    Return a new array of real numbers.

    Raises
    ------
    BellowsError
        If values are no numbers, complex, masked, or too large for a float.

    """
    try:
        if np.ma.is_masked(values) or np.iscomplexobj(values):
            raise TypeError('masked or complex numbers')
        return np.array(values, dtype=np.float64, order='C')
    except (TypeError, ValueError, OverflowError):
        raise BellowsError(f'The {what} must be real numbers, got {shown(values)}.') from None
