"""
Diagnosis after a fit: up to three causes of a misfit, each with the share that it explains.

A candidate is a quantity that is not free, or one that is free within the standard deviation of
its given value. Its score is the fall of chi^2 to first order with this quantity free without a
given value. The best two are fitted. A cause is certain if with it the residuals are noise, and if
no other candidate explains half as much. Discrete settings (worlds, axes, exchanged packages) have
no derivatives: each is tried by a short search, before the fit of a large misfit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
import math
from operator import itemgetter
from statistics import NormalDist
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.identification.estimate import (
    approach,
    MAX_NOISE_CHI2,
    minimise,
    MISFIT_CHI2,
    settled,
    Solution,
)
from bellows_ros.core.identification.quantities import Free, KINDS, weak_prior
from bellows_ros.core.identification.residuals import BLOCK_DURATION, Part
from bellows_ros.core.identification.result import Cause, CHANCE, DISTINCT, MATERIAL
from bellows_ros.core.identification.segments import (
    MeasuredSegment,
    Outline,
    outline_of,
    Segments,
)
from bellows_ros.core.identification.unknowns import Problem
from bellows_ros.core.model.cup_package import Cup, gravity_vector, Package
from bellows_ros.core.recording.alignment import levelling, R_WORLD_MOTIVE
from bellows_ros.core.sensors.body import of_fixed_frame
from bellows_ros.core.signals.residuals import AXES, spectrum
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.special import fdtri

SIGNIFICANT = 6.0
"""Distance of a significant change from zero, standard errors."""

CANDIDATES = ('time_offset', 'clock_rate', 'com', 'length', 'length_drift', 'mass', 'gravity',
              'package_world', 'scale', 'package_marker', 'tool_marker')
"""Quantities that may be wrong. Slip and relaxation are tested separately, as they need longer
simulations."""

MARKERS = ('package_marker', 'tool_marker')
"""Two marker frames that one recording can hardly distinguish."""

ALIKE: Mapping[str, str] = {
    'com': 'length', 'length': 'com', 'package_marker': 'tool_marker',
    'tool_marker': 'package_marker', 'gravity': 'force', 'mass': 'inertia', 'inertia': 'mass'}
"""Candidates that one recording can hardly distinguish; only the ratio of mass and inertia is
observable."""

OF_CUP = ('length_drift', 'relaxation')
"""Causes in the cup itself, which no given value corrects."""

OF_LIP = ('com', 'length', 'package_marker')
"""Quantities that seem wrong if poses of the lip are taken for poses of the com."""

REPORTED: Mapping[str, str] = {
    'mass': 'inertia', 'gravity': 'gravity.direction', 'tool_marker': 'package_marker'}
"""Names of findings that differ from the names of their candidates."""

FALSE_ALARMS = 1e-3
"""False-alarm rate of the largest deviation of a fit's given quantities, per fit."""

MIN_KNOWN = 0.01
"""Smallest relative reduction of a given variance by the recordings with which a deviation is
tested."""

MAX_TRIED = 2
"""Largest number of candidate causes that are tested by a refit, as each refit takes seconds."""

MAX_CAUSES = 3
"""Largest number of reported causes, as many as a user tests."""

MIN_FRAME_SHIFT = 0.5
"""Smallest shift by exchanged frames, and largest remaining shift with exchanged frames, relative
to the distance from lip to com."""

MIN_SLIP_PERIOD = 0.03
"""Resolution of the instant of a slip, s."""

BAND = 0.8
"""Share of the residual's power in the reported frequency band."""


def is_explained(found: Solution, given: Free) -> bool:
    """Return whether a minimum, with given quantities free, leaves no misfit."""
    names = [name for name in candidates_of(found.problem) if not (
        # small deviations count for both
        name in MARKERS and found.problem.places.keys() & set(MARKERS))]
    return found.fits and not is_off(found, given) and (
        max(scores(found, names).values()) < SIGNIFICANT**2)


def candidates_of(problem: Problem) -> list[str]:
    """Return the candidates that are not free; no marker if another marker is free."""
    taken = {*problem.places}
    for name in problem.places.keys() & set(MARKERS):
        kind = KINDS[name]
        if np.all(problem.weights[problem.places[name]] * (kind.prior_std / kind.unit) ** 2 < 2.0):
            taken.update(MARKERS)
    return [name for name in CANDIDATES if name not in taken]


def is_off(found: Solution, given: Free) -> bool:
    """Return whether a given quantity deviates by more than chance explains."""
    return any(z > limit for z, limit in pulls(found, given).values())


def pulls(found: Solution, given: Free) -> dict[str, tuple[float, float]]:
    """
    Return the deviations of given quantities by name, standard deviations, and their limits.

    The square of a deviation is the fall of chi^2 without the given value. For mass and inertia
    only the ratio is observable.
    """
    problem = found.problem
    information = found.information

    def pull(value: Array, prior: Array, variance: Array) -> float:
        """Return the largest deviation of values, by their variances before and after the fit."""
        return float(np.max(np.abs(value) / np.sqrt(
            prior * np.maximum(1.0 - variance / prior, MIN_KNOWN))))

    places = {name: problem.places[name].ravel() for name in problem.places.keys() & given.keys()
              - {'mass', 'inertia', 'exposure'}}  # an exposure is bounded, and no cause
    moments = problem.places['inertia'].ravel() if (
        'inertia' in problem.places.keys() & given.keys()) else np.zeros(0, dtype=int)
    count = max(sum(place.size for place in places.values()) + moments.size, 1)
    limit = -NormalDist().inv_cdf(0.5 * FALSE_ALARMS / count)
    sizes = {name: (pull(found.theta[place], 1.0 / problem.weights[place],
                         information.variances[place]), limit) for name, place in places.items()}
    if moments.size:
        sizes['inertia'] = max(
            ((pull(ratio @ found.theta[:len(ratio)], np.asarray(np.sum(ratio**2 / weights)),
                   ratio @ information.covariance @ ratio), largest)
             for ratio, weights, largest in _ratios_of_inertia(problem, moments, limit)),
            key=lambda own: own[0] / own[1])
    return sizes


def _ratios_of_inertia(
    problem: Problem, moments: Places, limit: float
) -> Iterator[tuple[Array, Array, float]]:
    """Yield the mean ratio of inertia and mass and each one, as factors, weights and a limit."""
    for parts, largest in ((np.full(moments.size, 1.0 / moments.size), CHANCE), *(
            (row, limit) for row in np.eye(moments.size))):
        ratio = np.zeros(problem.shared)
        ratio[moments] = parts
        if 'mass' in problem.places:
            ratio[problem.places['mass'].ravel()] = -1.0
        yield ratio * problem.units[:problem.shared], np.where(
            ratio != 0.0, problem.weights[:problem.shared], 1.0), largest


def scores(found: Solution, names: Sequence[str]) -> dict[str, float]:
    """Return the fall of chi² with each quantity free, to first order."""
    near = found.freed(weak_prior(names))
    wide, H, g = near.problem, near.information, near.slope
    tested = {name: np.isin(np.arange(len(g)), wide.places[name]) for name in names}
    base = ~np.any(list(tested.values()), axis=0)
    falls = {name: beyond_chance(wide, name, H.fall(g, base | own) - H.fall(g, base))
             for name, own in tested.items()}
    return {name: fall for name, fall in falls.items() if math.isfinite(fall)}


def beyond_chance(problem: Problem, name: str, fall: float) -> float:
    """
    Return a fall of chi² as if one recording alone had the quantity.

    By chance chi² falls by the number of free numbers; the root of this fall has a standard
    deviation of 0.7. A slip is in one recording only.
    """
    places = problem.places[name]
    others = places.size - places.shape[1]
    if name == 'slip' or not others or not fall > 0.0:
        return fall
    return max(math.sqrt(fall) - math.sqrt(others), 0.0) ** 2


class Alternative(NamedTuple):
    """A solution with one quantity free without its given value, and its fall of chi²."""

    name: str
    found: Solution
    gain: float


def least_share(one: Alternative) -> float:
    """
    Return the share of a misfit that a free quantity explains by chance, by an F test.

    Axes and seconds count as independent, because a misfit is correlated over about one swing.
    """
    problem = one.found.problem
    count = problem.places[one.name].shape[1]
    blocks = len(AXES) * sum(last - first for outline in problem.outlines
                             for first, last in outline.ends_ns) / NS_PER_S / BLOCK_DURATION
    F = count * float(fdtri(count, max(blocks, 1.0), 1.0 - FALSE_ALARMS))
    return float(F / (F + blocks))


def freed(before: Solution, name: str) -> Alternative:
    """Return the solution with a quantity free, from the start if the cup is implausible."""
    problem, more = before.problem, weak_prior([name])
    found = settled(before.freed(more)) if before.is_plausible else before
    if not (before.is_plausible and found.converged):
        found = minimise(problem.freed(problem.start, more))
    return Alternative(name, found, beyond_chance(
        found.problem, name, before.misfit - found.misfit))


def rank(end: Solution, given_std: Free) -> tuple[Cause, ...]:
    """
    Return up to three causes of a misfit, the likeliest first, after an unknown one if none fits.

    Parameters
    ----------
    end : Solution
        End of a search.
    given_std : mapping
        Standard deviations of the given quantities, SI units.

    """
    off = {name: pair for name, pair in pulls(end, given_std).items() if pair[0] > pair[1]}
    least = {name: limit**2 for name, (_, limit) in off.items()}
    is_off_by = {name: z**2 for name, (z, _) in off.items()}
    relaxation = [] if 'relaxation' in end.problem.places else ['relaxation']
    falls = scores(end, [*candidates_of(end.problem), *relaxation]) | is_off_by
    if 'slip' not in end.problem.places and not (end.fits and is_off_by):
        end, falls['slip'] = with_likeliest_slip(end)
    names = sorted((name for name in falls if falls[name] > least.get(name, SIGNIFICANT**2)),
                   key=falls.__getitem__, reverse=True)[:MAX_TRIED]
    if not end.is_plausible:  # scores about an implausible cup are unreliable
        names = [*dict.fromkeys([*names, 'length', 'package_world'])]
    tried = sorted((freed(end, name) for name in names),
                   key=lambda one: one.gain, reverse=True)
    gains = {one.name: one.gain for one in tried}
    if gains.get('slip', math.inf) < gains.get('com', 0.0) + SIGNIFICANT**2:  # from the beginning
        tried = [one for one in tried if one.name != 'slip']
        del falls['slip']
    total = max([misfit_beyond_noise(end), 1e-9, *(one.gain for one in tried)])
    tried = [one for one in tried if one.name in least or one.gain > max(
        SIGNIFICANT**2 * max(one.found.colour, 1.0), least_share(one) * total)]
    best = tried[0] if tried else None
    frame = best and best.name in OF_LIP and _other_frame(end, best)
    if frame:
        return (frame,)
    findings = [_finding(end, one, one.gain / total, falls) for one in tried]
    rivals = falls | {one.name: one.gain for one in tried}
    if best and _is_certain(end, best, rivals, given_std):
        return (findings[0]._replace(certain=True), *findings[1:MAX_CAUSES])
    if end.fits:
        return tuple(findings[:MAX_CAUSES])
    return (unknown(end), *findings[:MAX_CAUSES])


def misfit_beyond_noise(found: Solution) -> float:
    """Return chi² beyond the expectation of noise, with the priors of given quantities."""
    return found.squares - found.residual_count + float(found.problem.weights @ found.theta**2)


def _is_certain(
    end: Solution, best: Alternative, rivals: Mapping[str, float], given_std: Free
) -> bool:
    """Return whether a cause leaves noise alone, and no other explains half as much."""
    after, alike = best.found, (best.name, ALIKE.get(best.name, ''))
    theta, std = after.estimate(best.name)
    expected = given_std.get('package_marker' if best.name in MARKERS else best.name)
    is_expected = expected is not None and bool(
        np.all(np.abs(theta.reshape(-1, len(expected))) <= 3.0 * expected))
    others = {name: std for name, std in given_std.items() if name not in alike}
    return bool(
        after.fits and after.robust_chi2 < MAX_NOISE_CHI2
        and after.squares < MISFIT_CHI2 * after.residual_count
        and not is_off(after, others) and not is_expected
        and np.max(np.abs(theta) / std) > SIGNIFICANT * math.sqrt(after.colour)
        and max((gain for name, gain in rivals.items() if name not in alike), default=0.0)
        < DISTINCT * best.gain)


def _finding(
    end: Solution, one: Alternative, share: float, falls: Mapping[str, float]
) -> Cause:
    """Return the finding of a freed quantity, without a claim."""
    name, problem = one.name, one.found.problem
    theta, std = one.found.estimate(name)
    moved = float(np.max(np.abs(
        np.diag(one.found.cup.stiffness) / np.diag(end.cup.stiffness) - 1.0)))
    alike, clear = ALIKE.get(name, ''), SIGNIFICANT**2 * KINDS['com'].size
    is_along = name in OF_LIP[:2] and np.argmax(np.abs(theta)) == len(theta) - 1
    instead = alike if name == 'gravity' or is_along and (
        alike in problem.places or falls.get(alike, 0.0) > one.gain - clear) else ''
    if name == 'slip':
        worst = int(np.argmax(np.abs(theta) / std)) // 2 * 2  # of the affected recording
        since = (problem.slip_ns - problem.outlines[worst // 2].begin_ns) / NS_PER_S
        theta = np.append(theta[worst:worst + 2], since)
        std = np.append(std[worst:worst + 2], MIN_SLIP_PERIOD)
    if name == 'mass':  # K and P scaled with mass and inertia give equal motion
        theta = -theta
    return Cause(
        REPORTED.get(name, name), 'tool' if name == 'tool_marker' else '', theta, std,
        share=min(share, 1.0), moved=moved, certain=False, instead=instead,
        datum=name not in OF_CUP and (name != 'clock_rate' or moved > MATERIAL))


def with_likeliest_slip(found: Solution) -> tuple[Solution, float]:
    """
    Return a solution with the likeliest instant of a slip, and its fall of chi².

    A slip shifts the com in all blocks from its instant on. One simulation scores each block of
    the recording with the largest misfit; bisection finds the instant near the best block.
    """
    number = int(np.argmax([
        np.sum(one.squares) / np.sum(one.counts) for one in found.sums]))
    begins = [first for first, _ in found.problem.outlines[number].ends_ns]
    shifted = replace(found, problem=replace(
        found.problem, slip_ns=min(begins))).freed(weak_prior(['slip']))
    if not shifted.is_finite:
        return found, 0.0
    index = shifted.problem.index(number)
    own = np.isin(index, shifted.problem.places['slip'])
    C = shifted.information.within(
        ~np.isin(np.arange(len(shifted.theta)), shifted.problem.places['slip'])).block(number)
    (blocks,) = shifted.problem.held.pool.results(
        _slip_scores, own, np.where(np.outer(~own, ~own), C, 0.0), shifted.parts.only([number]))
    at = [first + round(BLOCK_DURATION * NS_PER_S * k) for first, block in zip(
        begins, blocks, strict=False) for k in range(len(block))]
    best = at[int(np.argmax(np.concatenate(blocks)))]

    def scored(slip_ns: int) -> tuple[Solution, float]:
        near = replace(found, problem=replace(found.problem, slip_ns=slip_ns))
        return near, scores(near, ['slip']).get('slip', 0.0)

    chosen, period = scored(best), BLOCK_DURATION
    while period > MIN_SLIP_PERIOD:
        period *= 0.5
        chosen = max(chosen, *(scored(chosen[0].problem.slip_ns + side * round(
            period * NS_PER_S)) for side in (-1, 1)), key=itemgetter(1))
    return chosen


def _slip_scores(own: Array, C: Array, parts: Sequence[Part]) -> list[Array]:
    """Return the fall of chi² by a slip at the beginning of each block of each segment."""
    information = np.concatenate([part.information for part in parts])[::-1].cumsum(axis=0)[::-1]
    slope = np.concatenate([part.slope for part in parts])[::-1].cumsum(axis=0)[::-1]
    B = information[:, own]
    S = B[:, :, own] - B @ C @ np.swapaxes(B, 1, 2)
    g = slope[:, own, None]
    falls = np.swapaxes(g, 1, 2) @ np.linalg.solve(S + 1e-9 * np.eye(S.shape[1]), g)
    counts = np.cumsum([len(part.slope) for part in parts])[:-1]
    return np.split(falls[:, 0, 0], counts)


def unknown(end: Solution) -> Cause:
    """Return axis, time span (s) and frequency band (Hz) of the largest residual."""
    sums, held = end.sums, end.problem.held.only
    axis = int(np.argmax(sum(np.sum(one.squares, axis=0) for one in sums)))
    means = [one.squares[:, axis] / one.counts for one in sums]
    number = int(np.argmax([np.max(each) for each in means]))
    begin_ns = end.problem.outlines[number].begin_ns
    (span,) = end.parts.pool.results(
        _span, axis, int(np.argmax(means[number])), begin_ns, held([number]),
        end.parts.only([number]))
    return Cause('unknown', AXES[axis], span, np.zeros(4), share=0.0, certain=False, datum=False)


def _span(
    axis: int, place: int, begin_ns: int, segments: Segments, parts: Sequence[Part]
) -> Array:
    """Return where the residual of a segment is largest: time span (s) and band (Hz)."""
    segment, values = segments[place], parts[place].innovations.reshape(-1, 6)[:, axis]
    size = max(round(BLOCK_DURATION / segment.period), 1)
    powers = np.add.reduceat(values**2, np.arange(0, len(values), size))
    order = np.argsort(powers)[::-1]
    kept = order[:1 + int(np.searchsorted(np.cumsum(powers[order]), 0.5 * powers.sum()))]
    since = (segment.package.stamps_ns[0] - begin_ns) / NS_PER_S
    low, high = spectrum(
        np.repeat(parts[place].residuals[:, axis:axis + 1], 6, axis=1),
        1.0 / segment.period).band(BAND)
    return np.array([
        since + kept.min() * BLOCK_DURATION,
        since + min((kept.max() + 1) * BLOCK_DURATION, len(values) * segment.period),
        low[0], high[0]])


def _other_frame(end: Solution, best: Alternative) -> Cause | None:
    """
    Return exchanged frames, poses of the lip for poses of the com or vice versa, or None.

    With exchanged frames, the shift of the best candidate, or of a given quantity, is the vector
    from lip to com. The com is also freed.
    """
    problem = end.problem
    measured, com = problem.outlines[0], float(np.linalg.norm(problem.outlines[0].payload.com))
    shifts = [best.found.estimate(name)[0][:3] for name in OF_LIP
              if name in best.found.problem.places]
    if max(map(np.linalg.norm, shifts)) < MIN_FRAME_SHIFT * com and end.is_plausible:
        return None
    is_lip = all(measured.moves_with_com)
    other = minimise(problem.changed(partial(_of_frame, is_lip)))
    if not other.converged:
        return None
    with_com = freed(other, 'com')
    left = np.linalg.norm(with_com.found.estimate('com')[0])
    if not with_com.found.fits or left > MIN_FRAME_SHIFT * com or (
            end.misfit - with_com.found.misfit < best.gain - SIGNIFICANT**2):
        return None
    return Cause('recording.package_frame', 'com' if is_lip else 'lip')


def _of_frame(is_lip: bool, measured: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with exchanged frames of the package, lip and com."""
    poses, sign = measured.package, -1.0 if is_lip else 1.0
    return replace(measured, moves_with_com=(not is_lip,) * 3, package=replace(
        poses, position=poses.position + sign * apply(poses.rotation, measured.payload.com)))


ROTATIONS = (90, 180, -90)
"""Rotations about z of a wrongly mounted frame, degrees."""

Setting = tuple[Cause, Callable[[MeasuredSegment], MeasuredSegment]]
"""A setting, and the function that applies the setting to a part of a recording."""


def settings_of(outlines: Sequence[Outline]) -> Iterator[Setting]:
    """Yield the other settings of recordings of one cup."""
    for value, R in _worlds(outlines[0].world):
        yield Cause('recording.world', value), partial(_in_world, R)
    for degrees in ROTATIONS:
        phi = np.array([0.0, 0.0, -np.radians(degrees)])
        yield Cause('yaw', f'tool {degrees}'), partial(_with_tool_turned, phi)
        yield Cause('yaw', f'package {degrees}'), partial(_with_package_turned, phi)
    packages = list({each.payload.mass: each.payload for each in outlines}.values())
    if len(packages) == 2:
        yield Cause('package.files', 'exchanged'), partial(_exchanged, packages)


def _in_world(R: Array, each: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with the gravity of another world."""
    return replace(each, gravity=R.T @ gravity_vector(each.gravity))


def _with_tool_turned(phi: Array, each: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with the tool's frame turned."""
    return replace(each, tool=of_fixed_frame(each.tool, phi, np.zeros(3)))


def _with_package_turned(phi: Array, each: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with the package's frame turned about its lip."""
    com = each.payload.com
    return replace(each, package=of_fixed_frame(each.package, phi, exp_so3(phi) @ com - com))


def _exchanged(packages: Sequence[Package], each: MeasuredSegment) -> MeasuredSegment:
    """Return a part of a recording with the other one of two packages."""
    return replace(each, payload=packages[int(each.payload.mass == packages[0].mass)])


def _worlds(world: str) -> Iterator[tuple[str, Array]]:
    """Yield worlds other than the given one: values of a setting, and their rotation."""
    other, R = ('motive_y_up', R_WORLD_MOTIVE) if world == 'z_up' else ('z_up', R_WORLD_MOTIVE.T)
    yield other, R
    for down in np.concatenate([np.eye(3), -np.eye(3)[:2]]):
        if down @ R[2] > -0.5:  # direction of gravity in the other world
            yield f'gravity {down.astype(int).tolist()}', levelling(down)


def likeliest_setting(near: Solution, cup: Cup) -> Cause | None:
    """
    Return the other setting with which recordings fit to the noise, or None.

    Each setting is tried by one approach on the segment with the largest chi² of each package; the
    best setting is fitted to all segments. If two frames cannot be distinguished, the finding
    names both.
    """
    problem = near.problem.from_cup(cup)
    squares = [np.sum(sums.squares, axis=1) for sums in near.sums]
    order = sorted(range(len(squares)), key=lambda number: float(np.max(squares[number])))
    numbers = list({problem.outlines[number].payload.mass: number for number in order}.values())
    held, pool = problem.held.only(numbers), problem.held.pool
    worst = problem.with_segments(*pool.hold(
        _segment, pool.each([int(np.argmax(squares[number])) for number in numbers]), held))
    ends = [(approach(worst).squares, Cause('', ''))]
    for finding, change in settings_of(worst.outlines):
        with suppress(BellowsError):  # no cup explains this setting
            ends.append((approach(worst.changed(change)).squares, finding))
    least, likeliest = min(ends, key=itemgetter(0))
    other = next((change for finding, change in settings_of(problem.outlines)
                  if finding[:2] == likeliest[:2]), None)
    if not other or least > (1.0 - DISTINCT) * ends[0][0] or (
            not minimise(problem.changed(other)).fits):
        return None
    instead = [finding.value for squares, finding in ends if finding is not likeliest and (
        finding.name == likeliest.name == 'yaw' and DISTINCT * squares < least)]
    return likeliest._replace(share=1.0 - least / ends[0][0], instead=next(iter(instead), ''))


def _segment(place: int, segments: Segments) -> tuple[Segments, Outline]:
    """Return one of a recording's segments, and its outline."""
    chosen = segments[place:place + 1]
    return chosen, outline_of(chosen)
