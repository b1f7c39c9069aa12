"""
What was given with a recording, each number a measurement with a standard deviation.

About the minimum all of it is free at once beside K and P; where poses come quickly, and know it
far better than most people do, from the start of the search. Directions of it that the recordings
know better than it was given are found with K and P. The others stay as they were given, and what
they move K and P by is an error of its own: with mass, inertia, K and P larger by one factor the
motion is the same, so no recording knows the size of K better than the mass.

A cause is a number that moves by many of its standard deviations. Each of `CANDIDATES` gets its
columns in one pass about the minimum; what the squares would fall by if it were free is its score.
The best is then freed, and all is fitted again (a slip from the start, as without it the noise of
slow poses was learned far too large; couplings as another structure). With it free, what is left
is looked at once more: it is certain where no other explains half as much, or none anything beside
it and each clearly less; and what is found beside it no more than itself. Settings that are no
numbers are tried before any fit, see `alternatives`.

With all that was given free, a fit may explain all poses though something given is wrong. The
cause is then what is off by many of its standard deviations (`outlying`). A fit that leaves only
noise, with nothing off by so much, has no cause; others are searched with what was given free
first, then with it as it was given.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from operator import attrgetter
from types import MappingProxyType
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.identification import quantities
from bellows_ros.core.identification.causes import DISTINCT, Finding, MATERIAL, SIGNIFICANT
from bellows_ros.core.identification.quantities import Free
from bellows_ros.core.identification.search import (
    deviance,
    MAX_NOISE_CHI2,
    Minimum,
    MISFIT_CHI2,
    Report,
    Search,
)
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.model.cup_package import package_of
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

NOTHING: Free = MappingProxyType({})

FIXED_INFORMATION, MIN_STD = 1e8, 1e-9
"""Information that fixes the other directions; and the smallest standard deviation, SI units."""

PACKAGE_STD: Mapping[str, float] = {'mass': 0.01, 'inertia': 0.05, 'com': 2e-3}
"""Standard deviations of a package where none is stated: parts of mass and inertia, and m."""


def given_std(values: Values) -> dict[str, Array]:
    """Return the standard deviations of what was given, by names of `KINDS`, SI units."""
    marker = np.repeat(values.recording.marker_std, 3)
    stds = {'length': np.array([values.cup.length_std]), 'package_marker': marker,
            'time_offset': np.array([values.recording.clock_std])}
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


def with_given(
    search: Search, minimum: Minimum, given: Free, report: Report
) -> tuple[Search, Minimum, Array]:
    """
    Return the minimum near one with what was given free, by its standard deviations.

    With its search, and what the rest adds to the covariance (m, m) of the unknowns, SI units.
    Where that leaves a cause to look for, the minimum from the start with all that was given free,
    if it leaves less and nothing is off by more than `SIGNIFICANT` times its standard deviation,
    or the search near it ended at no plausible cup (`Search.is_plausible`).
    """
    more = {name: std for name, std in given.items() if name not in search.places}
    size = len(search.units)
    near = near_with_given(search, minimum, more, report)
    if not more or is_explained(*near[:2], given):
        return near
    for segment in search.segments:
        segment.reset()
    wide = search.with_free(search.start, more)
    again = wide.minimum(report)
    off = np.abs(again.theta[size:]) * np.sqrt(wide.weights[size:])
    if again.converged and (not near[0].is_plausible(near[1]) or np.all(off < SIGNIFICANT)
                            and again.squares <= near[1].squares):
        return wide, again, np.zeros((len(wide.units),) * 2)
    search.restore(near[1])
    return near


def near_with_given(
    search: Search, minimum: Minimum, more: Free, report: Report
) -> tuple[Search, Minimum, Array]:
    """
    Return the minimum near one with that part of `more` free which the recordings know better.

    The rest stays as it was given. With search and covariance as `with_given`.
    """
    wide = search.with_free(
        minimum.theta, {name: std for name, std in more.items() if name not in search.places})
    size = len(wide.units) - sum(wide.places[name].size for name in more)
    start, unmoved = wide.transferred(search, minimum.theta), np.zeros((len(search.units),) * 2)
    if not search.is_plausible(minimum):
        return search, minimum, unmoved
    std = wide.weights[size:] ** -0.5
    parts, H, g = wide.system(start)
    if not np.all(np.isfinite(H)):  # what was given is so wrong that derivatives by it diverge
        return search, minimum._replace(converged=False), unmoved
    known = np.sum([part.jacobian.T @ part.jacobian for part in parts], axis=0)  # without a prior
    S = known[size:, size:] - known[size:, :size] @ np.linalg.lstsq(
        known[:size, :size], known[:size, size:], rcond=None)[0]
    values, vectors = np.linalg.eigh(std[:, None] * S * std)  # what was given has 1
    free = int(np.count_nonzero(values > 1.0))
    fixed = vectors[:, :len(std) - free] / std[:, None]
    wide.fixing[size:, size:] = FIXED_INFORMATION * fixed @ fixed.T
    again = wide.minimum(report, start, (
        parts, H + wide.fixing, g + wide.fixing @ (wide.start - start)))
    if again.converged:
        search, minimum, H = wide, again, again.information - wide.fixing
    else:
        search.accept(minimum.parts)
        if len(wide.units) == len(search.units):
            return search, minimum, unmoved
        free = 0
    by = np.eye(len(H))
    by[size:, size:] = std[:, None] * vectors[:, ::-1]  # the best known first
    H, first = by.T @ H @ by, size + free
    moved = np.zeros((len(search.units), len(H) - first))
    moved[:size] = -np.linalg.solve(H[:first, :first], H[:first, first:])[:size]
    moved *= search.units[:, None]
    return search, minimum, moved @ moved.T


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


MIN_SHIFT = 0.02
"""Part by which a cause moves an entry of K, at least, where it does not halve the residuals."""

MIN_EXCHANGE_SHIFT, MAX_EXCHANGE_REST = 0.5, 0.2
"""Parts of the distance from lip to centre of mass: by which one of them moves if exchanged, and
by which the centre of mass may be off then."""

MAX_TRIED = 2
"""Quantities that are freed in turn where the next explains at least half as much."""

MAX_SEARCHES = 4
"""Quantities that are freed at most, where searches do not converge."""

PRICE = 0.02
"""Part of a fall of squares that each number costs, where several explain nearly the same."""

SAME_FALL = 0.9
"""Part of the fall of squares with the largest structure with which a smaller one is as good."""

MAX_CAUSES = 2
"""Causes that are looked for, one beside the other, by a search for each quantity tried."""

CANDIDATES = ('time_offset', 'com', 'length', 'mass', 'gravity', 'package_world',
              'package_marker', 'tool_marker', 'world_drift', 'drift', 'cubic', 'friction')

MIN_LENGTH_ERROR = 2e-3
"""
The least error of a length (m) that is searched for where a cup is implausible.

With a length that is too small the weight seems to stretch the cup: K along z is far too soft, and
only much damping keeps that from swinging. Smaller errors are found with K and P.
"""

MAX_PULL, MAX_RATIO_PULL, MIN_KNOWN = 4.0, 3.0, 0.01
"""Standard deviations beyond which a given number is wrong; by chance, one in 16,000 is. They are
of its change by the recordings, and that part of its variance at least: of what only a sum is
known (length, centre of mass, marker), each moves by a part. And those of the ratio of inertia and
mass, on which all of K and P depends."""

OF_LIP = ('com', 'length', 'package_marker')
"""What seems wrong where poses of the lip are taken for those of the centre of mass."""

WORLDS = ('package_world', 'world_drift')
"""What keeps a search from converging that steps about its end do not show."""

MARKERS = ('package_marker', 'tool_marker')
"""Of which either is named."""

SIMILAR: Mapping[str, str] = {'com': 'length', 'length': 'com'}
"""What recordings can hardly tell apart."""

SLIP_PERIOD, MIN_SLIP_PERIOD, MAX_SLIPS = 1.0, 0.03, 30
"""Times (s) between the moments at which a slip is tried, and between the last and the best; and
at how many it is tried at first, as each is a simulation of all recordings."""

SQUARED_UNITS = [1.0, 1.0, 1.0, 0.01, 0.01, 0.01]
"""Squares of the units in which shifts (m) and turns (rad) of poses are compared."""


def causes(
    search: Search, minimum: Minimum, given: Free = NOTHING, count: int = MAX_CAUSES,
) -> tuple[Finding, ...]:
    """
    Return the likeliest cause of what a fit leaves, none where all is as it should be.

    After it comes what is likeliest where that is corrected, up to so many. A given quantity whose
    uncertainty was stated is no cause.
    """
    if count == MAX_CAUSES and (wrong := _wrong_length(search, minimum)):
        return (wrong,)
    off = is_off(search, minimum, given)  # few numbers before many
    decreases = scores(search, minimum, [*_candidates(search, stated(given)), *['couplings'] * (
        not search.structure.couples and not search.structure.places and not off)])
    decreases = {name: fall for name, fall in decreases.items() if np.isfinite(fall)}
    if 'slip' not in search.places and (
            not minimum.converged or max(decreases.values(), default=0.0) > SIGNIFICANT**2
            or off):  # a slip moves the com, too
        search, decreases['slip'] = _with_likeliest_slip(search, minimum)
    if max(decreases.values(), default=0.0) < SIGNIFICANT**2:
        return ()
    tried = _tried(search, minimum, dict(sorted(decreases.items(), key=_priced, reverse=True)))
    best = max(tried, key=lambda freed: _priced((freed.name, freed.gain)))
    if best.gain < SIGNIFICANT**2:
        return ()
    if off and (reasons := outlying(search, minimum, given, count, best.gain)):
        return reasons
    theta, std = _estimate(best)
    shifts = [freed.search.estimate(freed.minimum, freed.name)[0]
              for freed in tried if freed.name in OF_LIP] + [
        (search.units * minimum.theta)[search.places[name].ravel()]
        for name in OF_LIP if name in search.places]
    is_far = any(_is_as_far_as_com(search, shift[:3]) for shift in shifts)
    if count == MAX_CAUSES and is_far and (frame := _other_frame(search, minimum, best.gain)):
        search.restore(minimum)
        return (frame,)
    best.search.restore(best.minimum)
    least = SIGNIFICANT**2 * best.minimum.colour
    if np.max(np.abs(theta) / std) ** 2 < least:
        return ()
    moved = moved_between((search, minimum), (best.search, best.minimum))
    gains = decreases | {one.name: one.gain for one in tried}
    similar = SIMILAR.get(best.name, '')
    clear = SIGNIFICANT**2 * quantities.KINDS['com'].size  # as it has more numbers
    instead = similar if gains.get(similar, 0.0) > best.gain - clear else ''
    alike = {best.name, instead, *(MARKERS if best.name in MARKERS else ())}
    rival = max((gain for name, gain in gains.items() if name not in alike), default=0.0)
    left = best.left(minimum)
    others = () if count == 1 or not best.minimum.converged else causes(
        best.search, best.minimum, given, 1) or outlying(best.search, best.minimum, given, 1)
    unexplained = best.minimum.squares - best.minimum.residual_count
    is_all = count > 1 and (  # so that what a rival leaves is its own
        not others or unexplained < DISTINCT**2 * (best.gain - rival))
    is_material = best.name == 'slip' or moved > MIN_SHIFT or left < DISTINCT or (
        off and not is_off(best.search, best.minimum, given))
    expected = given.get('package_marker' if best.name in MARKERS else best.name)
    is_expected = expected is not None and bool(
        np.all(np.abs(theta.reshape(-1, len(expected))) <= 3.0 * expected))
    certain = is_material and best.minimum.converged and not is_expected and (
        rival < DISTINCT * best.gain or is_all and best.gain - rival > least) and (
        # what this one does not explain may be of another
        best.minimum.squares < MISFIT_CHI2 * best.minimum.residual_count
        or any(other.certain for other in others))
    excess = minimum.squares - minimum.residual_count
    if excess > MATERIAL * minimum.residual_count:
        left = min(left, float(np.sqrt(max(unexplained, 0.0) / excess)))
    return (_finding(best, theta, std)._replace(
        left=left, moved=moved, certain=certain, instead=instead),
        # a frame that is turned looks like couplings, and like another that is turned
        *(other._replace(certain=other.certain and certain and best.name != 'couplings')
          for other in others if best.name not in MARKERS or other.name not in (
              'structure', 'package_marker')))


def _priced(fall: tuple[str, float]) -> float:
    """Return a fall of squares by what is free by a name, less the price of its numbers."""
    return (1.0 - PRICE * quantities.KINDS[fall[0]].size) * fall[1]


def _candidates(search: Search, without: Sequence[str] = ()) -> list[str]:
    """Return what may be wrong and is not free; once a marker may be anywhere, no other is."""
    taken = {*search.places, *without}
    for name in search.places.keys() & set(MARKERS):
        kind = quantities.KINDS[name]
        if np.all(search.weights[search.places[name]] * (kind.prior_std / kind.unit) ** 2 < 2.0):
            taken.update(MARKERS)
    return [name for name in CANDIDATES if name not in taken]


def _tried(search: Search, minimum: Minimum, decreases: Mapping[str, float]) -> list['_Freed']:
    """
    Return the searches with each of what explains most free, by what it explains from the most on.

    What explains half as much is tried, too, and the next where a search does not converge. As
    couplings have most numbers they explain a part of anything: they come first, or instead. About
    an implausible cup little is known: from the start worlds are tried beside.
    """
    tried, least = list[_Freed](), DISTINCT * max(decreases.values())
    is_known = search.is_plausible(minimum)
    names = list(decreases)[:MAX_SEARCHES] if is_known else dict.fromkeys(
        [*list(decreases)[:MAX_TRIED], *(name for name in WORLDS if name in decreases)])
    for name in names:
        settled = [freed for freed in tried if freed.minimum.converged]
        if is_known and settled and (
                decreases[name] < least or name == 'couplings' or len(settled) == MAX_TRIED):
            break
        if is_known and name not in ('slip', 'couplings'):
            tried.append(_freed(search, minimum, name))
        if name == 'couplings':
            tried.append(_structured(search, minimum))
        elif not (tried and tried[-1].name == name and tried[-1].minimum.converged):
            tried.append(_freed(search, minimum, name, from_start=True))
    return tried


def is_explained(search: Search, minimum: Minimum, given: Free) -> bool:
    """Return whether a minimum leaves no cause to look for, with what was given free."""
    names = [name for name in _candidates(search) if not (  # a little off, it is as one of both
        name in MARKERS and search.places.keys() & set(MARKERS))]
    return search.fits(minimum) and not is_off(search, minimum, given) and (
        max(scores(search, minimum, names).values()) < SIGNIFICANT**2)


def reasons_at(ends: Mapping[Search, Minimum], given: Free) -> tuple[Finding, ...]:
    """
    Return the likeliest causes where a search ended, none if nothing is left to explain.

    The first end with a certain cause decides, or else the first with any. Ends after one that
    leaves only noise do not count: with fewer quantities free, whatever was given a little wrong
    would seem to be a cause. Nor does an implausible cup after an end with a likely cause. Where
    two would be wrong, couplings may be instead.
    """
    reasons, (search, minimum) = _reasons_at(ends, given), next(iter(ends.items()))
    coupled = _coupled(search, minimum, given) if len(reasons) > 1 else None
    return (coupled,) if coupled else reasons


def _reasons_at(ends: Mapping[Search, Minimum], given: Free) -> tuple[Finding, ...]:
    """Return the same, but for couplings."""
    likely: tuple[Finding, ...] = ()
    if is_explained(*next(iter(ends.items())), given):
        return likely
    for search, minimum in ends.items():
        if likely and not search.is_plausible(minimum):
            break
        search.restore(minimum)
        for test in (causes, outlying):
            reasons = test(search, minimum, given)
            if any(reason.certain for reason in reasons):
                return reasons
            likely = likely or reasons
        if search.fits(minimum):
            break
    return likely


def _wrong_length(search: Search, minimum: Minimum) -> Finding | None:
    """Return another length that explains an implausible cup, if one does."""
    explains = minimum.converged and minimum.squares < MISFIT_CHI2 * minimum.residual_count
    if not explains or 'length' in search.places or search.is_plausible(minimum):
        return None
    damping = search.largest_damping(minimum.theta)
    freed = _freed(search, minimum, 'length', from_start=True)
    search.restore(minimum)
    theta, std = freed.search.estimate(freed.minimum, 'length')
    if freed.gain < -SIGNIFICANT**2 or abs(theta[0]) < max(
            SIGNIFICANT * std[0], MIN_LENGTH_ERROR) or (
            freed.search.largest_damping(freed.minimum.theta) > damping):
        return None
    if _is_as_far_as_com(search, theta):
        frame = _other_frame(search, minimum, freed.gain)
        search.restore(minimum)
        if frame:
            return frame
    return Finding('length', '', theta, std, freed.left(minimum), moved_between(
        (search, minimum), (freed.search, freed.minimum)), instead='com')


def _is_as_far_as_com(search: Search, shift: Array) -> bool:
    """Return whether a shift (m) may be that from the lip to the centre of mass."""
    com = search.segments[0].measured.payload.com
    return bool(np.linalg.norm(shift) > MIN_EXCHANGE_SHIFT * np.linalg.norm(com))


def is_off(search: Search, minimum: Minimum, given: Free) -> bool:
    """Return whether something given is off by more than is allowed."""
    return max(pulls(search, minimum, given).values(), default=0.0) > 1.0


def pulls(search: Search, minimum: Minimum, given: Free) -> dict[str, float]:
    """
    Return by how much what was given is off, by name, in what is allowed: `MAX_PULL`.

    Of mass and inertia only the ratio is known.
    """
    found = dict[str, float]()
    covariance = np.linalg.inv(minimum.information - search.fixing)

    def pull(by: Array) -> float:
        """Return that of a sum of the unknowns."""
        prior = float(np.sum(by**2 / np.where(by != 0.0, search.weights, 1.0)))
        known = max(1.0 - float(by @ covariance @ by) / prior, MIN_KNOWN)
        return abs(float(by @ minimum.theta)) / float(np.sqrt(prior * known))

    for name in search.places.keys() & given.keys() - {'mass', 'inertia'}:
        found[name] = max(map(pull, np.eye(len(search.units))[search.places[name].ravel()]))
    if {'mass', 'inertia'} <= search.places.keys() & given.keys():
        ratio = np.zeros(len(search.units))
        for name, part in (('mass', -1.0), ('inertia', 1.0 / 3.0)):
            place = search.places[name].ravel()
            ratio[place] = part * search.units[place]
        found['mass'] = MAX_PULL / MAX_RATIO_PULL * pull(ratio)
    return {name: size / MAX_PULL for name, size in found.items()}


def outlying(
    search: Search, minimum: Minimum, given: Free, count: int = MAX_CAUSES, least: float = -np.inf,
) -> tuple[Finding, ...]:
    """
    Return what is off by most of its standard deviations, from `MAX_PULL` on, up to so many.

    None if squares fall by less than some with the first of them free.
    With all of it free, a fit may explain the poses by numbers that are not those given.
    """
    explains = minimum.converged and minimum.robust_chi2 < MISFIT_CHI2
    sizes = pulls(search, minimum, given)
    off = [name for name in sorted(sizes, key=sizes.__getitem__, reverse=True)[:MAX_TRIED]
           if sizes[name] > 1.0]
    if not explains or not off:
        return ()
    tried = dict.fromkeys([*off, *(SIMILAR.get(name, '') for name in off)])
    freed = max((_freed(search, minimum, name) for name in tried if name in search.places),
                key=attrgetter('gain'))
    if freed.gain < least:
        search.restore(minimum)
        return ()
    name = freed.name
    if not freed.minimum.converged:
        freed, count = freed._replace(search=search, minimum=minimum), 1
    if name in OF_LIP and (frame := _other_frame(search, minimum, freed.gain)):
        search.restore(minimum)
        return (frame,)
    theta, std = freed.search.estimate(freed.minimum, name)
    is_along = np.argmax(np.abs(theta)) == len(theta) - 1  # the cup, as the length is
    moved = moved_between((search, minimum), (freed.search, freed.minimum))
    others = outlying(freed.search, freed.minimum, given, count - 1) if count > 1 else ()
    search.restore(minimum)
    return (_finding(freed, theta, std)._replace(
        moved=moved, instead=SIMILAR.get(name, '') if is_along else '',
        certain=minimum.squares < MAX_NOISE_CHI2 * minimum.residual_count), *others)


def _structured(search: Search, minimum: Minimum) -> '_Freed':
    """Return the search with the smallest structure that explains what the largest one does."""
    larger = [each for each in STRUCTURES.values()
              if each.size > search.structure.size and each.contains(search.structure)]
    left = list[float]()
    for structure in (search.structure, *larger):
        for segment in search.segments:
            segment.reset()
        left.append(search.with_free(search.start, {}, structure=structure).approach().squares)
    before, *after = left
    most = max(before - SAME_FALL * (before - min(after)), min(after))
    best = min((each for each, squares in zip(larger, after, strict=True) if squares <= most),
               key=attrgetter('size'))
    return _freed(search, minimum, 'couplings', True, best)


def _coupled(search: Search, minimum: Minimum, given: Free) -> Finding | None:
    """Return that directions are coupled, where nothing given is off then by many deviations."""
    structure = next((each for each in STRUCTURES.values() if each.couples and (
        each.size > search.structure.size)), search.structure)
    if search.structure.couples or search.structure.places or not (
            search.places.keys() & given.keys()):
        return None
    freed = _freed(search, minimum, 'couplings', True, structure)
    if not freed.search.fits(freed.minimum) or (
            is_off(freed.search, freed.minimum, given)):
        return None
    return Finding('structure', freed.search.structure.name, datum=False)


def _with_likeliest_slip(search: Search, minimum: Minimum) -> tuple[Search, float]:
    """Return a search with the likeliest moment of a slip, and by how much the squares fall."""
    tried = dict[int, tuple[Search, float]]()

    def fall(slip_ns: int) -> float:
        if slip_ns not in tried:
            with_slip = copy(search)
            with_slip.slip_ns = slip_ns
            tried[slip_ns] = with_slip, float(np.nan_to_num(
                scores(with_slip, minimum, ['slip'])['slip'], posinf=0.0))
        return tried[slip_ns][1]

    ends = [segment.path.stamps_ns[[0, -1]].tolist() for segment in search.segments]
    period = max(round(SLIP_PERIOD * NS_PER_S),
                 sum(last - first for first, last in ends) // MAX_SLIPS)
    moments = [stamp for first, last in ends for stamp in range(first + period, last, period)]
    margin = period // 2  # nearer to an end a slip is a centre of mass elsewhere
    while moments and period > MIN_SLIP_PERIOD * NS_PER_S:
        best = max(moments, key=fall)
        period //= 2
        moments = [stamp for stamp in (best - period, best, best + period) if any(
            first + margin <= stamp <= last - margin for first, last in ends)]
    return tried[best] if tried else (search, 0.0)


def _finding(freed: '_Freed', theta: Array, std: Array) -> Finding:
    """Return what is reported of a quantity that was freed."""
    name = freed.name
    if name == 'slip':
        best = int(np.argmax(np.abs(theta) / std)) // 2 * 2  # of the recording in which it is
        first_ns = next(segment.package.stamps_ns[0] for segment in freed.search.segments
                        if segment.measured.recording == best // 2)
        since = (freed.search.slip_ns - first_ns) / NS_PER_S
        return Finding('slip', '', np.append(theta[best:best + 2], since),
                       np.append(std[best:best + 2], MIN_SLIP_PERIOD))
    if name == 'mass':  # K and P scaled with mass and inertia make the same motion
        return Finding('inertia', '', -theta, std)
    if name == 'gravity':
        return Finding('gravity.direction', '', theta, std)
    if name == 'tool_marker':
        return Finding('package_marker', 'tool', theta, std)
    if name == 'couplings':
        return Finding('structure', freed.search.structure.name, datum=False)
    if name not in quantities.OF_CUP:
        return Finding(name, '', theta, std)
    best = int(np.argmax(np.abs(theta) / std))  # the entry of K that shows it best is enough
    reach = max(part.reach[best] for part in freed.minimum.parts) if name == 'cubic' else 1.0
    return Finding(name, f'K {AXES[best]}', reach**2 * theta[[best]], reach**2 * std[[best]],
                   datum=False)


def _other_frame(search: Search, minimum: Minimum, rival: float) -> Finding | None:
    """
    Return that poses of the lip are those of the centre of mass, or vice versa, where it is so.

    The centre of mass is freed as well, since it is only approximately there. None if a rival,
    which has more numbers, explains more, or if the marker may be as far off.
    """
    measured = search.segments[0].measured
    if 'package_marker' in search.places:
        place = search.places['package_marker'][0, :3]
        if np.min(search.weights[place] / search.units[place] ** 2) < 1.0 / np.sum(
                np.square(measured.payload.com)):
            return None
    is_lip = all(measured.moves_with_com)
    other, sign = copy(search), -1.0 if is_lip else 1.0
    other.segments = [Segment(replace(
        segment.measured, moves_with_com=(not is_lip,) * 3, package=replace(
            segment.measured.package, position=segment.measured.package.position + sign * apply(
                segment.measured.package.rotation, segment.measured.payload.com))))
        for segment in search.segments]
    start = other.minimum()
    if not start.converged:
        return None
    with_com = _freed(other, start, 'com')
    left = np.linalg.norm(with_com.search.estimate(with_com.minimum, 'com')[0])
    if not with_com.minimum.converged or left > MAX_EXCHANGE_REST * np.linalg.norm(
            measured.payload.com) or (
            _gain((search, minimum), with_com[1:3]) < rival - SIGNIFICANT**2):
        return None
    return Finding('recording.package_frame', 'com' if is_lip else 'lip',
                   left=with_com.left(minimum))


def _estimate(freed: '_Freed') -> tuple[Array, Array]:
    """Return what was freed, with its standard errors; for couplings in those of a number."""
    if freed.name != 'couplings':
        return freed.search.estimate(freed.minimum, freed.name)
    mean = max(freed.gain, 0.0) / quantities.KINDS['couplings'].size
    return np.sqrt([mean]), np.ones(1)


class _Freed(NamedTuple):
    """A search with one quantity more, where it ended, and by how much squares fall."""

    name: str
    search: Search
    minimum: Minimum
    gain: float

    def left(self, before: Minimum) -> float:
        """Return the RMS of the differences over that before, 1 mm as much as 10 mrad."""
        now, then = (np.sum(np.median(minimum.residuals**2, axis=0) / SQUARED_UNITS)
                     for minimum in (self.minimum, before))
        return float(np.sqrt(now / then))


def _freed(
    search: Search, minimum: Minimum, name: str, from_start: bool = False,
    structure: Structure | None = None,
) -> _Freed:
    """Return the search from a minimum or its start with one quantity more, and its gain."""
    search.restore(minimum)
    theta = search.start if from_start else minimum.theta
    wide = search.with_free(
        theta, quantities.weak_prior([name] * (structure is None)), structure=structure)
    if from_start:
        for segment in search.segments:
            segment.reset()
    again = wide.minimum(near=None if from_start else wide.transferred(search, theta))
    gain = _gain((search, minimum), (wide, again), name == 'slip')
    return _Freed(name, wide, again, gain)


def _gain(
    before: tuple[Search, Minimum], after: tuple[Search, Minimum], of_poses: bool = False
) -> float:
    """
    Return by how much squares fall, with those of what was given, from one end to another.

    For slow poses, whose noise is estimated, deviances are compared. For a slip, those of the
    poses alone: soon after the beginning it is a centre of mass elsewhere, whose squares it would
    share.
    """
    is_slow = any(segment.is_slow for segment in before[0].segments)

    def left(search: Search, minimum: Minimum) -> float:
        """Return the squares or the deviance, and the squares of what was given."""
        given = 0.0 if of_poses else float(search.weights @ minimum.theta**2)
        if not is_slow:
            return minimum.squares + given
        return deviance(minimum.parts) * after[1].residual_count / minimum.residual_count + given

    return left(*before) - left(*after)


def scores(search: Search, minimum: Minimum, names: Sequence[str]) -> dict[str, float]:
    """Return by how much the squares would fall with each quantity free."""
    wide = search.with_free(minimum.theta, quantities.weak_prior(names))
    _, H, g = wide.system(wide.transferred(search, minimum.theta))
    base = np.arange(len(search.units))
    gain = np.linalg.solve(H[np.ix_(base, base)], np.column_stack([H[base], g[base]]))
    decreases = dict[str, float]()
    for name in names:
        place = wide.places[name].ravel()
        S = H[np.ix_(place, place)] - H[np.ix_(place, base)] @ gain[:, place]
        slope = g[place] - H[np.ix_(place, base)] @ gain[:, -1]
        decreases[name] = float(slope @ np.linalg.solve(S, slope))
    return decreases


def moved_between(*ends: tuple[Search, Minimum]) -> float:
    """Return the largest part by which the diagonal of K moves from one minimum to another."""
    first, second = (np.diag(search.cup(minimum.theta).stiffness) for search, minimum in ends)
    return float(np.max(np.abs(second / first - 1.0)))
