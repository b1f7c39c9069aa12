"""Mass and inertia of packages: boxes, cylinders and bodies put together from them (App. A)."""

from __future__ import annotations

from collections.abc import Sequence

from bellows_ros.core.arrays import Array
from bellows_ros.core.lie import adjoint, inverse_transform
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

R_FACTOR_WITHIN = 1e-3
"""How far (relative) the largest principal moment may be above the sum of the other two.

The rounded figures of a thin plate's data sheet may be so.
"""


def box_inertia(mass: float, depth: float, width: float, height: float) -> Array:
    """
    Return the inertia tensor (3, 3) in kg m^2 of a homogeneous box at its centre (A.2).

    Depth lies along x, width along y and height along z, all in m.
    """
    d2, w2, h2 = depth**2, width**2, height**2
    return mass / 12.0 * np.diag([h2 + w2, h2 + d2, d2 + w2])


def cylinder_inertia(mass: float, radius: float, height: float) -> Array:
    """Return the inertia tensor (3, 3) in kg m^2 of a homogeneous upright cylinder (A.4)."""
    lateral = (3.0 * radius**2 + height**2) / 12.0
    return mass * np.diag([lateral, lateral, radius**2 / 2.0])


def generalized_inertia(mass: float, inertia: ArrayLike) -> Array:
    """Return the generalized inertia (6, 6) of a body at its centre of mass (A.1)."""
    M = np.zeros((6, 6))
    M[:3, :3] = mass * np.eye(3)
    M[3:, 3:] = np.asarray(inertia)
    return M


def composite(parts: Sequence[tuple[float, ArrayLike, ArrayLike]]) -> tuple[float, Array, Array]:
    """
    Return mass, centre of mass and inertia of rigidly joined parts (A.3).

    Parameters
    ----------
    parts : sequence of (mass, inertia, T_lip_part)
        Mass in kg, inertia (3, 3) at the part's own centre of mass and in its own axes, and the
        pose (4, 4) of that frame in the lip frame S.

    Returns
    -------
    mass : float
    com : ndarray (3,)
        Centre of mass in S.
    inertia : ndarray (3, 3)
        Inertia at the centre of mass, in S axes.

    """
    if not parts:
        raise BellowsError('A composite package needs at least one part, got none.')
    masses = np.array([mass for mass, _, _ in parts], dtype=float)
    if not np.all(masses > 0.0):
        raise BellowsError(f'Every part of a package needs a mass above 0 kg, got {masses}.')
    poses = [np.asarray(T_lip_part, dtype=float) for _, _, T_lip_part in parts]
    mass = float(masses.sum())
    com = masses @ np.array([T[:3, 3] for T in poses]) / mass
    T_lip_com = np.eye(4)
    T_lip_com[:3, 3] = com
    total = np.zeros((6, 6))
    for (part_mass, inertia, _), T_lip_part in zip(parts, poses, strict=True):
        X = adjoint(inverse_transform(T_lip_part) @ T_lip_com)
        total += X.T @ generalized_inertia(part_mass, inertia) @ X
    return mass, com, total[3:, 3:]


def check_inertia(inertia: Array) -> None:
    """
    Raise BellowsError unless a rigid body can have this inertia tensor (3, 3), kg m^2.

    It must be symmetric and positive definite, and no principal moment above the sum of the
    other two.
    """
    if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
        raise BellowsError(f'The package inertia must be symmetric, got {inertia.tolist()}.')
    moments = np.linalg.eigvalsh(inertia)
    shown = ', '.join(f'{moment:.6g}' for moment in moments)
    if moments[0] <= 0.0:
        raise BellowsError(
            f'No body has this package.inertia: its principal moments are {shown} kg m^2, '
            'all must be above zero. Check the order ixx, iyy, izz, ixy, ixz, iyz and the signs.'
        )
    if moments[2] > (moments[0] + moments[1]) * (1.0 + R_FACTOR_WITHIN):
        raise BellowsError(
            f'No body has this package.inertia: its principal moments are {shown} kg m^2, '
            'but the largest is at most the sum of the other two. '
            'Check units (kg m^2) and the order ixx, iyy, izz, ixy, ixz, iyz.'
        )
