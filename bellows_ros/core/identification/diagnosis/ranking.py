"""
The likeliest cause of a misfit: one decision on the candidates that were freed.

A cause is certain only if the recordings fit to the noise with it, it beats the open alternative
"something else" (an unknown force on the package), and every rival reduces chi² by less than half
as much, or by significantly less. Otherwise the cause is unknown: the residual is described by
its axis, time span and frequency band, and the two likeliest candidates follow without a claim.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from operator import attrgetter

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.identification import quantities
from bellows_ros.core.identification.causes import DISTINCT, Finding, MATERIAL
from bellows_ros.core.identification.diagnosis import candidates
from bellows_ros.core.identification.diagnosis.candidates import (
    freed,
    FreedSearch,
    MARKERS,
    MIN_SLIP_PERIOD,
    moved_between,
    pulls,
    SIGNIFICANT,
)
from bellows_ros.core.identification.given import stated
from bellows_ros.core.identification.quantities import Free
from bellows_ros.core.identification.search import (
    deviance,
    MAX_NOISE_CHI2,
    Minimum,
    MISFIT_CHI2,
    Search,
)
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.signals.residuals import AXES, spectrum
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

MIN_SHIFT = 0.02
"""Smallest relative change of an entry of K by a cause that does not halve the residuals."""

MIN_EXCHANGE_SHIFT = 0.5
"""Smallest shift of the lip by exchanged frames, in the distance from lip to centre of mass."""

MAX_EXCHANGE_REST = 0.2
"""Largest deviation of the com after exchanged frames, in the distance from lip to com."""

MAX_TRIED = 2
"""Number of candidates that are freed if the first explains less than twice as much."""

MAX_SEARCHES = 4
"""Largest number of candidates that are freed if searches do not converge."""

PRICE = 0.02
"""Share of the fall of chi² that each number of a candidate costs."""

MIN_LENGTH_ERROR = 2e-3
"""
Smallest error of the cup's length that makes a cup implausible, m.

With too short a length the weight seems to stretch the cup: K z is far too small, and large
damping keeps such a cup from swinging. Smaller errors are estimated jointly with K and P.
"""

OF_LIP = ('com', 'length', 'package_marker')
"""Quantities that seem wrong if poses of the lip are taken for poses of the centre of mass."""

WORLDS = ('package_world',)
"""Causes of non-convergence without a gradient at the last iterate."""

ALIKE: Mapping[str, str] = {
    'com': 'length', 'length': 'com', 'package_marker': 'tool_marker',
    'tool_marker': 'package_marker', 'gravity': 'force'}
"""Candidates that one recording can hardly tell apart."""

EVENTS = ('slip', 'length_drift', 'clock_rate')
"""Causes that are named however little they change K."""

REPORTED: Mapping[str, str] = {
    'mass': 'inertia', 'gravity': 'gravity.direction', 'tool_marker': 'package_marker'}
"""Names of findings that are not the names of their candidates."""

BAND = 0.8
"""Share of the residual's power within the reported frequency band."""

BLOCK_S = 1.0
"""Resolution of the reported time span, s."""


def rank(ends: Mapping[Search, Minimum], given_std: Free) -> tuple[Finding, ...]:
    """
    Return the cause of a misfit, or an unknown cause with its likeliest candidates, or nothing.

    Parameters
    ----------
    ends : mapping
        Ends of a search, first with given quantities free, then as given. The first end with a
        certain cause decides. No end after one that fits to the noise counts: with fewer free
        quantities small errors of given quantities would seem to be causes.
    given_std : mapping
        Standard deviations of the given quantities, SI units.

    """
    search, minimum = next(iter(ends.items()))
    if candidates.is_explained(search, minimum, given_std):
        return ()
    likely, unexplained = tuple[Finding, ...](), tuple[Finding, ...]()
    for search, minimum in ends.items():
        if likely and not search.is_plausible(minimum):
            break
        search.restore(minimum)
        for test in (_causes, deviating):
            found = test(search, minimum, given_std)
            if any(finding.certain for finding in found):
                return found
            likely = likely or found
        if search.fits(minimum):
            break
        unexplained = unexplained or (unknown(search, minimum),)
    return likely or unexplained


def _causes(search: Search, minimum: Minimum, given_std: Free) -> tuple[Finding, ...]:
    """Return the cause at one end of a search."""
    if wrong := _wrong_length(search, minimum):
        return (wrong,)
    is_off = candidates.is_off(search, minimum, given_std)
    falls = candidates.scores(
        search, minimum, candidates.candidates_of(search, stated(given_std)))
    falls = {name: fall for name, fall in falls.items() if np.isfinite(fall)}
    if 'slip' not in search.places and (not minimum.converged or is_off or max(
            falls.values(), default=0.0) > SIGNIFICANT**2):  # a slip moves the com, too
        search, falls['slip'] = candidates.with_likeliest_slip(search, minimum)
    if max(falls.values(), default=0.0) < SIGNIFICANT**2:
        return ()
    tried = _tried(search, minimum, dict(sorted(falls.items(), key=_priced, reverse=True)))
    best = max(tried, key=lambda one: _priced((one.name, one.gain)))
    if best.gain < SIGNIFICANT**2:
        return ()
    if is_off and (found := deviating(search, minimum, given_std, best.gain)):
        return found
    if frame := _frame_instead(search, minimum, tried, best):
        return (frame,)
    search.restore(minimum)
    unknown_force = candidates.deviance_of_unknown_force(search, minimum)
    best.search.restore(best.minimum)
    theta, std = best.search.estimate(best.minimum, best.name)
    if np.max(np.abs(theta) / std) ** 2 < SIGNIFICANT**2 * best.minimum.colour:
        return ()
    return _decided(search, minimum, best, falls | {one.name: one.gain for one in tried},
                    unknown_force, given_std, is_off)


def _decided(
    search: Search, minimum: Minimum, best: FreedSearch, gains: Mapping[str, float],
    unknown_force: float, given_std: Free, is_off: bool,
) -> tuple[Finding, ...]:
    """Return the best candidate if it is certain, otherwise an unknown cause before it."""
    theta, std = best.search.estimate(best.minimum, best.name)
    moved = moved_between((search, minimum), (best.search, best.minimum))
    alike = ALIKE.get(best.name, '')
    clear = SIGNIFICANT**2 * quantities.KINDS['com'].size
    instead = alike if best.name == 'gravity' or best.name not in MARKERS and (
        gains.get(alike, 0.0) > best.gain - clear) else ''
    rivals = {name: gain for name, gain in gains.items() if name not in (best.name, alike)}
    rival = max(rivals, key=rivals.__getitem__, default='')
    expected = given_std.get('package_marker' if best.name in MARKERS else best.name)
    is_expected = expected is not None and bool(
        np.all(np.abs(theta.reshape(-1, len(expected))) <= 3.0 * expected))
    left, after = best.left(minimum), best.minimum
    is_material = best.name in EVENTS or moved > MIN_SHIFT or left < DISTINCT or (
        is_off and not candidates.is_off(best.search, after, given_std))
    certain = bool(
        after.converged and after.robust_chi2 < MAX_NOISE_CHI2
        and after.squares < MISFIT_CHI2 * after.residual_count
        and deviance(after.parts) < unknown_force
        and is_material and not is_expected
        and rivals.get(rival, 0.0) < max(
            DISTINCT * best.gain, best.gain - SIGNIFICANT**2 * after.colour))
    finding = _finding(best, theta, std)._replace(
        left=left, moved=moved, certain=certain, instead=instead,
        datum=best.name not in EVENTS[1:] or moved > MATERIAL)
    if certain or search.fits(minimum):
        return (finding,)
    second = (Finding(REPORTED.get(rival, rival), '', certain=False),) if (
        rivals.get(rival, 0.0) > max(DISTINCT * best.gain, SIGNIFICANT**2)) else ()
    return unknown(search, minimum), finding, *second


def unknown(search: Search, minimum: Minimum) -> Finding:
    """Return where the residual is largest: its axis, time span (s) and frequency band (Hz)."""
    innovations = [part.innovations.reshape(-1, 6) for part in minimum.parts]
    axis = int(np.argmax(np.mean(np.square(np.vstack(innovations)), axis=0)))
    number = int(np.argmax([np.mean(part[:, axis] ** 2) for part in innovations]))
    segment, values = search.segments[number], innovations[number][:, axis]
    size = max(round(BLOCK_S / segment.period), 1)
    powers = np.add.reduceat(values**2, np.arange(0, len(values), size))
    order = np.argsort(powers)[::-1]
    kept = order[:1 + int(np.searchsorted(np.cumsum(powers[order]), 0.5 * powers.sum()))]
    since = segment.package.stamps_ns[0] - min(
        other.package.stamps_ns[0] for other in search.segments
        if other.measured.recording == segment.measured.recording)
    low, high = spectrum(
        np.repeat(minimum.parts[number].residuals[:, axis:axis + 1], 6, axis=1),
        1.0 / segment.period).band(BAND)
    return Finding('unknown', AXES[axis], np.array([
        since / NS_PER_S + kept.min() * BLOCK_S,
        since / NS_PER_S + min((kept.max() + 1) * BLOCK_S, len(values) * segment.period),
        low[0], high[0]]), np.zeros(4), certain=False, datum=False)


def _priced(fall: tuple[str, float]) -> float:
    """Return a fall of chi² less the price of the candidate's numbers."""
    return (1.0 - PRICE * quantities.KINDS[fall[0]].size) * fall[1]


def _tried(search: Search, minimum: Minimum, falls: Mapping[str, float]) -> list[FreedSearch]:
    """
    Return the freed candidates, the highest score first.

    A second one is freed if it explains at least half as much, the next if searches do not
    converge. Scores about an implausible cup mean little: worlds are tried then, from the start.
    """
    tried, least = list[FreedSearch](), DISTINCT * max(falls.values())
    is_plausible = search.is_plausible(minimum)
    names = list(falls)[:MAX_SEARCHES] if is_plausible else dict.fromkeys(
        [*list(falls)[:MAX_TRIED], *(name for name in WORLDS if name in falls)])
    for name in names:
        settled = [one for one in tried if one.minimum.converged]
        if is_plausible and settled and (falls[name] < least or len(settled) == MAX_TRIED):
            break
        if is_plausible and name != 'slip':
            tried.append(freed(search, minimum, name))
        if not (tried and tried[-1].name == name and tried[-1].minimum.converged):
            tried.append(freed(search, minimum, name, from_start=True))
    return tried


def _frame_instead(
    search: Search, minimum: Minimum, tried: Sequence[FreedSearch], best: FreedSearch
) -> Finding | None:
    """Return exchanged frames if a shift of the lip is as large as its distance from the com."""
    shifts = [one.search.estimate(one.minimum, one.name)[0]
              for one in tried if one.name in OF_LIP] + [
        (search.units * minimum.theta)[search.places[name].ravel()]
        for name in OF_LIP if name in search.places]
    if not any(_is_as_far_as_com(search, shift[:3]) for shift in shifts):
        return None
    frame = _other_frame(search, minimum, best.gain)
    search.restore(minimum)
    return frame


def _wrong_length(search: Search, minimum: Minimum) -> Finding | None:
    """Return another length that explains an implausible cup, if one does."""
    explains = minimum.converged and minimum.squares < MISFIT_CHI2 * minimum.residual_count
    if not explains or 'length' in search.places or search.is_plausible(minimum):
        return None
    damping = search.largest_damping(minimum.theta)
    one = freed(search, minimum, 'length', from_start=True)
    search.restore(minimum)
    theta, std = one.search.estimate(one.minimum, 'length')
    if one.gain < -SIGNIFICANT**2 or abs(theta[0]) < max(
            SIGNIFICANT * std[0], MIN_LENGTH_ERROR) or (
            one.search.largest_damping(one.minimum.theta) > damping):
        return None
    if _is_as_far_as_com(search, theta):
        frame = _other_frame(search, minimum, one.gain)
        search.restore(minimum)
        if frame:
            return frame
    return Finding('length', '', theta, std, one.left(minimum), moved_between(
        (search, minimum), (one.search, one.minimum)), instead='com')


def _is_as_far_as_com(search: Search, shift: Array) -> bool:
    """Return whether a shift (m) may be that from the lip to the centre of mass."""
    com = search.segments[0].measured.payload.com
    return bool(np.linalg.norm(shift) > MIN_EXCHANGE_SHIFT * np.linalg.norm(com))


def deviating(
    search: Search, minimum: Minimum, given_std: Free, least: float = -np.inf
) -> tuple[Finding, ...]:
    """
    Return the given quantity that deviates by most standard deviations, if by more than allowed.

    With all given quantities free, a fit may explain the poses by numbers that are not the given
    ones. Nothing is returned if chi² falls by less than `least` with that quantity free.
    """
    explains = minimum.converged and minimum.robust_chi2 < MISFIT_CHI2
    sizes = pulls(search, minimum, given_std)
    off = [name for name in sorted(sizes, key=sizes.__getitem__, reverse=True)[:MAX_TRIED]
           if sizes[name] > 1.0]
    if not explains or not off:
        return ()
    tried = dict.fromkeys([*off, *(ALIKE.get(name, '') for name in off)])
    best = max((freed(search, minimum, name) for name in tried if name in search.places),
               key=attrgetter('gain'))
    if best.gain < least:
        search.restore(minimum)
        return ()
    name = best.name
    if not best.minimum.converged:
        best = best._replace(search=search, minimum=minimum)
    if name in OF_LIP and (frame := _other_frame(search, minimum, best.gain)):
        search.restore(minimum)
        return (frame,)
    theta, std = best.search.estimate(best.minimum, name)
    is_along = np.argmax(np.abs(theta)) == len(theta) - 1  # the cup's axis, as a length
    moved = moved_between((search, minimum), (best.search, best.minimum))
    others_deviate = candidates.is_off(best.search, best.minimum, given_std)
    search.restore(minimum)
    return (_finding(best, theta, std)._replace(
        moved=moved, datum=name not in EVENTS[1:] or moved > MATERIAL,
        instead=ALIKE.get(name, '') if is_along and name in OF_LIP[:2] else '',
        certain=minimum.squares < MAX_NOISE_CHI2 * minimum.residual_count and not (
            others_deviate and best.search is not search)),)


def _finding(best: FreedSearch, theta: Array, std: Array) -> Finding:
    """Return the finding of a freed quantity."""
    name = best.name
    if name == 'slip':
        worst = int(np.argmax(np.abs(theta) / std)) // 2 * 2  # of the recording in which it is
        first_ns = next(segment.package.stamps_ns[0] for segment in best.search.segments
                        if segment.measured.recording == worst // 2)
        since = (best.search.slip_ns - first_ns) / NS_PER_S
        return Finding('slip', '', np.append(theta[worst:worst + 2], since),
                       np.append(std[worst:worst + 2], MIN_SLIP_PERIOD))
    if name == 'mass':  # K and P scaled with mass and inertia make the same motion
        theta = -theta
    return Finding(
        REPORTED.get(name, name), 'tool' if name == 'tool_marker' else '', theta, std)


def _other_frame(search: Search, minimum: Minimum, rival: float) -> Finding | None:
    """
    Return exchanged frames, poses of the lip for poses of the com or vice versa, or None.

    The com is freed as well. None if a rival, which has more numbers, explains more, or if the
    marker's prior allows the same shift.
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
    with_com = freed(other, start, 'com')
    left = np.linalg.norm(with_com.search.estimate(with_com.minimum, 'com')[0])
    if not with_com.minimum.converged or left > MAX_EXCHANGE_REST * np.linalg.norm(
            measured.payload.com) or (
            candidates.gain_of((search, minimum), with_com[1:3]) < rival - SIGNIFICANT**2):
        return None
    return Finding('recording.package_frame', 'com' if is_lip else 'lip',
                   left=with_com.left(minimum))
