"""
Search for K and P with which the model, driven by the measured tool, reproduces all poses.

The steps are Gauss-Newton steps, with derivatives along the likeliest path of the tool: their mean
is zero at the truth, unlike the gradient of chi² along the measured path, or of the likelihood
with its weights. The iterate includes likeliest paths, first states and the noise of slow poses.

A remote start approaches first, with nearly constant damping and without couplings, which noise
would dominate: an unknown acceleration of the package makes the differences forget the past.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
import math
from operator import attrgetter
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.information import Arrow, symmetric_roots
from bellows_ros.core.identification.pool import Held, in_threads
from bellows_ros.core.identification.problem import (
    MIN_STRENGTH,
    Problem,
)
from bellows_ros.core.identification.quantities import Free
from bellows_ros.core.identification.result import CHANCE
from bellows_ros.core.identification.segments import (
    Course,
    MIN_POSE_STD,
    Segment,
    Segments,
    segments_of,
)
from bellows_ros.core.identification.whitening import HUBER_STD, WhitenedSegment
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.recording import BodyNoise
from bellows_ros.core.signals.resampling import MAD_TO_STD
from bellows_ros.core.signals.savgol import correlated
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

FORGETTING_RATE = 30.0
"""Rate at which an unknown acceleration makes the model forget during the approach, 1/s."""

DAMPING = 1e-2
"""Damping of a step that limits poorly determined unknowns: the smallest in the approach, the
largest of the last step, as a damped step is short anywhere, and the first after a failed step."""

ANDERSON_DEPTH = 3
"""Number of previous steps mixed into a step."""

MAX_ANDERSON_WEIGHT = 0.9
"""Largest weight of a previous step: 0.9 for a step that is 10 times too long."""

NOISE_TOLERANCE = 0.03
"""Relative change of the noise of slow poses below which the noise is kept."""

MAX_STEPS = 60
"""Largest number of steps in a search; a search with a misfit has half as many."""

FEW_STEPS = 10
"""Largest number of steps in the approach, and of steps after the shortest one of a search, with
which it may return to a root from noisy derivatives."""

MAX_DAMPING = 10.0
"""Largest ratio of damping to ordinary damping of a plausible cup."""

MAX_STIFFENING = 100.0
"""Largest ratio of stiffness to the start of a plausible cup."""

USUAL_CORNER = 1e-3
"""Largest error of a tag's corner by noise, rad: one to two pixels."""

MAX_NOISE_CHI2 = 1.2
"""Largest chi^2 per difference attributed to noise, without a warning."""

MISFIT_CHI2 = 1.5
"""Smallest chi^2 per difference of a certain misfit."""

APPROACH_TOLERANCE = 3.0
"""Squared length of a step at the end of the approach, squared standard errors."""

TOLERANCE = 3e-3
"""Squared length of a step at the end of the search: K and P move by 5 % of a standard error."""

LOOSE_TOLERANCE = 0.1
"""Largest squared length of the last step, as barely identifiable numbers keep oscillating."""

SHORTER = 0.25
"""Fraction of a step that is tried if chi² increases with the whole step."""

MAX_RISE = 1.2
"""Largest ratio of chi² after a step to chi² before, with the current noise; weights change in a
step."""

MAX_SMALL_RISE = 1.02
"""Ratio of chi² after a step to chi² before the step, above which the next step has more
damping."""

NOISE_FACTOR = 3.0
"""Size of the noise that is added to test the information, relative to the noise of the poses."""

UNSEEN_NOISE_FACTOR = 1.0
"""Size of the added noise for wrenches alone: it gives their bias, as noise of the tool shakes a
package that no pose shows."""

MIN_NOISE_FACTOR = 0.1
"""Smallest size of added noise, as large noise may turn the package over."""

Report = Callable[[Cup, float], None]
"""Callback with the cup and chi^2 after a step."""


def no_report(cup: Cup, chi2: float) -> None:
    """Report nothing."""


Parts = tuple[WhitenedSegment, ...]
"""Whitened segments of one recording."""


class Sums(NamedTuple):
    """
    Sums over a recording.

    Number (K,) and squares (K, 6) of the differences of each segment, squares (6,) without
    whitening, m^2 and rad^2, and the sums of the logarithms of their variances and of the products
    of neighbours.
    """

    counts: Array
    squares: Array
    residuals: Array
    logs: float
    neighbours: float

    @classmethod
    def of(cls, parts: Parts) -> 'Sums':
        """Return the sums of whitened segments."""
        r = [part.innovations.reshape(-1, 6) for part in parts]
        with np.errstate(divide='ignore', invalid='ignore'):  # of a diverging simulation
            return cls(
                np.array([e.size for e in r]), np.array([np.sum(e**2, axis=0) for e in r]),
                np.sum(squared_residuals(parts), axis=0),
                sum(float(np.sum(np.log(part.variance))) for part in parts),
                sum(float(np.sum(e[1:] * e[:-1])) for e in r))


def innovations_of(parts: Parts) -> Array:
    """Return the innovations (N, 6) of a recording."""
    return np.concatenate([part.innovations for part in parts]).reshape(-1, 6)


def squared_residuals(parts: Parts) -> Array:
    """Return the squared differences (N, 6) of a recording, m^2 and rad^2."""
    return np.asarray(np.square(np.concatenate([part.residuals for part in parts])))


Directions = tuple[Array, Mask]
"""Directions (s, d) of shared unknowns, and the mask (m,) of the own unknowns in use."""


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
    def residual_count(self) -> int:
        """Number of differences."""
        return int(sum(np.sum(one.counts) for one in self.sums))

    @cached_property
    def squares(self) -> float:
        """Sum of squared differences."""
        return float(sum(np.sum(one.squares) for one in self.sums))

    @property
    def deviance(self) -> float:
        """-2 log likelihood at the best common scale of all variances."""
        return self.residual_count * math.log(self.squares / self.residual_count) + sum(
            one.logs for one in self.sums)

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
        kept = sum(one.neighbours for one in self.sums) / max(self.squares, 1e-99)
        kept = min(max(kept, 0.0), 0.95)
        return max(self.squares / self.residual_count, 1.0) * (1.0 + kept) / (1.0 - kept)

    @property
    def mean_square(self) -> Array:
        """The mean squares (6,) of the differences of all segments, m^2 and rad^2."""
        total = np.sum([one.residuals for one in self.sums], axis=0)
        return np.asarray(6.0 * total / self.residual_count)

    def _of_each(self, function: Callable[[Segments, Any, Parts], Any]) -> list[Any]:
        """Return a function of the segments, courses and differences of each recording."""
        held = self.problem.held
        return held.pool.results(function, held, self.courses, self.parts)

    @property
    def cup(self) -> Cup:
        return self.problem.cup(self.theta)

    def freed(self, more: Free, structure: Structure | None = None) -> 'Solution':
        """Return the start of a problem with more free quantities, with equal cup and courses."""
        wide = self.problem.freed(self.theta, more, structure)
        return evaluated(wide, wide.transferred(self.problem, self.theta), self.courses)

    def refined(
        self, with_noise: bool, with_paths: bool = True
    ) -> tuple['Solution', float, bool]:
        """
        Return the solution with its likeliest paths, and the estimated noise of slow poses.

        Further results are the sum of squares with this noise, and whether the noise has settled.
        """
        held = self.problem.held
        courses, outcomes = held.pool.hold(
            _refined, with_noise, with_paths, held, self.courses, self.parts)
        squares, settled = zip(*outcomes, strict=True)
        return replace(self, courses=courses), sum(squares), all(settled)

    def estimate(self, name: str) -> tuple[Array, Array]:
        """Return the estimate of a free quantity, SI units, with its standard errors."""
        place, units = self.problem.places[name].ravel(), self.problem.units
        return (units * self.theta)[place], (units * np.sqrt(self.information.variances))[place]

    @property
    def is_plausible(self) -> bool:
        """Whether the search converged to a cup that is neither too stiff nor too damped."""
        inverse = symmetric_roots(self.problem.first_cup.stiffness)[1]
        stiffness = inverse @ self.cup.stiffness @ inverse
        return bool(self.converged and self.problem.largest_damping(self.theta) < MAX_DAMPING
                    and np.linalg.eigvalsh(stiffness)[-1] < MAX_STIFFENING)

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
        return float(max(self._of_each(_learned)))

    @property
    def pose_std(self) -> list[Array]:
        """Noise (K, 6) of the poses in the K segments of each recording, m and rad."""
        return self._of_each(_pose_std)

    @property
    def noise_in_motion(self) -> dict[int, Array]:
        """
        Standard deviations (6,) of white noise in motion by recording, m and rad.

        For views of a tag it is the `CornerNoise` (2,), rad and 1/rad.
        """
        return {number: std for number, std in enumerate(self._of_each(_noise_in_motion))
                if std is not None}


def _pose_std(segments: Segments, courses: Sequence[Course], parts: Parts) -> Array:
    """Return the noise (K, 6) of the poses in the K segments of a recording, m and rad."""
    return np.array([course.std for course in courses])


def _learned(segments: Segments, courses: Sequence[Course], parts: Parts) -> float:
    """Return `Solution.learned` of a recording."""
    if segments[0].views:
        return max((course.corners.sigma / USUAL_CORNER) ** 2 * (not part.is_white)
                   for course, part in zip(courses, parts, strict=True))
    return max((
        float(np.mean(share) / (1.0 + CHANCE * np.sqrt(2.0 / (3.0 * noise.independent))))
        for segment, course, part in zip(segments, courses, parts, strict=True)
        for noise in [segment.measured.package_noise] if not part.is_white
        for share in np.split((course.std / noise.std) ** 2, 2)), default=0.0)


def _noise_in_motion(
    segments: Segments, courses: Sequence[Course], parts: Parts
) -> Array | None:
    """Return `Solution.noise_in_motion` of a recording."""
    found = None
    for segment, course, part in zip(segments, courses, parts, strict=True):
        if segment.views:  # in full, as what uses it gives large errors no lesser weight
            h = np.abs(np.concatenate([each.innovations for each in parts]))
            raw = np.where(h > HUBER_STD, h**2 / HUBER_STD, h)
            return np.asarray(np.sqrt(np.mean(raw**2)) * np.array(course.corners))
        if segment.is_slow and part.is_white:
            found = np.maximum(course.std, segment.measured.package_noise.std)
    return found


def minimise(problem: Problem, report: Report = no_report) -> Solution:
    """Return the root of a problem, searched from its initial guess, with a callback."""
    return root(approach(problem, report), report)


def root(near: Solution, report: Report = no_report) -> Solution:
    """Return the root, searched from the end of an approach."""
    with suppress(BellowsError):  # the approach may end at too fast a cup
        return settled(evaluated(near.problem, near.theta, near.courses), report)
    return near


def settled(start: Solution, report: Report = no_report) -> Solution:
    """Return the root near a start, along all directions."""
    problem = start.problem
    return _descended(
        start, (np.eye(problem.shared), np.full(len(problem.start), True)), report)


def approach(
    problem: Problem, report: Report = no_report, held: Collection[str] = (),
    with_couplings: bool = True,
) -> Solution:
    """
    Return an approach to the root.

    The approach is first without couplings, which noise would disturb; with them, if requested,
    when a misfit remains. Clocks and frames of each recording approach first, because with large
    errors of clocks or frames a rigid cup would fit best. Held quantities keep their values,
    because differences with forgetting do not determine them.
    """
    forgetful = replace(problem, forgetting=FORGETTING_RATE)
    used = ~np.isin(np.arange(len(problem.start)), [
        row for name in held for row in problem.places[name].ravel()])
    everything, diagonal = (
        matrix[:, ~np.any(matrix[~used[:problem.shared]], axis=0)]
        for matrix in (np.eye(problem.shared), problem.uncoupled))
    theta, measured = problem.start, measured_courses(problem)
    courses = measured
    if used[problem.own].any():
        near = _descended(
            evaluated(forgetful, theta, measured), (everything[:, :0], used), report)
        theta, courses = near.theta, near.courses
    near = _descended(evaluated(forgetful, theta, courses), (diagonal, used), report)
    if with_couplings and diagonal.shape != everything.shape and not (
            near.squares < MISFIT_CHI2 * near.residual_count):
        near = _descended(evaluated(forgetful, theta, measured), (everything, used), report)
    return replace(near, problem=problem, converged=False)


def measured_courses(problem: Problem) -> Held:
    """Return the motions as measured."""
    return problem.held.pool.keep(_first, problem.held)


def _first(segments: Segments) -> tuple[Course, ...]:
    return tuple(segment.first for segment in segments)


def _descended(at: Solution, directions: Directions, report: Report) -> Solution:
    """Return the root along some directions; without convergence the likeliest solution."""
    if not at.is_finite:
        return _diverged(at)
    problem, expected = at.problem, at.residual_count  # squares, with noise as it was assumed
    is_approach = problem.forgetting > 0.0
    min_damping, tolerance, max_steps = (
        (DAMPING, APPROACH_TOLERANCE, FEW_STEPS) if is_approach else
        (0.0, TOLERANCE, MAX_STEPS))
    objective = attrgetter('squares' if is_approach else 'deviance')
    history: list[tuple[Array, Array]] = []  # steps, and resulting changes
    damping, settled, is_fresh, squares = min_damping, True, True, at.squares
    best, lowest, best_number = at, (True, math.inf), 0
    for number in range(max_steps):
        is_misfit = number >= MAX_STEPS // 2 and at.squares > MISFIT_CHI2 * expected
        if is_misfit or best.converged and number > best_number + FEW_STEPS:
            break
        step = _damped_step(at, damping, directions)
        length = _squared_length(at, step)
        is_near = not is_approach and settled and (
            length < LOOSE_TOLERANCE and damping <= DAMPING)
        cost = not is_near, length if is_near else objective(at)
        if cost < lowest:
            best, lowest, best_number = replace(at, converged=is_near), cost, number
        new = _moved_below(at, (_anderson_step(step, at.information, history), SHORTER * step),
                           MAX_RISE * max(squares, expected))
        if new is not None:
            history = [*history, (step, new.theta - at.theta)][-ANDERSON_DEPTH:]
            before = max(at.squares, expected)
            at, squares, settled = new.refined(not is_approach)
            is_fresh, settled = False, settled and damping <= DAMPING
            damping = _next_damping(damping, min_damping, at.squares > MAX_SMALL_RISE * before)
            report(at.cup, at.squares / expected)
            if length < tolerance and settled:
                break
        elif is_fresh:
            history, damping = [], max(10.0 * damping, DAMPING)
        else:  # compare chi² along one path and with one noise
            again = evaluated(problem, at.theta, at.courses)
            if not again.is_finite:
                break
            history, at, is_fresh, squares = [], again, True, again.squares
    is_near = not is_approach and settled and length < LOOSE_TOLERANCE
    if not is_near and lowest < (True, objective(at)):
        return best.refined(False)[0]
    return replace(at.refined(True, False)[0], converged=is_near)


def _next_damping(damping: float, least: float, is_risen: bool) -> float:
    """Return the damping of the step after a successful one."""
    if is_risen:
        return max(10.0 * damping, 1e-3)
    return max(0.1 * damping, least) if damping > 1e-5 else 0.0


def _diverged(at: Solution) -> Solution:
    """Return a diverging simulation as the end of a search, without information."""
    parts, sums = at.parts.pool.hold(_finite, at.parts)
    return replace(at.refined(False)[0], parts=parts, sums=sums,
                   information=at.information.within(np.full(len(at.theta), False)))


def _finite(parts: Parts) -> tuple[Parts, Sums]:
    """Return the differences of a simulation that diverges as large ones without information."""
    finite = tuple(part._replace(
        innovations=np.nan_to_num(part.innovations, nan=1e3), **{
            name: np.nan_to_num(getattr(part, name), posinf=0.0)
            for name in ('variance', 'information', 'slope')}) for part in parts)
    return finite, Sums.of(finite)


def _refined(
    with_noise: bool, with_paths: bool, segments: Segments, courses: tuple[Course, ...],
    parts: Parts,
) -> tuple[tuple[Course, ...], tuple[float, bool]]:
    """Return `Solution.refined` of a recording: courses, squares, and convergence of the noise."""
    settled, before = True, _noise_sizes(courses, parts)
    if with_paths:
        courses = likeliest(segments, courses, parts)
    if with_noise:
        courses, settled = _with_noise(segments, courses, parts)
    ratio = before / _noise_sizes(courses, parts)
    squares = [np.sum(part.innovations.reshape(-1, 6) ** 2, axis=0) for part in parts]
    return courses, (float(np.sum(squares * ratio**2)), settled)


def _noise_sizes(courses: Sequence[Course], parts: Parts) -> Array:
    """Return the sizes (K, 6) of the noise of differences."""
    return np.array([
        np.full(6, np.median(np.sqrt(course.corners.variance(part.smear, np.ones(1)))))
        if len(part.smear) else course.std for course, part in zip(courses, parts, strict=True)])


def likeliest(
    segments: Sequence[Segment], courses: Sequence[Course], parts: Sequence[WhitenedSegment]
) -> tuple[Course, ...]:
    """Return the likeliest courses of segments, unchanged for a diverging simulation."""
    return tuple(
        segment.course(part.tool_change, part.start, course.std, course.corners)
        if all(np.isfinite(values).all() for values in (part.tool_change, *part.start)) else course
        for segment, course, part in zip(segments, courses, parts, strict=True))


def _with_noise(
    segments: Segments, courses: Sequence[Course], parts: Parts
) -> tuple[tuple[Course, ...], bool]:
    """Return courses with the estimated noise of slow poses, and whether the noise has settled."""
    if all(len(part.smear) for part in parts):
        return _with_corner_noise(segments, courses, parts)
    new, settled = [], True
    for segment, course, part in zip(segments, courses, parts, strict=True):
        if segment.is_slow:
            correlation = segment.measured.package_noise.correlation
            total = (MAD_TO_STD * np.median(np.abs(part.residuals), axis=0)) ** 2
            simulated = np.median(part.variance, axis=0) - part.new_variance
            std = np.maximum(MIN_POSE_STD, np.sqrt(
                np.maximum(total - simulated, 0.1 * total) / (1.0 - correlation**2)))
            if np.any(np.abs(std - course.std) > NOISE_TOLERANCE * course.std):
                course, settled = course._replace(std=std), False
        new.append(course)
    return tuple(new), settled


def _with_corner_noise(
    segments: Segments, courses: Sequence[Course], parts: Parts
) -> tuple[tuple[Course, ...], bool]:
    """Return courses with one noise of all corners, from clipped squares in proportion."""
    noise, change = courses[0].corners.estimated(
        np.concatenate([part.smear for part in parts]), np.mean(np.clip(
            innovations_of(parts), -HUBER_STD, HUBER_STD) ** 2, axis=1))
    if change < 2.0 * NOISE_TOLERANCE:
        return tuple(courses), True
    return tuple(course._replace(corners=noise) for course in courses), False


def _moved_below(at: Solution, steps: Iterable[Array], largest: float) -> Solution | None:
    """Return the first solution after a step with chi² below the largest, if any."""
    for step in steps:
        with suppress(BellowsError):  # too short or fast a cup, or too large a clock offset
            new = evaluated(at.problem, at.problem.moved(at.theta, step), at.courses)
            if new.squares < largest:  # also false for nan
                return new
    return None


def _damped_step(at: Solution, damping: float, directions: Directions) -> Array:
    """Return the step along some directions, with nonnegative strengths of relaxation."""
    problem, step, (shared, own) = at.problem, at.slope, directions
    for _ in range(3):  # each strength may be stopped by the step as well
        along = shared
        for place in problem.places.get('relaxation', ()):
            stopped = place[
                (problem.strengths(at.theta) <= MIN_STRENGTH) & ~(step[place] > 0.0)]
            along = shared[:, ~np.any(shared[stopped], axis=0)]
        step = at.information.damped(damping).step_by(at.slope, along, own)
        if 'relaxation' not in problem.places:
            break
    return step


def _squared_length(at: Solution, step: Array) -> float:
    """
    Return the squared length of a step in standard errors.

    Unidentifiable unknowns may drift, and do not affect convergence.
    """
    H = at.information
    identifiable = np.sqrt(H.variances) < at.problem.max_std
    part = np.where(identifiable | ~identifiable.any(), step, 0.0)
    slope = H.times(part)
    return float(part @ slope) - H.fall(slope, ~identifiable & identifiable.any())


def evaluated(problem: Problem, theta: Array, courses: Held) -> Solution:
    """Return unknowns with the whitened segments about courses, and information and slope."""
    (H, g), pool, s = problem.prior(theta), problem.held.pool, problem.shared
    indices = list(map(problem.index, range(len(problem.outlines))))
    parts, found = pool.hold(
        _whitened, problem.local, pool.each([theta[index] for index in indices]), problem.held,
        courses)
    rows = [(number, information, slope) for number, (_, information, slope) in enumerate(found)]
    if problem.standstills and not problem.forgetting:
        J, r, _ = problem.local.at_rest(theta[indices[0]])
        rows.append((0, J.T @ J, J.T @ r))
    for number, information, slope in rows:
        H.shared[:] += information[:s, :s]
        H.coupling[number] += information[s:, :s]
        H.own[number] += information[s:, s:]
        g[indices[number]] += slope
    return Solution(problem, theta, courses, parts, [sums for sums, *_ in found], H, g)


def _whitened(
    problem: Problem, theta: Array, segments: Segments, courses: Sequence[Course]
) -> tuple[Parts, tuple[Sums, Array, Array]]:
    """Return whitened segments without Jacobians, their sums, information (q, q) and slope."""
    def whitened(segment: Segment, course: Course) -> WhitenedSegment:
        part = problem.whitened(theta, segment, course)
        return part._replace(jacobian=part.jacobian[:0].copy())  # a view would keep all columns

    parts = tuple(in_threads(whitened, segments, courses))
    return parts, (Sums.of(parts), *(sum(np.sum(getattr(part, name), axis=0) for part in parts)
                                     for name in ('information', 'slope')))


def _anderson_step(step: Array, H: Arrow, history: Sequence[tuple[Array, Array]]) -> Array:
    """
    Return the change by a step, mixed with previous steps and their resulting changes.

    Anderson's method (1965) is used, because with inaccurate K and P the derivatives have noise
    and change between steps, so that plain steps are too short or too long.
    """
    if not history:
        return step
    steps, changes = map(np.array, zip(*history, strict=True))
    differences = np.diff(np.vstack([steps, step]), axis=0)
    squares = differences @ np.transpose(list(map(H.times, differences)))
    weights = np.linalg.pinv(squares, 0.1**2, hermitian=True) @ (differences @ H.times(step))
    weights *= min(1.0, MAX_ANDERSON_WEIGHT / max(np.abs(weights).max(), 1e-99))
    return np.asarray(step - weights @ (changes + differences))


def noise_effects(found: Solution) -> tuple[Arrow, Array]:
    """
    Return the part of the information on the unknowns that is due to noise, and their bias (m,).

    Noise in the path also shakes the simulated package. With additional noise of either sign the
    information of motion is unchanged, and the information of noise grows with the squared noise,
    as does the bias (simulation extrapolation, Cook and Stefanski 1994).
    """
    size = NOISE_FACTOR if found.problem.is_seen else UNSEEN_NOISE_FACTOR
    known, ends = found.information, list[Solution]()
    pool = found.problem.held.pool
    while len(ends) < 2:
        segments = pool.keep(
            _noisier, size * (-1.0) ** len(ends), found.problem.held, found.courses)
        courses = pool.keep(_begun, segments, found.courses)
        noisy = found.problem.with_segments(segments, found.problem.outlines)
        for _ in range(2):  # about the measured path, then about the likeliest
            at = evaluated(noisy, found.theta, courses)
            if not at.is_finite:
                break
            courses = at.refined(False)[0].courses
        if at.is_finite:
            ends.append(at)
        elif size < MIN_NOISE_FACTOR:
            return known, np.zeros(len(found.theta))
        else:  # large noise may turn the package over
            size, ends = 0.5 * size, []
    bias = known.solve(np.mean([end.slope for end in ends], axis=0) - found.slope)
    return replace(known, **{
        name: (np.mean([getattr(end.information, name) for end in ends], axis=0)
               - getattr(known, name)) / size**2 for name in ('shared', 'coupling', 'own')}
    ), bias / size**2


def _noisier(size: float, segments: Segments, courses: Sequence[Course]) -> Segments:
    """Return a recording with more noise, in units of its own, by a seed of its number."""
    measured = []
    for place, (segment, course) in enumerate(zip(segments, courses, strict=True)):
        own = segment.measured
        noise = BodyNoise(course.std, own.package_noise.correlation), own.tool_noise
        draw = np.random.default_rng([own.recording, place])
        package, tool = (_shaken(body, body_noise, size, draw) for body, body_noise in zip(
            (own.package, own.tool), noise, strict=True))
        if own.views:
            smear = np.zeros(len(own.views.corners))
            sizes = np.sqrt(course.corners.variance(smear, own.views.frames))[:, None]
            own = replace(own, views=replace(own.views, corners=own.views.corners + (
                size * sizes * draw.standard_normal((len(smear), 8)))))
        measured.append(replace(own, tool=tool, package=package))
    return segments_of(measured, segments)


def _begun(segments: Segments, courses: Sequence[Course]) -> tuple[Course, ...]:
    """Return the measured courses from first states and with the noise of others."""
    return tuple(segment.first._replace(
        start=course.start, std=course.std, corners=course.corners)
                 for segment, course in zip(segments, courses, strict=True))


def _shaken(
    body: Trajectory, noise: BodyNoise, size: float, draw: np.random.Generator
) -> Trajectory:
    """Return poses with added noise: `size` times their own noise, and as correlated."""
    e = size * noise.std * correlated(draw.standard_normal((len(body), 6)), noise.correlation)
    return replace(body, position=body.position + e[:, :3],
                   rotation=body.rotation @ exp_so3(e[:, 3:]))
