"""
Which number that was given would explain what a fit by simulation leaves.

Beside K and P each quantity of `KINDS` gets its columns in one pass about the minimum; what the
squares would fall by if it were free is its score. The best is then freed, and all is fitted
again: a cause is a number that moves by many of its standard deviations. With it free, what is
left is looked at once more.
"""

from collections.abc import Iterator, Sequence

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.plausibility import DISTINCT, Finding, SIGNIFICANT
from bellows_ros.core.identification.quantities import anything
from bellows_ros.core.identification.search import Minimum, MISFIT, Search, squares
from bellows_ros.core.model.structure import Structure
import numpy as np

MOVES = 0.02
"""Part by which a cause moves an entry of K, at least, where it does not halve the residuals."""

MOST_CAUSES = 2
"""Causes that are looked for, one beside the other: the second takes 65 simulations at most, so
that a whole fit to a wrong recording takes 219."""

CANDIDATES = ('time_offset', 'com', 'length', 'mass', 'package_world', 'package_marker')


def causes(
    search: Search, found: Minimum, known: Sequence[str] = (), most: int = MOST_CAUSES,
) -> tuple[Finding, ...]:
    """
    Return the likeliest cause of what a fit leaves, none where all is as it should be.

    After it comes what is likeliest where that is corrected, up to so many. What is known to be
    uncertain is none.
    """
    scored = sorted(_scores(search, found, known), reverse=True)
    if not scored or scored[0][0] < SIGNIFICANT**2:
        return ()
    fall, name = scored[0]
    freed = search.beside(found, anything([name]))
    again = freed.found(lambda cup, chi2: None, freed.at(found.theta))
    if not again.converged:
        return ()
    place = freed.places[name].ravel()
    theta = (freed.units * again.theta)[place]
    covariance = np.linalg.inv(again.information)
    std = freed.units[place] * np.sqrt(np.diag(covariance))[place]
    if np.max(np.abs(theta) / std) < SIGNIFICANT:
        return ()
    left = float(np.sqrt(_rest(again) / _rest(found)))
    moved = _moved(search.structure, search.units[:search.count] * found.theta[:search.count],
                   freed.units[:search.count] * again.theta[:search.count])
    rival = next((other for other, _ in scored[1:]), 0.0)
    certain = rival < DISTINCT * fall and (moved > MOVES or left < DISTINCT)
    more = causes(freed, again, known, most - 1) if most > 1 else ()
    if not more:  # what no cause explains may be of another
        certain = certain and squares(again.parts) < MISFIT * sum(
            len(own.innovations) for own in again.parts)
    if name == 'mass':  # K and P scaled with mass and inertia make the same motion
        name, theta = 'inertia', -theta
    return Finding(name, '', theta, std, left, moved, True, certain), *more


def _scores(
    search: Search, found: Minimum, known: Sequence[str]
) -> Iterator[tuple[float, str]]:
    """Yield by how much the squares would fall with each quantity free."""
    names = [name for name in CANDIDATES if name not in (*search.places, *known)]
    wide = search.beside(found, anything(names))
    _, H, g = wide.system(wide.at(found.theta), 0.0)
    base = np.arange(len(search.units))
    gain = np.linalg.solve(H[np.ix_(base, base)], np.column_stack([H[base], g[base]]))
    for name in names:
        own = wide.places[name].ravel()
        S = H[np.ix_(own, own)] - H[np.ix_(own, base)] @ gain[:, own]
        slope = g[own] - H[np.ix_(own, base)] @ gain[:, -1]
        yield float(slope @ np.linalg.solve(S, slope)), name


def _rest(found: Minimum) -> float:
    """Return the mean square of the differences, 1 mm as much as 10 mrad."""
    left = np.concatenate([own.innovations.reshape(-1, 6) ** 2 * own.spread
                           for own in found.parts])
    return float(np.sum(np.mean(left, axis=0) / [1.0, 1.0, 1.0, 0.01, 0.01, 0.01]))


def _moved(structure: Structure, before: Array, after: Array) -> float:
    """Return the largest part by which the diagonal of K moves."""
    first, second = (np.diag(structure.matrices(x)[0]) for x in (before, after))
    return float(np.max(np.abs(second / first - 1.0)))
