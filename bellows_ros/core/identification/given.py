"""
What was given with a recording, each number a measurement with a standard deviation.

About the minimum all of it is free at once beside K and P. Directions of it that the recordings
know thirty times better than it was given are found with K and P. The others stay as they were
given, and what they move K and P by is an error of its own: with mass, inertia, K and P larger by
one factor the motion is the same, so no recording knows the size of K better than the mass.
"""

from collections.abc import Callable, Mapping
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.quantities import Free
from bellows_ros.core.identification.search import Minimum, Search
from bellows_ros.core.model.cup_package import Cup, package_of
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
import numpy as np

KNOWN_BETTER = 1000.0
"""A direction is fitted if the recordings have this many times the information that was given."""

HELD, LEAST = 1e8, 1e-9
"""Information that holds the other directions; and the smallest standard deviation, SI units."""

ORDINARY: Mapping[str, float] = {'mass': 0.01, 'inertia': 0.05, 'com': 2e-3}
"""Standard deviations of a package where none is stated: parts of mass and inertia, and m."""


def given_std(values: Mapping[str, Any]) -> dict[str, Array]:
    """Return the standard deviations of what was given, by names of `KINDS`, SI units."""
    marker = np.repeat(values['recording.marker_std'], 3)
    found = {'length': np.array([values['cup.length_std']]), 'package_marker': marker,
             'time_offset': np.array([values['recording.clock_std']])}
    if values['recording.package_world']:
        found['package_world'] = marker
    if all(name in values for name in PACKAGE_PARAMETERS):
        held = package_of(values)
        stated = {
            'mass': np.array([values['package.mass_std'] / held.mass]),
            'com': np.array(values['package.com_std']),
            'inertia': np.array(values['package.inertia_std'][:3]) / np.diag(held.inertia)}
        found |= {name: std if np.any(std) else np.full(len(std), ORDINARY[name])
                  for name, std in stated.items()}
    return {name: np.maximum(std, LEAST) for name, std in found.items() if np.any(std)}


def stated(given: Free) -> list[str]:
    """Return the names of what is as uncertain as a user stated."""
    return [name for name in given if name in ORDINARY and np.any(given[name] != ORDINARY[name])]


def with_given(
    search: Search, found: Minimum, given: Free, note: Callable[[Cup, float], None]
) -> tuple[Search, Minimum, Array]:
    """
    Return the minimum near one with what was given free, by its standard deviations.

    With its search, and what the rest adds to the covariance (m, m) of the unknowns, SI units.
    """
    names = [name for name in given if name not in search.places]
    if not found.converged or not names:
        return search, found, np.zeros((len(search.units),) * 2)
    wide = search.beside(found, {name: given[name] for name in names})
    size, std = len(search.units), wide.weights[len(search.units):] ** -0.5
    parts, H, g = wide.system(wide.at(found.theta), 0.0)
    if not np.all(np.isfinite(H)):  # what was given is so wrong that derivatives by it diverge
        return search, found._replace(converged=False), np.zeros((size, size))
    S = H[size:, size:] - H[size:, :size] @ np.linalg.solve(H[:size, :size], H[:size, size:])
    values, vectors = np.linalg.eigh(std[:, None] * S * std)  # with 1 of what was given
    free = int(np.count_nonzero(values > KNOWN_BETTER))
    held = vectors[:, :len(std) - free] / std[:, None]
    wide.held = np.zeros_like(H)
    wide.held[size:, size:] = HELD * held @ held.T
    again = wide.found(note, wide.at(found.theta), (parts, H + wide.held, g))
    if again.converged:
        search, found, H = wide, again, again.information - wide.held
    else:
        search.take(found.parts)
        free = 0
    by = np.eye(len(H))
    by[size:, size:] = std[:, None] * vectors[:, ::-1]  # the best known first
    H, first = by.T @ H @ by, size + free
    moved = np.zeros((len(search.units), len(H) - first))
    moved[:size] = -np.linalg.solve(H[:first, :first], H[:first, first:])[:size]
    moved *= search.units[:, None]
    return search, found, moved @ moved.T
