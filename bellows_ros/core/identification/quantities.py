"""Quantities that were given and may be free beside K and P: what they do to model and poses."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import gravity_vector, Package, varied
from bellows_ros.core.model.jacobians import COM, GRAVITY, INERTIA, LENGTH, MASS, WRENCH
from bellows_ros.core.model.structure import UPPER
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np


class Kind(NamedTuple):
    """
    A kind of quantity that may be estimated together with K and P.

    Parameters
    ----------
    unit : float
        Size in which it is searched for: s, m, or a logarithm.
    size : int
        How many there are.
    max_std : float
        With a larger standard error it is not identifiable.
    each : bool
        Whether each recording has another value.
    prior_std : float
        Standard deviation of a weak prior.

    """

    unit: float
    size: int
    max_std: float
    each: bool = False
    prior_std: float = np.inf


KINDS: Mapping[str, Kind] = {
    'time_offset': Kind(1e-3, 1, 3e-3, True, 0.1),
    'com': Kind(1e-3, 3, 3e-3, False, 0.05),
    'length': Kind(1e-3, 1, 1e-3, False, 0.02),
    'inertia': Kind(1e-2, 3, 0.1, False, 0.7),
    'mass': Kind(1e-2, 1, 0.1, False, 0.7),
    'gravity': Kind(1e-3, 2, 5e-3, False, 0.3),
    'package_world': Kind(1e-3, 6, 5e-3, True, 0.2),
    'package_marker': Kind(1e-3, 6, 5e-3, True, 0.1),
    'tool_marker': Kind(1.0, 6, 5e-3, True, 0.1),
    'world_drift': Kind(1e-5, 6, 1e-4, True, 1e-3),
    'relaxation': Kind(1e-2, 2, 0.1, False, 1.0),
    'drift': Kind(1e-2, 6, 0.1, False, 1.0),
    'cubic': Kind(1e-2, 6, 0.1, False, 1.0),
    'couplings': Kind(1e-2, 15, 0.1, False, 1.0),
    'friction': Kind(1e-2, 6, 0.1, False, 1.0),
    'slip': Kind(1e-3, 2, 3e-3, True, 0.05),
}
"""
By their names in fit.free.

By how much the tool's stamps are behind the package's, s; the centre of mass beside the given one
in axes of the lip, m; the length beside the given one, m; logarithms of the factors of the moments
of inertia and of the mass; by what angle the world is turned about x and y, so that gravity is
turned back, rad; shift and turn of the package's world about the middle of the package's way, of B
in its own axes against the measured pose, and of E likewise, m and rad; by how much that world
moves and turns per second, m/s and rad/s; the strengths of relaxation beside those of the start;
parts by which the diagonal of K changes from beginning to end, and up to displacements of the size
`LARGE_DISPLACEMENT`; couplings of directions in the roots of their stiffnesses; friction in the
largest forces; and by how much x and y of the centre of mass change at some moment as the package
slips on the lip, m.
"""

OF_CUP = ('drift', 'cubic', 'couplings', 'friction')
"""Deviations of the cup itself."""

CHANGING = (*OF_CUP, 'slip')
"""What changes within a recording. The model has none; the effect is added to first order."""

LARGE_DISPLACEMENT = np.repeat([5e-3, 0.1], 3)
"""m, rad."""

DIAGONAL, COUPLINGS = (
    np.flatnonzero(is_one).tolist() for is_one in (UPPER[0] == UPPER[1], UPPER[0] != UPPER[1]))
"""Places of the two in the upper triangle of a matrix (6, 6), row by row."""

COLUMNS: Mapping[str, slice | list[int]] = {
    'length': LENGTH, 'com': COM, 'relaxation': slice(-2, None),
    'slip': slice(COM.start, COM.start + 2), 'drift': DIAGONAL, 'cubic': DIAGONAL,
    'couplings': COUPLINGS, 'friction': WRENCH}
"""Derivatives of the model by quantities, among `jacobians.PARAMETERS`."""


Free = Mapping[str, Array]
"""Values by name, for one recording."""


def weak_prior(names: Iterable[str]) -> dict[str, Array]:
    """Return the standard deviations of weak priors on quantities, by name."""
    return {name: np.full(KINDS[name].size, KINDS[name].prior_std) for name in names}


def payload_of(payload: Package, free: Free) -> Package:
    """Return the package with the free quantities in it."""
    changes = {name: free[name] for name in ('com', 'mass', 'inertia') if name in free}
    return varied(payload, **changes) if changes else payload


def poses_of(
    package: Trajectory, free: Free, moves: Array, middle: Array | None = None
) -> Trajectory:
    """
    Return the poses of B, and its twists if there are any, for given free quantities.

    Moves (3,) is 1 for the components of the centre of mass that B moves with, else 0. The world
    turns about a middle, see `middle_of`, that of the poses where none is given.
    """
    if 'com' in free:
        package = of_fixed_frame(package, np.zeros(3), moves * free['com'])
    for name in free.keys() & {'package_world', 'world_drift'}:
        middle = middle_of(package) if middle is None else middle
        time = _since(package, middle) if name == 'world_drift' else np.ones((len(package), 1))
        R = lie.exp_so3(time * free[name][3:])
        package = replace(
            package, position=middle[:3] + time * free[name][:3] + lie.apply(
                R, package.position - middle[:3]), rotation=R @ package.rotation)
    if 'package_marker' in free:
        shift, turn = np.split(free['package_marker'], 2)
        package = of_fixed_frame(package, turn, shift)
    return package


def of_fixed_frame(body: Trajectory, turn: Array, shift: Array) -> Trajectory:
    """Return the motion of a frame that is fixed in a body, turned (rad) and moved (m) there."""
    R = lie.exp_so3(turn)
    X = lie.adjoint(lie.inverse_transform(lie.transform(R, shift)))
    return replace(
        body, position=body.position + lie.apply(body.rotation, shift), rotation=body.rotation @ R,
        twist=None if body.twist is None else lie.apply(X, body.twist),
        acceleration=None if body.acceleration is None else lie.apply(X, body.acceleration))


def middle_of(package: Trajectory) -> Array:
    """Return the mean (3,) of the positions in use (m), and their first stamp (s)."""
    used = package.select(package.valid)
    return np.append(used.position.mean(axis=0), used.stamps_ns[0] / NS_PER_S)


def _since(package: Trajectory, middle: Array) -> Array:
    """Return times (N, 1) since the first stamp of `middle_of`, s."""
    return np.asarray(package.stamps_ns / NS_PER_S - middle[3])[:, None]


def gravity_of(gravity: Array | float, free: Free) -> Array:
    """Return the vector (3,) of gravity in a world that is not level."""
    return np.asarray(lie.exp_so3(-np.append(free.get('gravity', (0.0, 0.0)), 0.0))
                      @ gravity_vector(gravity))


def model_columns(
    name: str, payload: Package, gravity: Array | float, free: Free, count: int
) -> Array:
    """Return derivatives (count, size) of the model's parameters by a free quantity."""
    parameters = np.eye(count)
    if name == 'gravity':
        after, before = (np.transpose([
            gravity_of(gravity, {name: free[name] + step}) for step in size * np.eye(2)])
            for size in (1e-4, -1e-4))
        return np.asarray(parameters[:, GRAVITY] @ (after - before) / 2e-4)
    if name in COLUMNS:
        return parameters[:, COLUMNS[name]]
    if name == 'mass':
        return np.asarray(payload.mass * parameters[:, MASS])
    if name == 'inertia':
        rows, columns = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
        sizes = payload.inertia[rows, columns]
        by_log = 0.5 * sizes[:, None] * (np.eye(3)[list(rows)] + np.eye(3)[list(columns)])
        return np.asarray(parameters[:, INERTIA] @ by_log)
    return np.zeros((count, KINDS[name].size))


def pose_changes(
    name: str, package: Trajectory, moves: Array, middle: Array | None = None
) -> Array:
    """
    Return the derivatives of poses (M, 6, count) by a quantity, in body axes.

    By the offset of the clocks in units of the twist.
    """
    change = np.zeros((len(package), 6, KINDS[name].size))
    if name == 'com':
        change[:, :3] = np.diag(moves)
    elif name == 'time_offset':
        change -= 1.0
    elif name == 'package_marker':
        change += np.eye(6)
    elif name in ('package_world', 'world_drift'):
        middle = middle_of(package) if middle is None else middle
        inverse = np.swapaxes(package.rotation, 1, 2)
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ lie.hat(package.position - middle[:3])
        if name == 'world_drift':
            change *= _since(package, middle)[..., None]
    return change
