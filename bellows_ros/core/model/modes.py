"""Natural frequencies and damping ratios of a package on its cup."""

from typing import NamedTuple

from bellows_ros.core.geometry.lie import adjoint, transform
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import linearise, static_equilibrium
from bellows_ros.core.model.kernels import ORIGIN
import numpy as np
from scipy.linalg import block_diag

DIRECTIONS = ('lateral', 'lateral', 'axial', 'bending', 'bending', 'torsion')
"""Names of the directions of the six axes."""


class Mode(NamedTuple):
    """
    A mode of small motions about static equilibrium.

    Parameters
    ----------
    direction : str
        Direction with most of the elastic energy.
    frequency : float
        Natural frequency, Hz.
    damping : float
        Damping ratio.

    """

    direction: str
    frequency: float
    damping: float


def modes(cup: Cup, package: Package, gravity: float) -> list[Mode]:
    """
    Return the six modes about static equilibrium under an upright tool at rest, lowest first.

    The damping ratio is phi^T C phi / (2 omega) with mode shapes phi of unit modal mass. This
    ratio is exact for proportional damping, and of first order otherwise. The direction is
    determined at the middle of the cup, the place of its spring (3.13).

    Parameters
    ----------
    cup : Cup
        Stiffness, damping and length.
    package : Package
        The load.
    gravity : float
        m/s^2, along -z of the world.

    Raises
    ------
    BellowsError
        If the cup cannot hold the package.

    """
    model = model_tuple(cup, package, gravity)
    jacobian = linearise(model, ORIGIN, static_equilibrium(model, ORIGIN))
    mass = block_diag(package.mass * np.eye(3), package.inertia)
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    stiffness = -inverse @ (mass @ jacobian.body_pose) @ inverse.T  # eigh reads its lower half
    damping = -inverse @ (mass @ jacobian.body_twist) @ inverse.T
    middle_body = adjoint(transform(np.eye(3), package.com - [0.0, 0.0, 0.5 * cup.length]))
    found = []
    for shape in np.linalg.eigh(stiffness)[1].T:
        omega = float(np.sqrt(max(shape @ stiffness @ shape, 0.0)))
        ratio = float(shape @ damping @ shape) / (2.0 * omega) if omega else float('inf')
        middle = middle_body @ (inverse.T @ shape)
        energy = dict.fromkeys(DIRECTIONS, 0.0)
        for direction, part in zip(DIRECTIONS, middle * (cup.stiffness @ middle), strict=True):
            energy[direction] += abs(part)
        found.append(Mode(max(energy, key=energy.__getitem__), omega / (2.0 * np.pi), ratio))
    return found
