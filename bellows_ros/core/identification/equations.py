"""
The equations of identification: the cup's wrench equals the wrench of the motion.

At the lip L x = c for every sample, with x the parameters of K and P (4.66-4.68). They are
weighted by the wrenches' covariance, reduced to R factors, which have the same inner products,
and solved as far as they go. A parameter that has a part in a direction which is not
known at all has an infinite variance and no covariances; the information about it is zero.
"""

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.model.cup_package import regressor
from bellows_ros.core.model.structure import RELAXATION_TIMES, Structure
from bellows_ros.core.signals.savgol import first_order
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

BLOCK = 4096
"""Samples processed at a time, so that memory does not grow with the recording."""

MOST_KEPT = 50_000
"""Samples of the longest recording whose lip motion and regressors are kept for reuse."""

CLUSTER_WINDOWS = 4
"""Residuals this many filter windows apart count as independent for standard errors."""


class SampleEquations(NamedTuple):
    """Equations A x = b of N samples: A (N, 6, p), b (N, 6), and which of the N are a cluster."""

    A: Array
    b: Array
    clusters: list[slice]

    @property
    def stacked(self) -> Array:
        """Rows [A b] (6 N, p + 1)."""
        return np.dstack([self.A, self.b]).reshape(-1, self.A.shape[2] + 1)

    def whitened(self, whitening: Array) -> 'SampleEquations':
        """Return the same equations with their errors whitened."""
        return SampleEquations(whitening @ self.A, self.b @ whitening.T, self.clusters)


NO_HISTORY: Array = np.empty((0, 2, 9))


def strain_history(position: Array, rotation: Array, rate_hz: float) -> Array:
    """
    Return what the internal strains of a cup that relaxes follow from (N, 2, 9).

    For each branch three parts of h (3.18), relaxed: (I + R^T) E_o_S, (I + R^T)(I + R) z / 2,
    which counts with the length, and (R - R^T)^vee. Exact where h is linear from sample to sample:
    z1 = a z0 + (1 - a) h0 + (1 - (1 - a) tau / dt) (h1 - h0), a = exp(-dt / tau). At the first
    sample the cup has been at rest.

    Parameters
    ----------
    position, rotation : ndarray (N, 3), (N, 3, 3)
        E_o_S (m) and E_R_S at a uniform rate.
    rate_hz : float
        Samples per second.

    """
    R_back = np.swapaxes(rotation, 1, 2)
    of_length = 0.5 * (rotation[:, :, 2] + R_back[:, :, 2]) + [0.0, 0.0, 1.0]
    skew = rotation - R_back
    parts = np.hstack([
        position + apply(R_back, position), of_length,
        np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)])
    relaxed = []
    for tau in RELAXATION_TIMES:
        a = float(np.exp(-1.0 / (rate_hz * tau)))
        end = 1.0 - (1.0 - a) * tau * rate_hz
        relaxed.append(first_order(
            np.vstack([parts[:1], end * parts[1:] + (1.0 - a - end) * parts[:-1]]), a))
    return np.stack(relaxed, axis=1)


def internal_strains(history: Array, cup_length: float) -> Array:
    """Return the internal strains (N, 2, 6) of a cup with a nominal length (m)."""
    linear = history[..., :3] + cup_length * history[..., 3:6]
    return np.concatenate([linear, history[..., 6:]], axis=-1)


@dataclass(frozen=True, eq=False)
class LipMotion:
    """
    Motion of the lip in the tool, and the wrench that it needs, at the valid samples.

    Parameters
    ----------
    index : ndarray (N,)
        Which of the recording's samples they are.
    stamps_ns : ndarray (N,)
        ns.
    window : float
        Duration of the filter's window, s: so far residuals are correlated.
    position, rotation, twist : ndarray (N, 3), (N, 3, 3), (N, 6)
        E_o_S (m), E_R_S and S_v_ES (m/s, rad/s).
    wrench : ndarray (N, 6)
        c of (4.68), N and N m.
    relaxation : (float, float)
        Strengths r_b of a cup that relaxes.
    history : ndarray (N, 2, 9)
        What its internal strains follow from; see `strain_history`.

    """

    index: Stamps
    stamps_ns: Stamps
    window: float
    position: Array
    rotation: Array
    twist: Array
    wrench: Array
    relaxation: tuple[float, float] = (0.0, 0.0)
    history: Array = field(default_factory=lambda: NO_HISTORY)
    _kept: dict[Hashable, Array] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what can be computed again."""
        return {**vars(self), '_kept': {}}

    @cached_property
    def rotation_vector(self) -> Array:
        """Rotation vector of the lip in the tool, rad (N, 3)."""
        return log_so3(self.rotation)

    def displacement(self, cup_length: float) -> Array:
        """Return how the lip is displaced from nominal (N, 6): E_o_S + l0 z (m), and rotation."""
        return np.hstack([self.position + [0.0, 0.0, cup_length], self.rotation_vector])

    def clusters(self, block: slice) -> list[slice]:
        """Return the samples of a block cut into clusters that are several windows long."""
        stamps = self.stamps_ns[block]
        cluster_ns = int(CLUSTER_WINDOWS * self.window * NS_PER_S)
        starts = np.unique((stamps - stamps[:1]) // cluster_ns, return_index=True)[1]
        return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(stamps)], strict=True)]

    def equations(
        self, cup_length: float, structure: Structure, keep: bool = True
    ) -> Iterator[SampleEquations]:
        """
        Yield L and c of (4.67), (4.68), block by block.

        Parameters
        ----------
        cup_length : float
            Nominal length l0, m.
        structure : Structure
            Of K and P.
        keep : bool
            Whether somebody will ask for the same again.

        """
        key = (cup_length, structure, self.relaxation)
        strains = internal_strains(self.history, cup_length) if any(self.relaxation) else None
        size = 2 * structure.size
        keep &= len(self.index) <= MOST_KEPT
        kept = self._kept.get(key)
        L = np.empty((len(self.index), 6, size)) if keep and kept is None else None
        for start in range(0, max(len(self.index), 1), BLOCK):
            block = slice(start, min(start + BLOCK, len(self.index)))
            own = kept[block] if kept is not None else regressor(
                cup_length, structure.model_basis, self.position[block], self.rotation[block],
                self.twist[block], self.relaxation, None if strains is None else strains[block])
            if L is not None:
                L[block] = own
            yield SampleEquations(own, self.wrench[block], self.clusters(block))
        if L is not None:
            self._kept[key] = L

    def select(self, chosen: slice | Mask | Stamps) -> 'LipMotion':
        """Return some of the samples, with all their data."""
        some = LipMotion(
            self.index[chosen], self.stamps_ns[chosen], self.window, self.position[chosen],
            self.rotation[chosen], self.twist[chosen], self.wrench[chosen], self.relaxation,
            self.history[chosen] if len(self.history) else self.history)
        some._kept.update({key: L[chosen] for key, L in self._kept.items()})
        return some

    def thinned(self, step: int) -> 'LipMotion':
        """Return every n-th sample of the recording, renumbered."""
        some = self.select(self.index % step == 0)
        object.__setattr__(some, 'index', some.index // step)
        return some


def sizes(displacement: Array) -> Array:
    """Return sizes of displacements (N, 6): x and y together, as they are of a round cup."""
    x, y, z, rx, ry, rz = displacement.T
    radial, bent = np.hypot(x, y), np.hypot(rx, ry)
    return np.asarray(np.abs(np.column_stack([radial, radial, z, bent, bent, rz])))


LEVER = 0.01
"""Moments are compared with forces at this lever, m."""

NO_WRENCH, FLOOR = 1e-10, 1e-8
"""Relative variance below which a component of the wrench is zero, and what is then added."""


@dataclass(frozen=True, eq=False)
class Moments:
    """
    First and second moments of six-vectors, such as wrenches (N and N m).

    Parameters
    ----------
    count : int
        How many.
    mean : ndarray (6,)
        In their units.
    scatter : ndarray (6, 6)
        Sum of the products of the deviations from the mean.

    """

    count: int
    mean: Array
    scatter: Array

    @classmethod
    def of(cls, vectors: Array) -> 'Moments':
        """Return the moments of six-vectors (N, 6)."""
        if not len(vectors):
            return cls(0, np.zeros(6), np.zeros((6, 6)))
        mean = np.mean(vectors, axis=0)
        deviation = vectors - mean
        return cls(len(vectors), mean, deviation.T @ deviation)

    def joined(self, other: 'Moments') -> 'Moments':
        """Return the moments of both together, from deviations rather than raw squares."""
        count = self.count + other.count
        if not count:
            return self
        apart = other.mean - self.mean
        return Moments(
            count,
            self.mean + apart * (other.count / count),
            self.scatter + other.scatter
            + np.outer(apart, apart) * (self.count * other.count / count),
        )

    @property
    def std(self) -> Array:
        """Standard deviations (6,), NaN without samples."""
        return np.sqrt(np.diag(self.scatter) / (self.count or np.nan))

    def covariance(self, structure: Structure) -> Array:
        """Return Q (6, 6) of wrenches in the form of a structure (4.69, 4.80)."""
        return structure.covariance(self.count, self.mean, self.scatter)


def joined(parts: Iterable[Moments]) -> Moments:
    """Return the moments of all parts together."""
    return reduce(Moments.joined, parts, Moments.of(np.empty((0, 6))))


def regular(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches, made regular in directions without a wrench."""
    force, moment = (float(np.mean(np.diag(covariance)[part]))
                     for part in (slice(0, 3), slice(3, 6)))
    scale = np.repeat([max(force, moment), max(moment, LEVER**2 * force)], 3)
    if not scale[0] > 0.0:
        return np.eye(6)
    unit = np.sqrt(np.outer(scale, scale))
    if np.linalg.eigvalsh(covariance / unit)[0] > NO_WRENCH:
        return covariance
    return np.asarray(covariance + FLOOR * np.diag(scale))


def whitening_of(covariance: Array) -> Array:
    """Return the root of the weight W that makes a covariance (6, 6) the identity."""
    whitening: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return whitening


LARGEST_CONDITION = 1e6
"""Ratio of singular values beyond which a combination of parameters is not identifiable."""

ROUNDING = 1e-12
"""Eigenvalues of scaled information below this fraction of the largest are rounding errors."""

IN_NULL_SPACE = 0.05
"""A parameter with a larger component in the null space is not identifiable."""

NO_EFFECT = 1e-8
"""A parameter whose column is smaller than this fraction of others of its kind has no effect."""


def covariance_of(information: Array) -> Array:
    """
    Return the covariance (n, n) of parameters with this information.

    What is not known has inf on the diagonal and 0 beside it; the rest is as if it were left out.
    """
    diagonal = np.diag(information)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    unit = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(information / unit)
    null = vectors[:, values <= ROUNDING * values[-1]]
    known = (diagonal > 0.0) & ~np.any(np.abs(null) > IN_NULL_SPACE, axis=1)
    covariance = np.diag(np.where(known, 0.0, np.inf))
    index = np.flatnonzero(known)
    if len(index):
        part = np.ix_(index, index)
        values, vectors = np.linalg.eigh(information[part] / unit[part])
        kept = values > ROUNDING * values[-1]
        covariance[part] = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / unit[part]
    return covariance


def information_of(covariance: Array) -> Array:
    """Return the information (n, n) of a covariance, zero where that is infinite."""
    index = np.flatnonzero(np.isfinite(np.diag(covariance)))
    information = np.zeros_like(covariance)
    if len(index):
        part = covariance[np.ix_(index, index)]
        scale = np.sqrt(np.diag(part))
        scale = np.where(scale > 0.0, scale, 1.0)
        unit = np.outer(scale, scale)
        information[np.ix_(index, index)] = np.linalg.pinv(part / unit, hermitian=True) / unit
    return information


def without(covariance: Array, unknown: Mask) -> Array:
    """Return a covariance in which some parameters (n,) are unknown."""
    known = ~unknown
    result = np.where(np.outer(known, known), covariance, 0.0)
    result[np.diag_indices_from(result)] = np.where(known, np.diag(covariance), np.inf)
    return result


QR_ROWS = 512
"""Rows reduced to an R factor at a time, so that they stay in the processor's cache."""


def r_factor(parts: Iterable[Array], columns: int) -> Array:
    """Return R (columns, columns) of the QR factorisation of stacked parts (4.71, 4.72)."""
    R: Array = np.zeros((columns, columns))
    for rows in parts:
        R = r_factor_of(np.vstack([R, rows]))
    return R


def r_factor_of(rows: Array) -> Array:
    """Return R (q, q) of the QR factorisation of rows (N, q), N at least q."""
    whole = len(rows) // QR_ROWS * QR_ROWS
    size = rows.shape[1]
    # R factors of small parts, then of these: four times faster than at once.
    parts = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, QR_ROWS, size), mode='r'))
    left = np.concatenate([parts.reshape(-1, size), rows[whole:]])
    return np.asarray(np.linalg.qr(left, mode='r'))


class Solution(NamedTuple):
    """
    The least-squares solution of p parameters.

    x (p,): of what is not identifiable the smallest that fits as well as any. Inverse (p, p) of
    R; which of the p are identifiable; the rank; the condition number with columns of unit length.
    """

    x: Array
    inverse: Array
    identifiable: Mask
    rank: int
    condition_number: float


def solution(R: Array, structure: Structure) -> Solution:
    """
    Solve the equations of an R factor (q, q) of rows [A b] as far as they go (4.74).

    Columns of K or P of the same units are compared with each other, and scaled.
    """
    sizes = np.linalg.norm(R[:-1, :-1], axis=0)
    angular = [(row > 2) + (column > 2) for row, column in structure.leads]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    unit = np.where(sizes > NO_EFFECT * largest, sizes, np.inf)
    U, singular, Vt = np.linalg.svd(R[:-1, :-1] / unit)
    known = singular > singular[0] / LARGEST_CONDITION
    inverse = (Vt[known].T / singular[known]) @ U[:, known].T / unit[:, None]
    return Solution(
        inverse @ R[:-1, -1],
        inverse,
        ~np.any(np.abs(Vt[~known]) > IN_NULL_SPACE, axis=0),
        int(np.count_nonzero(known)),
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
    )
