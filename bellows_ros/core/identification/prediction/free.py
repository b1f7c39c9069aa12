"""
Numbers that were given, found together with K and P: how they enter the equations of motion.

Poses that move with such a number act on the equations as noise of the poses would, and what it
changes in the model is a column of `parameter_jacobian`.
"""

from collections.abc import Mapping
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.jacobians import COM, INERTIA, LENGTH, MASS
from bellows_ros.core.lie import apply, exp_so3, hat
from bellows_ros.core.model import Package
from bellows_ros.core.trajectory import Trajectory
import numpy as np


class Kind(NamedTuple):
    """
    One kind of number.

    Parameters
    ----------
    unit : float
        Size in which it is searched for: s, m, or a logarithm.
    size : int
        How many there are.
    known : float
        With a larger standard error it is not identifiable.
    each : bool
        Whether each recording has its own.

    """

    unit: float
    size: int
    known: float
    each: bool = False


KINDS: Mapping[str, Kind] = {
    'time_offset': Kind(1e-3, 1, 3e-4, True),
    'com': Kind(1e-3, 3, 3e-3),
    'length': Kind(1e-3, 1, 1e-3),
    'inertia': Kind(1e-2, 3, 0.1),
    'mass': Kind(1e-2, 1, 0.1),
    'package_world': Kind(1e-3, 6, 5e-3, True),
}
"""
By their names in fit.free.

By how much the tool's stamps are behind the package's, s; the centre of mass beside the given one
in axes of the lip, m; the length beside the given one, m; logarithms of the factors of the moments
of inertia and of the mass; and shift and turn of the package's world about the middle of the
package's way, m and rad.
"""

Free = Mapping[str, Array]
"""Values by name, of one recording."""


def payload_of(held: Package, free: Free) -> Package:
    """Return the package with the free numbers in it."""
    if not free.keys() & {'com', 'mass', 'inertia'}:
        return held
    root = np.exp(0.5 * free.get('inertia', np.zeros(3)))
    there = object.__new__(Package)  # a little beyond what a body can have, on the way
    for name, value in (
        ('mass', held.mass * float(np.exp(free.get('mass', np.zeros(1))[0]))),
        ('inertia', held.inertia * np.outer(root, root)),
        ('com', held.com + free.get('com', np.zeros(3))),
    ):
        object.__setattr__(there, name, value)
    return there


def poses_of(package: Trajectory, free: Free, moves: Array) -> Trajectory:
    """
    Return the poses of B that follow from those with the given numbers.

    Moves (3,) is 1 for the components of the centre of mass that B moves with, else 0.
    """
    position, R = package.position, package.rotation
    if 'com' in free:
        position = position + apply(R, moves * free['com'])
    if 'package_world' in free:
        way, turn = np.split(free['package_world'], 2)
        middle = _middle(package)
        position = middle + way + apply(exp_so3(turn), position - middle)
        R = exp_so3(turn) @ R
    return Trajectory(package.stamps_ns, position, R)


def _middle(package: Trajectory) -> Array:
    """Return the mean position (3,)."""
    return np.asarray(package.position.mean(axis=0))


def model_columns(name: str, payload: Package, parameters: Array) -> Array:
    """Return derivatives (..., count) by a number that is of the model, of those by parameters."""
    if name == 'length':
        return parameters[..., LENGTH]
    if name == 'com':
        return parameters[..., COM]
    if name == 'mass':
        return np.asarray(payload.mass * parameters[..., MASS])
    if name == 'inertia':
        rows, columns = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
        sizes = payload.inertia[rows, columns]
        by_log = 0.5 * sizes[:, None] * (np.eye(3)[list(rows)] + np.eye(3)[list(columns)])
        return np.asarray(parameters[..., INERTIA] @ by_log)
    return np.zeros((*parameters.shape[:-1], KINDS[name].size))


def pose_changes(name: str, package: Trajectory, moves: Array) -> Array | None:
    """Return how the poses (M, 6, count) move in their own axes, None where they do not."""
    if name == 'com' and moves.any():
        change = np.zeros((6, 3))
        change[:3] = np.diag(moves)
        return np.broadcast_to(change, (len(package), 6, 3))
    if name == 'package_world':
        inverse = np.swapaxes(package.rotation, 1, 2)
        change = np.zeros((len(package), 6, 6))
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ hat(package.position - _middle(package))
        return change
    return None
