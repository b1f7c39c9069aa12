"""
Weighted linear least squares on accelerations (4.66-4.81).

Sufficient statistics of the recordings are weighted and joined by QR factorisations: the normal
equations of the raw data are never formed. Noise in the equations adds M to A^T A and m to A^T b
on average; where it is known both are subtracted (compensated least squares).
"""

from collections.abc import Iterator, Sequence

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification.equations import (
    CLUSTER_WINDOWS,
    IN_NULL_SPACE,
    joined,
    r_factor,
    regular,
    Rows,
    Solution,
    solution,
    whitening_of,
    without,
)
from bellows_ros.core.identification.reduction import Statistics
from bellows_ros.core.identification.result import (
    Fit,
    LARGEST_ERROR,
    WRENCH_UNITS,
)
from bellows_ros.core.model.structure import Structure
from bellows_ros.errors import BellowsError, UndeterminedError
import numpy as np

SHOWN = 4
"""Most parameters named in a sentence."""

CLUSTERS_PER_PARAMETER = 2
"""Clusters per parameter required for the correlations of the estimates."""

ENOUGH_CLUSTERS = 10
"""Clusters required for the variances of the estimates."""

SMALLEST_SHARE = 1e-3
"""Share of the information on a direction that other clusters need for a residual to count."""

LEAST_SIGNAL = 0.1
"""Share of the information that must be signal for noise to be removed from a direction."""

TOO_SHORT = (
    'The recordings are too short for standard errors of K and P: residuals within a filter '
    'window are correlated, and too few windows are left. The standard errors are infinite. '
    'Record longer.')

UNEXPLAINED, OF_THE_WRENCH = 1.5, 0.1
"""Residuals are too large beyond this multiple of noise and this fraction of the wrench."""


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
        returned as it is, with a warning that says so.

    Raises
    ------
    BellowsError
        If there are none or too few samples, the parts differ in structure or length, or no
        parameter is identifiable.

    """
    structure = structure_of(parts)
    used, rejected = sum(part.used for part in parts), sum(part.rejected for part in parts)
    if 6 * used <= 2 * structure.size:
        raise UndeterminedError(
            f'{used} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or check in the report why samples were rejected.'
        )
    whitening, (x, inverse, identifiable, _, condition), noise = weighted(parts)
    if not identifiable.any():
        raise UndeterminedError(
            f'{", ".join(structure.labels[:SHOWN])} and all others are not identifiable from '
            'these recordings: nothing moves. Excite all six directions.'
        )
    bias = noise_rms = None
    gain = inverse
    if noise is not None:
        bias, gain, separable = noise_bias(noise, whitening, x, inverse)
        x, identifiable = x - bias, identifiable & separable
        left = np.append(x, -1.0)
        noise_rms = np.sqrt(np.einsum('p,ipiq,q->i', left, noise, left) / used)
    covariance, squares = _uncertainty(parts, whitening, x, inverse, gain)
    std = np.sqrt(np.diag(covariance))
    known = identifiable & (std <= LARGEST_ERROR * structure.sizes(*structure.matrices(x)))
    residual_rms = np.sqrt(squares / used)
    return Fit(
        method='least_squares',
        structure=structure.name,
        parameters=x,
        covariance=without(covariance, ~known),
        samples_used=used,
        samples_rejected=rejected,
        condition_number=condition,
        weight=whitening.T @ whitening,
        residual_rms=residual_rms,
        noise_rms=noise_rms,
        bias=bias,
        notes=() if known.any() else (TOO_SHORT,),
        misfit=_misfit(residual_rms, noise_rms, whitening),
    )


def structure_of(parts: Sequence[Statistics]) -> Structure:
    """Return the structure of all parts, or raise BellowsError if they are not of one cup."""
    kinds = {(part.structure.name, part.cup_length) for part in parts}
    if len(kinds) != 1:
        found = ', '.join(f'{name} with {length:g} m' for name, length in sorted(kinds))
        raise BellowsError(
            'Recordings can be fitted together only with the same fit.structure and cup.length; '
            f'these have {found or "none"}. Use one parameter file for all of them.'
        )
    return parts[0].structure


def weighted(parts: Sequence[Statistics]) -> tuple[Array, Solution, Array | None]:
    """
    Return the whitening (6, 6), the solution as it is with noise, and what this adds to products.

    The last (6, q, 6, q) is that of all parts (see `noise_products`), None where one lacks it.
    """
    structure = structure_of(parts)
    whitening = whitening_of(regular(joined(part.moments for part in parts).covariance(structure)))
    known = [part.noise for part in parts if part.noise is not None]
    R = r_factor((own.stacked for own in _rows(parts, whitening)), 2 * structure.size + 1)
    return (whitening, solution(R, structure),
            np.sum(known, axis=0) if len(known) == len(parts) else None)


def _rows(parts: Sequence[Statistics], whitening: Array) -> Iterator[Rows]:
    """Return the whitened rows of all parts."""
    return (own.whitened(whitening) for part in parts for own in part.rows())


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
    for A, b, clusters in _rows(parts, whitening):
        Z, r = A @ inverse, b - A @ x
        squares += np.sum((r @ colour.T) ** 2, axis=0)
        whitened += np.sum(r**2, axis=0)
        products += np.transpose(Z, (1, 2, 0)) @ np.swapaxes(Z, 0, 1)
        for part in clusters:
            own = Z[part].reshape(-1, size)
            share, V = np.linalg.eigh(np.eye(size) - own.T @ own)
            root = V / np.sqrt(np.maximum(share, SMALLEST_SHARE))
            scores.append(root @ (V.T @ (own.T @ r[part].ravel())))
    u = np.array(scores)
    if gain is not inverse:
        u = u - u.mean(axis=0)
    covariance = gain @ u.T @ u @ gain.T
    if len(u) >= CLUSTERS_PER_PARAMETER * size:
        return covariance, squares
    variances = np.diag(covariance)
    if len(u) < ENOUGH_CLUSTERS:
        degrees = 6 * CLUSTER_WINDOWS * (len(u) - 1) - size
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
    noisy = share > 1.0 - LEAST_SIGNAL
    parts = (inverse @ V) ** 2
    separable = parts[:, noisy].sum(axis=1) <= IN_NULL_SPACE * parts.sum(axis=1)
    compensated = inverse @ (V[:, ~noisy] / (1.0 - share[~noisy])) @ V[:, ~noisy].T
    gain = compensated + inverse @ V[:, noisy] @ V[:, noisy].T
    return -compensated @ slope, gain, separable


def _misfit(left: Array, by_noise: Array | None, whitening: Array) -> str:
    """Return a sentence if the residual wrench (6,) is larger than noise explains."""
    if by_noise is None:
        return ''
    spread = np.linalg.norm(np.linalg.inv(whitening), axis=1)
    excess = np.sqrt(np.maximum(left**2 - by_noise**2, 0.0)) / spread
    doubtful = (left > UNEXPLAINED * by_noise) & (excess > OF_THE_WRENCH)
    if not doubtful.any():
        return ''
    worst = int(np.argmax(np.where(doubtful, excess, 0.0)))
    axis, unit = 'xyz'[worst % 3], WRENCH_UNITS[worst]
    what = f'moment about {axis}' if worst > 2 else f'force along {axis}'
    return (
        f'The model does not explain the recordings: the residual {what} is {left[worst]:.2g} '
        f'{unit} RMS, of which noise explains {by_noise[worst]:.2g} {unit}. Check '
        'recording.world and the other frames, that the topics are not exchanged, package.mass, '
        'package.com and cup.length, and that one clock stamps both streams; or use a richer '
        'fit.structure, or a shorter filter window if the motion is jerky.'
    )
