"""Shapes of cup and package, for animations and pictures in space."""

from bellows_ros.core.geometry.arrays import Array
import numpy as np

RINGS, SIDES = 25, 13  # of the drawn cup; the last point of a ring is its first one again
CONVOLUTIONS = 2.5
RADIUS = 0.020  # m

BOX_EDGES = [[0, 1], [0, 2], [0, 4], [1, 3], [1, 5], [2, 3], [2, 6], [3, 7], [4, 5], [4, 6],
             [5, 7], [6, 7]]
BOX_FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
"""Of the corners of `box_corners`."""


def box_corners(centre: Array, R: Array, size: Array) -> Array:
    """Return the corners (8, 3) of a box in the world, m, counted in binary: x, y, z."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners: Array = centre + (0.5 * signs * size) @ R.T
    return corners


def bellows_rings(top_o: Array, top_R: Array, lip_o: Array, lip_R: Array) -> Array:
    """
    Return the rings of a bellows between two z axes.

    Parameters
    ----------
    top_o, lip_o : array (3,)
        Tool tip E and lip S in the world, m.
    top_R, lip_R : array (3, 3)
        Their orientations.

    Returns
    -------
    array (RINGS, SIDES, 3)
        Points in the world, m.

    """
    s = np.linspace(0.0, 1.0, RINGS)[:, None]
    reach = float(np.linalg.norm(lip_o - top_o))
    rates = -reach * top_R[:, 2], -reach * lip_R[:, 2]
    spine = ((2 * s**3 - 3 * s**2 + 1) * top_o + (s**3 - 2 * s**2 + s) * rates[0]
             + (3 * s**2 - 2 * s**3) * lip_o + (s**3 - s**2) * rates[1])
    radius = RADIUS * (0.75 + 0.2 * np.cos(2.0 * np.pi * CONVOLUTIONS * (s - 1.0)))
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)])
    return np.array([o + r * (circle @ ((1 - t) * top_R + t * lip_R).T)
                     for o, r, t in zip(spine, radius, s, strict=True)])
