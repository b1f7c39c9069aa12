"""
The likeliest cause of a misfit, from all freed candidates.

A cause is certain only if the recordings fit to the noise with it, it beats the open alternative
"something else" (an unknown force on the package), and every rival reduces chi² by less than half
as much, or by significantly less. Otherwise the cause is unknown: the residual is described by its
axis, time span and frequency band, and the two likeliest candidates follow without a claim.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.identification import quantities
from bellows_ros.core.identification.causes import DISTINCT, Finding, MATERIAL
from bellows_ros.core.identification.diagnosis import candidates
from bellows_ros.core.identification.diagnosis.candidates import (
    Alternative,
    freed,
    MARKERS,
    MIN_SLIP_PERIOD,
    moved_between,
    OutOfTime,
    pulls,
    SIGNIFICANT,
)
from bellows_ros.core.identification.problem import Problem, WhitenedSegment
from bellows_ros.core.identification.quantities import Free, stated
from bellows_ros.core.identification.search import (
    MAX_NOISE_CHI2,
    minimise,
    MISFIT_CHI2,
    no_report,
    Report,
    Solution,
)
from bellows_ros.core.identification.segments import MeasuredSegment, Segments
from bellows_ros.core.signals.residuals import AXES, spectrum
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

MIN_SHIFT = 0.02
"""Smallest relative change of an entry of K by a cause that does not halve the residuals."""

MIN_EXCHANGE_SHIFT = 0.5
"""Smallest shift of the lip by exchanged frames, relative to the distance from lip to com."""

MAX_EXCHANGE_REST = 0.2
"""Largest com offset after exchanged frames, relative to the distance from lip to com."""

MAX_TRIED = 2
"""Number of freed candidates if the first explains less than twice as much as the second."""

MAX_SEARCHES = 4
"""Largest number of freed candidates if searches do not converge."""

PRICE = 0.02
"""Penalty of a candidate per free number, as a share of its fall of chi²."""

MIN_LENGTH_ERROR = 2e-3
"""
Smallest error of the cup's length that makes a cup implausible, m.

With too short a length the weight seems to stretch the cup: K z is far too small, and large
damping suppresses its swing. Smaller errors are estimated jointly with K and P.
"""

OF_LIP = ('com', 'length', 'package_marker')
"""Quantities that seem wrong if poses of the lip are taken for poses of the com."""

WORLDS = ('package_world',)
"""Causes of non-convergence without a gradient at the last iterate."""

ALIKE: Mapping[str, str] = {
    'com': 'length', 'length': 'com', 'package_marker': 'tool_marker',
    'tool_marker': 'package_marker', 'gravity': 'force'}
"""Candidates that one recording can hardly distinguish."""

EVENTS = ('slip', 'length_drift', 'clock_rate')
"""Causes that are named irrespective of their effect on K."""

REPORTED: Mapping[str, str] = {
    'mass': 'inertia', 'gravity': 'gravity.direction', 'tool_marker': 'package_marker'}
"""Names of findings that differ from the names of their candidates."""

BAND = 0.8
"""Share of the residual's power within the reported frequency band."""

BLOCK_S = 1.0
"""Resolution of the reported time span, s."""


def rank(
    ends: Sequence[Solution], given_std: Free, report: Report = no_report
) -> tuple[Finding, ...]:
    """
    Return the cause of a misfit, or an unknown cause with its likeliest candidates, or nothing.

    Parameters
    ----------
    ends : sequence of Solution
        Ends of a search, first with given quantities free, then as given. The first end with a
        certain cause decides. Ends after one that fits to the noise are ignored: with fewer free
        quantities, small errors of given quantities would seem to be causes.
    given_std : mapping
        Standard deviations of the given quantities, SI units.
    report : callable
        Called after each step; see `candidates.within`.

    """
    likely, unexplained = tuple[Finding, ...](), tuple[Finding, ...]()
    for end in ends:
        if likely and not end.is_plausible:
            break
        for test in (_causes, deviating):
            try:
                findings = test(end, given_std, report=report)
            except OutOfTime as error:
                first, *others = likely or unexplained or (unknown(end),)
                return (first._replace(untried=error.args), *others)
            if any(finding.certain for finding in findings):
                return findings
            likely = likely or findings
        if end.fits and not candidates.is_off(end, given_std):
            break
        unexplained = unexplained or (unknown(end),)
    return likely or unexplained


def _causes(end: Solution, given_std: Free, report: Report) -> tuple[Finding, ...]:
    """Return the cause at one end of a search."""
    if wrong := _wrong_length(end, report):
        return (wrong,)
    is_off = candidates.is_off(end, given_std)
    falls = candidates.scores(
        end, candidates.candidates_of(end.problem, stated(given_std)))
    falls = {name: fall for name, fall in falls.items() if np.isfinite(fall)}
    if 'slip' not in end.problem.places and (not end.converged or is_off or max(
            falls.values(), default=0.0) > SIGNIFICANT**2):  # a slip also shifts the com
        try:
            end, falls['slip'] = candidates.with_likeliest_slip(end, report)
        except OutOfTime:
            untried = sorted(falls, key=falls.__getitem__, reverse=True)
            raise OutOfTime(*untried[:MAX_SEARCHES], 'slip') from None
    if max(falls.values(), default=0.0) < SIGNIFICANT**2:
        return ()
    tried = _tried(end, dict(sorted(falls.items(), key=_priced, reverse=True)), report)
    best = max(tried, key=lambda one: _priced((one.name, one.gain)))
    if best.gain < SIGNIFICANT**2:
        return ()
    if is_off and (
            found := deviating(end, given_std, best.gain, report)):
        return found
    if frame := _frame_instead(end, tried, best, report):
        return (frame,)
    theta, std = best.found.estimate(best.name)
    if np.max(np.abs(theta) / std) ** 2 < SIGNIFICANT**2 * best.found.colour:
        return ()
    return _decided(end, best, falls | {one.name: one.gain for one in tried}, given_std, is_off)


def _decided(
    end: Solution, best: Alternative, gains: Mapping[str, float], given_std: Free, is_off: bool
) -> tuple[Finding, ...]:
    """Return the best candidate if certain, otherwise an unknown cause before it."""
    theta, std = best.found.estimate(best.name)
    moved = moved_between(end, best.found)
    alike = ALIKE.get(best.name, '')
    clear = SIGNIFICANT**2 * quantities.KINDS['com'].size
    instead = alike if best.name == 'gravity' or best.name not in MARKERS and (
        gains.get(alike, 0.0) > best.gain - clear) else ''
    rivals = {name: gain for name, gain in gains.items() if name not in (best.name, alike)}
    rival = max(rivals, key=rivals.__getitem__, default='')
    expected = given_std.get('package_marker' if best.name in MARKERS else best.name)
    is_expected = expected is not None and bool(
        np.all(np.abs(theta.reshape(-1, len(expected))) <= 3.0 * expected))
    left, after = best.left(end), best.found
    is_material = best.name in EVENTS or moved > MIN_SHIFT or left < DISTINCT or (
        is_off and not candidates.is_off(after, given_std))
    certain = bool(
        after.fits and after.robust_chi2 < MAX_NOISE_CHI2
        and after.squares < MISFIT_CHI2 * after.residual_count
        and after.deviance < candidates.deviance_of_unknown_force(end)
        and is_material and not is_expected
        and rivals.get(rival, 0.0) < max(
            DISTINCT * best.gain, best.gain - SIGNIFICANT**2 * after.colour))
    finding = _finding(best, theta, std)._replace(
        left=left, moved=moved, certain=certain, instead=instead,
        datum=best.name not in EVENTS[1:] or moved > MATERIAL)
    if certain or end.fits:
        return (finding,)
    second = (Finding(REPORTED.get(rival, rival), '', certain=False),) if (
        rivals.get(rival, 0.0) > max(DISTINCT * best.gain, SIGNIFICANT**2)) else ()
    return unknown(end), finding, *second


def unknown(end: Solution) -> Finding:
    """Return axis, time span (s) and frequency band (Hz) of the largest residual."""
    sums, pool = end.sums, end.problem.held.pool
    axis = int(np.argmax(sum(np.sum(one.squares, axis=0) for one in sums)))
    means = [one.squares[:, axis] / one.counts for one in sums]
    number = int(np.argmax([np.max(each) for each in means]))
    begin_ns = end.problem.outlines[number].begin_ns
    (span,) = pool.only([number]).results(
        _span, axis, int(np.argmax(means[number])), begin_ns, end.problem.held, end.parts)
    return Finding('unknown', AXES[axis], span, np.zeros(4), certain=False, datum=False)


def _span(
    axis: int, place: int, begin_ns: int, segments: Segments, parts: Sequence[WhitenedSegment]
) -> Array:
    """Return where the residual of a segment is largest: time span (s) and band (Hz)."""
    segment, values = segments[place], parts[place].innovations.reshape(-1, 6)[:, axis]
    size = max(round(BLOCK_S / segment.period), 1)
    powers = np.add.reduceat(values**2, np.arange(0, len(values), size))
    order = np.argsort(powers)[::-1]
    kept = order[:1 + int(np.searchsorted(np.cumsum(powers[order]), 0.5 * powers.sum()))]
    since = (segment.package.stamps_ns[0] - begin_ns) / NS_PER_S
    low, high = spectrum(
        np.repeat(parts[place].residuals[:, axis:axis + 1], 6, axis=1),
        1.0 / segment.period).band(BAND)
    return np.array([
        since + kept.min() * BLOCK_S,
        since + min((kept.max() + 1) * BLOCK_S, len(values) * segment.period), low[0], high[0]])


def _priced(fall: tuple[str, float]) -> float:
    """Return a fall of chi² minus the penalty of the candidate's free numbers."""
    return (1.0 - PRICE * quantities.KINDS[fall[0]].size) * fall[1]


def _tried(
    end: Solution, falls: Mapping[str, float], report: Report
) -> list[Alternative]:
    """
    Return the freed candidates, the highest score first.

    A second candidate is freed if it explains at least half as much, further ones if searches do
    not converge. Scores about an implausible cup are unreliable: worlds are then tried from the
    start.
    """
    tried, least = list[Alternative](), DISTINCT * max(falls.values())
    names = list(falls)[:MAX_SEARCHES] if end.is_plausible else dict.fromkeys(
        [*list(falls)[:MAX_TRIED], *(name for name in WORLDS if name in falls)])
    for name in names:
        settled = [one for one in tried if one.found.converged]
        if end.is_plausible and settled and (falls[name] < least or len(settled) == MAX_TRIED):
            break
        try:
            if end.is_plausible and name != 'slip':
                tried.append(freed(end, name, report=report))
            if not (tried and tried[-1].name == name and tried[-1].found.converged):
                tried.append(freed(end, name, True, report))
        except OutOfTime:
            raise OutOfTime(*list(names)[list(names).index(name):]) from None
    return tried


def _frame_instead(
    end: Solution, tried: Sequence[Alternative], best: Alternative, report: Report
) -> Finding | None:
    """Return exchanged frames if the lip's shift is as large as its distance from the com."""
    problem = end.problem
    shifts = [one.found.estimate(one.name)[0] for one in tried if one.name in OF_LIP] + [
        (problem.units * end.theta)[problem.places[name].ravel()]
        for name in OF_LIP if name in problem.places]
    if not any(_is_as_far_as_com(problem, shift[:3]) for shift in shifts):
        return None
    return _other_frame(end, best.gain, report)


def _wrong_length(end: Solution, report: Report) -> Finding | None:
    """Return another cup length if it explains an implausible cup."""
    explains = end.converged and end.squares < MISFIT_CHI2 * end.residual_count
    if not explains or 'length' in end.problem.places or end.is_plausible:
        return None
    one = freed(end, 'length', True, report)
    theta, std = one.found.estimate('length')
    if one.gain < -SIGNIFICANT**2 or abs(theta[0]) < max(
            SIGNIFICANT * std[0], MIN_LENGTH_ERROR) or (
            one.found.problem.largest_damping(one.found.theta)
            > end.problem.largest_damping(end.theta)):
        return None
    if _is_as_far_as_com(end.problem, theta) and (
            frame := _other_frame(end, one.gain, report)):
        return frame
    return Finding('length', '', theta, std, one.left(end), moved_between(end, one.found),
                   instead='com')


def _is_as_far_as_com(problem: Problem, shift: Array) -> bool:
    """Return whether a shift (m) may be the vector from lip to com."""
    com = problem.outlines[0].payload.com
    return bool(np.linalg.norm(shift) > MIN_EXCHANGE_SHIFT * np.linalg.norm(com))


def deviating(
    end: Solution, given_std: Free, least: float = -np.inf, report: Report = no_report
) -> tuple[Finding, ...]:
    """
    Return the given quantity with the largest deviation, if larger than allowed.

    With all given quantities free, a fit may explain the poses with wrong values. Nothing is
    returned if chi² falls by less than `least` with this quantity free. An exposure beyond its
    standard deviation is negative or longer than the period, and no cause.
    """
    explains = end.converged and end.robust_chi2 < MISFIT_CHI2
    sizes = pulls(end, given_std)
    off = [name for name in sorted(sizes, key=sizes.__getitem__, reverse=True)[:MAX_TRIED]
           if sizes[name] > 1.0 and name != 'exposure']
    if not explains or not off:
        return ()
    tried = dict.fromkeys([*off, *(ALIKE.get(name, '') for name in off)])
    best = max((freed(end, name, report=report) for name in tried if name in end.problem.places),
               key=attrgetter('gain'))
    if best.gain < least:
        return ()
    name = best.name
    if not best.found.converged:
        best = best._replace(found=end)
    if name in OF_LIP and (frame := _other_frame(end, best.gain, report)):
        return (frame,)
    theta, std = best.found.estimate(name)
    is_along = np.argmax(np.abs(theta)) == len(theta) - 1  # along the cup's axis, like a length
    moved = moved_between(end, best.found)
    certain = end.fits and end.squares < MAX_NOISE_CHI2 * end.residual_count and not (
        best.found is not end and candidates.is_off(best.found, given_std))
    finding = _finding(best, theta, std)._replace(
        moved=moved, datum=name not in EVENTS[1:] or moved > MATERIAL, certain=certain,
        instead=ALIKE.get(name, '') if is_along and name in OF_LIP[:2] else '')
    return (finding,) if certain or end.fits else (unknown(end), finding)


def _finding(best: Alternative, theta: Array, std: Array) -> Finding:
    """Return the finding of a freed quantity."""
    name, problem = best.name, best.found.problem
    if name == 'slip':
        worst = int(np.argmax(np.abs(theta) / std)) // 2 * 2  # of the affected recording
        since = (problem.slip_ns - problem.outlines[worst // 2].begin_ns) / NS_PER_S
        return Finding('slip', '', np.append(theta[worst:worst + 2], since),
                       np.append(std[worst:worst + 2], MIN_SLIP_PERIOD))
    if name == 'mass':  # K and P scaled with mass and inertia give equal motion
        theta = -theta
    return Finding(
        REPORTED.get(name, name), 'tool' if name == 'tool_marker' else '', theta, std)


def _other_frame(end: Solution, rival: float, report: Report) -> Finding | None:
    """
    Return exchanged frames, poses of the lip for poses of the com or vice versa, or None.

    The com is freed as well. None if a rival with more free numbers explains more, or if the
    marker's prior allows the shift.
    """
    problem = end.problem
    measured = problem.outlines[0]
    if 'package_marker' in problem.places:
        place = problem.places['package_marker'][0, :3]
        if np.min(problem.weights[place] / problem.units[place] ** 2) < 1.0 / np.sum(
                np.square(measured.payload.com)):
            return None
    is_lip = all(measured.moves_with_com)
    other = minimise(problem.changed(partial(_of_frame, is_lip)), report=report)
    if not other.converged:
        return None
    with_com = freed(other, 'com', report=report)
    left = np.linalg.norm(with_com.found.estimate('com')[0])
    if not with_com.found.converged or left > MAX_EXCHANGE_REST * np.linalg.norm(
            measured.payload.com) or (
            candidates.gain_of(end, with_com.found) < rival - SIGNIFICANT**2):
        return None
    return Finding('recording.package_frame', 'com' if is_lip else 'lip',
                   left=with_com.left(end))


def _of_frame(is_lip: bool, measured: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with exchanged frames of the package, lip and com."""
    poses, sign = measured.package, -1.0 if is_lip else 1.0
    return replace(measured, moves_with_com=(not is_lip,) * 3, package=replace(
        poses, position=poses.position + sign * apply(poses.rotation, measured.payload.com)))
