"""
Causes of a misfit: quantities that leave noise alone if they are free.

The score of a quantity is the fall of chi² to first order if it were free without a given value;
the score of a slip also depends on its instant. The two quantities with the largest scores are
fitted. A cause is certain if chi² is then as expected of noise, and if no other quantity explains
half as much.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from operator import attrgetter, itemgetter
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.estimate import (
    MAX_NOISE_CHI2,
    minimise,
    MISFIT_CHI2,
    settled,
    Solution,
)
from bellows_ros.core.identification.residuals import BLOCK_DURATION, Part
from bellows_ros.core.identification.result import Cause, FALSE_ALARMS, MAJORITY, MATERIAL
from bellows_ros.core.identification.segments import Segments
from bellows_ros.core.identification.unknowns import Free, KINDS, MARKERS, weak_prior
from bellows_ros.core.signals.residuals import AXES, spectrum
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np
from scipy.special import chdtri

CANDIDATES = ('time_offset', 'clock_rate', 'com', 'length', 'length_drift', 'mass', 'inertia',
              'gravity', 'package_world', 'scale', 'package_marker', 'tool_marker', 'relaxation',
              'exposure')
"""Quantities that may be wrong."""

UNLIKELY = ('tool_marker', 'relaxation')
"""Candidates with usual values beyond their errors, which are tested for a misfit alone."""

ALIKE: Mapping[str, str] = {
    'com': 'length', 'length': 'com', 'package_marker': 'tool_marker',
    'tool_marker': 'package_marker', 'gravity': 'force', 'mass': 'inertia', 'inertia': 'mass'}
"""Candidates that one recording can hardly distinguish; only the ratio of mass and inertia is
observable."""

OF_CUP = ('length_drift', 'relaxation')
"""Causes in the cup itself, which no given value corrects."""

REPORTED: Mapping[str, str] = {
    'mass': 'inertia', 'gravity': 'gravity.direction', 'tool_marker': 'package_marker'}
"""Names of findings that differ from the names of their candidates."""

SLIP_INSTANTS = 8
"""Number of first instants of a slip: its score falls linearly with the distance from them."""

MIN_SLIP_PERIOD = 0.03
"""Resolution of the instant of a slip, s: the package moves on for some poses of a camera."""

MIN_SLIP_GAIN = 1.1
"""Smallest ratio of the gains of a slip and of a com offset: near the ends of a recording the two
cannot be distinguished."""

BAND = 0.8
"""Share of the residual's power in the reported frequency band."""


class Alternative(NamedTuple):
    """A solution with one quantity free without its given value, and its fall of chi²."""

    name: str
    found: Solution
    gain: float


def causes_of(found: Solution, given: Free) -> tuple[Cause, ...]:
    """
    Return the causes of a misfit, or of wrong given values, the likeliest first.

    With a misfit left by all of them, the unknown cause is the first.

    Parameters
    ----------
    found : Solution
        End of a search.
    given : mapping
        Standard deviations of the given quantities, SI units.

    """
    falls = significant(found, given)
    if found.fits and not falls:
        return ()
    if found.is_plausible and 'slip' not in found.problem.places:
        found, falls['slip'] = with_likeliest_slip(found)
    names = sorted(falls, key=lambda name: falls[name], reverse=True)[:2]
    if not found.is_plausible:  # scores about an implausible cup are unreliable
        names = [*dict.fromkeys([*names, 'length', 'package_world'])]
    solutions = [freed(found, name) for name in names]
    gains = {one.name: one.gain for one in solutions}
    tried = [one for one in solutions if one.gain > limit_of(one.found, one.name)]
    if gains.get('slip', 0.0) < MIN_SLIP_GAIN * gains.get('com', 0.0):
        tried = [one for one in tried if one.name != 'slip']
    if found.fits:  # a cause that contradicts no given value, and hardly moves K, is harmless
        tried = [one for one in tried if one.name in given or _moved(found, one) > MATERIAL]
    tried.sort(key=attrgetter('gain'), reverse=True)
    rivals = falls | gains
    beyond = found.total.squares - found.total.number + float(
        found.problem.weights @ found.theta**2)
    causes = [_cause(found, one, beyond, rivals) for one in tried]
    if tried and _is_certain(tried[0], rivals, given):
        causes[0] = causes[0]._replace(certain=True)
    elif not found.fits:
        causes = [unknown(found), *causes]
    return tuple(causes)


def significant(found: Solution, given: Free) -> dict[str, float]:
    """Return the falls of chi² beyond chance by the candidates that are given or not free."""
    problem, places = found.problem, found.problem.places
    has_stated_error = {name for name in given.keys() & places.keys()
                        if np.array_equal(given[name], problem.free[name])}
    excluded = places.keys() - has_stated_error
    if found.fits:
        excluded.update(UNLIKELY)
    if excluded & places.keys() & set(MARKERS):
        excluded.update(MARKERS)
    excluded.add('mass' if 'inertia' in places else 'inertia')
    if 'exposure' in places or not problem.is_slow:
        excluded.add('exposure')
    falls = scores(found, [name for name in CANDIDATES if name not in excluded])
    return {name: fall for name, fall in falls.items() if fall > limit_of(found, name)}


def limit_of(found: Solution, name: str) -> float:
    """Return the largest fall of chi² by chance with a free quantity."""
    numbers = KINDS[name].size * (len(found.problem.outlines) if KINDS[name].each else 1)
    return float(chdtri(numbers, FALSE_ALARMS / len(CANDIDATES))) * max(found.colour, 1.0)


def scores(found: Solution, names: Sequence[str]) -> dict[str, float]:
    """
    Return the fall of chi² with each quantity free without a given value, to first order.

    Information H (m, m) and slope g (m,) include the unknowns of all the names. For each name the
    unknowns of the fit and of this quantity are used, with a weak prior of the quantity.
    """
    near = found.freed(weak_prior(set(names) - found.problem.places.keys()))
    extended, H, g = near.problem, near.information, near.slope
    unknowns = np.arange(len(g))
    is_own = {name: np.isin(unknowns, extended.places[name]) for name in names}
    is_of_fit = np.full(len(g), True)
    for name in set(names) - found.problem.places.keys():
        is_of_fit &= ~is_own[name]
    before, falls = H.fall(g, is_of_fit), dict[str, float]()
    for name in names:
        weak = weak_prior([name])[name] / KINDS[name].unit
        removed = np.where(is_own[name], extended.weights, 0.0)  # weights (m,) of the prior
        removed[extended.places[name]] -= weak**-2.0
        with_weak_prior = H.raised(-removed).fall(
            g + removed * near.theta, is_of_fit | is_own[name])
        falls[name] = float(removed @ near.theta**2) - before + with_weak_prior
    return falls


def freed(before: Solution, name: str) -> Alternative:
    """Return the solution with a quantity free, from the start if the cup is implausible."""
    problem, more = before.problem, weak_prior([name])
    found = settled(before.freed(more)) if before.is_plausible else before
    if not (before.is_plausible and found.converged):
        found = minimise(problem.freed(problem.start, more))
    return Alternative(name, found, before.misfit - found.misfit)


def _is_certain(best: Alternative, rivals: Mapping[str, float], given: Free) -> bool:
    """Return whether a cause leaves noise alone, and no other explains half as much."""
    after, alike = best.found, (best.name, ALIKE.get(best.name, ''))
    is_noise = after.fits and after.robust_chi2 < MAX_NOISE_CHI2 and after.chi2 < MISFIT_CHI2
    gains = [gain for name, gain in rivals.items() if name not in alike]
    is_alone = max(gains, default=0.0) < MAJORITY * best.gain
    if not (is_noise and is_alone):
        return False
    others = {name: std for name, std in given.items() if name not in alike}
    return not significant(after, others).keys() & given.keys()


def _moved(end: Solution, one: Alternative) -> float:
    """Return the largest relative change of an entry on the diagonal of K by a freed quantity."""
    return float(np.max(np.abs(
        np.diag(one.found.cup.stiffness) / np.diag(end.cup.stiffness) - 1.0)))


def _cause(
    end: Solution, one: Alternative, beyond: float, rivals: Mapping[str, float]
) -> Cause:
    """Return the finding of a freed quantity by the chi² beyond noise, without a claim."""
    name, problem = one.name, one.found.problem
    theta, std = one.found.estimate(name)
    moved = _moved(end, one)
    alike = ALIKE.get(name, '')
    is_along_z = name in ('com', 'length') and np.argmax(np.abs(theta)) == len(theta) - 1
    is_open = is_along_z and (
        alike in problem.places
        or rivals.get(alike, 0.0) > one.gain - limit_of(one.found, 'com'))
    if name == 'slip':
        shifts, errors = theta.reshape(-1, 2), std.reshape(-1, 2)  # of each recording
        worst = int(np.argmax(np.max(np.abs(shifts) / errors, axis=1)))
        since = (problem.slip_ns - problem.outlines[worst].begin_ns) / NS_PER_S
        theta, std = np.append(shifts[worst], since), np.append(errors[worst], MIN_SLIP_PERIOD)
    if name == 'mass':  # reported as an inertia: K and P scaled with the mass move alike
        theta = -theta
    return Cause(
        REPORTED.get(name, name), 'tool' if name == 'tool_marker' else '', theta, std,
        share=one.gain / max(beyond, *rivals.values(), 1e-9), moved=moved, certain=False,
        instead=alike if name == 'gravity' or is_open else '',
        datum=name not in OF_CUP and (name != 'clock_rate' or moved > MATERIAL))


def with_likeliest_slip(found: Solution) -> tuple[Solution, float]:
    """Return a solution with the likeliest instant of a slip, and its fall of chi²."""
    worst = found.only(int(np.argmax([one.squares / one.number for one in found.sums])))

    def at(slip_ns: int, whole: Solution) -> Solution:
        return replace(whole, problem=replace(whole.problem, slip_ns=slip_ns))

    @cache
    def score(slip_ns: int) -> float:
        return float(np.nan_to_num(scores(at(slip_ns, worst), ['slip'])['slip']))

    begin, last = worst.problem.outlines[0].ends_ns
    period = (last - begin) / NS_PER_S / SLIP_INSTANTS
    best = max((begin + round((k + 0.5) * period * NS_PER_S) for k in range(SLIP_INSTANTS)),
               key=score)
    while period > MIN_SLIP_PERIOD:
        period *= 0.5
        best = max((best + round(side * period * NS_PER_S) for side in (0, -1, 1)), key=score)
    return at(best, found), score(best)


def unknown(end: Solution) -> Cause:
    """Return the axis, the second, and the frequency band (Hz) of the largest residual."""
    begins = [outline.begin_ns for outline in end.problem.outlines]
    _, axis, span = max(end.parts.pool.results(
        _worst, begins, end.problem.held, end.parts), key=itemgetter(0))
    return Cause('unknown', AXES[axis], span, np.zeros(4), share=0.0, certain=False, datum=False)


def _worst(
    begin_ns: int, segments: Segments, parts: Sequence[Part]
) -> tuple[float, int, Array]:
    """Return the largest mean square over a second, its axis, and second and band (Hz)."""
    found = []
    for segment, part in zip(segments, parts, strict=True):
        size = max(round(BLOCK_DURATION / segment.period), 1)
        squares = part.innovations**2
        axis = int(np.argmax(squares.sum(axis=0)))
        means = np.add.reduceat(squares[:, axis], np.arange(0, len(squares), size)) / size
        second = float(segment.package.stamps_ns[0] - begin_ns) / NS_PER_S + np.argmax(means)
        low, high = spectrum(np.repeat(part.residuals[:, axis:axis + 1], 6, axis=1),
                             1.0 / segment.period).band(BAND)
        found.append((float(means.max()), axis, np.array([second, second + 1.0, low[0], high[0]])))
    return max(found, key=itemgetter(0))
