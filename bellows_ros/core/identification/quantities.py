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
from bellows_ros.core.model.cup_package import gravity_vector, Package, varied
from bellows_ros.core.model.structure import INERTIA_STD
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.parameters.conversion import package_of, stated_std
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np


class Kind(NamedTuple):
    """
    A kind of quantity that may be estimated jointly with K and P, see `quantities.toml`.

    Parameters
    ----------
    unit : float
        Unit of the search, SI units.
    size : int
        Number of values.
    max_std : float
        Largest standard error of an identifiable quantity.
    prior_std : float
        Standard deviation of a weak prior.
    each : bool
        Whether every recording has values of its own.

    """

    unit: float
    size: int
    max_std: float
    prior_std: float
    each: bool = False


KINDS: Mapping[str, Kind] = {
    name: Kind(**numbers) for name, numbers in tomllib.loads(
        Path(__file__).with_name('quantities.toml').read_text()).items()}
"""Kinds by their names in fit.free."""

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


def gravity_of(gravity: Array | float, free: Free) -> Array:
    """Return the vector (3,) of gravity in a tilted world."""
    return np.asarray(lie.exp_so3(-np.append(free.get('gravity', (0.0, 0.0)), 0.0))
                      @ gravity_vector(gravity))


def given_std(values: Values) -> dict[str, Array]:
    """Return the standard deviations of given quantities, by names of `KINDS`, SI units."""
    marker = np.repeat(values.recording.marker_std, 3)
    stds = {'length': np.array([values.cup.length_std]), 'package_marker': marker,
            'time_offset': np.array([values.recording.clock_std]),
            'clock_rate': np.array([CLOCK_RATE_STD if values.recording.clock_std else 0.0]),
            'exposure': _exposure_std(values)}
    if values.recording.package_world:
        stds['package_world'] = marker
    if not values.topics.package_pose:
        stds = {'length': stds['length']}
    if all(name in values for name in PACKAGE_PARAMETERS):
        payload = package_of(values)
        for name, size in (('mass', np.array([payload.mass])), ('com', np.ones(3)),
                           ('inertia', np.diag(payload.inertia))):
            stds[name] = stated_std(
                values, f'package.{name}_std', PACKAGE_STD[name] * size) / size
    return {name: np.maximum(std, MIN_STD) for name, std in stds.items() if np.any(std)}


def _exposure_std(values: Values) -> Array:
    """Return the relative standard deviation of the exposure, 0 for a tracked body."""
    is_unknown = values.measured.tag_size > 0.0 and not values.measured.exposure
    return np.array([float(is_unknown)])


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
    middle, views = body.middle_of(tracked), recording.views
    camera = views.tag.T_world_camera[:3, 3] if views else 0.0
    offset, rate = (float(free.get(name, (0.0,))[0]) for name in ('time_offset', 'clock_rate'))
    delays = offset * NS_PER_S + rate * (tracked.stamps_ns - middle[3] * NS_PER_S)

    def moved(poses: Trajectory) -> Trajectory:
        return body.poses_of(poses, free, moves, middle, camera)

    of_tool, of_package = recording.filters
    payload = payload_of(recording.payload, free)
    stamps_ns = tracked.stamps_ns + np.rint(delays).astype(np.int64)
    return replace(
        recording, seen=views and replace(
            views.at(tracked.stamps_ns).corrected(free, moves, middle), stamps_ns=stamps_ns),
        settings=replace(recording.settings, payload=payload),
        filters=(of_tool, replace(of_package, poses=moved(of_package.poses))),
        tracked_package=replace(moved(tracked), stamps_ns=stamps_ns))
