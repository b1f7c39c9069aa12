"""
Weighted linear least squares on accelerations (4.66-4.81).

Sufficient statistics of the recordings are weighted and joined by QR factorisations: the normal
equations of the raw data are never formed. Noise in the equations adds M to A^T A and m to A^T b
on average; where it is given both are subtracted (compensated least squares).

The internal strains of a cup that relaxes follow from the measured strain alone, so that the
wrench is linear in K, P and r_b K, too: K, P and r are the minimum of the same weighted squares.
Without a hold of some seconds r2 is not identifiable.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification import result
from bellows_ros.core.identification import samples as sampling
from bellows_ros.core.identification.reduction import Statistics
from bellows_ros.core.identification.result import Fit, IN_NULL_SPACE, MAX_RELATIVE_ERROR, NOTES
from bellows_ros.core.identification.samples import Equations, joined, Moments, Samples
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.recording import FilterNoise, NOISE_SAMPLES, Relaxation
from bellows_ros.errors import UndeterminedError
import numpy as np

MAX_LISTED = 4
"""Most parameters named in a sentence."""

MAX_CONDITION = 1e6
"""Ratio of singular values beyond which a combination of parameters is not identifiable."""

NO_EFFECT = 1e-8
"""A parameter whose column is smaller than this fraction of others of its kind has no effect."""

QR_ROWS = 512
"""Rows reduced to an R factor at a time, so that they stay in the processor's cache."""

CLUSTERS_PER_PARAMETER = 2
"""Clusters per parameter required for the correlations of the estimates."""

MIN_CLUSTERS = 10
"""Clusters required for the variances of the estimates."""

MIN_SHARE = 1e-3
"""Share of the information on a direction that other clusters need for a residual to count."""

MIN_SIGNAL_SHARE = 0.1
"""Share of the information that must be signal for noise to be removed from a direction."""

MAX_RESIDUAL_TO_NOISE, MAX_RESIDUAL_TO_WRENCH = 1.5, 0.1
"""Residuals are too large beyond this multiple of noise and this fraction of the wrench."""


def whitening_of(covariance: Array) -> Array:
    """Return the root of the weight W that makes a covariance (6, 6) of wrenches the identity."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(sampling.regularised(covariance))))


def r_factor(parts: Iterable[Array], columns: int) -> Array:
    """Return R (columns, columns) of the QR factorisation of stacked parts (4.71, 4.72)."""
    R: Array = np.zeros((columns, columns))
    for rows in parts:
        rows = np.vstack([R, rows])
        whole = len(rows) // QR_ROWS * QR_ROWS
        # R factors of small parts, then of these: four times faster than at once.
        small = np.linalg.qr(rows[:whole].reshape(-1, QR_ROWS, columns), mode='r')
        R = np.asarray(np.linalg.qr(np.concatenate([*small, rows[whole:]]), mode='r'))
    return R


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
    determined = singular > singular[0] / MAX_CONDITION
    inverse = (Vt[determined].T / singular[determined]) @ U[:, determined].T / unit[:, None]
    return Solution(
        inverse @ R[:-1, -1],
        inverse,
        ~np.any(np.abs(Vt[~determined]) > IN_NULL_SPACE, axis=0),
        int(np.count_nonzero(determined)),
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf)


def least_squares(parts: Sequence[Statistics]) -> Fit:
    """
    Fit K and P so that the cup's wrench is the one that the motion needs (4.66, 4.74).

    Parameters
    ----------
    parts : sequence of Statistics
        Of recordings of one cup, all with one structure and cup length.

    Returns
    -------
    Fit
        K and P with standard errors that allow for the correlation that the filter's window puts
        into the residuals, and are infinite where a parameter is not identifiable. Where the noise
        is known, the bias that it causes is taken out. A result that is not positive definite is
        returned as it is, with a warning.

    Raises
    ------
    BellowsError
        If there are too few samples, or no parameter is identifiable.

    """
    structure = parts[0].structure
    used, rejected = sum(part.used for part in parts), sum(part.rejected for part in parts)
    if 6 * used <= 2 * structure.size:
        raise UndeterminedError(
            f'{used} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or check in the report why samples were rejected.')
    whitening, (x, inverse, identifiable, _, condition), noise = weighted(parts)
    if not identifiable.any():
        raise UndeterminedError(
            f'{", ".join(structure.labels[:MAX_LISTED])} and all others are not identifiable from '
            'these recordings: nothing moves. Excite all six directions.')
    bias = noise_rms = None
    gain = inverse
    if noise is not None:
        bias, gain, separable = noise_bias(noise, whitening, x, inverse)
        x, identifiable = x - bias, identifiable & separable
        combination = np.append(x, -1.0)
        noise_rms = np.sqrt(np.einsum('p,ipiq,q->i', combination, noise, combination) / used)
    covariance, squares = _uncertainty(parts, whitening, x, inverse, gain)
    std = np.sqrt(np.diag(covariance))
    sizes = structure.sizes(*structure.matrices(x))
    significant = identifiable & (std <= MAX_RELATIVE_ERROR * sizes)
    residual_rms = np.sqrt(squares / used)
    return Fit(
        method='least_squares',
        structure=structure.name,
        parameters=x,
        covariance=result.with_unidentifiable(covariance, ~significant),
        samples_used=used,
        samples_rejected=rejected,
        condition_number=condition,
        weight=whitening.T @ whitening,
        residual_rms=residual_rms,
        noise_rms=noise_rms,
        bias=bias,
        notes=() if significant.any() else (NOTES['too_short'],),
        misfit=_misfit(residual_rms, noise_rms, whitening))


def weighted(parts: Sequence[Statistics]) -> tuple[Array, Solution, Array | None]:
    """
    Return the whitening (6, 6), the solution as it is with noise, and what this adds to products.

    The last (6, q, 6, q) is that of all parts (see `noise_products`), None where one lacks it.
    """
    structure = parts[0].structure
    whitening = whitening_of(joined(part.moments for part in parts).covariance(structure))
    noises = [part.noise for part in parts if part.noise is not None]
    size = 2 * structure.size + 1
    R = r_factor((rows.reshape(-1, size) for rows, _ in _rows(parts, whitening)), size)
    return (whitening, solution(R, structure),
            np.sum(noises, axis=0) if len(noises) == len(parts) else None)


def _rows(parts: Sequence[Statistics], whitening: Array) -> Iterator[Equations]:
    """Return the whitened rows of all parts."""
    return ((whitening @ rows, clusters) for part in parts for rows, clusters in part.rows())


def _uncertainty(
    parts: Sequence[Statistics], whitening: Array, x: Array, inverse: Array, gain: Array
) -> tuple[Array, Array]:
    """
    Return the covariance (p, p) of x, and the squares (6,) of wrench residuals.

    The covariance needs no independence of residuals that are less than a cluster apart, and
    no equal noise (the cluster-robust estimator; with Z = A R^-1 it is
    G (sum of u u^T) G^T, u = (I - Z_j^T Z_j)^-1/2 Z_j^T r_j for cluster j, in which the
    root makes up for residuals that the fit itself has shrunk, and G is R^-1, but where noise is
    compensated; then the u have a mean, which is subtracted). Correlations of many parameters
    do not follow from too few clusters; they are then those of the equations.

    A fit brings the scores of its clusters to a sum of zero: those of few clusters say next to
    nothing of the variances, that of one says zero. Then these are at least what they are if
    residuals in a filter window are one, else independent; infinite where so many windows leave
    no residual. The last cluster may be short and is not counted there.
    """
    size, colour, scores = len(x), np.linalg.inv(whitening), []
    squares, whitened, products = np.zeros(6), np.zeros(6), np.zeros((6, size, size))
    for rows, clusters in _rows(parts, whitening):
        A, b = rows[..., :-1], rows[..., -1]
        Z, r = A @ inverse, b - A @ x
        squares += np.sum((r @ colour.T) ** 2, axis=0)
        whitened += np.sum(r**2, axis=0)
        products += np.transpose(Z, (1, 2, 0)) @ np.swapaxes(Z, 0, 1)
        for part in clusters:
            Z_cluster = Z[part].reshape(-1, size)
            share, V = np.linalg.eigh(np.eye(size) - Z_cluster.T @ Z_cluster)
            root = V / np.sqrt(np.maximum(share, MIN_SHARE))
            scores.append(root @ (V.T @ (Z_cluster.T @ r[part].ravel())))
    u = np.array(scores)
    if gain is not inverse:
        u = u - u.mean(axis=0)
    covariance = gain @ u.T @ u @ gain.T
    if len(u) >= CLUSTERS_PER_PARAMETER * size:
        return covariance, squares
    variances = np.diag(covariance)
    if len(u) < MIN_CLUSTERS:
        degrees = 6 * sampling.CLUSTER_WINDOWS * (len(u) - 1) - size
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
    Return the expected error (p,) of x by noise (6, q, 6, q), and the gain without it.

    With noise that adds M to A^T A and m to A^T b on average, the truth is near
    (A^T A - M)^-1 (A^T b - m), and the estimate off it by -(A^T A - M)^-1 (M x - m). The gain
    (p, p) is G = (A^T A - M)^-1 R^T. Directions that are nearly all noise stay as they are, and
    parameters with a part in them are not identifiable (p,).
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


def _misfit(residual_rms: Array, noise_rms: Array | None, whitening: Array) -> str:
    """Return a sentence if the residual wrench (6,) is larger than noise explains."""
    if noise_rms is None:
        return ''
    spread = np.linalg.norm(np.linalg.inv(whitening), axis=1)
    excess = np.sqrt(np.maximum(residual_rms**2 - noise_rms**2, 0.0)) / spread
    doubtful = (residual_rms > MAX_RESIDUAL_TO_NOISE * noise_rms) & (
        excess > MAX_RESIDUAL_TO_WRENCH)
    if not doubtful.any():
        return ''
    worst = int(np.argmax(np.where(doubtful, excess, 0.0)))
    axis, unit = 'xyz'[worst % 3], result.WRENCH_UNITS[worst]
    what = f'moment about {axis}' if worst > 2 else f'force along {axis}'
    return NOTES['too_large_residual'].format(
        what=what, rms=residual_rms[worst], unit=unit, noise=noise_rms[worst])


MIN_SQUARED_DISTANCE = 13.8
"""Squared Mahalanobis distance from zero that 1 in 1000 cups without relaxation exceed."""

MAX_REMAINING_SHARE = 0.2
"""Part of what noise does not explain without relaxation that may be left with it: rubber leaves
some percent, and where something else is wrong with a recording more than half is."""

MAX_STRENGTH = 2.0
"""No rubber has stronger branches: a loss factor of 0.3 is one of 0.8. Wrong data may seem to."""

DEFAULT_RATIO, RATIO_STD = 1.05, 0.4
"""r2 / r1 of rubber with a constant loss factor, and its standard deviation among rubbers."""

RELAXATION_STEPS = 20
"""Most steps of the search; a handful suffice."""


def relaxation_of(
    recordings: Sequence[Samples], noises: Sequence[FilterNoise], cup_length: float,
    structure: Structure,
) -> Relaxation | None:
    """
    Estimate the strengths of the branches; None without any that exceeds its standard error.

    Parameters
    ----------
    recordings : sequence of Samples
        Of one cup.
    noises : sequence of FilterNoise
        Of each.
    cup_length : float
        Cup length l0, m.
    structure : Structure
        Of K and P.

    """
    products = _cluster_products(recordings, noises, cup_length, structure)
    if not np.diag(products[1])[:2 * structure.size].min() > 0.0:  # nothing but noise moves it
        return None
    _, unexplained = _fit_strengths(products, structure.size, ())
    for free in ((0, 1), (0,), (1,)):
        estimate, remaining = _fit_strengths(products, structure.size, free)
        if min(estimate.strengths) >= 0.0:
            break
    else:
        return None
    index, strengths = np.ix_(free, free), np.array(estimate.strengths)[list(free)]
    distance = strengths @ np.linalg.pinv(estimate.covariance[index]) @ strengths
    if distance <= MIN_SQUARED_DISTANCE or remaining > MAX_REMAINING_SHARE * unexplained or (
            max(strengths) > MAX_STRENGTH):
        return None
    if 0.0 < estimate.std[1] <= MAX_RELATIVE_ERROR * max(estimate.strengths):
        return estimate
    alone, remaining = _fit_strengths(products, structure.size, (0,), DEFAULT_RATIO)
    if remaining > MAX_REMAINING_SHARE * unexplained:
        return None
    unknown = np.diag([0.0, (RATIO_STD * alone.strengths[0]) ** 2])
    return alone._replace(covariance=alone.covariance + unknown, assumed=True)


def _relaxing_rows(
    samples: Samples, cup_length: float, structure: Structure
) -> Iterator[Equations]:
    """Yield rows [L, L1, L2, c] (N, 6, q), L_b by r_b K, and the clusters, block by block."""
    n = structure.size
    for (static, clusters), *others in zip(*(
            samples.relaxing(r).lip.equations(cup_length, structure)
            for r in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))), strict=True):
        of_branches = [other[..., :n] - static[..., :n] for other, _ in others]
        yield np.dstack([static[..., :-1], *of_branches, static[..., -1]]), clusters


def _cluster_products(
    recordings: Sequence[Samples], noises: Sequence[FilterNoise], cup_length: float,
    structure: Structure,
) -> tuple[Array, Array]:
    """
    Return the products of whitened rows [L, L1, L2, c] of all recordings.

    Those of each cluster (C, q, q), and their sum (q, q) less what noise adds.
    """
    whitening = whitening_of(joined(
        Moments.of(samples.lip.wrench) for samples in recordings).covariance(structure))
    size, clusters = 4 * structure.size + 1, []
    added = np.zeros((size, size))
    for samples, noise in zip(recordings, noises, strict=True):
        for rows, parts in _relaxing_rows(samples, cup_length, structure):
            rows = whitening @ rows
            clusters += [_square(rows[part]) for part in parts]
        thinned = samples.relaxing((1.0, 1.0)).thinned(NOISE_SAMPLES)
        (draw,) = np.random.default_rng(sampling.NOISE_SEED).spawn(1)
        part = max(thinned.count, 1) / max(samples.count, 1)
        for block in thinned.blocks():
            for (clean, _), (noisy, _) in zip(*(
                    _relaxing_rows(each, cup_length, structure)
                    for each in (block, sampling.with_noise(block, noise, draw))), strict=True):
                added += _square(whitening @ (noisy - clean)) / part
    products = np.array(clusters)
    return products, products.sum(axis=0) - added


def _square(rows: Array) -> Array:
    """Return the sum of products (q, q) of rows (N, 6, q)."""
    flat = rows.reshape(-1, rows.shape[-1])
    return np.asarray(flat.T @ flat)


def _fit_strengths(
    products: tuple[Array, Array], n: int, free: Sequence[int], ratio: float = 0.0
) -> tuple[Relaxation, float]:
    """
    Return r1 and r2, zero where not free, by Gauss-Newton, and the squares that are left.

    They may be negative, and so may be the squares, as those of noise are taken out.

    With a ratio r2 is so many times r1. The covariance needs no independence of residuals that
    are less than a cluster apart.
    """
    by = np.zeros((2, len(free)))
    by[list(free), range(len(free))] = 1.0
    by[1] += ratio * by[0]
    clusters, G = products
    scale = 1.0 / np.sqrt(np.diag(G)[:2 * n])
    x = np.append(np.linalg.solve(G[:2 * n, :2 * n] * np.outer(scale, scale),
                                  scale * G[:2 * n, -1]) * scale, np.zeros(len(free)))
    unit = np.append(scale, np.ones(len(free)))
    for _ in range(RELAXATION_STEPS):
        y, Y = _linear_unknowns(x, n, by)
        H = (Y * unit).T @ G @ (Y * unit)
        step = unit * np.linalg.solve(H, (Y * unit).T @ (G @ y))
        x = x - step
        if np.abs(step[2 * n:]).max(initial=0.0) < 1e-9:
            break
    y, Y = _linear_unknowns(x, n, by)
    scores = (clusters @ y) @ (Y * unit)
    scores = scores - scores.mean(axis=0)
    H = (Y * unit).T @ G @ (Y * unit)
    gain = by @ np.linalg.inv(H)[2 * n:]
    slopes = -np.linalg.solve(H[:2 * n, :2 * n], H[:2 * n, 2 * n:]) @ np.linalg.pinv(by)
    r = by @ x[2 * n:]
    covariance = gain @ scores.T @ scores @ gain.T
    return Relaxation(
        (float(r[0]), float(r[1])), covariance, scale[:, None] * slopes), float(y @ G @ y)


def _linear_unknowns(x: Array, n: int, by: Array) -> tuple[Array, Array]:
    """Return y = [K, P, r1 K, r2 K, -1], with which rows @ y is the residual, and dy/dx."""
    K, r = x[:n], by @ x[2 * n:]
    y = np.concatenate([x[:2 * n], r[0] * K, r[1] * K, [-1.0]])
    Y = np.zeros((len(y), len(x)))
    Y[:2 * n, :2 * n] = np.eye(2 * n)
    for b in range(2):
        part = slice((2 + b) * n, (3 + b) * n)
        Y[part, :n] = r[b] * np.eye(n)
        Y[part, 2 * n:] = np.outer(K, by[b])
    return y, Y
