"""
The distance between two poses, in units of a tolerance.

Positions and rotations share no unit. Each is divided by its own tolerance, and the larger ratio
is the distance, so that an error of any axis counts alike. A distance above 1 is out of tolerance.
"""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
import numpy as np
from numpy.typing import ArrayLike


@kernel
def pose_distance(difference: tuple[float, float], tolerance: tuple[float, float]) -> float:
    """Return the distance of a difference (m, rad), at least 0, by a tolerance (m, rad)."""
    return max(difference[0] / tolerance[0], difference[1] / tolerance[1])


def pose_distances(differences: Array, tolerance: ArrayLike) -> Array:
    """
    Return the distances (N,) of many differences, as `pose_distance` does.

    Parameters
    ----------
    differences : ndarray (2, N, 3)
        Shifts (m) and rotation vectors (rad).
    tolerance : array_like (2, N) or (2, 1)
        m and rad, above 0.

    """
    return np.asarray((np.linalg.norm(differences, axis=2) / tolerance).max(axis=0))
