"""
The minimum of the prediction errors: K, P and delays by Gauss-Newton steps.

The equations of motion are linear in K and P, so there is one minimum, and the steps find it from
any start. Every step estimates the noise of the poses anew. The equations are linearised about the
motion that all poses together make likeliest, outlying poses are weighted down (Huber), and near
the minimum the autocorrelation of the noise is chosen by the likelihood of the innovations.

The covariance of the equations is banded, and so is its Cholesky factor, which whitens them: each
row becomes the part that the rows before do not predict. These are the innovations of a Kalman
filter linearised about the same motion, without any other approximation.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.identification.motion_equations import (
    Equations,
    Segment,
    STEPS,
)
from bellows_ros.core.identification.quantities import Free, KINDS
from bellows_ros.core.identification.segments import Measured, PoseNoise
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.signals.savgol import first_order
from bellows_ros.core.signals.timing import MAD_TO_STD
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.linalg import lapack

MOTION_ROUNDS = 2
"""Rounds in which the motion that is linearised about comes near to the likeliest."""


class Whitened(NamedTuple):
    """
    Equations in units of their noise.

    Innovations (6 N,), their derivatives by the parameters (6 N, p), and how others are whitened.
    """

    innovations: Array
    jacobian: Array
    root: 'Root'


class Root:
    """
    The Cholesky factor of the equations' covariance.

    Autoregressive noise n_k = a n_(k-1) + e_k is whitened by differences of equations; where
    package and tool have different a, by both (A_j changes little from pose to pose).

    Parameters
    ----------
    equations : Equations
        With N poses in the middle of M.
    noise : tuple of PoseNoise
        Of package and tool.
    spread : ndarray (M, 12)
        Standard deviation of each pose, as a multiple of the usual one.

    """

    def __init__(
        self, equations: Equations, noise: tuple[PoseNoise, PoseNoise], spread: Array
    ) -> None:
        kept = [own.kept for own in noise]
        self.kept = kept
        self.filters = sorted({a for a in kept if a > 0.0})
        A = [equations.package, equations.tool]
        first = 0
        if len(self.filters) == 2 or (self.filters and 0.0 in kept):
            others = [[a for a in self.filters if a != own] for own in kept]
            A = [_differences(own, other[0] if other else 0.0)
                 for own, other in zip(A, others, strict=True)]
            first = -1
        drop = len(self.filters)
        both = np.concatenate([own[drop + first:] for own in A], axis=3)
        self.first = drop + first
        self.scale = spread[:len(equations.errors) + STEPS - 1] * np.concatenate(
            [own.fresh for own in noise])
        for j in range(both.shape[2]):
            poses = slice(self.first + j, self.first + j + len(both))
            both[:, :, j] *= self.scale[poses, None, :]
        self.effects = both
        band = _band(both)
        self.factor, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        if info:
            raise BellowsError(
                'The covariance of the equations of motion is not definite. Check for repeated '
                'poses, and that the noise of both bodies is not zero.')

    def whitened(self, rows: Array) -> Array:
        """Return rows (N, 6, p) of the equations in units of their noise (6 N, p)."""
        for a in self.filters:
            rows = rows[1:] - a * rows[:-1]
        flat = np.asfortranarray(rows.reshape(6 * len(rows), -1))
        return np.asarray(lapack.dtbtrs(self.factor, flat, uplo='L')[0])

    def innovations(self, errors: Array) -> Array:
        """Return errors (N, 6) of the equations in units of their noise (6 N,)."""
        return self.whitened(errors)[:, 0]

    def deviance(self, errors: Array) -> float:
        """Return the deviance of errors (N, 6): -2 log likelihood, up to a constant."""
        return float(
            np.sum(self.innovations(errors)**2) + 2.0 * np.sum(np.log(self.factor[0])))

    def noise(self, whitened: Array) -> tuple[Array, Array]:
        """Return the likeliest values (M, 12) given innovations (6 N,), and their white source."""
        back = lapack.dtbtrs(self.factor, whitened[:, None], uplo='L', trans='T')[0]
        parts = np.einsum('kijm,ki->kjm', self.effects, back.reshape(-1, 6))
        fresh = np.zeros_like(self.scale)
        for j in range(parts.shape[1]):
            fresh[self.first + j:self.first + j + len(parts)] += parts[:, j]
        return self.accumulated(fresh), fresh

    def accumulated(self, fresh: Array) -> Array:
        """Return the noise (M, 12), m and rad, from its white source."""
        halves = zip(np.hsplit(fresh * self.scale, 2), self.kept, strict=True)
        return np.hstack([first_order(part, a) for part, a in halves])

    def errors(self, fresh: Array) -> Array:
        """Return the innovations (6 N,) that noise makes."""
        rows = sum(
            np.einsum('kim,km->ki', self.effects[:, :, j], fresh[
                self.first + j:self.first + j + len(self.effects)])
            for j in range(self.effects.shape[2]))
        return np.asarray(lapack.dtbtrs(self.factor, np.reshape(rows, (-1, 1)), uplo='L')[0][:, 0])


def innovations(cup: Cup, measured: Measured) -> Array:
    """
    Return the one-step prediction errors (N, 6) of a segment, of unit variance for the true cup.

    They are those of white noise, about the motion that all poses together make likeliest.
    """
    segment = Segment(measured)
    noise: Array = np.zeros((len(measured.package), 12))
    for _ in range(MOTION_ROUNDS):
        equations = segment.equations(cup, noise, {})
        root = Root(equations, (measured.package_noise, measured.tool_noise), _missing(segment))
        white = root.innovations(equations.errors)
        noise, _ = root.noise(white)
    return white.reshape(-1, 6)


def _differences(A: Array, a: float) -> Array:
    """Return the effects (N - 1, 6, J + 1, 6) of noise on each equation less a times the last."""
    out = np.zeros((len(A) - 1, 6, A.shape[2] + 1, A.shape[3]))
    out[:, :, 1:] = A[1:]
    out[:, :, :-1] -= a * A[:-1]
    return out


def _band(effects: Array) -> Array:
    """Return the lower band (6 J, 6 N) of the covariance that unit noise makes."""
    count, _, steps, bodies = effects.shape
    band = np.zeros((6 * steps, 6 * count), order='F')
    flat = effects.reshape(count, 6, steps * bodies)
    for lag in range(min(steps, count)):
        product = flat[lag:, :, :bodies * (steps - lag)] @ np.swapaxes(
            flat[:count - lag, :, bodies * lag:], 1, 2)
        for row in range(6):
            for column in range(6):
                if 6 * lag + row >= column:
                    band[6 * lag + row - column, column:6 * (count - lag):6] = (
                        product[:, row, column])
    return band


Note = Callable[[Array, float], None]
"""Called with the parameters of a step and its chi^2."""

WIDEST, FURTHEST = 10.0, 100.0
"""
Standard deviations of a weak prior about the start: of K and P in units of their scale, and of
what else is free in its units.
"""

TOLERANCE = 1e-3
"""Converged when half the predicted decrease of chi^2 is below this."""

NEAR = 1.0
"""Predicted decrease below which the correlation of the noise is estimated."""

MOST_STEPS = 40

HUBER_FROM = 3.0
"""Threshold of Huber's loss, standard deviations."""

ROBUST_STEPS = (2, 3, 4)
"""Steps before which the scale of the residuals is re-estimated; then it is kept."""

FARTHEST = 4.0
"""
The motion that is linearised about stays within so many standard deviations of the measured one,
except at outlying poses.
"""

MISSING, LARGEST_MISSING = np.repeat([5e-3, 5e-2], 3), 1000.0
"""Standard deviation of a missing pose (m, rad), and at most this many of a measured one."""

KEPT = (0.0, 0.4, 0.65, 0.8, 0.9, 0.95, 0.975, 0.99)
"""Candidate autocorrelations of the noise between successive poses."""

ENOUGH = 4096
"""Poses of each segment used to estimate the correlation of its noise."""

CONVINCING = 10.0
"""Decrease of the deviance required to reject white noise."""


class Found(NamedTuple):
    """
    Where the search ended.

    Parameters (m,), the whitened equations of each segment and the noise of its poses, the
    information (m, m), and whether it is a minimum.
    """

    theta: Array
    parts: list[Whitened]
    noise: list[Array]
    information: Array
    converged: bool


class Search:
    """
    Gauss-Newton steps towards the minimum.

    The parameters theta are those of the structure in units of their size, then the quantities
    of `KINDS` that are wanted, one after the other, in theirs.

    Parameters
    ----------
    segments : list of Segment
        Of one cup's recordings.
    structure : Structure
        Of K and P.
    start : Cup
        First guess, with the length.
    free : sequence of str
        Names of what else is wanted.

    """

    def __init__(
        self, segments: list[Segment], structure: Structure, start: Cup, free: Sequence[str]
    ) -> None:
        self.segments, self.structure, self.length = segments, structure, start.length
        self.relaxation = start.relaxation
        recordings = 1 + max(segment.measured.recording for segment in segments)
        diagonals = [np.abs(np.diag(M)) for M in (start.stiffness, start.damping)]
        for diagonal in diagonals:
            for part in (slice(0, 3), slice(3, 6)):  # metres and radians
                diagonal[part] = np.maximum(diagonal[part], 0.05 * diagonal[part].max())
        units = structure.sizes(*map(np.diag, diagonals))
        self.count = len(units)
        self.places: dict[str, Places] = {}
        wanted = [units]
        for name in free:
            kind = KINDS[name]
            rows = recordings if kind.each else 1
            first = sum(map(len, wanted))
            self.places[name] = first + np.arange(rows * kind.size).reshape(rows, kind.size)
            wanted.append(np.full(rows * kind.size, kind.unit))
        self.units = np.concatenate(wanted)
        self.start = np.zeros(len(self.units))
        self.start[:self.count] = structure.parameters(start.stiffness, start.damping) / units
        self.missing = [_missing(segment) for segment in segments]
        self.spread = list(self.missing)
        self.noise = [np.zeros_like(spread) for spread in self.spread]
        self.kept = (0.0, 0.0)

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the free parameters."""
        x = (self.units * theta)[:self.count]
        return Cup(*self.structure.matrices(x), self.length, self.relaxation)

    def own_places(self, segment: Segment) -> dict[str, Places]:
        """Return where a segment's free parameters are, by name."""
        return {name: rows[segment.measured.recording if KINDS[name].each else 0]
                for name, rows in self.places.items()}

    def free(self, theta: Array, segment: Segment) -> Free:
        """Return the free parameters of a segment, in SI units."""
        values = self.units * theta
        return {name: values[places] for name, places in self.own_places(segment).items()}

    def by_numbers(self, segment: Segment, jacobian: Array) -> Array:
        """Return derivatives (..., m) by all parameters, from those by entries and the rest."""
        out = np.zeros((*jacobian.shape[:-1], len(self.units)))
        first = len(self.structure.upper)
        out[..., :self.count] = jacobian[..., :first] @ self.structure.upper
        for places in self.own_places(segment).values():
            out[..., places] = jacobian[..., first:first + len(places)]
            first += len(places)
        return np.asarray(out * self.units)

    def noises(self, segment: Segment, kept: tuple[float, float]) -> tuple[PoseNoise, PoseNoise]:
        """Return the noise of package and tool."""
        measured = segment.measured
        return (measured.package_noise._replace(kept=kept[0]),
                measured.tool_noise._replace(kept=kept[1]))

    def found(self, note: Note) -> Found:
        """Go to the minimum."""
        theta, looks, before = self.start, 0, np.inf
        prior = np.full(len(theta), FURTHEST**-2)
        prior[:self.count] = WIDEST**-2
        for number in range(MOST_STEPS):
            if number > 0:
                self.estimate_noise(theta, number in ROBUST_STEPS)
            equations = self.equations(theta)
            if number > 1 and before < NEAR and looks < 2:
                self.kept = self.colour(equations)
                looks += 1 if any(self.kept) else 2
            parts = self.whitened(equations)
            H = sum(part.jacobian.T @ part.jacobian for part in parts) + np.diag(prior)
            g = sum(part.jacobian.T @ part.innovations for part in parts)
            g = g - prior * (theta - self.start)
            r = np.concatenate([part.innovations for part in parts])
            note(theta, float(np.mean(r**2)))
            step = np.linalg.solve(H, g)
            before = 0.5 * float(g @ step)
            if before < TOLERANCE and looks and number >= ROBUST_STEPS[1]:
                return Found(theta, parts, self.noise, H, True)
            if not np.isfinite(before):
                break
            theta = theta + step
        return Found(theta, parts, self.noise, H, False)

    def equations(self, theta: Array) -> list[Equations]:
        """Return the equations of all segments, about the motions without their noise."""
        cup = self.cup(theta)
        return [segment.equations(cup, noise, self.free(theta, segment))
                for segment, noise in zip(self.segments, self.noise, strict=True)]

    def estimate_noise(self, theta: Array, robustly: bool) -> None:
        """Estimate the noise of the poses, and perhaps how far they scatter."""
        for i, (segment, own) in enumerate(
                zip(self.segments, self.equations(theta), strict=True)):
            root = Root(own, self.noises(segment, self.kept), self.spread[i])
            noise, fresh = root.noise(root.innovations(own.errors))
            if robustly:
                self.spread[i] = np.maximum(self.missing[i], _spread(fresh * self.spread[i]))
            usual = np.where(self.missing[i] > 1.0, 1.0, self.spread[i]**2)
            largest = FARTHEST * usual * np.concatenate(
                [body.std for body in self.noises(segment, self.kept)])
            self.noise[i] = np.clip(noise, -largest, largest)

    def whitened(self, equations: list[Equations]) -> list[Whitened]:
        """Return equations in units of their noise, with derivatives by all parameters."""
        parts = []
        for own, segment, spread in zip(equations, self.segments, self.spread, strict=True):
            root = Root(own, self.noises(segment, self.kept), spread)
            rows = root.whitened(np.concatenate(
                [own.errors[:, :, None], self.by_numbers(segment, own.jacobian)], axis=2))
            parts.append(Whitened(rows[:, 0], rows[:, 1:], root))
        return parts

    def colour(self, equations: list[Equations]) -> tuple[float, float]:
        """Return the autocorrelation of the noise of package and tool between successive poses."""
        parts = [(segment, Equations(*(array[:ENOUGH] for array in own)), spread)
                 for segment, own, spread in zip(
                     self.segments, equations, self.spread, strict=True)]

        @cache
        def deviance(kept: tuple[float, float]) -> float:
            return sum(
                Root(own, self.noises(segment, kept), spread).deviance(own.errors)
                for segment, own, spread in parts)

        best = (0, 0)  # places in KEPT: first both bodies alike, then one after the other
        for move in ((1, 1), (1, 0), (0, 1)):
            for side in (1, -1):
                while True:
                    there = best[0] + side * move[0], best[1] + side * move[1]
                    if not 0 <= min(there) <= max(there) < len(KEPT) or (
                            deviance(_kept(there)) >= deviance(_kept(best))):
                        break
                    best = there
        if deviance(_kept(best)) > deviance((0.0, 0.0)) - CONVINCING:
            return 0.0, 0.0
        package = _vertex(lambda a: deviance((a, KEPT[best[1]])), best[0])
        return package, _vertex(lambda a: deviance((package, a)), best[1])


def _kept(places: tuple[int, int]) -> tuple[float, float]:
    """Return the autocorrelations at places in `KEPT`."""
    return KEPT[places[0]], KEPT[places[1]]


def _vertex(deviance: Callable[[float], float], place: int) -> float:
    """Return where the parabola through the deviances about a place in `KEPT` is least."""
    if not 0 < place < len(KEPT) - 1:
        return KEPT[place]
    near = KEPT[place - 1:place + 2]
    x = np.log1p(-np.array(near))
    quadratic, linear, _ = np.polyfit(x - x[1], [deviance(a) for a in near], 2)
    return float(-np.expm1(np.clip(x[1] - 0.5 * linear / quadratic, x[2], x[0])))


def _missing(segment: Segment) -> Array:
    """Return the relative scatter of each pose (M, 12), large for missing ones."""
    measured = segment.measured
    lost = ~measured.package.valid
    lost[1:] |= lost[:-1]
    ratio = np.concatenate([
        np.clip(MISSING / noise.ripple, 1.0, LARGEST_MISSING)
        for noise in (measured.package_noise, measured.tool_noise)])
    return np.where(lost[:, None], ratio, 1.0)


def _spread(fresh: Array) -> Array:
    """Return the scatter (M, 12) that Huber's loss assigns to noise of given deviations."""
    size = np.abs(fresh)
    typical = np.maximum(MAD_TO_STD * np.median(size, axis=0), 1.0)
    return np.sqrt(np.clip(size / (HUBER_FROM * typical), 1.0, LARGEST_MISSING))
