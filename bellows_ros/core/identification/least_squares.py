"""
Weighted linear least squares on accelerations (4.66-4.81).

Sufficient statistics of the recordings are weighted and joined by QR factorisations, without
normal equations of the raw data. Noise in the equations adds M to A^T A and m to A^T b on average;
if the noise is given, both are subtracted (compensated least squares).
"""

from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification import result
from bellows_ros.core.identification import samples as sampling
from bellows_ros.core.identification.pool import Held
from bellows_ros.core.identification.reduction import Statistics
from bellows_ros.core.identification.result import Fit, IN_NULL_SPACE, MAX_RELATIVE_ERROR, NOTES
from bellows_ros.core.identification.samples import joined
from bellows_ros.core.model.structure import has_coupling, Structure
from bellows_ros.errors import UndeterminedError
import numpy as np

MAX_LISTED = 4
"""Largest number of parameters named in a sentence."""

MAX_CONDITION = 1e6
"""Largest ratio of singular values of identifiable combinations of parameters."""

NO_EFFECT = 1e-8
"""Relative size of a column, among columns of its kind, below which a parameter has no effect."""

QR_ROWS = 512
"""Number of rows reduced to an R factor at a time, which fit into the processor's cache."""

CLUSTERS_PER_PARAMETER = 2
"""Clusters per parameter required for the correlations of the estimates."""

MIN_CLUSTERS = 10
"""Clusters required for the variances of the estimates."""

MIN_SHARE = 1e-3
"""Smallest share of the information on a direction in other clusters for a residual to count."""

MIN_SIGNAL_SHARE = 0.1
"""Smallest share of signal in the information on a direction whose noise is subtracted."""

MIN_SQUARED_DISTANCE = 13.8
"""Smallest squared Mahalanobis distance of a significant extension of the spring from zero;
false-alarm rate 1 in 1000."""

MIN_CLUSTER_DISTANCE = 25.0
"""
Smallest squared Mahalanobis distance of significant couplings from zero for least squares.

Covariances of few clusters cause more false alarms: at most 2 of 40 cups by simulation.
"""


def whitening_of(covariance: Array) -> Array:
    """Return the root of the weight W that makes a covariance (6, 6) of wrenches the identity."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(sampling.regularised(covariance))))


def r_factor(parts: Iterable[Array], columns: int) -> Array:
    """Return R (columns, columns) of the QR factorisation of stacked parts (4.71, 4.72)."""
    R: Array = np.zeros((columns, columns))
    for rows in parts:
        rows = np.vstack([R, rows])
        whole = len(rows) // QR_ROWS * QR_ROWS
        # R factors of small parts, then of the stacked factors: four times faster than at once.
        small = np.linalg.qr(rows[:whole].reshape(-1, QR_ROWS, columns), mode='r')
        R = np.asarray(np.linalg.qr(np.concatenate([*small, rows[whole:]]), mode='r'))
    return R


class LinearSolution(NamedTuple):
    """
    The least-squares solution of p parameters.

    x (p,), the smallest of equally good solutions; the inverse (p, p) of R; the mask of
    identifiable parameters; and the condition number with columns of unit length.
    """

    x: Array
    inverse: Array
    identifiable: Mask
    condition_number: float


def solution(R: Array, structure: Structure) -> LinearSolution:
    """
    Solve the equations of an R factor (q, q) of rows [A b], up to their rank (4.74).

    Columns of K or P with equal units are compared with each other, and scaled.
    """
    sizes = np.linalg.norm(R[:-1, :-1], axis=0)
    angular = [(row > 2) + (column > 2) for row, column in structure.leads]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    unit = np.where(sizes > NO_EFFECT * largest, sizes, np.inf)
    U, singular, Vt = np.linalg.svd(R[:-1, :-1] / unit)
    determined = singular > singular[0] / MAX_CONDITION
    inverse = (Vt[determined].T / singular[determined]) @ U[:, determined].T / unit[:, None]
    return LinearSolution(
        inverse @ R[:-1, -1],
        inverse,
        ~np.any(np.abs(Vt[~determined]) > IN_NULL_SPACE, axis=0),
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf)


def least_squares(parts: Held) -> Fit:
    """
    Fit K and P so that the cup's wrench is the wrench required by the motion (4.66, 4.74).

    Parameters
    ----------
    parts : Held
        Statistics of recordings of one cup, all with one structure and cup length.

    Returns
    -------
    Fit
        K and P with standard errors that allow for the correlation of residuals within the
        filter's window, infinite for unidentifiable parameters. With known noise its bias is
        subtracted. An indefinite result is returned with a warning.

    Raises
    ------
    BellowsError
        If there are too few samples, or no parameter is identifiable.

    """
    heads = parts.pool.results(Statistics.head, parts)
    structure = heads[0].structure
    used, rejected = sum(head.used for head in heads), sum(head.rejected for head in heads)
    if 6 * used <= 2 * structure.size:
        raise UndeterminedError(
            f'{used} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or check in the report why samples were rejected.')
    whitening, (x, inverse, identifiable, condition), noise = weighted(parts)
    if not identifiable.any():
        raise UndeterminedError(
            f'{", ".join(structure.labels[:MAX_LISTED])} and all others are not identifiable from '
            'these recordings: nothing moves. Excite all six directions.')
    bias = noise_share = None
    gain = inverse
    if noise is not None:
        bias, gain, separable = noise_bias(noise, whitening, x, inverse)
        energy = np.einsum('ij,ipjp->p', whitening.T @ whitening, noise)[:-1]
        noise_share = np.where(
            identifiable, np.minimum(energy * np.sum(inverse**2, axis=1), 1.0), 1.0)
        x, identifiable = x - bias, identifiable & separable
    covariance, squares = _uncertainty(parts, whitening, x, inverse, gain)
    std = np.sqrt(np.diag(covariance))
    sizes = structure.sizes(*structure.matrices(x))
    significant = identifiable & (std <= MAX_RELATIVE_ERROR * sizes)
    return Fit(
        method='least_squares',
        structure=structure.name,
        parameters=x,
        covariance=result.with_unidentifiable(covariance, ~significant),
        samples_used=used,
        samples_rejected=rejected,
        condition_number=condition,
        weight=whitening.T @ whitening,
        residual_rms=np.sqrt(squares / used),
        bias=bias,
        noise_share=noise_share,
        notes=() if significant.any() else (NOTES['too_short'],))


def simplest_fit(parts: Held, simpler: Structure) -> Fit:
    """
    Return the fit of least squares, in the simpler structure unless couplings are significant.

    The covariance is robust against correlated residuals in clusters: a significant coupling is
    confirmed by held-out clusters.
    """
    structure = parts.pool.results(Statistics.head, parts)[0].structure
    if structure != simpler:
        couplings = structure.couplings
        with suppress(UndeterminedError):
            fit = least_squares(parts)
            x, C = fit.parameters[couplings], fit.covariance[np.ix_(couplings, couplings)]
            if fit.usable and np.isfinite(C).all() and has_coupling(fit.stiffness) and (
                    float(x @ np.linalg.solve(C, x)) > MIN_CLUSTER_DISTANCE):
                return fit
    return least_squares(parts.pool.keep(Statistics.of, parts, simpler))


def weighted(parts: Held) -> tuple[Array, LinearSolution, Array | None]:
    """
    Return the whitening (6, 6), the solution with noise, and the noise in its products.

    The products (6, q, 6, q) are summed over all parts (see `noise_products`), None if one lacks
    them.
    """
    heads = parts.pool.results(Statistics.head, parts)
    structure = heads[0].structure
    whitening = whitening_of(joined(head.moments for head in heads).covariance(structure))
    noises = [head.noise for head in heads if head.noise is not None]
    size = 2 * structure.size + 1
    R = r_factor(parts.pool.results(_r_factor, whitening, parts), size)
    return (whitening, solution(R, structure),
            np.sum(noises, axis=0) if len(noises) == len(heads) else None)


def _r_factor(whitening: Array, part: Statistics) -> Array:
    """Return R (q, q) of the whitened rows of a recording."""
    size = 2 * part.structure.size + 1
    return r_factor(((whitening @ rows).reshape(-1, size) for rows, _ in part.rows()), size)


class ClusterSums(NamedTuple):
    """
    Sums over the clusters of a recording, see `_uncertainty`.

    Squares (6,) of the wrench residuals and of the whitened residuals, products (6, p, p) of the
    rows of Z, number of the vectors u (p,), their sum, and the sum of their products.
    """

    squares: Array
    whitened: Array
    products: Array
    clusters: int
    total: Array
    outer: Array


def _scores(whitening: Array, x: Array, inverse: Array, part: Statistics) -> ClusterSums:
    """Return the sums of a recording."""
    size, colour, scores = len(x), np.linalg.inv(whitening), [np.empty((0, len(x)))]
    squares, whitened, products = np.zeros(6), np.zeros(6), np.zeros((6, size, size))
    for plain, clusters in part.rows():
        rows = whitening @ plain
        A, b = rows[..., :-1], rows[..., -1]
        Z, r = A @ inverse, b - A @ x
        squares += np.sum((r @ colour.T) ** 2, axis=0)
        whitened += np.sum(r**2, axis=0)
        products += np.transpose(Z, (1, 2, 0)) @ np.swapaxes(Z, 0, 1)
        for cluster in clusters:
            Z_cluster = Z[cluster].reshape(-1, size)
            share, V = np.linalg.eigh(np.eye(size) - Z_cluster.T @ Z_cluster)
            root = V / np.sqrt(np.maximum(share, MIN_SHARE))
            scores.append((root @ (V.T @ (Z_cluster.T @ r[cluster].ravel())))[None])
    u = np.concatenate(scores)
    return ClusterSums(squares, whitened, products, len(u), u.sum(axis=0), u.T @ u)


def _uncertainty(
    parts: Held, whitening: Array, x: Array, inverse: Array, gain: Array
) -> tuple[Array, Array]:
    """
    Return the covariance (p, p) of x, and the squares (6,) of wrench residuals.

    The cluster-robust covariance needs neither independent residuals within a cluster nor equal
    noise: with Z = A R^-1 it is G (sum of u u^T) G^T, u = (I - Z_j^T Z_j)^-1/2 Z_j^T r_j for
    cluster j, whose root corrects for the shrinking of residuals by the fit. G is R^-1 without
    compensation of noise; with it the u have a mean, which is subtracted. Too few clusters do not
    determine the correlations of many parameters, which are then taken from the equations.

    A fit makes the sum of the clusters' scores zero, so that few clusters underestimate the
    variances. A lower bound are the variances with residuals that are constant within a filter
    window and independent between windows; infinite if so many windows leave no residual. A short
    last cluster is not counted.
    """
    squares, whitened, products, count, total, outer = (
        sum(each[1:], each[0]) for each in zip(
            *parts.pool.results(_scores, whitening, x, inverse, parts), strict=True))
    size, mean = len(x), total / max(count, 1)
    centred = outer if gain is inverse else outer - count * np.outer(mean, mean)
    covariance = gain @ centred @ gain.T
    if count >= CLUSTERS_PER_PARAMETER * size:
        return covariance, squares
    variances = np.diag(covariance)
    if count < MIN_CLUSTERS:
        degrees = 6 * sampling.CLUSTER_WINDOWS * (count - 1) - size
        meat = np.tensordot(6.0 * whitened / max(degrees, 1), products, axes=1)
        variances = np.maximum(
            variances, np.diag(gain @ meat @ gain.T) if degrees > 0 else np.inf)
    of_equations = gain @ gain.T
    ratio = np.sqrt(variances / np.maximum(np.diag(of_equations), np.finfo(float).tiny))
    return of_equations * np.outer(ratio, ratio), squares


def noise_bias(
    noise: Array, whitening: Array, x: Array, inverse: Array
) -> tuple[Array, Array, Mask]:
    """
    Return the expected error (p,) of x by noise (6, q, 6, q), and the gain without noise.

    With noise that adds M to A^T A and m to A^T b on average, the truth is near (A^T A - M)^-1
    (A^T b - m), and the error of the estimate is -(A^T A - M)^-1 (M x - m). The gain (p, p) is G =
    (A^T A - M)^-1 R^T. Directions with nearly pure noise are not corrected, and parameters with
    components in them are not identifiable (p,).
    """
    added = np.einsum('ij,ipjq->pq', whitening.T @ whitening, noise)
    share, V = np.linalg.eigh(inverse.T @ added[:-1, :-1] @ inverse)
    slope = inverse.T @ (added[:-1] @ np.append(x, -1.0))
    noisy = share > 1.0 - MIN_SIGNAL_SHARE
    parts = (inverse @ V) ** 2
    separable = parts[:, noisy].sum(axis=1) <= IN_NULL_SPACE * parts.sum(axis=1)
    compensated = inverse @ (V[:, ~noisy] / (1.0 - share[~noisy])) @ V[:, ~noisy].T
    gain = compensated + inverse @ V[:, noisy] @ V[:, noisy].T
    return -compensated @ slope, gain, separable
