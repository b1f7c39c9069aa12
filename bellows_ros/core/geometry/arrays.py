"""Type aliases for arrays in signatures."""

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
