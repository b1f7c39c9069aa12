"""
The equations of motion in units of their noise: one-step prediction errors.

The covariance of the equations is banded, and so is its Cholesky factor, by which they become
uncorrelated: row by row what those before do not predict. These are the innovations of the Kalman
filter that knows the motion about which is linearised, without any other approximation.
"""

from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.prediction.equations import Equations, STEPS
from bellows_ros.core.identification.prediction.segments import PoseNoise
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.linalg import lapack
from scipy.signal import lfilter


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

    Noise of the first order, n_k = a n_(k-1) + e_k, is made white by differences of equations:
    where package and tool have different a, by both (A_j changes little from pose to pose).

    Parameters
    ----------
    equations : Equations
        With N poses in the middle of M.
    noise : tuple of PoseNoise
        Of package and tool.
    spread : ndarray (M, 12)
        By how much more each pose scatters than usual.

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
                'The covariance of the equations of motion is not definite: are poses repeated, '
                'or is the noise of both bodies zero?')

    def whitened(self, rows: Array) -> Array:
        """Return rows (N, 6, p) of the equations in units of their noise (6 N, p)."""
        for a in self.filters:
            rows = rows[1:] - a * rows[:-1]
        flat = np.asfortranarray(rows.reshape(6 * len(rows), -1))
        return np.asarray(lapack.dtbtrs(self.factor, flat, uplo='L')[0])

    def deviance(self, errors: Array) -> float:
        """Return how unlikely errors (N, 6) are: twice the negative logarithm, and a constant."""
        innovations = self.whitened(errors)
        return float(np.sum(innovations**2) + 2.0 * np.sum(np.log(self.factor[0])))

    def noise(self, whitened: Array) -> tuple[Array, Array]:
        """Return the likeliest (M, 12) that makes innovations (6 N,), and what is new in it."""
        back = lapack.dtbtrs(self.factor, whitened[:, None], uplo='L', trans='T')[0]
        parts = np.einsum('kijm,ki->kjm', self.effects, back.reshape(-1, 6))
        fresh = np.zeros_like(self.scale)
        for j in range(parts.shape[1]):
            fresh[self.first + j:self.first + j + len(parts)] += parts[:, j]
        return self.accumulated(fresh), fresh

    def accumulated(self, fresh: Array) -> Array:
        """Return the noise (M, 12), m and rad, of what is new in it, in units of its spread."""
        halves = zip(np.hsplit(fresh * self.scale, 2), self.kept, strict=True)
        return np.hstack([lfilter([1.0], [1.0, -a], part, axis=0) for part, a in halves])

    def errors(self, fresh: Array) -> Array:
        """Return the innovations (6 N,) that noise makes."""
        rows = sum(
            np.einsum('kim,km->ki', self.effects[:, :, j], fresh[
                self.first + j:self.first + j + len(self.effects)])
            for j in range(self.effects.shape[2]))
        return np.asarray(lapack.dtbtrs(self.factor, np.reshape(rows, (-1, 1)), uplo='L')[0][:, 0])


def whitened(
    equations: Equations, noise: tuple[PoseNoise, PoseNoise], spread: Array
) -> Whitened:
    """Return equations in units of their noise (see `Root` for the arguments)."""
    root = Root(equations, noise, spread)
    rows = root.whitened(np.concatenate([equations.errors[:, :, None], equations.jacobian], 2))
    return Whitened(rows[:, 0], rows[:, 1:], root)


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
