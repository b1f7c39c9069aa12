"""
The given quantities of a recording, each a measurement with a standard deviation.

Near the minimum, given quantities are estimated jointly with K and P; with quick poses from the
start of the search. Directions that the recordings determine better than their standard deviations
are estimated. The others keep their given values, and their effect on K and P is an error of its
own: mass, inertia, K and P larger by one factor give the same motion, so that no recording
determines the size of K better than the mass.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import quantities
from bellows_ros.core.identification.diagnosis.candidates import is_explained, SIGNIFICANT
from bellows_ros.core.identification.quantities import Free
from bellows_ros.core.identification.search import minimise, Report, Solution, system_of
from bellows_ros.core.model.cup_package import package_of
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

NOTHING: Free = MappingProxyType({})

CLOCK_RATE_STD = 5e-5
"""Standard deviation of the rates of two quartz clocks (50 ppm)."""

FIXED_INFORMATION, MIN_STD = 1e8, 1e-9
"""Information that fixes the other directions; and the smallest standard deviation, SI units."""

PACKAGE_STD: Mapping[str, float] = {'mass': 0.01, 'inertia': 0.05, 'com': 2e-3}
"""Standard deviations of a package where none is stated: parts of mass and inertia, and m."""


def given_std(values: Values) -> dict[str, Array]:
    """Return the standard deviations of what was given, by names of `KINDS`, SI units."""
    marker = np.repeat(values.recording.marker_std, 3)
    stds = {'length': np.array([values.cup.length_std]), 'package_marker': marker,
            'time_offset': np.array([values.recording.clock_std]),
            'clock_rate': np.array([CLOCK_RATE_STD if values.recording.clock_std else 0.0])}
    if values.recording.package_world:
        stds['package_world'] = marker
    if all(name in values for name in PACKAGE_PARAMETERS):
        payload = package_of(values)
        stated = {
            'mass': np.array([values.package.mass_std / payload.mass]),
            'com': np.array(values.package.com_std),
            'inertia': np.array(values.package.inertia_std[:3]) / np.diag(payload.inertia)}
        stds |= {name: std if np.any(std) else np.full(len(std), PACKAGE_STD[name])
                 for name, std in stated.items()}
    return {name: np.maximum(std, MIN_STD) for name, std in stds.items() if np.any(std)}


def stated(given: Free) -> list[str]:
    """Return the names of what is as uncertain as a user stated."""
    return [name for name, std in given.items()
            if name in PACKAGE_STD and np.any(std != PACKAGE_STD[name])]


def with_given(found: Solution, given: Free, report: Report) -> tuple[Solution, Array]:
    """
    Return the minimum near one with what was given free, by its standard deviations.

    With what the rest adds to the covariance (m, m) of the unknowns, SI units. Where that leaves a
    cause to look for, the minimum from the start with all that was given free, if it leaves less
    and nothing is off by more than `SIGNIFICANT` times its standard deviation, or the search near
    it ended at no plausible cup (`Solution.is_plausible`).
    """
    problem = found.problem
    more = {name: std for name, std in given.items() if name not in problem.places}
    size = len(problem.units)
    near = near_with_given(found, more, report)
    if not more or is_explained(near[0], given):
        return near
    wide = problem.freed(problem.start, more)
    again = minimise(wide, report=report)
    off = np.abs(again.theta[size:]) * np.sqrt(wide.weights[size:])
    if again.converged and (not near[0].is_plausible or np.all(off < SIGNIFICANT)
                            and again.squares <= near[0].squares):
        return again, unmoved(again)
    return near


def unmoved(found: Solution) -> Array:
    """Return no covariance (m, m) by what was given."""
    return np.zeros((len(found.theta),) * 2)


def near_with_given(found: Solution, more: Free, report: Report) -> tuple[Solution, Array]:
    """
    Return the minimum near one with that part of `more` free which the recordings know better.

    The rest stays as it was given. With a covariance as `with_given`.
    """
    problem = found.problem
    wide = problem.freed(
        found.theta, {name: std for name, std in more.items() if name not in problem.places})
    size = len(wide.units) - sum(wide.places[name].size for name in more)
    if not found.is_plausible:
        return found, unmoved(found)
    start, std = found.near(wide), wide.weights[size:] ** -0.5
    parts, H, g = system_of(wide, start)
    if not np.all(np.isfinite(H)):  # what was given is so wrong that derivatives by it diverge
        return replace(found, converged=False), unmoved(found)
    known = H - wide.prior(start.theta, 0.0)[0]
    S = known[size:, size:] - known[size:, :size] @ np.linalg.lstsq(
        known[:size, :size], known[:size, size:], rcond=None)[0]
    values, vectors = np.linalg.eigh(std[:, None] * S * std)  # what was given has 1
    free = int(np.count_nonzero(values > 1.0))
    fixed = vectors[:, :len(std) - free] / std[:, None]
    fixing = np.zeros_like(H)
    fixing[size:, size:] = FIXED_INFORMATION * fixed @ fixed.T
    again = minimise(replace(wide, fixing=fixing), start, report, (
        parts, H + fixing, g + fixing @ (wide.start - start.theta)))
    if again.converged:
        found, H = again, again.information - fixing
    else:
        if len(wide.units) == len(problem.units):
            return found, unmoved(found)
        free = 0
    by = np.eye(len(H))
    by[size:, size:] = std[:, None] * vectors[:, ::-1]  # the best known first
    H, first = by.T @ H @ by, size + free
    units = found.problem.units
    moved = np.zeros((len(units), len(H) - first))
    moved[:size] = -np.linalg.solve(H[:first, :first], H[:first, first:])[:size]
    moved *= units[:, None]
    return found, moved @ moved.T


def as_found(recording: Recording, found: Free, number: int) -> Recording:
    """
    Return a recording with what a fit found beside K and P: its package, marker, world and clock.

    Parameters
    ----------
    recording : Recording
        As it was given.
    found : mapping
        See `Fit.nuisances`.
    number : int
        Of the recording in the fit.

    """
    if not found:
        return recording
    free = {name: rows[number if quantities.KINDS[name].each else 0]
            for name, rows in found.items()}
    moves, tracked = np.array(recording.settings.moves_with_com, float), recording.tracked_package
    middle = quantities.middle_of(tracked)
    delay = round(float(free['time_offset'][0]) * NS_PER_S) if 'time_offset' in free else 0

    def moved(poses: Trajectory) -> Trajectory:
        return quantities.poses_of(poses, free, moves, middle)

    of_tool, of_package = recording.filters
    payload = quantities.payload_of(recording.payload, free)
    return replace(
        recording, settings=replace(recording.settings, payload=payload),
        filters=(of_tool, replace(of_package, poses=moved(of_package.poses))),
        tracked_package=replace(moved(tracked), stamps_ns=tracked.stamps_ns + delay))
