"""
Search for K and P with which the model, driven by the measured tool, meets all poses.

All other uncertain quantities are free, with their prior as one more measurement. `whitening` has
the weights of the differences. The steps are Gauss-Newton steps, with derivatives along the
likeliest path of the tool: their mean is zero at the truth, unlike the gradient of chi² along the
measured path, or of the likelihood with its weights. K and P move along geodesics of the definite
matrices, with a wide prior on the logarithm of their size, K about the start, P about ordinary
rubber; the prior is negligible for entries that the recordings determine.

A remote start approaches first, with nearly constant damping and without couplings, which noise
would move anywhere: with an unknown acceleration of the package the differences forget the past.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
import math
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.geometry.jit import usable_cores
from bellows_ros.core.identification import quantities, whitening
from bellows_ros.core.identification.quantities import Free, KINDS
from bellows_ros.core.identification.result import MAX_RELATIVE_ERROR
from bellows_ros.core.identification.segments import MIN_POSE_STD, Nodes, Segment
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple
from bellows_ros.core.model.equilibrium import adapted, largest_step, pose_error, substeps_of
from bellows_ros.core.model.jacobians import BY_DAMPING, PARAMETER_COLUMNS
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.signals.resampling import MAD_TO_STD, resample
from bellows_ros.core.signals.savgol import first_order
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np
from numpy.typing import ArrayLike

INITIAL_STD = np.repeat([0.05, 0.3, 0.5, 3.0, 0.01, 0.1, 0.01, 0.1], 3)
"""
Standard deviation of the package's first state about its first pose, at rest, and of internal
strains; SI units.
"""

REST_SIGMAS = 3.0
"""Standard deviations of a pose beyond which a package swings at first."""

MIN_STRENGTH, TYPICAL_STRENGTH = 1e-6, 0.05
"""Strengths of relaxation: the smallest one in a search for them, and that of soft rubber."""

DEFAULT_RATIO = 1.05
"""Ratio r2 / r1 of rubber with a constant loss factor."""

RATIO_STD = 0.4
"""Standard deviation of the ratio r2 / r1 among rubbers."""

MAX_INTEGRATION_STEP = 0.005
"""Longest step of the integrator (s)."""

MIN_INTEGRATION_STEP = 5e-6
"""
Shortest step of the integrator (s).

A cup that needs shorter ones, for modes faster than 20,000/s, is no cup: the search turns back.
"""

MAX_QUICKENING = 30.0
"""Times as fast as with the start that modes may become: 100 times as stiff, they are 10 times as
fast, and some three times that with ten times ordinary damping."""

COARSE_FACTOR = 4.0
"""Factor of the integrator's steps during the approach: fast modes need no accuracy there."""

FORGETTING_RATE = 30.0
"""Rate at which an unknown acceleration makes the model forget during the approach, 1/s."""

APPROACH_DAMPING, MAX_FINAL_DAMPING = 1e-2, 1e-2
"""Smallest damping of the approach, in which noise would carry away what is hardly determined, and
largest of the last step: a damped step is short wherever the minimum is."""

PRIOR_LOG_STD, APPROACH_LOG_STD = (2.0, 1.0), 0.3
"""Standard deviation of the logarithm of the size of K, about the start, and of P; that of P in
the approach."""

LOSS_FACTOR = 0.25
"""Loss factor of ordinary rubber. Without damping a fit to noise would ring."""

MAX_LOG_STEP = 1.0
"""Largest change of the logarithm of K or P in a step."""

ANDERSON_DEPTH, MAX_ANDERSON_WEIGHT, MIN_SINGULAR_VALUE = 3, 0.9, 0.1
"""
How many earlier steps a step is mixed with, the largest weight of one of them (a step 10 times
too long has 0.9), and the smallest singular value, in the largest, that counts.
"""

NOISE_TOLERANCE = 0.03
"""Relative change of the noise of slow poses below which it is kept."""

MAX_APPROACH_STEPS, MAX_STEPS, MAX_MISFIT_STEPS = 10, 60, 30
"""
Largest numbers of steps: of the approach, after that, and after that with a misfit.

So a search simulates a wrong recording 53 times at most (with clocks or frames free, 64). A whole
fit is several: with relaxation, the likeliest causes and what was given free in turn.
"""

MAX_WANDERING_STEPS = 10
"""Steps that a search goes on after the shortest one, if that is short enough: where noise has
changed derivatives, it may leave the root again."""

MAX_DAMPING, MAX_STIFFENING = 10.0, 100.0
"""Times ordinary damping, and the stiffness of the start, that a cup hardly has."""

DIVERGED = 1e3
"""Difference of a pose from a diverging simulation, standard deviations."""

CHANCE = 3.0
"""Deviation of an estimated variance of noise by chance, standard deviations."""

WHITE_LAGS = (1, 2, 3)
"""Lags at which innovations are tested for correlation, poses."""

WHITE_SIGMAS = 4.0
"""Largest correlation of white innovations, standard deviations; false-alarm rate 1 in 900."""

MAX_WHITE_CORRELATION = 0.1
"""Largest correlation of innovations that count as white."""

MAX_CLIPPED = 3.0
"""Size at which innovations are clipped in the test for whiteness, standard deviations."""

MAX_NOISE_CHI2, MISFIT_CHI2 = 1.2, 1.5
"""Chi^2 per difference that is put down to noise, and above which surely more is left."""

APPROACH_TOLERANCE, TOLERANCE, LOOSE_TOLERANCE = 3.0, 3e-3, 0.1
"""
Squared length of a step, in standard deviations, that ends the approach, and the search.

And the largest of the last step allowed: numbers that are barely identifiable keep oscillating.
"""

SHORTER = 0.25
"""Fraction of a step that is tried if chi² rises with the whole step."""

MAX_RISE = 1.2
"""Factor by which the sum of squares, in noise as it is estimated now, may rise in a step: their
weights change, too."""

MAX_SMALL_RISE = 1.02
"""Factor of a rise of chi² after which the next step is shorter."""


class WhitenedSegment(NamedTuple):
    """
    The whitened differences of a segment.

    Innovations (6 N,), their derivatives (6 N, q) by the unknowns of the segment, the places (q,)
    of these among all m unknowns, the variance (N, 6) of each
    difference and that (6,) of the innovation of a pose's noise, and the likeliest changes of the
    tool's path and first state of the package.
    """

    innovations: Array
    jacobian: Array
    places: Places
    variance: Array
    new_variance: Array
    tool_change: Array
    start: State

    def information(self, size: int) -> Array:
        """Return J^T J (m, m) of the segment among all unknowns."""
        H = np.zeros((size, size))
        H[np.ix_(self.places, self.places)] = self.jacobian.T @ self.jacobian
        return H

    @property
    def residuals(self) -> Array:
        """The differences (N, 6) themselves, m and rad."""
        return np.asarray(self.innovations.reshape(-1, 6) * np.sqrt(self.variance))

    @property
    def is_white(self) -> bool:
        """Whether neighbouring innovations are uncorrelated."""
        e = np.clip(self.innovations.reshape(-1, 6), -MAX_CLIPPED, MAX_CLIPPED)
        correlation = [np.sum(e[lag:] * e[:-lag], axis=0) / np.sum(e**2, axis=0)
                       for lag in WHITE_LAGS if lag < len(e)]
        limit = max(MAX_WHITE_CORRELATION, WHITE_SIGMAS / np.sqrt(len(e)))
        return bool(np.max(np.abs(correlation), initial=0.0) < limit)


Report = Callable[[Cup, float], None]
"""Called with the cup after a step, and chi^2."""


def no_report(cup: Cup, chi2: float) -> None:
    """Report nothing."""


System = tuple[list[WhitenedSegment], Array, Array]
"""The whitened segments, and information (m, m) and slope (m,) of the whole."""


class Minimum(NamedTuple):
    """
    Where the search ended: unknowns, segments, information, and whether it is a minimum.

    And the noise (6,) of the poses of each segment, as it was estimated.
    """

    theta: Array
    parts: list[WhitenedSegment]
    information: Array
    converged: bool
    noise: tuple[Array, ...]

    @property
    def residual_count(self) -> int:
        """Number of differences."""
        return sum(len(part.innovations) for part in self.parts)

    @property
    def squares(self) -> float:
        """The sum of squares."""
        return squares(self.parts)

    @property
    def robust_chi2(self) -> float:
        """Chi^2 per difference, from their median: tails of the noise do not count."""
        r = np.concatenate([part.innovations for part in self.parts])
        return float(np.median(np.abs(r)) * MAD_TO_STD) ** 2

    @property
    def colour(self) -> float:
        """Squares that memory and tails of the noise make of those of white normal noise."""
        r = [part.innovations.reshape(-1, 6) for part in self.parts]
        kept = sum(np.sum(one[1:] * one[:-1]) for one in r) / max(self.squares, 1e-99)
        kept = min(max(float(kept), 0.0), 0.95)
        return max(self.squares / self.residual_count, 1.0) * (1.0 + kept) / (1.0 - kept)

    @property
    def residuals(self) -> Array:
        """The differences (N, 6) of all segments, m and rad."""
        return np.concatenate([part.residuals for part in self.parts])


class Parametrization:
    """
    What the unknowns of a search are, what they make of the cup, and what was given of them.

    The unknowns theta are those of the structure in units of their size, then the quantities of
    `KINDS` that are free, one after the other, in theirs.

    Parameters
    ----------
    segments : list of Segment
        Of one cup's recordings.
    structure : Structure
        Of K and P.
    start : Cup
        First guess, with the length.
    free : mapping
        Standard deviation, SI units, of what else is free, by names of `KINDS`.
    slip_ns : int
        Stamp at which the package slips, if that is free.

    """

    def __init__(
        self, segments: list[Segment], structure: Structure, start: Cup, free: Free,
        slip_ns: int = 0,
    ) -> None:
        if 'relaxation' in free:
            start = replace(start, relaxation=_not_below(start.relaxation))
        if min(np.linalg.eigvalsh(M)[0] for M in (start.stiffness, start.damping)) <= 0.0:
            start = replace(start, stiffness=np.diag(np.diag(start.stiffness)),
                            damping=np.diag(np.diag(start.damping)))
        self.segments, self.structure, self.start_cup = segments, structure, start
        self.slip_ns = slip_ns
        units = structure.sizes(start.stiffness, start.damping)
        recordings = 1 + max(segment.measured.recording for segment in segments)
        shapes = [(recordings if KINDS[name].each else 1, KINDS[name].size) for name in free]
        ends = np.cumsum([len(units), *map(math.prod, shapes)])
        self.count, more = len(units), (0, ends[-1] - len(units))
        self.units, self.weights = np.pad(units, more), np.zeros(ends[-1])
        self.max_std = np.full(ends[-1], MAX_RELATIVE_ERROR)  # of what is identifiable
        self.places = dict[str, Places]()
        for (name, std), shape, first in zip(free.items(), shapes, ends[:-1], strict=True):
            kind, place = KINDS[name], first + np.arange(math.prod(shape)).reshape(shape)
            self.places[name], self.units[place] = place, kind.unit
            self.max_std[place] = kind.max_std / kind.unit
            self.weights[place] = (np.asarray(std) / kind.unit) ** -2
        self.fixing = np.zeros((ends[-1],) * 2)  # more information on the start
        self.start = np.pad(structure.parameters(start.stiffness, start.damping) / units, more)
        self.shortest_step = max(MIN_INTEGRATION_STEP, min(
            largest_step(self.model(self.start, segment)[0]) for segment in segments
        ) / MAX_QUICKENING)
        self.uncoupled = np.eye(len(self.start))  # directions without couplings
        if self.count > 2 * STRUCTURES['diagonal'].size:
            diagonal = [structure.parameters(*pair) / units
                        for unit in STRUCTURES['diagonal'].basis
                        for pair in ((unit, 0.0 * unit), (0.0 * unit, unit))]
            self.uncoupled = np.vstack([
                np.pad(diagonal, ((0, 0), more)), self.uncoupled[self.count:]]).T

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the unknowns, one of those of a gripper."""
        K, P = self._matrices(theta)
        return replace(self.start_cup, stiffness=K, damping=P)

    def unknowns(self, cup: Cup) -> Array:
        """Return the unknowns of a cup, and nothing else changed."""
        theta = self.start.copy()
        theta[:self.count] = self.structure.parameters(
            cup.stiffness, cup.damping) / self.units[:self.count]
        return theta

    def strengths(self, theta: Array) -> Array:
        """Return the strengths of relaxation (2,) of the unknowns."""
        r = np.array(self.start_cup.relaxation)
        for place in self.places.get('relaxation', ()):
            r += (self.units * theta)[place]
        return r

    def stretch(self, theta: Array) -> tuple[float, float]:
        """Return the coefficients of stretch of the unknowns, N/m^2 and N."""
        change = np.sum([(self.units * theta)[place] for place in self.places.get('stretch', ())],
                        axis=0)
        a, b = (self.start_cup.stretch + change * quantities.STRETCH_UNITS).tolist()
        return a, b

    def estimate(self, minimum: Minimum, name: str) -> tuple[Array, Array]:
        """Return what is free by a name, SI units, with standard errors by its information."""
        place = self.places[name].ravel()
        std = np.sqrt(np.diag(np.linalg.inv(minimum.information)))
        return (self.units * minimum.theta)[place], (self.units * std)[place]

    def places_of(self, segment: Segment) -> dict[str, Places]:
        """Return where a segment's free quantities are, by name."""
        return {name: rows[segment.measured.recording if KINDS[name].each else 0]
                for name, rows in self.places.items()}

    def index_of(self, segment: Segment) -> Places:
        """Return the places (q,) of a segment's unknowns, of the cup and its free quantities."""
        return np.sort(np.concatenate([
            np.arange(self.count), *self.places_of(segment).values()]).astype(np.int64))

    def transferred(self, other: 'Parametrization', theta: Array) -> Array:
        """Return the unknowns at those of another search with the same cup."""
        moved = self.start.copy()
        for name in self.places.keys() & other.places:
            moved[self.places[name]] = theta[other.places[name]]
        return moved

    def model(self, theta: Array, segment: Segment) -> tuple[ModelTuple, Free]:
        """Return the model of a segment, and what is free in it, SI units."""
        values = self.units * theta
        free = {name: values[places] for name, places in self.places_of(segment).items()}
        cup, measured = gripper_of(self.cup(theta), self.structure.places), segment.measured
        if 'length' in free:
            cup = replace(cup, length=cup.length + float(free['length'][0]))
        if 'relaxation' in free:
            cup = replace(cup, relaxation=_not_below(self.strengths(theta)))
        if 'stretch' in free:
            cup = replace(cup, stretch=self.stretch(theta))
        payload = quantities.payload_of(measured.payload, free)
        return model_tuple(cup, payload, quantities.gravity_of(measured.gravity, free)), free

    def moved(self, theta: Array, step: Array) -> Array:
        """Return unknowns after a step, K and P along a geodesic."""
        moved, ends = theta + step, []
        for M, change in zip(self._matrices(theta), self._matrices(step), strict=True):
            root, inverse = _symmetric_roots(M)
            values, vectors = np.linalg.eigh(inverse @ change @ inverse)
            half = root @ vectors * np.exp(0.5 * np.clip(values, -MAX_LOG_STEP, MAX_LOG_STEP))
            ends.append(half @ half.T)
        moved[:self.count] = self.structure.parameters(*ends) / self.units[:self.count]
        for place in self.places.get('relaxation', ()):
            moved[place] = np.maximum(
                moved[place], -np.array(self.start_cup.relaxation) / self.units[place])
        return moved

    def _matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P of unknowns, SI units."""
        return self.structure.matrices((self.units * theta)[:self.count])

    def ordinary_damping(self, stiffness: Array) -> Array:
        """Return the damping (6, 6) with which each mode of the package has one loss factor."""
        payload = self.segments[0].measured.payload
        to_com, inertia = np.eye(6), np.zeros((6, 6))
        to_com[:3, 3:] = -lie.hat(payload.com)
        inertia[:3, :3], inertia[3:, 3:] = payload.mass * np.eye(3), payload.inertia
        root, inverse = _symmetric_roots(to_com.T @ inertia @ to_com)
        P = LOSS_FACTOR * root @ _symmetric_roots(inverse @ stiffness @ inverse)[0] @ root
        return self.structure.matrices(self.structure.parameters(stiffness, P))[1]

    def largest_damping(self, theta: Array) -> float:
        """Return the most that a cup damps in some direction, in ordinary damping."""
        K, P = self._matrices(theta)
        inverse = _symmetric_roots(self.ordinary_damping(K))[1]
        return float(np.linalg.eigvalsh(inverse @ P @ inverse)[-1])

    def prior(self, theta: Array, forgetting: float) -> tuple[Array, Array]:
        """Return information (m, m) and slope (m,) of the prior."""
        H = np.diag(self.weights) + self.fixing
        g = H @ (self.start - theta)
        size = self.count // 2
        K, P = self._matrices(theta)
        means = self._matrices(self.start)[0], self.ordinary_damping(K)
        stds = PRIOR_LOG_STD[0], APPROACH_LOG_STD if forgetting else PRIOR_LOG_STD[1]
        for first, M, mean, std in zip((0, size), (K, P), means, stds, strict=True):
            index = slice(first, first + size)
            unit = np.array(self.structure.basis) * self.units[index, None, None]
            root, inverse = _symmetric_roots(M)
            slopes = inverse @ unit @ inverse
            values, vectors = np.linalg.eigh(inverse @ mean @ inverse)
            difference = (vectors * np.log(values)) @ vectors.T
            H[index, index] += np.einsum('aij,bji->ab', slopes, slopes) / std**2
            g[index] = np.einsum('aij,ji->a', slopes, difference) / std**2
        for place in self.places.get('relaxation', ()):  # rubbers differ in the ratio of r2 to r1
            r = self.strengths(theta)
            std = RATIO_STD * max(r[0], TYPICAL_STRENGTH)
            slope = np.array([-DEFAULT_RATIO, 1.0]) * self.units[place] / std
            H[np.ix_(place, place)] += np.outer(slope, slope)
            g[place] -= slope * (r[1] - DEFAULT_RATIO * r[0]) / std
        return H, g


class Search(Parametrization):
    """Gauss-Newton steps of the unknowns."""

    def with_free(
        self, theta: Array, more: Free, structure: Structure | None = None
    ) -> 'Search':
        """Return a search from some unknowns with more free quantities or another structure."""
        free = {name: self.units[rows[0]] * self.weights[rows[0]] ** -0.5
                for name, rows in self.places.items()}
        return Search(self.segments, structure or self.structure, self.cup(theta),
                      {**free, **more}, self.slip_ns)

    def minimum(
        self, report: Report = no_report, near: Array | None = None, system: System | None = None
    ) -> Minimum:
        """Find the root, from unknowns near to it, and the system there, where they are given."""
        if near is not None:
            return self._descend(near, 0.0, np.eye(len(near)), report, system)
        return self.root_from(self.approach(report), report)

    def root_from(self, start: Minimum, report: Report = no_report) -> Minimum:
        """Find the root from where an approach ended."""
        try:
            return self._descend(start.theta, 0.0, np.eye(len(start.theta)), report)
        except BellowsError:  # the long steps of the approach took a cup that is too fast
            return start

    def approach(
        self, report: Report = no_report, held: Collection[str] = (), with_couplings: bool = True
    ) -> Minimum:
        """
        Return where the search comes near to the root.

        Without couplings, which noise would disturb; with them, if they are wanted, where a misfit
        remains without. Clocks and frames of each recording approach first: as long as they are
        far off, a cup that does not swing explains most. Names that are held stay: the differences
        forget what they are known by.
        """
        stay = [row for name in held for row in self.places[name].ravel()]
        everything, diagonal = (matrix[:, ~np.any(matrix[stay], axis=0)] for matrix in (
            np.eye(len(self.start)), self.uncoupled))
        each = [rows.ravel() for name, rows in self.places.items()
                if KINDS[name].each and name not in held]
        start = self.start
        if each:
            start = self._descend(start, FORGETTING_RATE, np.eye(len(start))[
                :, np.concatenate(each)], report).theta
        minimum = self._descend(start, FORGETTING_RATE, diagonal, report)
        if with_couplings and diagonal.shape != everything.shape and not (
                minimum.squares < MISFIT_CHI2 * minimum.residual_count):
            for segment in self.segments:
                segment.reset()
            minimum = self._descend(start, FORGETTING_RATE, everything, report)
        return minimum._replace(converged=False)

    def _descend(
        self, theta: Array, forgetting: float, directions: Array,
        report: Report, system: System | None = None,
    ) -> Minimum:
        """
        Return the root in some directions, or where the poses were likeliest.

        The latter if the search does not converge, and with an unknown acceleration of the
        package that forgets at a rate (1/s).
        """
        parts, H, g = system or self.system(theta, forgetting)
        if not np.all(np.isfinite(g)):
            finite = [part._replace(
                innovations=np.nan_to_num(part.innovations, nan=DIVERGED), **{
                    name: np.nan_to_num(getattr(part, name), posinf=0.0)
                    for name in ('jacobian', 'variance')}) for part in parts]
            return Minimum(theta, finite, np.eye(len(theta)), False, self.noise)
        min_damping, tolerance, max_steps = (
            (APPROACH_DAMPING, APPROACH_TOLERANCE, MAX_APPROACH_STEPS) if forgetting else
            (0.0, TOLERANCE, MAX_STEPS))
        damping, settled, is_fresh = min_damping, True, True
        objective = squares if forgetting else deviance
        history: list[tuple[Array, Array]] = []  # steps, and how far the search went after each
        expected = sum(len(part.innovations) for part in parts)  # with noise as it was assumed
        largest = MAX_RISE * max(squares(parts), expected)
        best, lowest = Minimum(theta, parts, H, False, self.noise), (True, math.inf)
        best_number = 0
        for number in range(max_steps):
            is_misfit = number >= MAX_MISFIT_STEPS and squares(parts) > MISFIT_CHI2 * expected
            if is_misfit or best.converged and number > best_number + MAX_WANDERING_STEPS:
                break
            step = self._damped_step(theta, H, g, damping, directions)
            length = self.squared_length(step, H)
            is_near = not forgetting and settled and (
                length < LOOSE_TOLERANCE and damping <= MAX_FINAL_DAMPING)
            cost = not is_near, length if is_near else objective(parts)
            if cost < lowest:
                best, lowest, best_number = (
                    Minimum(theta, parts, H, is_near, self.noise), cost, number)
            steps = _anderson_step(step, H, history), SHORTER * step
            moved, new = self._moved_below(theta, steps, forgetting, largest)
            if new is None:
                history = []
                if is_fresh:
                    damping = max(10.0 * damping, 1e-2)
                else:  # squares are compared along the same path, in the same noise
                    again = self.system(theta, forgetting)
                    if not np.all(np.isfinite(again[2])):
                        break
                    (parts, H, g), is_fresh = again, True
                    largest = MAX_RISE * max(squares(parts), expected)
                continue
            history = [*history, (step, moved - theta)][-ANDERSON_DEPTH:]
            rises = squares(new[0]) > MAX_SMALL_RISE * max(squares(parts), expected)
            theta, (parts, H, g) = moved, new
            self.accept(parts)
            before, is_fresh = self.noise, False
            settled = forgetting > 0.0 or self.update_noise(parts)
            largest = MAX_RISE * max(expected, sum(
                float(np.sum((part.innovations.reshape(-1, 6) * std / segment.std) ** 2))
                for segment, part, std in zip(self.segments, parts, before, strict=True)))
            settled &= damping <= MAX_FINAL_DAMPING
            damping = max(10.0 * damping, 1e-3) if rises else (
                max(0.1 * damping, min_damping) if damping > 1e-5 else 0.0)
            report(self.cup(theta), squares(parts) / expected)
            if length < tolerance and settled:
                break
        is_near = not forgetting and settled and length < LOOSE_TOLERANCE
        if not is_near and lowest < (True, objective(parts)):
            self.restore(best)
            return best
        self.update_noise(parts)
        return Minimum(theta, parts, H, is_near, self.noise)

    def _moved_below(
        self, theta: Array, steps: Iterable[Array], forgetting: float, largest: float
    ) -> tuple[Array, System | None]:
        """Return where squares are below the largest after the first step, if any, and there."""
        for step in steps:
            theta_moved = self.moved(theta, step)
            with suppress(BellowsError):  # no cup is that short or fast, no clock that far off
                system = self.system(theta_moved, forgetting)
                if squares(system[0]) < largest:  # nor nan
                    return theta_moved, system
        return theta, None

    def _damped_step(
        self, theta: Array, H: Array, g: Array, damping: float, directions: Array
    ) -> Array:
        """Return the step in some directions that no strength of relaxation takes below zero."""
        step = g
        for _ in range(3):  # as each strength may be stopped by the step, too
            D = directions
            for place in self.places.get('relaxation', ()):
                stopped = place[(self.strengths(theta) <= MIN_STRENGTH) & ~(step[place] > 0.0)]
                D = directions[:, ~np.any(directions[stopped], axis=0)]
            step = D @ np.linalg.solve(D.T @ (H + damping * np.diag(np.diag(H))) @ D, D.T @ g)
        return np.asarray(step)

    def squared_length(self, step: Array, H: Array) -> float:
        """
        Return the squared length of a step in standard errors, at some information.

        What is not identifiable may go on wandering: it does not decide over the others.
        """
        covariance = np.linalg.inv(H)
        identifiable = np.sqrt(np.diag(covariance)) < self.max_std
        if not identifiable.any():
            return float(step @ H @ step)
        part = step[identifiable]
        return float(part @ np.linalg.solve(
            covariance[np.ix_(identifiable, identifiable)], part))

    def system(self, theta: Array, forgetting: float = 0.0) -> System:
        """Return the whitened segments, and information and slope of the whole."""
        def whitened(segment: Segment) -> WhitenedSegment:
            return self.whitened(theta, segment, forgetting)

        if len(self.segments) == 1:
            parts = [whitened(self.segments[0])]
        else:
            with ThreadPoolExecutor(usable_cores()) as threads:
                parts = list(threads.map(whitened, self.segments))
        H, g = self.prior(theta, forgetting)
        for part in parts:
            H[np.ix_(part.places, part.places)] += part.jacobian.T @ part.jacobian
            g[part.places] += part.jacobian.T @ part.innovations
        return parts, H, g

    @property
    def noise(self) -> tuple[Array, ...]:
        """That (6,) of the poses of each segment, as it is estimated now."""
        return tuple(segment.std for segment in self.segments)

    def restore(self, minimum: Minimum) -> None:
        """Go back to the paths, first states and noise of a minimum."""
        for segment, std in zip(self.segments, minimum.noise, strict=True):
            segment.std = std
        self.accept(minimum.parts)

    def is_plausible(self, minimum: Minimum) -> bool:
        """Return whether a search converged to a cup that is not too stiff, nor too damped."""
        inverse = _symmetric_roots(self.start_cup.stiffness)[1]
        stiffness = inverse @ self._matrices(minimum.theta)[0] @ inverse
        return bool(minimum.converged and self.largest_damping(minimum.theta) < MAX_DAMPING
                    and np.linalg.eigvalsh(stiffness)[-1] < MAX_STIFFENING)

    def fits(self, minimum: Minimum) -> bool:
        """Return whether a search ended at a plausible cup that leaves no more than noise."""
        return self.is_plausible(minimum) and (
            minimum.robust_chi2 * max(self.learned(minimum), 1.0) < MISFIT_CHI2)

    def learned(self, minimum: Minimum) -> float:
        """
        Return the ratio of the estimated variance of slow poses to their variance at rest.

        Below 1 within chance. White residuals are noise, larger in motion than at rest: a misfit
        leaves correlated ones.
        """
        return max((
            float(np.mean(share) / (1.0 + CHANCE * np.sqrt(2.0 / (3.0 * noise.independent))))
            for segment, part, std in zip(
                self.segments, minimum.parts, minimum.noise, strict=True)
            for noise in [segment.measured.package_noise] if not part.is_white
            for share in np.split((std / noise.std) ** 2, 2)), default=0.0)

    def noise_in_motion(self, minimum: Minimum) -> dict[int, Array]:
        """Return the standard deviations (6,) of white noise in motion by recording, m and rad."""
        return {segment.measured.recording: np.maximum(std, segment.measured.package_noise.std)
                for segment, part, std in zip(
                    self.segments, minimum.parts, minimum.noise, strict=True)
                if segment.is_slow and part.is_white}

    def accept(self, parts: Sequence[WhitenedSegment]) -> None:
        """Set the likeliest paths and first states, but for a simulation that diverges."""
        for segment, part in zip(self.segments, parts, strict=True):
            if all(np.isfinite(values).all() for values in (part.tool_change, *part.start)):
                segment.start = part.start
                segment.set_path(part.tool_change)

    def update_noise(self, parts: Sequence[WhitenedSegment]) -> bool:
        """Estimate the noise of poses that come slowly; return whether it hardly changes."""
        settled = True
        for segment, part in zip(self.segments, parts, strict=True):
            if segment.is_slow:
                correlation = segment.measured.package_noise.correlation
                total = (MAD_TO_STD * np.median(np.abs(part.residuals), axis=0)) ** 2
                simulated = np.median(part.variance, axis=0) - part.new_variance
                std = np.maximum(MIN_POSE_STD, np.sqrt(
                    np.maximum(total - simulated, 0.1 * total) / (1.0 - correlation**2)))
                if np.any(np.abs(std - segment.std) > NOISE_TOLERANCE * segment.std):
                    segment.std, settled = std, False
        return settled

    def whitened(
        self, theta: Array, segment: Segment, forgetting: float = 0.0
    ) -> WhitenedSegment:
        """Return a segment's whitened differences."""
        model, free = self.model(theta, segment)
        nodes = segment.nodes(*(
            float(free.get(name, (0.0,))[0]) for name in ('time_offset', 'clock_rate')))
        lengths = np.diff(nodes.stamps) / NS_PER_S
        step = self._integration_step(model, COARSE_FACTOR if forgetting else 1.0)
        path = whitening.Path(simulation.tool_rows(resample(segment.path, nodes.stamps)),
                              lengths, substeps_of(lengths, step))
        expected, start = (
            adapted(model, simulation.row_state(path.rows[0]), body)
            for body in (segment.expected_start, segment.start))
        start = _start_near_rest(model, path.rows[0], start, segment.std)
        index = self.index_of(segment)
        places = {name: np.searchsorted(index, place)
                  for name, place in self.places_of(segment).items()}
        mean = _difference(start, expected)
        poses = _poses(segment, nodes, free, lengths, places, self.units[index])
        marker = free.get('tool_marker', np.zeros(6))
        tool_noise = segment.tool_noise(nodes, marker)
        initial_std = INITIAL_STD[:len(mean)]
        unknowns = self._unknowns(
            segment, free, places, index, *self._changes(theta, segment, nodes.stamps, index))
        is_correlated = segment.measured.package_noise.correlation > 0.0
        std = [initial_std, np.zeros(6), segment.std][:3 if is_correlated else 2]
        result = whitening.whiten(
            whitening.relaxing(model), whitening.with_inner(start), mean, np.concatenate(std),
            path, tool_noise, poses, unknowns,
            forgetting**4 * segment.period * segment.std**2)
        innovations, slopes, *_, gains = result
        smoothed, slope = whitening.smooth(
            result, nodes.place, tool_noise.variances, len(mean) + 6)
        change = np.zeros_like(segment.deviation)
        change[nodes.sampled] = smoothed[nodes.samples]
        correction = mean - initial_std**2 * slope[:len(mean)]
        with np.errstate(divide='ignore'):  # a simulation that diverges has no weights
            variance = gains[:, :, -1] ** -2
        return WhitenedSegment(
            innovations.ravel(), slopes.reshape(innovations.size, -1), index, variance,
            (1.0 - segment.measured.package_noise.correlation**2) * segment.std**2,
            first_order(change, segment.measured.tool_noise.correlation) + marker,
            whitening.shifted(start, correction))

    def _integration_step(self, model: ModelTuple, factor: float) -> float:
        """Return the longest step (s) of the integrator, or refuse a cup that is too fast."""
        longest = min(factor * largest_step(model), MAX_INTEGRATION_STEP)
        if longest < self.shortest_step:
            raise BellowsError(
                f'With this cup the simulation needs integration steps of {longest:.2g} s; at '
                f'least {self.shortest_step:.2g} s is expected. Check the units of package.mass, '
                'package.inertia, cup.stiffness and cup.damping.')
        return longest

    def _unknowns(
        self, segment: Segment, free: Free, places: Mapping[str, Places], index: Places,
        scales: Array, extra: Array,
    ) -> whitening.Unknowns:
        """Return the effect of a segment's unknowns on its model."""
        payload = quantities.payload_of(segment.measured.payload, free)
        columns = np.zeros((whitening.PARAMETER_COUNT, len(index) + 1))
        columns[:BY_DAMPING.stop, :self.count] = self.structure.upper
        for name, place in places.items():
            columns[:, place] = quantities.model_columns(
                name, payload, segment.measured.gravity, free, len(columns))
        columns[:, :-1] *= self.units[index]
        used = np.flatnonzero(np.any(columns[:PARAMETER_COLUMNS], axis=1))[-1]
        last = BY_DAMPING.stop if used < BY_DAMPING.stop else PARAMETER_COLUMNS
        return whitening.Unknowns(
            last, columns, scales, extra, np.array([
                int(place) for name in ('time_offset', 'clock_rate')
                for place in places.get(name, ())], dtype=np.int64),
            int(places.get('tool_marker', (-1,))[0]))

    def _changes(
        self, theta: Array, segment: Segment, stamps: Stamps, index: Places
    ) -> tuple[Array, Array]:
        """Return factors (M, q) of columns at the nodes, and values (q,) of `CHANGING`."""
        if self.places.keys().isdisjoint(quantities.CHANGING):
            return np.empty((len(stamps), 0)), np.empty(0)
        first, *_, last = np.concatenate([
            other.path.stamps_ns[[0, -1]] for other in self.segments
            if other.measured.recording == segment.measured.recording])
        profiles = {
            'length_drift': (stamps - first) / (last - first) - 0.5,
            'slip': (stamps >= self.slip_ns) & (self.slip_ns >= first)}
        scales, extra = np.ones((len(stamps), len(theta))), np.zeros(len(theta))
        for name, places in self.places_of(segment).items():
            if name in profiles:
                scales[:, places], extra[places] = profiles[name][:, None], theta[places]
        return scales[:, index], extra[index]


def _poses(
    segment: Segment, nodes: Nodes, free: Free, lengths: Array, places: Mapping[str, Places],
    units: Array,
) -> whitening.Poses:
    """Return the package's poses at the nodes, corrected by the free quantities."""
    noise, poses = segment.measured.package_noise, segment.package.select(nodes.used)
    context = segment.com_axes, segment.middle
    package = quantities.poses_of(poses, free, *context)
    by_unknowns = np.zeros((len(poses), 6, len(units)))
    for name, place in places.items():
        known = quantities.carried(poses, segment.path) if name == 'scale' else poses
        by_unknowns[:, :, place] = -quantities.pose_changes(name, known, *context)
    rows = np.column_stack(
        [package.position, lie.rotation_to_quaternion(package.rotation), nodes.delays])
    return whitening.Poses(
        nodes.place, rows, by_unknowns * units,
        (MIN_POSE_STD if noise.correlation > 0.0 else segment.std) ** 2, segment.std**2,
        noise.correlation ** (lengths / segment.period))


def _not_below(strengths: ArrayLike) -> tuple[float, float]:
    """Return strengths of relaxation with which internal strains are followed."""
    r = np.maximum(strengths, MIN_STRENGTH)
    return float(r[0]), float(r[1])


def squares(parts: Sequence[WhitenedSegment]) -> float:
    """Return the sum of squares."""
    return float(sum(part.innovations @ part.innovations for part in parts))


def deviance(parts: Sequence[WhitenedSegment]) -> float:
    """Return -2 times the logarithm of the likelihood, at the best scale of all variances."""
    count = sum(len(part.innovations) for part in parts)
    logs = sum(float(np.sum(np.log(part.variance))) for part in parts)
    return float(count * np.log(squares(parts) / count)) + logs


def _anderson_step(step: Array, H: Array, history: Sequence[tuple[Array, Array]]) -> Array:
    """
    Return the change after steps before this one, and how far the search went after each.

    Mixed by Anderson's method (1965). Where K and P are inaccurate, derivatives have noise and
    change from step to step: a step is too short, or so long that the next turns back.
    """
    if not history:
        return step
    root = np.linalg.cholesky(H).T
    steps, changes = map(np.array, zip(*history, strict=True))
    differences = np.diff(np.vstack([steps, step]), axis=0)
    weights = np.linalg.lstsq(root @ differences.T, root @ step, rcond=MIN_SINGULAR_VALUE)[0]
    weights *= min(1.0, MAX_ANDERSON_WEIGHT / max(np.abs(weights).max(), 1e-99))
    return np.asarray(step - weights @ (changes + differences))


def _symmetric_roots(M: Array) -> tuple[Array, Array]:
    """Return the symmetric root of a definite matrix, and its inverse."""
    values, vectors = np.linalg.eigh(M)
    root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T


def _start_near_rest(model: ModelTuple, tool: Array, start: State, std: Array) -> State:
    """
    Return a first state that hangs at rest where its pose is within the noise of the poses.

    Noise in it would ring, and that the derivatives would take for motion. Its twist tells nothing
    of that: of a slow camera's poses it is known worse than ordinary swings are large.
    """
    try:
        rest = simulation.rest(model, tool)
    except UnstableError:
        return start
    difference = _difference(rest, start)
    size = np.max(np.abs(difference[:6]) / std) / REST_SIGMAS
    return whitening.shifted(rest, (1.0 - max(size, 1.0) ** -2) * difference)


def _difference(body: State, other: State) -> Array:
    """Return what separates a state from another (12,), with internal strains (24,)."""
    return np.concatenate([*pose_error(body, other[0], other[1]), *(
        np.ravel(np.array(end) - np.array(begin))
        for begin, end in zip(body[2:], other[2:], strict=True))])
