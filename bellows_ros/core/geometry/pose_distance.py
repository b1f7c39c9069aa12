"""
The distance between two poses, in units of a tolerance.

Shift and rotation are each divided by their own tolerance; the distance is the larger ratio. A
distance above 1 is out of tolerance.
"""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry
import numpy as np
from numpy.typing import ArrayLike


@entry
def pose_distance(difference: tuple[float, float], tolerance: tuple[float, float]) -> float:
    """Return the distance, at least 0, of a difference (m, rad) by a tolerance (m, rad)."""
    return max(difference[0] / tolerance[0], difference[1] / tolerance[1])


def pose_distances(differences: Array, tolerance: ArrayLike) -> Array:
    """
    Return the distances (N,) of many differences; see `pose_distance`.

    Parameters
    ----------
    differences : ndarray (2, N, 3)
        Shifts (m) and rotation vectors (rad).
    tolerance : array_like (2, N) or (2, 1)
        m and rad, above 0.

    """
    return np.asarray((np.linalg.norm(differences, axis=2) / tolerance).max(axis=0))
