"""
What was given with a recording, each number a measurement with a standard deviation.

About the minimum all of it is free at once beside K and P. Directions of it that the recordings
know thirty times better than it was given are found with K and P. The others stay as they were
given, and what they move K and P by is an error of its own: with mass, inertia, K and P larger by
one factor the motion is the same, so no recording knows the size of K better than the mass.

A cause is a number that moves by many of its standard deviations. Each of `CANDIDATES` gets its
columns in one pass about the minimum; what the squares would fall by if it were free is its score.
The best is then freed, and all is fitted again. With it free, what is left is looked at once more:
it is certain where no other explains half as much, or none anything beside it and each clearly
less; and what is found beside it no more than itself.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.identification.causes import DISTINCT, Finding, SIGNIFICANT
from bellows_ros.core.identification.quantities import (
    anything,
    Free,
    KINDS,
    middle_of,
    OF_CUP,
    payload_of,
    poses_of,
)
from bellows_ros.core.identification.search import (
    MAX_NOISE_CHI2,
    Minimum,
    MISFIT_CHI2,
    Search,
    Segment,
)
from bellows_ros.core.model.cup_package import Cup, package_of
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

KNOWN_BETTER = 1000.0
"""A direction is fitted if the recordings have this many times the information that was given."""

LEAST_CHI2 = 1.03
"""Chi^2 per difference above which another minimum is looked for where something given is off."""

FIXED_INFORMATION, LEAST = 1e8, 1e-9
"""Information that fixes the other directions; and the smallest standard deviation, SI units."""

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
    search: Search, found: Minimum, given: Free, note: Callable[[Cup, float], None],
    is_off: bool = False,
) -> tuple[Search, Minimum, Array]:
    """
    Return the minimum near one with what was given free, by its standard deviations.

    With its search, and what the rest adds to the covariance (m, m) of the unknowns, SI units. Of
    a search that did not converge, or leaves more than noise (however little, where something
    given is known to be off), that from its start with all that was given free, where it leaves
    less and nothing is off by more than `SIGNIFICANT` times its standard deviation.
    """
    more = {name: std for name, std in given.items() if name not in search.places}
    size = len(search.units)
    near = search, found, np.zeros((size, size))
    if more and found.converged:
        near = _near_with_given(search, found, more, note)
    noise = (LEAST_CHI2 if is_off else MAX_NOISE_CHI2) * near[1].residual_count
    if not more or near[1].converged and near[1].squares < noise:
        return near
    stds = [segment.std for segment in search.segments]
    for segment in search.segments:
        segment.reset()
    wide = search.with_free(search.start, more)
    again = wide.minimum(note)
    off = np.abs(again.theta[size:]) * np.sqrt(wide.weights[size:])
    if again.converged and np.all(off < SIGNIFICANT) and not (
            near[1].converged and near[1].squares < again.squares):
        return wide, again, np.zeros((len(wide.units),) * 2)
    _restore(search, near[1], stds)
    return near


def _near_with_given(
    search: Search, found: Minimum, more: Free, note: Callable[[Cup, float], None]
) -> tuple[Search, Minimum, Array]:
    """Return the minimum near one with what the recordings know better free; see `with_given`."""
    size = len(search.units)
    wide = search.with_free(found.theta, more)
    std = wide.weights[size:] ** -0.5
    start = wide.transferred(search, found.theta)
    parts, H, g = wide.system(start)
    if not np.all(np.isfinite(H)):  # what was given is so wrong that derivatives by it diverge
        return search, found._replace(converged=False), np.zeros((size, size))
    S = H[size:, size:] - H[size:, :size] @ np.linalg.solve(H[:size, :size], H[:size, size:])
    values, vectors = np.linalg.eigh(std[:, None] * S * std)  # with 1 of what was given
    free = int(np.count_nonzero(values > KNOWN_BETTER))
    fixed = vectors[:, :len(std) - free] / std[:, None]
    wide.fixing[size:, size:] = FIXED_INFORMATION * fixed @ fixed.T
    again = wide.minimum(note, start, (parts, H + wide.fixing, g))
    if again.converged:
        search, found, H = wide, again, again.information - wide.fixing
    else:
        search.accept(found.parts)
        free = 0
    by = np.eye(len(H))
    by[size:, size:] = std[:, None] * vectors[:, ::-1]  # the best known first
    H, first = by.T @ H @ by, size + free
    moved = np.zeros((len(search.units), len(H) - first))
    moved[:size] = -np.linalg.solve(H[:first, :first], H[:first, first:])[:size]
    moved *= search.units[:, None]
    return search, found, moved @ moved.T


def as_found(own: Recording, found: Free, number: int) -> Recording:
    """
    Return a recording with what a fit found beside K and P: its package, marker, world and clock.

    Parameters
    ----------
    own : Recording
        As it was given.
    found : mapping
        See `Fit.found`.
    number : int
        Of the recording in the fit.

    """
    if not found:
        return own
    free = {name: rows[number if KINDS[name].each else 0] for name, rows in found.items()}
    moves, tracked = np.array(own.settings.moves_with_com, float), own.tracked_package
    middle = middle_of(tracked)
    delay = round(float(free['time_offset'][0]) * NS_PER_S) if 'time_offset' in free else 0

    def moved(poses: Trajectory) -> Trajectory:
        return poses_of(poses, free, moves, middle)

    of_package = own.filters[1]
    return replace(
        own, settings=replace(own.settings, payload=payload_of(own.payload, free)),
        filters=(own.filters[0], replace(of_package, poses=moved(of_package.poses))),
        tracked_package=replace(moved(tracked), stamps_ns=tracked.stamps_ns + delay))


MOVES = 0.02
"""Part by which a cause moves an entry of K, at least, where it does not halve the residuals."""

SUSPECT = 0.5
"""Part of the distance from lip to centre of mass by which one of them moves if exchanged."""

MOST_TRIED = 2
"""Quantities that are freed in turn where the next explains at least half as much."""

MOST_CAUSES = 2
"""Causes that are looked for, one beside the other, by a search for each quantity tried."""

CANDIDATES = ('time_offset', 'com', 'length', 'mass', 'package_world', 'package_marker',
              'world_drift', *OF_CUP)


def causes(
    search: Search, found: Minimum, known: Sequence[str] = (), most: int = MOST_CAUSES,
) -> tuple[Finding, ...]:
    """
    Return the likeliest cause of what a fit leaves, none where all is as it should be.

    After it comes what is likeliest where that is corrected, up to so many. What is known to be
    uncertain is none.
    """
    scored = sorted((own for own in _scores(search, found, known) if np.isfinite(own[0])),
                    reverse=True)
    if not scored or scored[0][0] < SIGNIFICANT**2:
        return ()
    stds = [segment.std for segment in search.segments]
    tried = sorted((_freed(search, found, name, stds) for score, name in scored[:MOST_TRIED]
                    if score >= DISTINCT * scored[0][0]), key=lambda own: -own.gain)
    name, freed, again, fall, noise = tried[0]
    if not again.converged:
        return ()
    if most == MOST_CAUSES and name in ('com', 'package_marker'):
        frame = _in_other_frame(search, found, freed, again)
        if frame is not None and _gain(found, frame.minimum) > fall + SIGNIFICANT**2:
            _restore(search, found, stds)
            lip = all(search.segments[0].measured.moves_with_com)
            left = float(np.sqrt(_rest(frame.minimum) / _rest(found)))
            return (Finding('recording.package_frame', 'com' if lip else 'lip', left=left),)
    _restore(freed, again, noise)
    place = freed.places[name].ravel()
    theta = (freed.units * again.theta)[place]
    covariance = np.linalg.inv(again.information)
    std = freed.units[place] * np.sqrt(np.diag(covariance))[place]
    if np.max(np.abs(theta) / std) < SIGNIFICANT:
        return ()
    left = float(np.sqrt(_rest(again) / _rest(found)))
    moved = moved_between((search, found), (freed, again))
    gains = {other: score for score, other in scored} | {own.name: own.gain for own in tried}
    clear = SIGNIFICANT**2 * KINDS['com'].size  # as it has more numbers
    instead = next((other for other in ('com', 'length') if {name, other} == {'com', 'length'}
                    and gains.get(other, 0.0) > fall - clear), '')
    rival = max((gain for other, gain in gains.items() if other not in (name, instead)),
                default=0.0)
    more = causes(freed, again, known, most - 1) if most > 1 else ()
    is_all = most > 1 and not more  # so that what a rival leaves is its own
    certain = (moved > MOVES or left < DISTINCT) and (
        rival < DISTINCT * fall or is_all and fall - rival > SIGNIFICANT**2)
    if not more:  # what no cause explains may be of another
        certain = certain and again.squares < MISFIT_CHI2 * again.residual_count
    more = tuple(own._replace(certain=own.certain and certain) for own in more)
    value, datum = '', name not in OF_CUP
    if name == 'mass':  # K and P scaled with mass and inertia make the same motion
        name, theta = 'inertia', -theta
    if not datum:  # the entry of K that shows it best is enough
        best = int(np.argmax(np.abs(theta) / std))
        reach = max(own.reach[best] for own in again.parts) if name == 'cubic' else 1.0
        value, theta, std = f'K {AXES[best]}', *(reach**2 * own[[best]] for own in (theta, std))
    return Finding(name, value, theta, std, left, moved, datum, certain, instead), *more


def _in_other_frame(
    search: Search, found: Minimum, freed: Search, again: Minimum
) -> '_Freed | None':
    """
    Return the minimum with poses of the lip taken for those of the centre of mass, or vice versa.

    With the centre of mass free near it, as it is a little off beside. None where what was freed
    moves by much less than the two are apart, or the search ends nowhere.
    """
    measured = search.segments[0].measured
    com, lip = measured.payload.com, all(measured.moves_with_com)
    values = freed.units * again.theta
    way = values[freed.places['com'][0]] if 'com' in freed.places else (
        values[freed.places['package_marker'][0]][:3])
    if np.linalg.norm(way) < SUSPECT * np.linalg.norm(com):
        return None
    other, sign = copy(search), -1.0 if lip else 1.0
    other.segments = [Segment(replace(own.measured, package=replace(
        own.measured.package, position=own.measured.package.position + sign * apply(
            own.measured.package.rotation, own.measured.payload.com))))
        for own in search.segments]
    there = other.minimum()
    if not there.converged:
        return None
    beside = _freed(other, there, 'com', [segment.std for segment in other.segments])
    return beside if beside.minimum.converged else None


class _Freed(NamedTuple):
    """A search with one quantity more, where it ended, and by how much squares fall."""

    name: str
    search: Search
    minimum: Minimum
    gain: float
    noise: list[Array]
    """Of the poses of each segment, as it was found (6,)."""


def _freed(search: Search, found: Minimum, name: str, noise: list[Array]) -> _Freed:
    """Return the search from a minimum with one quantity more, and what that explains."""
    _restore(search, found, noise)
    wide = search.with_free(found.theta, anything([name]))
    again = wide.minimum(near=wide.transferred(search, found.theta))
    gain = _gain(found, again) if again.converged else -np.inf
    return _Freed(name, wide, again, gain, [segment.std for segment in search.segments])


def _restore(search: Search, found: Minimum, noise: list[Array]) -> None:
    """Go back to the paths, first states and noise of a minimum."""
    for segment, std in zip(search.segments, noise, strict=True):
        segment.std = std
    search.accept(found.parts)


def _gain(found: Minimum, again: Minimum) -> float:
    """Return by how much squares fall, in the noise that is left, as that of slow poses is fit."""
    before, after = (minimum.residuals**2 for minimum in (found, again))
    return float(len(after) * np.sum(np.log(np.mean(before, axis=0) / np.mean(after, axis=0))))


def _scores(
    search: Search, found: Minimum, known: Sequence[str]
) -> Iterator[tuple[float, str]]:
    """Yield by how much the squares would fall with each quantity free."""
    names = [name for name in CANDIDATES if name not in (*search.places, *known)]
    wide = search.with_free(found.theta, anything(names))
    _, H, g = wide.system(wide.transferred(search, found.theta))
    base = np.arange(len(search.units))
    gain = np.linalg.solve(H[np.ix_(base, base)], np.column_stack([H[base], g[base]]))
    for name in names:
        own = wide.places[name].ravel()
        S = H[np.ix_(own, own)] - H[np.ix_(own, base)] @ gain[:, own]
        slope = g[own] - H[np.ix_(own, base)] @ gain[:, -1]
        yield float(slope @ np.linalg.solve(S, slope)), name


def _rest(found: Minimum) -> float:
    """Return the mean square of the differences, 1 mm as much as 10 mrad."""
    return float(np.sum(np.mean(found.residuals**2, axis=0) / [1.0, 1.0, 1.0, 0.01, 0.01, 0.01]))


def moved_between(*ends: tuple[Search, Minimum]) -> float:
    """Return the largest part by which the diagonal of K moves from one minimum to another."""
    first, second = (np.diag(search.cup(found.theta).stiffness) for search, found in ends)
    return float(np.max(np.abs(second / first - 1.0)))
