"""
The unknowns of a fit by simulation, and their effect on cup, package, poses and innovations.

All uncertain quantities are free jointly with K and P, with their priors as additional
measurements. K and P move along geodesics of the definite matrices, with a wide prior on the
logarithm of their size: of K about the start, of P about ordinary rubber; the inertia moves along
logarithms of its pseudo-inertia. The wide priors are negligible for entries that the recordings
determine.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
import math
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.identification import quantities, whitening
from bellows_ros.core.identification.information import Arrow, symmetric_roots
from bellows_ros.core.identification.pool import Held, here
from bellows_ros.core.identification.quantities import Free, KINDS
from bellows_ros.core.identification.result import CHANCE, MAX_RELATIVE_ERROR
from bellows_ros.core.identification.segments import (
    Course,
    MeasuredSegment,
    MIN_POSE_STD,
    Nodes,
    Outline,
    outline_of,
    Segment,
    Segments,
    segments_of,
)
from bellows_ros.core.identification.statics import balance
from bellows_ros.core.identification.whitening import sums_of_blocks, WhitenedSegment
from bellows_ros.core.model import pseudo_inertia, simulation
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple, Package
from bellows_ros.core.model.equilibrium import adapted, largest_step, pose_error, substeps_of
from bellows_ros.core.model.jacobians import BY_DAMPING, PARAMETER_COLUMNS
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import Seen
from bellows_ros.core.sensors.readings import Readings, SimulatedMotion
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.savgol import first_order
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

INITIAL_STD = np.repeat([0.05, 0.3, 0.5, 3.0, 0.01, 0.1, 0.01, 0.1], 3)
"""
Standard deviation of the package's first state about its first pose, at rest, and of internal
strains; SI units.
"""

MIN_STRENGTH = 1e-6
"""Smallest strength of relaxation in a search, as a branch of none has no strain."""

TYPICAL_STRENGTH = 0.05
"""Strength of relaxation of soft rubber."""

DEFAULT_RATIO = 1.05
"""Ratio r2 / r1 of rubber with a constant loss factor."""

RATIO_STD = 0.4
"""Standard deviation of the ratio r2 / r1 among rubbers."""

MAX_INTEGRATION_STEP = 0.005
"""Longest step of the integrator, s."""

MIN_INTEGRATION_STEP = 2e-5
"""
Shortest step of the integrator, s.

A cup with modes faster than 20,000/s, which needs shorter steps, is rejected by the search.
"""

MAX_QUICKENING = 30.0
"""Largest ratio of the speed of modes to the start, with 100 times the stiffness and 10 times the
ordinary damping."""

COARSE_FACTOR = 4.0
"""
Ratio of the integrator's steps in a fit to the steps in a prediction.

K and P of `bags/identification` change by less than 1e-4, 0.01 standard errors.
"""

WIDE_LOG_STD = 2.0
"""Standard deviation of the logarithms of K about the start, and of a package's thickness, of
which only the order of magnitude is known: negligible but for a thin plate."""

DAMPING_LOG_STD = 1.0
"""Standard deviation of the logarithm of P about ordinary rubber."""

APPROACH_LOG_STD = 0.3
"""Standard deviation of the logarithm of P in the approach, which noise would dominate."""

LOSS_FACTOR = 0.25
"""Loss factor of ordinary rubber, the prior of the damping; an undamped cup would fit noise."""

DIFFERENCE_STEP = 1e-4, 1e-2
"""Steps of unknowns of the cup, and of others, for derivatives of a further sensor."""

MAX_LOG_STEP = 1.0
"""Largest change of the logarithm of K or P in a step."""


@dataclass(frozen=True, eq=False)
class Problem:
    """
    Recordings of one cup, and the unknowns of their fit.

    The m unknowns theta are the parameters of the structure in units of their size, then the free
    quantities of `KINDS` in their units: first the s that all recordings share, including the
    parameters, then the own ones of each recording.

    Parameters
    ----------
    segments : Held or None
        Segments of each recording; None for one recording whose segments are given to a function.
    outlines : tuple of Outline
        Facts on each recording.
    structure : Structure
        Structure of K and P.
    guess : Cup
        Initial guess, with the length.
    free : mapping
        Standard deviations, SI units, of other free quantities, by names of `KINDS`.
    slip_ns : int
        Stamp of a slip of the package, if free.
    common : tuple of str
        Names of quantities that all recordings share instead of having their own.
    forgetting : float
        Rate (1/s) at which an unknown acceleration of the package makes the model forget.
    standstills : tuple of Standstill
        Standstills of the same cup, with the marker and the world of the first recording.

    """

    segments: Held | None
    outlines: tuple[Outline, ...]
    structure: Structure
    guess: Cup
    free: Free
    slip_ns: int = 0
    common: tuple[str, ...] = ()
    forgetting: float = 0.0
    standstills: tuple[Standstill, ...] = ()

    @classmethod
    def of(
        cls, segments: Held | Sequence[Segment], structure: Structure, guess: Cup, free: Free,
        **more: Any,
    ) -> 'Problem':
        """Return the problem of held recordings, or of segments that are in this process."""
        if not isinstance(segments, Held):
            segments = here([tuple(own) for _, own in groupby(
                segments, lambda segment: segment.measured.recording)])
        return cls(segments, tuple(segments.pool.results(outline_of, segments)), structure, guess,
                   free, **more)

    @property
    def held(self) -> Held:
        """The segments of each recording."""
        assert self.segments is not None
        return self.segments

    def changed(self, change: Callable[[MeasuredSegment], MeasuredSegment]) -> 'Problem':
        """Return the problem with other recordings, each segment changed."""
        return self.with_segments(*self.held.pool.hold(_changed, change, self.held))

    def with_segments(self, segments: Held, outlines: Sequence[Outline]) -> 'Problem':
        """Return the problem with other recordings."""
        return replace(self, segments=segments, outlines=tuple(outlines))

    @cached_property
    def local(self) -> 'Problem':
        """The problem of each recording alone: its unknowns are the shared ones, then its own."""
        return replace(self, segments=None, outlines=self.outlines[:1])

    def index(self, number: int) -> Places:
        """Return the places (q,) of a recording's unknowns among all."""
        return np.concatenate([np.arange(self.shared), self.own[number]])

    @property
    def is_slow(self) -> bool:
        """Whether the noise of some poses is estimated together with K and P."""
        return any(outline.is_slow for outline in self.outlines)

    @property
    def is_seen(self) -> bool:
        """Whether poses of the packages are measured, or only wrenches."""
        return all(outline.is_seen for outline in self.outlines)

    def freed(self, theta: Array, more: Free, structure: Structure | None = None) -> 'Problem':
        """Return the problem from the cup of unknowns, with more free quantities."""
        return replace(self, structure=structure or self.structure, guess=self.cup(theta),
                       free={**self.free, **more})

    def is_own(self, name: str) -> bool:
        """Return whether each recording has its own value of a quantity."""
        return KINDS[name].each and name not in self.common

    @cached_property
    def first_cup(self) -> Cup:
        """Initial cup with definite matrices, and with internal strains if relaxation is free."""
        cup = self.guess
        if 'relaxation' in self.free:
            cup = replace(cup, relaxation=_not_below(cup.relaxation))
        if min(np.linalg.eigvalsh(M)[0] for M in (cup.stiffness, cup.damping)) <= 0.0:
            cup = replace(cup, stiffness=np.diag(np.diag(cup.stiffness)),
                          damping=np.diag(np.diag(cup.damping)))
        return cup

    @property
    def count(self) -> int:
        """Number of unknowns of the cup."""
        return 2 * self.structure.size

    @cached_property
    def places(self) -> Mapping[str, Places]:
        """Indices of free quantities among the unknowns: a row per recording, or one for all."""
        shapes = {name: (len(self.outlines) if self.is_own(name) else 1, KINDS[name].size)
                  for name in sorted(self.free, key=self.is_own)}
        ends = np.cumsum([self.count, *map(math.prod, shapes.values())])
        return {name: first + np.arange(math.prod(shape)).reshape(shape)
                for first, (name, shape) in zip(ends, shapes.items(), strict=False)}

    @cached_property
    def rows(self) -> Mapping[str, Places]:
        """Indices of free quantities among the unknowns of the first recording."""
        return {name: row for name, (row, *_) in self.places.items()}

    @cached_property
    def own(self) -> Places:
        """Indices (R, o) of the own unknowns of each recording."""
        return np.hstack([np.empty((len(self.outlines), 0), dtype=np.int64), *(
            place for name, place in self.places.items() if self.is_own(name))])

    @property
    def shared(self) -> int:
        """Number s of shared unknowns."""
        return len(self.units) - self.own.size

    def _of_all(self, of_cup: Array, of_free: Callable[[str], ArrayLike]) -> Array:
        """Return numbers (m,) from the numbers of the cup, and a function by free quantity."""
        numbers = np.pad(of_cup, (0, sum(place.size for place in self.places.values())))
        for name, place in self.places.items():
            numbers[place] = of_free(name)
        return numbers

    @cached_property
    def units(self) -> Array:
        """Units (m,) of the unknowns."""
        sizes = self.structure.sizes(self.first_cup.stiffness, self.first_cup.damping)
        return self._of_all(sizes, lambda name: KINDS[name].unit)

    @cached_property
    def weights(self) -> Array:
        """Information (m,) of the priors of free quantities."""
        return self._of_all(np.zeros(self.count), lambda name: (
            np.asarray(self.free[name]) / KINDS[name].unit) ** -2)

    @cached_property
    def max_std(self) -> Array:
        """Largest standard errors (m,) of identifiable unknowns."""
        return self._of_all(np.full(self.count, MAX_RELATIVE_ERROR), lambda name: (
            KINDS[name].max_std / KINDS[name].unit))

    @cached_property
    def start(self) -> Array:
        """Unknowns (m,) of the initial guess."""
        return self.unknowns(self.first_cup)

    @cached_property
    def uncoupled(self) -> Array:
        """Directions (s, d) of the shared unknowns without couplings."""
        if self.count <= 2 * STRUCTURES['diagonal'].size:
            return np.eye(self.shared)
        diagonal = [self.structure.parameters(*pair) / self.units[:self.count]
                    for unit in STRUCTURES['diagonal'].basis
                    for pair in ((unit, 0.0 * unit), (0.0 * unit, unit))]
        return block_diag(np.transpose(diagonal), np.eye(self.shared - self.count))

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the unknowns, a single one of a gripper."""
        K, P = self._matrices(theta)
        return replace(self.first_cup, stiffness=K, damping=P)

    def unknowns(self, cup: Cup) -> Array:
        """Return the unknowns of a cup, with other unknowns at the start."""
        return self._of_all(self.structure.parameters(
            cup.stiffness, cup.damping) / self.units[:self.count], lambda name: 0.0)

    def strengths(self, theta: Array) -> Array:
        """Return the strengths of relaxation (2,) of the unknowns."""
        r = np.array(self.first_cup.relaxation)
        for place in self.places.get('relaxation', ()):
            r += (self.units * theta)[place]
        return r

    def stretch(self, theta: Array) -> tuple[float, float]:
        """Return the coefficients of stretch of the unknowns, N/m^2 and N."""
        change = np.sum([(self.units * theta)[place] for place in self.places.get('stretch', ())],
                        axis=0)
        a, b = (self.first_cup.stretch + change * quantities.STRETCH_UNITS).tolist()
        return a, b

    def transferred(self, other: 'Problem', theta: Array) -> Array:
        """Return the unknowns equal to the unknowns of another problem with the same cup."""
        moved = self.start.copy()
        for name in self.places.keys() & other.places:
            moved[self.places[name]] = theta[other.places[name]]
        return moved

    def model(self, theta: Array, segment: Segment) -> tuple[ModelTuple, Free]:
        """Return the model of a segment, and its free quantities, SI units."""
        measured, free = segment.measured, self._values(theta)
        payload = quantities.payload_of(measured.payload, free)
        return model_tuple(self._gripper(theta), payload, quantities.gravity_of(
            measured.gravity, free)), free

    def _values(self, theta: Array) -> Free:
        """Return the free quantities of a recording, SI units."""
        values = self.units * theta
        return {name: values[row] for name, row in self.rows.items()}

    def _gripper(self, theta: Array) -> Cup:
        """Return the cup or cups with their free quantities."""
        cup, free = gripper_of(self.cup(theta), self.structure.places), self._values(theta)
        if 'length' in free:
            cup = replace(cup, length=cup.length + float(free['length'][0]))
        if 'relaxation' in free:
            cup = replace(cup, relaxation=_not_below(self.strengths(theta)))
        if 'stretch' in free:
            cup = replace(cup, stretch=self.stretch(theta))
        return cup

    def at_rest(self, theta: Array) -> tuple[Array, Array, float]:
        """
        Return derivatives (n, q) and residuals (n,) of the standstills, in standard errors.

        A chi^2 above its expectation reduces the weight of the standstills; the weight is the
        third result. Unknowns are of the first recording.
        """
        middle = np.append(np.mean([
            still.package.position[0] for still in self.standstills], axis=0), 0.0)
        rows = np.concatenate([self._balance(theta, still, middle) for still in self.standstills])
        chi2 = float(np.mean(rows[:, -1] ** 2))
        rows /= max(chi2, 1.0) ** 0.5
        return rows[:, :-1], rows[:, -1], chi2

    def _balance(self, theta: Array, still: Standstill, middle: Array) -> Array:
        """Return derivatives and residual (6, q + 1) of a standstill, in standard errors."""
        free = self._values(theta)
        payload = quantities.payload_of(still.payload, free)
        gravity = quantities.gravity_of(still.gravity, free)
        cup = replace(self._gripper(theta), relaxation=(0.0, 0.0))
        context = np.array(still.moves_with_com, float), middle, 0.0
        poses = body.poses_of(still.package, free, *context)
        places = {name: row for name, row in self.rows.items() if name not in body.CLOCKS}
        residual, by_parameter = balance(model_tuple(cup, payload, gravity), still.tool, poses)
        J = (by_parameter @ self._columns(payload, still.gravity, free)[:PARAMETER_COLUMNS, :-1]
             + body.columns_of(poses, free, places, len(theta), context, poses)[0]) * self.units
        std = np.maximum(np.repeat(still.error, 3), MIN_POSE_STD)
        return np.asarray(np.column_stack([J, residual]) / std[:, None])

    def _columns(self, payload: Package, gravity: Array | float, free: Free) -> Array:
        """Return derivatives (:, q + 1) of a model's parameters by the unknowns, SI units."""
        columns = np.zeros((whitening.PARAMETER_COUNT, len(self.units) + 1))
        columns[:BY_DAMPING.stop, :self.count] = self.structure.upper
        for name, row in self.rows.items():
            columns[:, row] = quantities.model_columns(name, payload, gravity, free, len(columns))
        return columns

    def moved(self, theta: Array, step: Array) -> Array:
        """Return unknowns after a step, K and P along a geodesic."""
        moved, ends = theta + step, []
        for M, change in zip(self._matrices(theta), self._matrices(step), strict=True):
            root, inverse = symmetric_roots(M)
            values, vectors = np.linalg.eigh(inverse @ change @ inverse)
            half = root @ vectors * np.exp(0.5 * np.clip(values, -MAX_LOG_STEP, MAX_LOG_STEP))
            ends.append(half @ half.T)
        moved[:self.count] = self.structure.parameters(*ends) / self.units[:self.count]
        for place in self.places.get('relaxation', ()):
            moved[place] = np.maximum(
                moved[place], -np.array(self.first_cup.relaxation) / self.units[place])
        for place in self.places.get('inertia', ()):
            plate, before = self.flattest, (self.units * theta)[place]
            change = pseudo_inertia.by_moments(pseudo_inertia.with_moments(plate, before)) @ (
                self.units * step)[place]
            moved[place] = pseudo_inertia.moments_of(
                plate, pseudo_inertia.stretch_of(plate, before) + np.clip(
                    change, -MAX_LOG_STEP, MAX_LOG_STEP)) / self.units[place]
        return moved

    @property
    def flattest(self) -> Array:
        """Inertia (3, 3) of the flattest package, which limits changes of the moments most."""
        return min((pseudo_inertia.nearest(outline.payload.inertia) for outline in self.outlines),
                   key=pseudo_inertia.flatness)

    def _matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P of unknowns, SI units."""
        return self.structure.matrices((self.units * theta)[:self.count])

    def ordinary_damping(self, stiffness: Array) -> Array:
        """Return the damping (6, 6) with one loss factor for each mode of the package."""
        payload = self.outlines[0].payload
        to_com, inertia = np.eye(6), np.zeros((6, 6))
        to_com[:3, 3:] = -lie.hat(payload.com)
        inertia[:3, :3], inertia[3:, 3:] = payload.mass * np.eye(3), payload.inertia
        root, inverse = symmetric_roots(to_com.T @ inertia @ to_com)
        P = LOSS_FACTOR * root @ symmetric_roots(inverse @ stiffness @ inverse)[0] @ root
        return self.structure.matrices(self.structure.parameters(stiffness, P))[1]

    def largest_damping(self, theta: Array) -> float:
        """Return the largest ratio of a cup's damping to ordinary damping over all directions."""
        K, P = self._matrices(theta)
        inverse = symmetric_roots(self.ordinary_damping(K))[1]
        return float(np.linalg.eigvalsh(inverse @ P @ inverse)[-1])

    def prior(self, theta: Array) -> tuple[Arrow, Array]:
        """Return information (m, m) and slope (m,) of the prior."""
        weights, own = self.weights[:self.shared], self.weights[self.own]
        H, (recordings, count) = np.diag(weights), self.own.shape
        g = self.weights * (self.start - theta)
        for place, J, deviation in self._wide_priors(theta):
            H[np.ix_(place, place)] += J.T @ J
            g[place] -= J.T @ deviation
        return Arrow(H, np.zeros((recordings, count, len(H))), own[:, :, None] * np.eye(count),
                     self.own), g

    def _wide_priors(self, theta: Array) -> Iterator[tuple[Places, Array, Array]]:
        """
        Yield places (k,), derivatives (n, k) and sizes (n,) of deviations in standard deviations.

        They are of K, P, relaxation and inertia. Sizes are relative to the mass: K, P, inertia and
        mass scaled by one factor give equal motion, and only the given mass determines the factor.
        """
        mass = self.rows.get('mass', np.empty(0, dtype=np.int64))
        heavier, by_mass = float(np.sum((self.units * theta)[mass])), self.units[mass]
        size, (K, P) = self.count // 2, self._matrices(theta)
        for first, M, mean, std in (
                (0, K, np.exp(heavier) * self._matrices(self.start)[0], WIDE_LOG_STD),
                (size, P, np.exp(0.5 * heavier) * self.ordinary_damping(K),
                 APPROACH_LOG_STD if self.forgetting else DAMPING_LOG_STD)):
            place = np.arange(first, first + size)
            inverse = symmetric_roots(M)[1]
            slopes = inverse @ (self.structure.basis * self.units[place, None, None]) @ inverse
            values, vectors = np.linalg.eigh(inverse @ mean @ inverse)
            yield np.append(place, mass), np.hstack([
                slopes.reshape(size, -1).T, -np.reshape(np.eye(6), (-1, 1)) * by_mass]) / std, (
                vectors * -np.log(values) @ vectors.T).ravel() / std
        for place in self.places.get('relaxation', ()):  # the ratio of r2 and r1
            r = self.strengths(theta)
            std = RATIO_STD * max(r[0], TYPICAL_STRENGTH)
            slope = np.array([-DEFAULT_RATIO, 1.0])
            yield place, slope[None] * self.units[place] / std, slope[None] @ r / std
        for place in self.places.get('inertia', ()):  # the thickness
            plate, moments = self.flattest, (self.units * theta)[place] - heavier
            slope = pseudo_inertia.by_moments(pseudo_inertia.with_moments(plate, moments))
            yield np.append(place, mass), np.hstack([
                slope * self.units[place], -slope.sum(axis=1)[:, None] * by_mass
            ]) / WIDE_LOG_STD, pseudo_inertia.stretch_of(plate, moments) / WIDE_LOG_STD

    def whitened(self, theta: Array, segment: Segment, course: Course) -> WhitenedSegment:
        """Return a segment's whitened differences, linearised about a course; theta is local."""
        model, free = self.model(theta, segment)
        nodes = segment.nodes(*(
            float(free.get(name, (0.0,))[0]) for name in ('time_offset', 'clock_rate')))
        path = whitening.Path(
            simulation.tool_rows(resample(course.path, nodes.stamps)), nodes.lengths,
            substeps_of(nodes.lengths, self._integration_step(model, segment)))
        start = _start_near_rest(model, path.rows[0], course)
        mean = _difference(start, adapted(
            model, simulation.row_state(path.rows[0]), segment.expected_start))
        marker = free.get('tool_marker', np.zeros(6))
        tool_noise = segment.tool_noise(course.deviation + marker, nodes)
        initial_std = INITIAL_STD[:len(mean)]
        is_correlated = segment.measured.package_noise.correlation > 0.0
        std = [initial_std, np.zeros(6), course.std][:3 if is_correlated else 2]
        first = whitening.relaxing(model), whitening.with_inner(start)
        poses, seen = self._poses(segment, course, nodes, free), None
        if segment.views is not None and not self.forgetting:
            seen = self._seen(segment, course, nodes, free, *first, path)
            poses = poses._replace(
                views=seen.views, white_variance=np.tile(seen.variance[:, None], 6))
        result = whitening.whiten(
            *first, mean, np.concatenate(std), path, tool_noise, poses,
            self._unknowns(theta, segment, free, nodes.stamps),
            self.forgetting**4 * segment.period * course.std**2)
        innovations, slopes, _, _, gains, _ = result
        smoothed, slope = whitening.smooth(
            result, nodes.place, tool_noise.variances, len(mean) + 6)
        change = np.zeros_like(course.deviation)
        change[nodes.sampled] = smoothed[nodes.samples]
        correction = mean - initial_std**2 * slope[:len(mean)]
        with np.errstate(divide='ignore'):  # no weights for a diverging simulation
            variance = gains[:, :, -1] ** -2
        return WhitenedSegment(
            innovations.ravel(), slopes.reshape(innovations.size, -1), variance,
            np.median(poses.white_variance, axis=0) if seen else (
                1.0 - segment.measured.package_noise.correlation**2) * course.std**2,
            nodes.used, seen.scale if seen else np.ones(6),
            first_order(change, segment.measured.tool_noise.correlation) + marker,
            whitening.shifted(start, correction),
            *self._sums(theta, segment, course, nodes, path, slopes, innovations),
            seen.smear if seen else np.empty(0))

    def _sums(
        self, theta: Array, segment: Segment, course: Course, nodes: Nodes, path: whitening.Path,
        slopes: Array, innovations: Array,
    ) -> tuple[Array, Array]:
        """Return information (c, q, q) and slope (c, q) of each second, of all sensors."""
        sums = [sums_of_blocks(slopes, innovations, segment.period)]
        for readings in () if self.forgetting else segment.measured.further:
            if readings.quantities.keys() & self.rows:
                sums.append(self._compared(theta, segment, course, nodes, path, readings))
        order = np.argsort(np.concatenate([
            np.linspace(0.0, 1.0, len(each)) for each, _ in sums]), kind='stable')
        information, slope = (np.concatenate(pair)[order] for pair in zip(*sums, strict=True))
        return information, slope

    def _compared(
        self, theta: Array, segment: Segment, course: Course, nodes: Nodes, path: whitening.Path,
        readings: Readings,
    ) -> tuple[Array, Array]:
        """Return information (c, q, q) and slope (c, q) of each second of a further sensor."""
        now, free = self._simulated(theta, segment, course, path), self._values(theta)
        compared = readings.compared(
            path.rows, nodes.stamps, now.gravity, (segment.span_ns or segment.ends_ns)[0])
        here = compared.predicted(now, free)
        moves = np.any(self._columns(
            now.payload, segment.measured.gravity, free)[:, :-1], axis=0)
        own = np.isin(np.arange(len(theta)), [
            row for name in readings.quantities for row in self.rows.get(name, ())])
        J = np.zeros((*here.shape, len(theta)))
        for j in np.flatnonzero(moves | own).tolist():
            step = DIFFERENCE_STEP[j >= self.count] * (np.arange(len(theta)) == j)
            motion = self._simulated(theta + step, segment, course, path) if moves[j] else now
            J[..., j] = (compared.predicted(motion, self._values(theta + step)) - here) / step[j]
        return sums_of_blocks(
            *compared.whitened(J, compared.values - here), compared.period)

    def _simulated(
        self, theta: Array, segment: Segment, course: Course, path: whitening.Path
    ) -> SimulatedMotion:
        """Return the simulated motion at nodes."""
        (model, free), measured = self.model(theta, segment), segment.measured
        start = _start_near_rest(model, path.rows[0], course)
        motion = np.empty((len(path.rows), 19))
        whitening.write_motion(
            whitening.relaxing(model), whitening.with_inner(start), path,
            np.arange(len(motion)), np.zeros(len(motion)), motion)
        return SimulatedMotion(
            quantities.payload_of(measured.payload, free),
            quantities.gravity_of(measured.gravity, free), motion, path.rows)

    def _integration_step(self, model: ModelTuple, segment: Segment) -> float:
        """Return the longest step (s) of the integrator, or raise for too fast a cup."""
        longest, first = (COARSE_FACTOR * largest_step(each) for each in (
            model, self.model(self.start, segment)[0]))
        shortest = max(MIN_INTEGRATION_STEP, first / MAX_QUICKENING)
        if longest < shortest:
            raise BellowsError(
                f'With this cup the simulation needs integration steps of {longest:.2g} s; at '
                f'least {shortest:.2g} s is expected. Check the units of package.mass, '
                'package.inertia, cup.stiffness and cup.damping.')
        return min(longest, MAX_INTEGRATION_STEP)

    def _unknowns(
        self, theta: Array, segment: Segment, free: Free, stamps: Stamps
    ) -> whitening.Unknowns:
        """Return the effect of a segment's unknowns on its model at nodes."""
        payload = quantities.payload_of(segment.measured.payload, free)
        columns = self._columns(payload, segment.measured.gravity, free)
        columns[:, :-1] *= self.units
        used = np.flatnonzero(np.any(columns[:PARAMETER_COLUMNS], axis=1))[-1]
        first, last = segment.span_ns or segment.ends_ns
        profiles = {
            'length_drift': (stamps - first) / (last - first) - 0.5,
            'slip': (stamps >= self.slip_ns) & (self.slip_ns >= first)}
        changing = self.rows.keys() & profiles
        scales = np.ones((len(stamps), len(theta) if changing else 0))
        values = np.zeros(scales.shape[1])
        for name in changing:
            scales[:, self.rows[name]] = profiles[name][:, None]
            values[self.rows[name]] = theta[self.rows[name]]
        return whitening.Unknowns(
            BY_DAMPING.stop if used < BY_DAMPING.stop else PARAMETER_COLUMNS, columns, scales,
            values, int(self.rows.get('tool_marker', (-1,))[0]))

    def _poses(
        self, segment: Segment, course: Course, nodes: Nodes, free: Free
    ) -> whitening.Poses:
        """Return the package's poses at the nodes, corrected by the free quantities."""
        noise, poses = segment.measured.package_noise, segment.package.select(nodes.used)
        white = MIN_POSE_STD if noise.correlation > 0.0 else course.std
        return whitening.Poses(
            nodes.place, body.views(
                poses, free, self.rows, self.units, segment.context, course.path, nodes.delays),
            np.tile(white**2, (len(poses), 1)), course.std**2,
            noise.correlation ** (nodes.lengths / segment.period))

    def _seen(
        self, segment: Segment, course: Course, nodes: Nodes, free: Free, model: ModelTuple,
        start: State, path: whitening.Path,
    ) -> Seen:
        """Return the views of a tag at the nodes about the simulated package."""
        assert segment.views is not None
        views = segment.views.select(nodes.used)
        motion = np.empty((len(views.corners), 19))
        whitening.write_motion(model, start, path, nodes.place, nodes.delays, motion)
        return views.seen(motion, course.corners, free, self.rows, self.units, segment.context)


def _changed(
    change: Callable[[MeasuredSegment], MeasuredSegment], segments: Segments
) -> tuple[Segments, Outline]:
    """Return other segments of a recording, and their outline."""
    other = segments_of([change(segment.measured) for segment in segments])
    return other, outline_of(other)


def _not_below(strengths: ArrayLike) -> tuple[float, float]:
    """Return strengths of relaxation large enough for internal strains."""
    r = np.maximum(strengths, MIN_STRENGTH)
    return float(r[0]), float(r[1])


def _start_near_rest(model: ModelTuple, tool: Array, course: Course) -> State:
    """
    Return the first state of a course, at rest if its pose is within the noise of the poses.

    Noise in the first state would excite a swing, which derivatives would treat as motion. The
    twist is not tested, because for a slow camera its uncertainty exceeds ordinary swings.
    """
    start = adapted(model, simulation.row_state(tool), course.start)
    try:
        rest = simulation.rest(model, tool)
    except UnstableError:
        return start
    difference = _difference(rest, start)
    size = np.max(np.abs(difference[:6]) / course.std) / CHANCE
    return whitening.shifted(rest, (1.0 - max(size, 1.0) ** -2) * difference)


def _difference(body: State, other: State) -> Array:
    """Return the difference (12,) of two states, with internal strains (24,)."""
    return np.concatenate([*pose_error(body, other[0], other[1]), *(
        np.ravel(np.array(end) - np.array(begin))
        for begin, end in zip(body[2:], other[2:], strict=True))])
