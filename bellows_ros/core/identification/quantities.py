"""
Given quantities that may be estimated jointly with K and P: their effect on model and poses.

Each given quantity is a measurement with a standard deviation.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
import tomllib
from types import MappingProxyType
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import pseudo_inertia
from bellows_ros.core.model.cup_package import gravity_vector, Package, varied
from bellows_ros.core.model.structure import INERTIA_STD
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.parameters.conversion import package_of, stated_std
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, Trajectory
import numpy as np


class Kind(NamedTuple):
    """A kind of quantity that may be estimated jointly with K and P, see `quantities.toml`."""

    unit: float
    size: int
    max_std: float
    prior_std: float
    each: bool = False


KINDS: Mapping[str, Kind] = {
    name: Kind(**numbers) for name, numbers in tomllib.loads(
        Path(__file__).with_name('quantities.toml').read_text()).items()}
"""Kinds by their names in fit.free."""

COLUMNS: Mapping[str, slice] = {
    'length': jac.BY_LENGTH, 'length_drift': jac.BY_LENGTH, 'com': jac.BY_COM,
    'relaxation': slice(-2, None), 'slip': slice(jac.BY_COM.start, jac.BY_COM.start + 2)}
"""Columns of the quantities among `jacobians.PARAMETER_COLUMNS`."""

STRETCH_UNITS = np.array([1e3, 1.0])
"""Units of the two coefficients of stretch in a search, N/m^2 and N."""


Free = Mapping[str, Array]
"""Values by name, for one recording."""

NOTHING: Free = MappingProxyType({})

CLOCK_RATE_STD = 5e-5
"""Standard deviation of the relative rate of two quartz clocks."""

MIN_STD = 1e-9
"""Smallest standard deviation, SI units."""

PACKAGE_STD: Mapping[str, float] = {'mass': 0.01, 'inertia': INERTIA_STD, 'com': 2e-3}
"""Standard deviations of a package's quantities by default: relative for mass and inertia, m."""


def weak_prior(names: Iterable[str]) -> dict[str, Array]:
    """Return the standard deviations of weak priors on quantities, by name."""
    return {name: np.full(KINDS[name].size, KINDS[name].prior_std) for name in names}


def payload_of(payload: Package, free: Free) -> Package:
    """Return the package with the values of free quantities."""
    changes = {name: free[name] for name in ('com', 'mass', 'inertia') if name in free}
    return varied(payload, **changes) if changes else payload


def poses_of(
    package: Trajectory, free: Free, moves: Array, middle: Array | None = None
) -> Trajectory:
    """
    Return the poses of B, and twists if any, for given free quantities.

    Moves (3,) is 1 for the components of the com that shift B, else 0. The world rotates about a
    middle, see `middle_of`; by default of the poses.
    """
    if 'com' in free:
        package = of_fixed_frame(package, np.zeros(3), moves * free['com'])
    if 'scale' in free:
        package = replace(package, position=(1.0 + free['scale']) * package.position)
    if 'package_world' in free:
        middle = middle_of(package) if middle is None else middle
        R = lie.exp_so3(free['package_world'][3:])
        package = replace(
            package, position=middle[:3] + free['package_world'][:3] + lie.apply(
                R, package.position - middle[:3]), rotation=R @ package.rotation)
    if 'package_marker' in free:
        shift, rotation = np.split(free['package_marker'], 2)
        package = of_fixed_frame(package, rotation, shift)
    return package


def of_fixed_frame(body: Trajectory, rotation: Array, shift: Array) -> Trajectory:
    """Return the motion of a frame fixed in a body, rotated (rad) and shifted (m) there."""
    return at_tip(body, lie.transform(lie.exp_so3(rotation), shift))


def middle_of(package: Trajectory) -> Array:
    """Return the mean (3,) of the valid positions (m), and their first stamp (s)."""
    used = package.select(package.valid)
    return np.append(used.position.mean(axis=0), used.stamps_ns[0] / NS_PER_S)


def carried(package: Trajectory, tool: Trajectory) -> Trajectory:
    """
    Return the package as if fixed to the tool's smooth path.

    Noisy positions in the derivative by their scale would bias the scale towards zero.
    """
    nearest = np.minimum(np.searchsorted(tool.stamps_ns, package.stamps_ns), len(tool) - 1)
    position, R = tool.position[nearest], tool.rotation[nearest]
    offset = lie.apply(np.swapaxes(R, 1, 2), package.position - position).mean(axis=0)
    return replace(package, position=position + R @ offset, rotation=R)


def gravity_of(gravity: Array | float, free: Free) -> Array:
    """Return the vector (3,) of gravity in a tilted world."""
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
        return np.asarray(parameters[:, jac.BY_GRAVITY] @ (after - before) / 2e-4)
    if name in COLUMNS:
        return parameters[:, COLUMNS[name]]
    if name == 'stretch':
        return np.asarray(parameters[:, jac.BY_STRETCH] * STRETCH_UNITS)
    if name == 'mass':
        return np.asarray(payload.mass * parameters[:, jac.BY_MASS])
    if name == 'inertia':
        rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
        stretch = pseudo_inertia.by_moments(payload.inertia)
        by_log = payload.inertia[rows, columns][:, None] * (stretch[rows] + stretch[columns])
        by_log[:3] = np.diag(np.diag(payload.inertia))
        return np.asarray(parameters[:, jac.BY_INERTIA] @ by_log)
    return np.zeros((count, KINDS[name].size))


def pose_changes(name: str, package: Trajectory, moves: Array, middle: Array) -> Array:
    """
    Return the derivatives of poses (M, 6, count) by a quantity, in body axes.

    Derivatives by offset and rate of the clocks are in units of the twist.
    """
    change = np.zeros((len(package), 6, KINDS[name].size))
    if name == 'com':
        change[:, :3] = np.diag(moves)
    elif name == 'time_offset':
        change -= 1.0
    elif name == 'clock_rate':
        change -= (package.stamps_ns / NS_PER_S - middle[3])[:, None, None]
    elif name == 'scale':  # of smooth poses, see `carried`
        change[:, :3, 0] = lie.apply(np.swapaxes(package.rotation, 1, 2), package.position)
    elif name == 'package_marker':
        change += np.eye(6)
    elif name == 'package_world':
        inverse = np.swapaxes(package.rotation, 1, 2)
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ lie.hat(package.position - middle[:3])
    return change


def given_std(values: Values) -> dict[str, Array]:
    """Return the standard deviations of given quantities, by names of `KINDS`, SI units."""
    marker = np.repeat(values.recording.marker_std, 3)
    stds = {'length': np.array([values.cup.length_std]), 'package_marker': marker,
            'time_offset': np.array([values.recording.clock_std]),
            'clock_rate': np.array([CLOCK_RATE_STD if values.recording.clock_std else 0.0]),
            'exposure': np.array([0.2**0.5])}  # RMS square of exposures from 0 to 1 period
    if values.recording.package_world:
        stds['package_world'] = marker
    if all(name in values for name in PACKAGE_PARAMETERS):
        payload = package_of(values)
        for name, size in (('mass', np.array([payload.mass])), ('com', np.ones(3)),
                           ('inertia', np.diag(payload.inertia))):
            stds[name] = stated_std(
                values, f'package.{name}_std', PACKAGE_STD[name] * size) / size
    return {name: np.maximum(std, MIN_STD) for name, std in stds.items() if np.any(std)}


def stated(given: Free) -> list[str]:
    """Return the names of given quantities whose uncertainty the user stated."""
    return [name for name, std in given.items()
            if name in PACKAGE_STD and np.any(std != PACKAGE_STD[name])]


def as_found(recording: Recording, found: Free, number: int) -> Recording:
    """
    Return a recording with the estimates of a fit for package, marker, world and clock.

    Parameters
    ----------
    recording : Recording
        Recording with the given quantities.
    found : mapping
        See `Fit.nuisances`.
    number : int
        Index of the recording in the fit.

    """
    if not found:
        return recording
    free = {name: rows[number % len(rows)] for name, rows in found.items()}
    moves, tracked = np.array(recording.settings.moves_with_com, float), recording.tracked_package
    middle = middle_of(tracked)
    offset, rate = (float(free.get(name, (0.0,))[0]) for name in ('time_offset', 'clock_rate'))
    delays = offset * NS_PER_S + rate * (tracked.stamps_ns - middle[3] * NS_PER_S)

    def moved(poses: Trajectory) -> Trajectory:
        return poses_of(poses, free, moves, middle)

    of_tool, of_package = recording.filters
    payload = payload_of(recording.payload, free)
    return replace(
        recording, settings=replace(recording.settings, payload=payload),
        filters=(of_tool, replace(of_package, poses=moved(of_package.poses))),
        tracked_package=replace(moved(tracked), stamps_ns=tracked.stamps_ns
                                + np.rint(delays).astype(np.int64)))
