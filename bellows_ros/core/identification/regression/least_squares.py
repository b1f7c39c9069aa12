"""
Weighted linear least squares on accelerations (4.66-4.81).

The rows of all samples are reduced to one small triangle by QR factorisations, block by block:
the normal equations of the raw data are never formed, memory does not grow with the regressor,
and the triangles of several recordings can be joined.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

from bellows_ros.core.identification.regression.moments import joined, Moments
from bellows_ros.core.identification.regression.triangles import triangle
from bellows_ros.core.identification.result import definiteness_warnings, Fit
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.identification.unknown import IN_NULL_SPACE, Mask, without
from bellows_ros.core.identification.wrenches import lip_relative, needed_wrench
from bellows_ros.core.model import Package, regressor
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 4096
"""Samples whose regressor is in memory at a time."""

LARGEST_CONDITION = 1e6
"""Combinations of parameters that are told by less than this part of the best are not told."""

UNTOLD_SHOWN = 4

WRENCH = (
    *((f'force along {axis}', 'N') for axis in 'xyz'),
    *((f'moment about {axis}', 'N m') for axis in 'xyz'),
)
"""The components of a wrench at S, and their units."""

NO_EFFECT = 1e-8
"""A parameter whose column is smaller than this part of those of its kind has no effect."""

LEVER = 0.01
"""Moments are taken to be at least forces at such a lever, m, where they are compared."""

NO_WRENCH, FLOOR = 1e-10, 1e-8
"""Variances of a wrench (parts of their mean) that are none, and what is then added."""

CLUSTER_WINDOWS = 4
"""Residuals this many filter windows apart are taken as independent for standard errors."""

CLUSTERS_PER_PARAMETER = 2
"""Clusters that it takes at least to tell correlations of the estimates."""

ENOUGH_CLUSTERS = 10
"""Clusters that it takes at least to tell variances of the estimates."""

SMALLEST_SHARE = 1e-3
"""Least part of a direction that other clusters must tell, for a cluster's residual to count."""

LEAST_SIGNAL = 0.05
"""Noise is taken to leave at least this part of what tells a direction."""

UNEXPLAINED, OF_THE_WRENCH = 1.5, 0.1
"""Residuals so many times those of noise, and by such a part of the wrench, are too large."""


@dataclass(frozen=True, eq=False)
class Samples:
    """
    One prepared recording as least squares sees it.

    Parameters
    ----------
    tool : Trajectory
        N poses of E in the world with body twists.
    package : Trajectory
        N poses of B with body twists and accelerations, at the same stamps.
    held : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float
        m/s^2 along -z of the world.
    window : float
        Duration of the package's filter window, s: so far residuals are correlated.

    """

    tool: Trajectory
    package: Trajectory
    held: Package
    gravity: float
    window: float

    def blocks(self) -> 'Iterator[Samples]':
        """Yield the valid samples in blocks, in the order of time."""
        valid = np.flatnonzero(self.tool.valid & self.package.valid)
        for start in range(0, len(valid), BLOCK):
            index = valid[start:start + BLOCK]
            yield Samples(
                self.tool.select(index), self.package.select(index), self.held, self.gravity,
                self.window,
            )  # fmt: skip

    def thinned(self, most: int) -> 'Samples':
        """Return every so many of the samples, about as many as asked for or a few more."""
        step = slice(None, None, max(len(self.tool) // most, 1))
        return replace(self, tool=self.tool.select(step), package=self.package.select(step))

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.tool.valid & self.package.valid))


def least_squares(
    recordings: list[Samples],
    cup_length: float,
    structure: Structure,
    noise: Array | None = None,
) -> Fit:
    """
    Fit K and P so that the cup's wrench is the one that the motion needs (4.66, 4.74).

    Parameters
    ----------
    recordings : list of Samples
        Recordings of one cup, each with the package it held.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries of K and P are free.
    noise : ndarray (6, q, 6, q), optional
        What noise adds to the products of the rows, of all recordings (see `noise_products`).

    Returns
    -------
    Fit
        K and P with standard errors that allow for the correlation that the filter's window puts
        into the residuals, and are infinite where the recordings tell nothing. Where the noise is
        known, they hold the bias that it causes as well. A result that is not positive definite
        is returned as it is, with a warning that says so.

    Raises
    ------
    BellowsError
        If there are too few samples, or they tell nothing at all.

    """
    count = sum(samples.count for samples in recordings)
    rejected = sum(len(samples.tool) for samples in recordings) - count
    require_enough(count, structure)
    whitening = whitening_of(regular(wrench_covariance(recordings, structure)))
    rows = partial(_rows, recordings, cup_length, structure, whitening)
    return solved(rows, structure, whitening, count, rejected, noise)


class Rows(NamedTuple):
    """Whitened rows of the problem: A (N, 6, p), b (N, 6), and which of the N are a cluster."""

    A: Array
    b: Array
    clusters: list[slice]


def require_enough(count: int, structure: Structure) -> None:
    """Raise BellowsError if there are fewer equations than parameters."""
    if 6 * count <= 2 * structure.size:
        raise BellowsError(
            f'{count} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or see in the report why samples were rejected.'
        )


def regular(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches that has a root where none act in some direction."""
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


def solved(
    rows: Callable[[], Iterable[Rows]],
    structure: Structure,
    whitening: Array,
    used: int,
    rejected: int,
    noise: Array | None = None,
) -> Fit:
    """Return the fit of whitened rows, which are made anew whenever they are needed."""
    x, inverse, condition, untold = _solve(_triangle(rows(), structure), structure)
    covariance, squares = _uncertainty(rows, whitening, x, inverse)
    bias = noise_rms = None
    if noise is not None:
        bias = _bias(noise, whitening, x, inverse)
        covariance = covariance + np.outer(bias, bias)
        noise_rms = _noise_rms(noise, x, used)
    covariance = without(covariance, untold | np.isinf(np.diag(covariance)))
    residual_rms = np.sqrt(squares / used)
    stiffness, damping = structure.matrices(x)
    stiffness_std, damping_std = structure.spread(np.sqrt(np.diag(covariance)))
    return Fit(
        method='least_squares',
        structure=structure.name,
        stiffness=stiffness,
        damping=damping,
        stiffness_std=stiffness_std,
        damping_std=damping_std,
        covariance=covariance,
        labels=structure.labels,
        samples_used=used,
        samples_rejected=rejected,
        condition_number=condition,
        weight=whitening.T @ whitening,
        residual_rms=residual_rms,
        noise_rms=noise_rms,
        bias=bias,
        warnings=(
            *definiteness_warnings(stiffness, damping, structure.name),
            *untold_warnings(structure.labels, untold),
            *_short_warnings(covariance),
            *_doubts(residual_rms, noise_rms, whitening),
        ),
    )


def wrench_covariance(recordings: list[Samples], structure: Structure) -> Array:
    """Return Q (6, 6) of the needed wrenches (4.69), (4.80); see `Moments.covariance`."""
    return joined(wrench_moments(r) for r in recordings).covariance(structure)


def wrench_moments(recording: Samples) -> Moments:
    """Return the moments of the wrenches that a recording needs."""
    return joined(
        Moments.of(needed_wrench(b.held, b.package, b.gravity)) for b in recording.blocks()
    )


def equations(
    block: Samples, cup_length: float, structure: Structure
) -> tuple[Array, Array, list[slice]]:
    """Return a block's L (N, 6, p) and c (N, 6) of (4.67), (4.68), and its clusters."""
    o_E_S, R_E_S, twist = lip_relative(block.tool, block.package, block.held.com)
    L = regressor(cup_length, structure.basis, o_E_S, R_E_S, twist)
    return L, needed_wrench(block.held, block.package, block.gravity), _clusters(block)


def _rows(
    recordings: list[Samples], cup_length: float, structure: Structure, whitening: Array
) -> Iterator[Rows]:
    """Yield the whitened rows of recordings, block by block."""
    for recording in recordings:
        for block in recording.blocks():
            L, c, clusters = equations(block, cup_length, structure)
            yield Rows(whitening @ L, c @ whitening.T, clusters)


def _triangle(rows: Iterable[Rows], structure: Structure) -> Array:
    """Return R of the QR factorisation of [A b] (4.71, 4.72)."""
    size = 2 * structure.size + 1
    return triangle((np.dstack([A, b]).reshape(-1, size) for A, b, _ in rows), size)


def _uncertainty(
    rows: Callable[[], Iterable[Rows]], whitening: Array, x: Array, inverse: Array
) -> tuple[Array, Array]:
    """Return the covariance (p, p) of x, however few clusters, and the squares (6,) left."""
    covariance, squares, clusters = _cluster_robust(rows(), whitening, x, inverse)
    if clusters < ENOUGH_CLUSTERS:
        variances = np.maximum(np.diag(covariance), _least_variances(rows(), x, inverse, clusters))
        covariance = _with_correlations_of(inverse @ inverse.T, variances)
    return covariance, squares


def _cluster_robust(
    rows: Iterable[Rows], whitening: Array, x: Array, inverse: Array
) -> tuple[Array, Array, int]:
    """
    Return the covariance (p, p) of x, the squares (6,) of wrench residuals, and the clusters.

    The covariance needs no independence of residuals that are less than a cluster apart, and
    no equal noise (the cluster-robust estimator; with Z = A R^-1 it is
    R^-1 (sum of u u^T) R^-T, u = (I - Z_j^T Z_j)^-1/2 Z_j^T r_j for cluster j, in which the
    root makes up for residuals that the fit itself has shrunk). Too few clusters cannot tell the
    correlations of many parameters; these are then those of the equations.
    """
    meat, squares, count = np.zeros((len(x), len(x))), np.zeros(6), 0
    colour = np.linalg.inv(whitening)
    for A, b, clusters in rows:
        r = b - A @ x
        squares += np.sum((r @ colour.T) ** 2, axis=0)
        count += len(clusters)
        for part in clusters:
            Z = A[part].reshape(-1, len(x)) @ inverse
            share, V = np.linalg.eigh(np.eye(len(x)) - Z.T @ Z)
            root = V / np.sqrt(np.maximum(share, SMALLEST_SHARE))
            u = root @ (V.T @ (Z.T @ r[part].ravel()))
            meat += np.outer(u, u)
    covariance = inverse @ meat @ inverse.T
    if count < CLUSTERS_PER_PARAMETER * len(x):
        covariance = _with_correlations_of(inverse @ inverse.T, np.diag(covariance))
    return covariance, squares, count


def _least_variances(rows: Iterable[Rows], x: Array, inverse: Array, clusters: int) -> Array:
    """
    Return the variances (p,) of x if residuals in a filter window are one, else independent.

    They are infinite where so many windows leave no residual. The last cluster may be short and
    is not counted. (A fit brings the scores of its clusters to a sum of zero: those of few
    clusters say next to nothing of the variances, that of one says zero.)
    """
    products, squares = np.zeros((6, len(x), len(x))), np.zeros(6)
    for A, b, _ in rows:
        Z = np.swapaxes(A @ inverse, 0, 1)
        products += np.swapaxes(Z, 1, 2) @ Z
        squares += np.sum((b - A @ x) ** 2, axis=0)
    degrees = 6 * CLUSTER_WINDOWS * (clusters - 1) - len(x)
    if degrees <= 0:
        return np.full(len(x), np.inf)
    meat = np.tensordot(6.0 * squares / degrees, products, axes=1)
    return np.asarray(np.diag(inverse @ meat @ inverse.T))


def _bias(noise: Array, whitening: Array, x: Array, inverse: Array) -> Array:
    """
    Return the expected error (p,) of x that noise in the equations causes.

    With noise that adds M to A^T A and m to A^T b on average, the truth is near
    (A^T A - M)^-1 (A^T b - m), and the estimate off it by -(A^T A - M)^-1 (M x - m).
    """
    added = np.einsum('ij,ipjq->pq', whitening.T @ whitening, noise)
    share, V = np.linalg.eigh(inverse.T @ added[:-1, :-1] @ inverse)
    slope = inverse.T @ (added[:-1] @ np.append(x, -1.0))
    return np.asarray(-inverse @ V @ (V.T @ slope / np.maximum(1.0 - share, LEAST_SIGNAL)))


def _noise_rms(noise: Array, x: Array, used: int) -> Array:
    """Return the RMS of the wrenches (6,) that noise alone would leave unexplained."""
    left = np.append(x, -1.0)
    return np.asarray(np.sqrt(np.einsum('p,ipiq,q->i', left, noise, left) / used))


def _with_correlations_of(covariance: Array, variances: Array) -> Array:
    """Return a covariance with the correlations of one and with other variances (p,)."""
    size = np.sqrt(variances / np.maximum(np.diag(covariance), np.finfo(float).tiny))
    return np.asarray(covariance * np.outer(size, size))


def _clusters(block: Samples) -> list[slice]:
    """Return the samples of a block cut into clusters that are several filter windows long."""
    cluster_ns = int(CLUSTER_WINDOWS * block.window * NS_PER_S)
    stamps = block.package.stamps_ns
    starts = np.unique((stamps - stamps[0]) // cluster_ns, return_index=True)[1]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(stamps)], strict=True)]


def _solve(triangle: Array, structure: Structure) -> tuple[Array, Array, float, Mask]:
    """
    Return x, the inverse of R, the scaled problem's condition number, and what is not told (4.74).

    Of parameters that are not told, x holds the smallest that fit as well as any.
    """
    R, d = triangle[:-1, :-1], triangle[:-1, -1]
    unit = column_sizes(R, structure)
    U, singular, Vt = np.linalg.svd(R / unit)
    told = singular > singular[0] / LARGEST_CONDITION
    untold = np.any(np.abs(Vt[~told]) > IN_NULL_SPACE, axis=0)
    if untold.all():
        raise BellowsError(
            f'The recording tells nothing about {", ".join(structure.labels[:UNTOLD_SHOWN])} and '
            'all others: nothing moves. Excite all six directions.'
        )
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    inverse = (Vt[told].T / singular[told]) @ U[:, told].T / unit[:, None]
    return inverse @ d, inverse, condition, untold


def column_sizes(R: Array, structure: Structure) -> Array:
    """
    Return by what the columns (p,) of equations are divided, infinite where they are rounding.

    Those of K or P of the same units are compared with each other.
    """
    sizes = np.linalg.norm(R, axis=0)
    angular = [(row > 2) + (column > 2) for (row, column), *_ in structure.entries]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    return np.where(sizes > NO_EFFECT * largest, sizes, np.inf)


def untold_warnings(labels: Sequence[str], untold: Mask) -> tuple[str, ...]:
    """Return a sentence that names the parameters that are not told, or none."""
    names = [label for label, is_untold in zip(labels, untold, strict=True) if is_untold]
    if not names:
        return ()
    more = f' and {len(names) - UNTOLD_SHOWN} more' if len(names) > UNTOLD_SHOWN else ''
    return (
        f'The recordings tell nothing about {", ".join(names[:UNTOLD_SHOWN])}{more}, alone: the '
        'standard errors are infinite, and the values say nothing. Excite all six directions, or '
        'take a simpler fit.structure.',
    )


def _short_warnings(covariance: Array) -> tuple[str, ...]:
    """Return a sentence where no standard error is told, or none."""
    if np.isfinite(np.diag(covariance)).any():
        return ()
    return (
        'The recordings are too short to tell how far off K and P may be: residuals within some '
        'filter windows are not independent, and too few are left. The standard errors are '
        'infinite. Record longer.',
    )


def _doubts(left: Array, by_noise: Array | None, whitening: Array) -> tuple[str, ...]:
    """Return a sentence where a fit leaves more of the wrench (6,) than noise explains."""
    if by_noise is None:
        return ()
    spread = np.linalg.norm(np.linalg.inv(whitening), axis=1)
    excess = np.sqrt(np.maximum(left**2 - by_noise**2, 0.0)) / spread
    doubtful = (left > UNEXPLAINED * by_noise) & (excess > OF_THE_WRENCH)
    if not doubtful.any():
        return ()
    worst = int(np.argmax(np.where(doubtful, excess, 0.0)))
    what, unit = WRENCH[worst]
    return (
        f'The model does not explain the recordings: of the {what} {left[worst]:.2g} {unit} RMS '
        f'are left where noise explains {by_noise[worst]:.2g} {unit}. Check recording.world and '
        'the other frames, that the topics are not exchanged, package.mass, package.com and '
        'cup.length, and that both streams are stamped by one clock; or take a richer '
        'fit.structure, or a shorter filter window where the motion is jerky.',
    )
