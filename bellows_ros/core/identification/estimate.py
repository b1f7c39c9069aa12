"""
Search for K and P with which the model, driven by the tool, reproduces all poses.

The first stage begins at the best of several stiffnesses, and follows the measured path of the
tool, with trust regions about the unknowns. In the second stage the steps are Gauss-Newton steps,
and the path of the tool and the noise of slow poses are renewed with each: with derivatives along
the likeliest path the mean of the steps is zero at the truth, unlike the gradient of chi² along
the measured one.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification import residuals
from bellows_ros.core.identification.residuals import Part
from bellows_ros.core.identification.result import Arrow, CHANCE
from bellows_ros.core.identification.segments import Course, Held, Segments
from bellows_ros.core.identification.unknowns import Free, MIN_STRENGTH, Problem
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.sensors.corners import USUAL_NOISE
from bellows_ros.core.signals.resampling import MAD_TO_STD
from bellows_ros.errors import BellowsError
import numpy as np

DAMPING = 1e-2
"""Damping of the first step, and after a failed one: it limits poorly determined unknowns."""

NOISE_TOLERANCE = 0.03
"""Relative change of the noise of slow poses below which the noise is kept."""

MODES_HZ = 3.0, 40.0
"""Frequencies of the axial mode between which initial guesses are tried; those of bellows with a
package are 6 to 25 Hz."""

MAX_STEPS = 60, 40
"""Largest number of steps in the two stages, twice that of 7 of 8 full matrices from a diagonal
start; with a misfit the second has half as many."""

MAX_NOISE_CHI2 = 1.2
"""Largest chi^2 per difference attributed to noise, without a warning; also its largest growth in
a step, in which the weights change."""

MISFIT_CHI2 = 1.5
"""Smallest chi^2 per difference of a certain misfit."""

GROSS_CHI2 = 4.0
"""Smallest chi^2 per difference of a misfit for which no likeliest path is searched:
deviations are twice the noise."""

TOLERANCES = 3.0, 1e-2
"""Squared length of a step at the end of each stage, squared standard errors: K and P then move by
some and by 10 % of a standard error."""

LOOSE_TOLERANCE = 0.1
"""Largest squared length of the last step, as barely identifiable numbers keep oscillating, in
standard errors by the colour of the residuals, which the misfit of rubber has."""

MAX_SMALL_RISE = 1.001
"""Ratio of two Huber's sums in the first stage that are equal, as priors may raise it a little."""

MAX_STOPS = 5
"""Largest number of times that unknowns are stopped at the largest step, and the others follow."""

SHORTER = 0.25
"""Fraction of a step that is tried if chi² increases with the whole step."""

Report = Callable[[Cup, float], None]
"""Callback with the cup and chi^2 after a step."""


def no_report(cup: Cup, chi2: float) -> None:
    """Report nothing."""


Parts = tuple[Part, ...]
"""Whitened segments of one recording."""


class Sums(NamedTuple):
    """
    Sums over segments.

    Number of the differences, their squares, products of neighbours and logarithms of variances;
    squares (6,) without whitening, m^2 and rad^2.
    """

    number: int
    squares: float
    neighbours: float
    logs: float
    residuals: Array

    @classmethod
    def total(cls, sums: 'Iterable[Sums]') -> 'Sums':
        """Return the sum of sums."""
        return cls(*(sum(numbers) for numbers in zip(*sums, strict=True)))


def innovations_of(parts: Parts) -> Array:
    """Return the innovations (N, 6) of a recording."""
    return np.concatenate([part.innovations for part in parts])


@dataclass(frozen=True, eq=False)
class Solution:
    """
    Unknowns of a problem, with the differences of a simulation about courses.

    Parameters
    ----------
    problem : Problem
        Recordings and unknowns.
    theta : ndarray (m,)
        Unknowns.
    courses : Held
        Motion of the tool in each segment, and the noise of the package's poses.
    parts : Held
        Whitened segments of each recording.
    sums : sequence of Sums
        Sums over each recording.
    information, slope : Arrow, ndarray (m,)
        Information on the unknowns, and slope.
    converged : bool
        Whether it is a minimum.

    """

    problem: Problem
    theta: Array
    courses: Held
    parts: Held
    sums: Sequence[Sums]
    information: Arrow
    slope: Array
    converged: bool = False

    @property
    def is_finite(self) -> bool:
        """Whether the simulation does not diverge."""
        return bool(np.all(np.isfinite(self.slope)))

    @cached_property
    def total(self) -> Sums:
        """The sums over all recordings."""
        return Sums.total(self.sums)

    @property
    def chi2(self) -> float:
        """Chi^2 per difference."""
        return self.total.squares / self.total.number

    @property
    def deviance(self) -> float:
        """-2 log likelihood at the best common scale of all variances."""
        return self.total.number * math.log(self.chi2) + self.total.logs

    @property
    def misfit(self) -> float:
        """Chi² with the priors of given quantities; a deviance for estimated noise."""
        given = float(self.problem.weights @ self.theta**2)
        return given + (self.deviance if self.problem.is_slow else self.total.squares)

    @cached_property
    def _median_squares(self) -> Array:
        """Squared medians (7,) of the differences, of all and by axis, insensitive to tails."""
        sizes = np.abs(np.concatenate(self.parts.pool.results(innovations_of, self.parts)))
        return np.asarray(MAD_TO_STD * np.append(
            np.median(sizes), np.median(sizes, axis=0))) ** 2

    @property
    def robust_chi2(self) -> float:
        """Chi^2 per difference from their median."""
        return float(self._median_squares[0])

    @property
    def worst_chi2(self) -> float:
        """Robust chi^2 per difference of the axis with the largest."""
        return float(self._median_squares[1:].max())

    @property
    def colour(self) -> float:
        """Factor of chi² by memory and tails of the noise, relative to white normal noise."""
        kept = min(max(self.total.neighbours / max(self.total.squares, 1e-99), 0.0), 0.95)
        return max(self.chi2, 1.0) * (1.0 + kept) / (1.0 - kept)

    def of_each(self, function: Callable[[Segments, Any, Parts], Any]) -> list[Any]:
        """Return a function of the segments, courses and differences of each recording."""
        held = self.problem.held
        return held.pool.results(function, held, self.courses, self.parts)

    @property
    def cup(self) -> Cup:
        return self.problem.cup(self.theta)

    def only(self, number: int) -> 'Solution':
        """Return the solution of one recording alone, with its information still of all."""
        problem = replace(self.problem, held=self.problem.held.only(
            number), outlines=self.problem.outlines[number:number + 1])
        return replace(
            self, problem=problem, theta=self.theta[self.problem.index(number)],
            courses=self.courses.only(number), parts=self.parts.only(number),
            sums=self.sums[number:number + 1])

    def freed(self, more: Free, structure: Structure | None = None) -> 'Solution':
        """Return the start of a problem with more free quantities, with equal cup and courses."""
        wide = self.problem.freed(self.theta, more, structure)
        return evaluated(wide, wide.transferred(self.problem, self.theta),
                         self.courses)

    def estimate(self, name: str) -> tuple[Array, Array]:
        """Return the estimate of a free quantity, SI units, with its standard errors."""
        problem = self.problem
        place, std = problem.places[name].ravel(), np.sqrt(self.information.variances)
        return problem.reported(self.theta)[place], (problem.units * std)[place]

    @property
    def is_plausible(self) -> bool:
        """Whether the search converged to a cup that is neither too stiff nor too damped."""
        (_, of_K), (_, of_P), *_ = self.problem.wide_priors(self.theta)
        return self.converged and bool(max(of_K.max(), of_P.max()) < CHANCE)

    @property
    def fits(self) -> bool:
        """Whether the search ended at a plausible cup without a misfit."""
        return self.is_plausible and self.worst_chi2 * max(self.learned, 1.0) < MISFIT_CHI2

    @cached_property
    def learned(self) -> float:
        """
        Ratio of the estimated variance of slow poses to their variance at rest.

        The ratio is below 1 only by chance. Segments with white residuals are excluded, because
        their larger noise is noise in motion; a misfit has correlated residuals.
        """
        return float(max(self.of_each(_learned)))

    @property
    def noise_in_motion(self) -> dict[int, Array]:
        """
        Standard deviations (6,) of white noise in motion by recording, m and rad.

        For views of a tag it is the `CornerNoise` (2,), rad and 1/rad.
        """
        return {number: std for number, std in enumerate(self.of_each(_noise_in_motion))
                if std is not None}


def _learned(segments: Segments, courses: Sequence[Course], parts: Parts) -> float:
    """Return `Solution.learned` of a recording."""
    if segments[0].views:
        return max((course.corners.sigma / (CHANCE * USUAL_NOISE.sigma)) ** 2 * (not part.is_white)
                   for course, part in zip(courses, parts, strict=True))
    return max((
        float(np.mean(share) / (1.0 + CHANCE * np.sqrt(2.0 / (3.0 * noise.independent))))
        for segment, course, part in zip(segments, courses, parts, strict=True)
        for noise in [segment.package_noise] if not part.is_white
        for share in np.split((course.std / noise.std) ** 2, 2)), default=0.0)


def _noise_in_motion(
    segments: Segments, courses: Sequence[Course], parts: Parts
) -> Array | None:
    """Return `Solution.noise_in_motion` of a recording."""
    found = None
    for segment, course, part in zip(segments, courses, parts, strict=True):
        if segment.views:  # in full, as what uses it gives large errors no lesser weight
            h = np.abs(innovations_of(parts))
            raw = np.where(h > CHANCE, h**2 / CHANCE, h)
            return np.asarray(np.sqrt(np.mean(raw**2)) * np.array(course.corners))
        if segment.is_slow and part.is_white:
            found = np.maximum(course.std, segment.package_noise.std)
    return found


def minimise(problem: Problem, report: Report = no_report) -> Solution:
    """Return the root of a problem, searched from its initial guess, with a callback."""
    return settled(approach(problem, report), report)


def approach(problem: Problem, report: Report = no_report) -> Solution:
    """Return the end of the first stage, along the measured paths, with the noise renewed."""
    rough = replace(problem, is_rough=True)
    near = _near(_best_start(rough), report)[0]
    return replace(near, problem=replace(near.problem, is_rough=problem.is_rough),
                   courses=renewed(near)[0])


def _best_start(problem: Problem) -> Solution:
    """
    Return the best of the initial guesses whose stiffness is scaled, with ordinary damping.

    The sum of squares has a minimum wherever a mode of the model meets another mode of the
    package's motion, and steps lead to the nearest minimum. The sums compared are those at the
    best values of the other unknowns, to first order.

    Raises
    ------
    BellowsError
        If no simulation is possible.

    """
    courses, failure = measured_courses(problem), None
    best, least = None, math.inf
    for scale in _scales(problem):
        guess = replace(problem.guess, stiffness=scale * problem.guess.stiffness,
                        damping=np.zeros((6, 6)))
        scaled = replace(problem, guess=guess)
        try:
            at = evaluated(scaled, scaled.start, courses)
        except BellowsError as error:  # unstable, or too fast
            failure = failure or error
            continue
        information, slope = _tempered(at)
        others = np.arange(len(slope)) >= problem.count
        squares = at.total.squares - information.fall(slope, others)
        if best is None or squares < least or math.isnan(least):  # nan of a diverging one
            best, least = at, squares
    if best is None:
        assert failure is not None
        raise failure
    return best


def _scales(problem: Problem) -> list[float]:
    """Return scales of K, powers of two with 1, for axial modes within `MODES_HZ`."""
    masses = [outline.payload.mass for outline in problem.outlines]
    mode_hz = np.sqrt(problem.guess.stiffness[2, 2] / np.median(masses)) / (2.0 * math.pi)
    low, high = (math.floor(2.0 * math.log2(limit / mode_hz)) for limit in MODES_HZ)
    return [2.0**power for power in range(min(low, 0), max(high, 0) + 1)]


def measured_courses(problem: Problem) -> Held:
    """Return the motions as measured."""
    return problem.held.pool.keep(_first, problem.held)


def _first(segments: Segments) -> tuple[Course, ...]:
    return tuple(segment.first for segment in segments)


def _near(at: Solution, report: Report) -> tuple[Solution, bool]:
    """Return the end of damped steps that reduce Huber's sum, and whether it is a minimum."""
    is_last, damping, used = False, DAMPING, np.ones(len(at.theta), dtype=bool)
    used[np.ravel(at.problem.places.get('exposure', ())).astype(int)] = False
    for _ in range(MAX_STEPS[0]):
        if not at.is_finite or at.chi2 < MISFIT_CHI2:
            break
        information, slope = _tempered(at)
        step = damped_step(at, information.damped(damping), slope, used)
        length = _squared_length(at, step, at.information)
        if damping > DAMPING and length < TOLERANCES[1]:
            break
        new = _moved(at, step, renewed(at, False)[0])
        if new is None or not new.chi2 < MAX_SMALL_RISE * at.chi2:
            damping = max(10.0 * damping, DAMPING)
            continue
        is_last = new.chi2 * MAX_SMALL_RISE > at.chi2 or (
            length < TOLERANCES[0] and damping <= DAMPING)
        at, damping = new, 0.1 * damping
        report(at.cup, at.chi2)
        if is_last:
            break
    return at, is_last


def _tempered(at: Solution) -> tuple[Arrow, Array]:
    """
    Return information and slope of a misfit that counts as noise.

    The deviations of a remote start are `Solution.chi2` times the noise, so that all priors weigh
    as much more. Otherwise length, centre of mass and marker leave their given values together,
    or the damping its order of magnitude, for any small gain, and do not return.
    """
    prior, slope = at.problem.prior(at.theta)
    more = max(at.chi2 - 1.0, 0.0)
    information = replace(
        at.information, shared=at.information.shared + more * prior.shared,
        own=at.information.own + more * prior.own)
    return information, at.slope + more * slope


def settled(start: Solution, report: Report = no_report) -> Solution:
    """
    Return the root near a start, or the best solution.

    Damped steps are first, if there is a misfit; then path and noise are renewed with each step.
    """
    try:  # the first stage may end at too fast a cup
        at, is_last = _near(evaluated(start.problem, start.theta, start.courses), report)
    except BellowsError:
        return replace(start, converged=False)
    if at.chi2 > GROSS_CHI2:  # which paths would explain in part
        return replace(at, converged=is_last)
    damping, best, least = 0.0, at, math.inf
    used, before = np.ones(len(at.theta), dtype=bool), np.zeros(len(at.theta))
    for number in range(MAX_STEPS[1]):
        if not at.is_finite or number >= MAX_STEPS[1] // 2 and at.robust_chi2 > MISFIT_CHI2:
            break
        courses, is_kept = renewed(at)
        step = damped_step(at, at.information.damped(damping), at.slope, used)
        length = _squared_length(at, step, at.information)
        if is_kept and damping <= DAMPING and length < least:
            best, least = at, length
        if least < TOLERANCES[1]:
            break
        new, size = None, 0.5 if before @ at.information.times(step) < 0.0 else 1.0
        for trial in (size * step, SHORTER * step):  # half a step back, as two may alternate
            new = _moved(at, trial, courses)
            if new is not None and new.deviance < at.deviance + (
                    at.total.number * math.log(MAX_NOISE_CHI2)):
                break
            new = None
        if new is None:
            damping = max(10.0 * damping, DAMPING)
            continue
        at, before, damping = new, trial, 0.1 * damping
        report(at.cup, at.chi2)
    return replace(best, converged=least < LOOSE_TOLERANCE * best.colour)


def renewed(at: Solution, with_noise: bool = True) -> tuple[Held, bool]:
    """Return the likeliest courses, and whether the noise of slow poses is nearly unchanged."""
    courses, settles = at.parts.pool.hold(
        partial(_renewed, with_noise, at.problem.is_rough), at.problem.held, at.courses, at.parts)
    return courses, all(settles)


def _renewed(
    with_noise: bool, is_rough: bool, segments: Segments, courses: Sequence[Course], parts: Parts
) -> tuple[tuple[Course, ...], bool]:
    """Return `renewed` of a recording, the first states alone without noise."""
    if not with_noise:
        return tuple(course._replace(start=part.course.start)
                     for course, part in zip(courses, parts, strict=True)), True
    new, settles = [], True
    corners, change = courses[0].corners, 0.0
    if segments[0].views and not is_rough:
        corners, change = corners.estimated(
            np.concatenate([part.smear for part in parts]), np.mean(np.clip(
                innovations_of(parts), -CHANCE, CHANCE) ** 2, axis=1))
        if change < 2.0 * NOISE_TOLERANCE:
            corners, change = courses[0].corners, 0.0
    for segment, course, part in zip(segments, courses, parts, strict=True):
        std = course.std
        if segment.is_slow and (is_rough or not segment.views) and np.any(
                np.abs(part.std - std) > NOISE_TOLERANCE * std):
            std, settles = part.std, False
        new.append(part.course._replace(std=std, corners=corners))
    return tuple(new), settles and not change


def _moved(at: Solution, step: Array, courses: Held) -> Solution | None:
    """Return the solution after a step about courses, if its simulation is possible."""
    with suppress(BellowsError):  # too short or fast a cup, or too large a clock offset
        new = evaluated(at.problem, at.problem.moved(at.theta, step), courses)
        if new.is_finite:
            return new
    return None


def damped_step(at: Solution, information: Arrow, slope: Array, used: Mask) -> Array:
    """
    Return the step of the used unknowns (m,) within the largest steps.

    Strengths of relaxation stay nonnegative. Other unknowns follow those that stop at a limit.
    """
    problem, used, limit = at.problem, used.copy(), at.problem.max_step
    is_none = problem.extended('relaxation', at.theta) <= MIN_STRENGTH
    fixed = np.zeros(len(slope))
    for _ in range(MAX_STOPS):
        rest = np.where(used, slope - information.times(fixed), 0.0)
        step = np.where(used, information.within(used).solve(rest), fixed)
        stops = used & (np.abs(step) > limit)
        fixed[stops] = (np.sign(step) * limit)[stops]
        for place in problem.places.get('relaxation', ()):
            stops[place] |= used[place] & is_none & (step[place] < 0.0)
            fixed[place] = np.where(is_none, np.maximum(fixed[place], 0.0), fixed[place])
        if not stops.any():
            break
        used[stops] = False
    return np.clip(step, -limit, limit)


def _squared_length(at: Solution, step: Array, H: Arrow) -> float:
    """
    Return the squared length of a step in standard errors.

    Unidentifiable unknowns may drift, and do not affect convergence.
    """
    identifiable = np.sqrt(H.variances) < at.problem.max_std
    part = np.where(identifiable | ~identifiable.any(), step, 0.0)
    slope = H.times(part)
    return float(part @ slope) - H.fall(slope, ~identifiable & identifiable.any())


def evaluated(problem: Problem, theta: Array, courses: Held) -> Solution:
    """Return unknowns with the whitened segments about courses, and information and slope."""
    (H, g), pool = problem.prior(theta), problem.held.pool
    indices = list(map(problem.index, range(len(problem.outlines))))
    parts, found = pool.hold(
        partial(_whitened, problem.local), [theta[index] for index in indices], problem.held,
        courses)
    for number, (_, information, slope) in enumerate(found):
        H.add(number, information)
        g[indices[number]] += slope
    return Solution(problem, theta, courses, parts, [sums for sums, *_ in found], H, g)


def _whitened(
    problem: Problem, theta: Array, segments: Segments, courses: Sequence[Course]
) -> tuple[Parts, tuple[Sums, Array, Array]]:
    """Return whitened segments, their sums, information (q, q) and slope (q,)."""
    parts = tuple(residuals.evaluated(problem, theta, segment, course)
                  for segment, course in zip(segments, courses, strict=True))
    sums = Sums.total(Sums(
        e.size, float(np.sum(e**2)), float(np.sum(e[1:] * e[:-1])), part.logs,
        np.sum(part.residuals**2, axis=0)) for part in parts for e in [part.innovations])
    return parts, (sums, *(sum(np.sum(getattr(part, name), axis=0) for part in parts)
                           for name in ('information', 'slope')))
