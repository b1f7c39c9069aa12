"""
Candidates for the cause of a misfit: quantities that may be freed, and how much each explains.

Each of `CANDIDATES` gets its columns in one pass about the minimum; its score is the fall of chi²
with the candidate free. A candidate with a high score is freed in a new fit. The open alternative,
"something else", is an unknown white force on the package, beyond all candidates. Discrete
settings (worlds, axes, exchanged packages) are each tested by a search.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
import math
from operator import itemgetter
from statistics import NormalDist
import time
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification import quantities
from bellows_ros.core.identification.causes import DISTINCT, Finding
from bellows_ros.core.identification.problem import Problem
from bellows_ros.core.identification.quantities import Free, of_fixed_frame
from bellows_ros.core.identification.search import (
    approach,
    evaluated,
    median,
    minimise,
    no_report,
    Report,
    settled,
    Solution,
    squared_residuals,
)
from bellows_ros.core.identification.segments import (
    MeasuredSegment,
    Outline,
    outline_of,
    Segments,
)
from bellows_ros.core.model.cup_package import Cup, gravity_vector, Package
from bellows_ros.core.recording.alignment import levelling, R_WORLD_MOTIVE
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

SIGNIFICANT = 6.0
"""Distance of a significant change from zero, standard errors."""

CANDIDATES = ('time_offset', 'clock_rate', 'com', 'length', 'length_drift', 'mass', 'gravity',
              'package_world', 'scale', 'package_marker', 'tool_marker')
"""Candidates for the cause of a misfit, without slips; see `with_likeliest_slip`."""

MARKERS = ('package_marker', 'tool_marker')
"""Two marker frames that one recording can hardly distinguish."""

FALSE_ALARMS = 1e-3
"""False-alarm rate of the largest deviation of a fit's given quantities, per fit."""

MAX_RATIO_PULL = 3.0
"""Largest deviation of the ratio of inertia and mass, standard deviations."""

MIN_KNOWN = 0.01
"""Smallest relative reduction of a given variance by the recordings for a test of the
deviation."""

SLIP_PERIOD = 1.0
"""Time between the first tried instants of a slip, s."""

MIN_SLIP_PERIOD = 0.03
"""Resolution of the instant of a slip, s."""

MAX_SLIPS = 30
"""Largest number of first tried instants of a slip, each with a simulation."""

UNKNOWN_FORCES = (3.0, 10.0, 30.0)
"""Forgetting rates of the model under an unknown white force, 1/s; the likeliest is used."""

SQUARED_UNITS = [1.0, 1.0, 1.0, 0.01, 0.01, 0.01]
"""Squared units of shifts (m) and rotations (rad) in comparisons of poses."""


class OutOfTime(Exception):
    """End of the time of a diagnosis; the arguments are candidates not yet tried."""


def within(seconds: float, clock: Callable[[], float] = time.process_time) -> Report:
    """Return a callback that ends a diagnosis after some time (s) of a clock."""
    end = clock() + seconds

    def report(cup: Cup, chi2: float) -> None:
        if clock() > end:
            raise OutOfTime

    return report


def is_explained(found: Solution, given: Free) -> bool:
    """Return whether a minimum, with given quantities free, leaves no misfit."""
    names = [name for name in candidates_of(found.problem) if not (
        # small deviations count for both
        name in MARKERS and found.problem.places.keys() & set(MARKERS))]
    return found.fits and not is_off(found, given) and (
        max(scores(found, names).values()) < SIGNIFICANT**2)


def candidates_of(problem: Problem, without: Sequence[str] = ()) -> list[str]:
    """Return the candidates that are not free; no marker if another marker is free."""
    taken = {*problem.places, *without}
    for name in problem.places.keys() & set(MARKERS):
        kind = quantities.KINDS[name]
        if np.all(problem.weights[problem.places[name]] * (kind.prior_std / kind.unit) ** 2 < 2.0):
            taken.update(MARKERS)
    return [name for name in CANDIDATES if name not in taken]


def is_off(found: Solution, given: Free) -> bool:
    """Return whether a given quantity deviates by more than allowed."""
    return max(pulls(found, given).values(), default=0.0) > 1.0


def pulls(found: Solution, given: Free) -> dict[str, float]:
    """
    Return the deviations of given quantities by name, relative to the largest by chance.

    For mass and inertia only the ratio is observable.
    """
    problem, sizes = found.problem, dict[str, float]()
    information = found.information.plus(-problem.fixing)

    def pull(value: Array, prior: Array, variance: Array) -> float:
        """Return the largest deviation of values, by their variances before and after the fit."""
        return float(np.max(np.abs(value) / np.sqrt(
            prior * np.maximum(1.0 - variance / prior, MIN_KNOWN))))

    places = {name: problem.places[name].ravel()
              for name in problem.places.keys() & given.keys() - {'mass', 'inertia'}}
    limit = largest_by_chance(sum(place.size for place in places.values()))
    for name, place in places.items():
        sizes[name] = pull(found.theta[place], 1.0 / problem.weights[place],
                           information.variances[place]) / limit
    if {'mass', 'inertia'} <= problem.places.keys() & given.keys():
        ratio = np.zeros(problem.shared)
        for name, part in (('mass', -1.0), ('inertia', 1.0 / 3.0)):
            place = problem.places[name].ravel()
            ratio[place] = part * problem.units[place]
        weights = np.where(ratio != 0.0, problem.weights[:len(ratio)], 1.0)
        sizes['mass'] = pull(
            ratio @ found.theta[:len(ratio)], np.asarray(np.sum(ratio**2 / weights)),
            ratio @ information.covariance @ ratio) / MAX_RATIO_PULL
    return sizes


def largest_by_chance(count: int) -> float:
    """Return the largest of a number of deviations by chance, standard deviations."""
    return -NormalDist().inv_cdf(0.5 * FALSE_ALARMS / max(count, 1))


class Alternative(NamedTuple):
    """A solution with one additional free quantity, and its fall of chi²."""

    name: str
    found: Solution
    gain: float

    def left(self, before: Solution) -> float:
        """Return the ratio of the RMS residuals of two solutions; 1 mm counts as 10 mrad."""
        now, then = (np.sum(median(squared_residuals, found.parts) / SQUARED_UNITS)
                     for found in (self.found, before))
        return float(np.sqrt(now / then))


def freed(
    before: Solution, name: str, from_start: bool = False, report: Report = no_report
) -> Alternative:
    """Return the solution near another, or from its start, with one more free quantity."""
    problem, more = before.problem, quantities.weak_prior([name])
    found = minimise(problem.freed(problem.start, more), report) if from_start else settled(
        before.freed(more), report)
    return Alternative(name, found, beyond_chance(
        found.problem, name, gain_of(before, found, name == 'slip')))


def beyond_chance(problem: Problem, name: str, fall: float) -> float:
    """
    Return a fall of chi² as if one recording alone had the quantity.

    By chance chi² falls by the number of free numbers, with a root that varies by 0.7. A slip is
    in one recording only.
    """
    places = problem.places[name]
    others = places.size - places.shape[1]
    if name == 'slip' or not others or not fall > 0.0:
        return fall
    return max(math.sqrt(fall) - math.sqrt(others), 0.0) ** 2


def gain_of(before: Solution, after: Solution, of_poses: bool = False) -> float:
    """
    Return the fall of chi², with the given quantities' priors, between two solutions.

    For slow poses, with estimated noise, deviances are compared. For a slip, chi² of the poses
    alone is compared: near the beginning a slip resembles a com offset, whose prior would share
    its cost.
    """
    def left(found: Solution) -> float:
        """Return chi² or the deviance, and the chi² of the given quantities."""
        given = 0.0 if of_poses else float(found.problem.weights @ found.theta**2)
        if not before.problem.is_slow:
            return found.squares + given
        return found.deviance * after.residual_count / found.residual_count + given

    return left(before) - left(after)


def scores(found: Solution, names: Sequence[str]) -> dict[str, float]:
    """Return the fall of chi² with each quantity free, to first order."""
    near = found.freed(quantities.weak_prior(names))
    wide, H, g = near.problem, near.information, near.slope
    tested = {name: np.isin(np.arange(len(g)), wide.places[name]) for name in names}
    base = ~np.any(list(tested.values()), axis=0)
    return {name: beyond_chance(wide, name, H.fall(g, base | own) - H.fall(g, base))
            for name, own in tested.items()}


def with_likeliest_slip(
    found: Solution, report: Report = no_report
) -> tuple[Solution, float]:
    """Return a solution with the likeliest instant of a slip, and its fall of chi²."""
    tried = dict[int, tuple[Solution, float]]()

    def fall(slip_ns: int) -> float:
        if slip_ns not in tried:
            report(found.cup, 0.0)
            with_slip = replace(found, problem=replace(found.problem, slip_ns=slip_ns))
            tried[slip_ns] = with_slip, float(np.nan_to_num(
                scores(with_slip, ['slip'])['slip'], posinf=0.0))
        return tried[slip_ns][1]

    ends = [pair for outline in found.problem.outlines for pair in outline.ends_ns]
    period = max(round(SLIP_PERIOD * NS_PER_S),
                 sum(last - first for first, last in ends) // MAX_SLIPS)
    moments = [stamp for first, last in ends for stamp in range(first + period, last, period)]
    margin = period // 2  # near the ends a slip resembles a com offset
    while moments and period > MIN_SLIP_PERIOD * NS_PER_S:
        best = max(moments, key=fall)
        period //= 2
        moments = [stamp for stamp in (best - period, best, best + period) if any(
            first + margin <= stamp <= last - margin for first, last in ends)]
    return tried[best] if tried else (found, 0.0)


def deviance_of_unknown_force(found: Solution) -> float:
    """Return the smallest deviance with an unknown force on the package and fixed K and P."""
    deviances = [np.inf]
    for rate in UNKNOWN_FORCES:
        with suppress(BellowsError):
            deviances.append(evaluated(
                replace(found.problem, forgetting=rate), found.theta, found.courses).deviance)
    return float(np.nanmin(deviances))


def moved_between(first: Solution, second: Solution) -> float:
    """Return the largest relative change of the diagonal of K between two solutions."""
    return float(np.max(np.abs(
        np.diag(second.cup.stiffness) / np.diag(first.cup.stiffness) - 1.0)))


ROTATIONS = (90, 180, -90)
"""Rotations about z of a wrongly mounted frame, degrees."""

Setting = tuple[Finding, Callable[[MeasuredSegment], MeasuredSegment]]
"""A setting, and a part of a recording with it."""


def settings_of(outlines: Sequence[Outline]) -> Iterator[Setting]:
    """Yield the other settings of recordings of one cup."""
    for value, R in _worlds(outlines[0].world):
        yield Finding('recording.world', value), partial(_in_world, R)
    for degrees in ROTATIONS:
        phi = np.array([0.0, 0.0, -np.radians(degrees)])
        yield Finding('yaw', f'tool {degrees}'), partial(_with_tool_turned, phi)
        yield Finding('yaw', f'package {degrees}'), partial(_with_package_turned, phi)
    packages = list({each.payload.mass: each.payload for each in outlines}.values())
    if len(packages) == 2:
        yield Finding('package.files', 'exchanged'), partial(_exchanged, packages)


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


def likeliest_setting(near: Solution, cup: Cup, report: Report = no_report) -> Finding | None:
    """
    Return the other setting with which recordings fit to the noise, or None.

    Settings are ranked by the segment of each package with the largest chi², each with one
    approach; the best is fitted to all segments. If two frames cannot be distinguished, the
    finding names both.

    Parameters
    ----------
    near : Solution
        Solution with the given settings, with a misfit.
    cup : Cup
        First guess of each search.
    report : callable
        Called after each step; see `within`.

    """
    problem = near.problem
    problem = problem.freed(problem.unknowns(cup), {})
    squares = [np.sum(sums.squares, axis=1) for sums in near.sums]
    order = sorted(range(len(squares)), key=lambda number: float(np.max(squares[number])))
    numbers = list({problem.outlines[number].payload.mass: number for number in order}.values())
    pool = problem.held.pool.only(numbers)
    worst = problem.with_segments(*pool.hold(
        _segment, pool.each([int(np.argmax(squares[number])) for number in numbers]),
        problem.held))
    ends = list[tuple[float, Finding]]()
    for finding, change in [(Finding('', ''), None), *settings_of(worst.outlines)]:
        with suppress(BellowsError, OutOfTime):  # no cup explains this setting
            near = approach(
                worst.changed(change) if change else worst, report, with_couplings=False)
            ends.append((near.squares, finding))
    least, likeliest = min(ends, key=itemgetter(0), default=(0.0, Finding('', '')))
    other = next((change for finding, change in settings_of(problem.outlines)
                  if finding[:2] == likeliest[:2]), None)
    if not other or not minimise(problem.changed(other)).fits:
        return None
    (before, _), *_ = ends
    instead = [finding.value for squares, finding in ends if finding is not likeliest and (
        finding.name == likeliest.name == 'yaw' and DISTINCT * squares < least)]
    return likeliest._replace(
        left=float(np.sqrt(least / before)), instead=next(iter(instead), ''))


def _segment(place: int, segments: Segments) -> tuple[Segments, Outline]:
    """Return one of a recording's segments, and its outline."""
    chosen = segments[place:place + 1]
    return chosen, outline_of(chosen)
