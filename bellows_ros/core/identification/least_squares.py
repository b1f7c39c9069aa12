"""
Weighted linear least squares on accelerations (4.66-4.81).

The weight W of (4.66) depends on the wrenches of all recordings. The sums over a recording are
therefore products of the rows [L c] for each pair of components of the wrench, which are weighted
later. Noise of the filtered motions is neither compensated nor part of the standard errors: in
motion capture it biases K by less than 0.5 % and P by less than 5 %; output error has no such
bias.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification.information import inverted, with_unidentifiable
from bellows_ros.core.identification.result import (
    Fit,
    MAX_NOISE_SHARE,
    MAX_RELATIVE_ERROR,
    remedy_for,
)
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.recording import FilterNoise
from bellows_ros.errors import UndeterminedError
import numpy as np

NO_EFFECT = 1e-8
"""Relative size, the root of rounding, of a column without effect, or of a variance of zero."""

MOMENT_LEVER = 0.01
"""Lever with which moments are compared with forces, m: of the order of a cup's radius."""


class Statistics(NamedTuple):
    """
    Sufficient statistics of one recording for any weight.

    Parameters
    ----------
    structure : Structure
        Structure of K and P.
    used, rejected : int
        Numbers of valid and of invalid samples.
    windows : float
        Number of filter windows in the valid samples, which have independent residuals.
    wrench : ndarray (6,)
        Sum of the required wrenches, N and N m.
    products : ndarray (6, q, 6, q)
        Sums of the products of the rows [L c] (6, q) of all samples, q = p + 1.
    noise : ndarray (2, 6)
        Sums of the variances of the noise in the lip's displacement (m, rad) and twist.

    """

    structure: Structure
    used: int
    rejected: int
    windows: float
    wrench: Array
    products: Array
    noise: Array


def statistics(
    samples: Samples, cup_length: float, structure: Structure, noise: FilterNoise | None = None
) -> Statistics:
    """Return the statistics of samples for a structure of K and P and a cup length l0, m."""
    size = 2 * structure.size + 1
    products = np.zeros((6 * size, 6 * size))
    for rows in samples.lip.equations(cup_length, structure):
        flat = rows.reshape(-1, 6 * size)
        products += flat.T @ flat
    return Statistics(
        structure, samples.count, len(samples.tool) - samples.count,
        samples.windows, samples.lip.wrench.sum(axis=0),
        products.reshape(6, size, 6, size), samples.count * (
            lip_noise(noise, samples.payload, cup_length) if noise else np.zeros((2, 6))))


def lip_noise(noise: FilterNoise, payload: Package, cup_length: float) -> Array:
    """Return the variances (2, 6) of the noise in displacement and twist of the lip."""
    variances = np.zeros((2, 6))
    for sizes, weights, lever in (
            (noise.package, noise.package_weights, float(np.linalg.norm(payload.com))),
            (noise.tool, noise.tool_weights, cup_length)):
        turned = sizes.rotation**2
        variances += np.outer(np.sum(weights[:2] ** 2, axis=1), np.repeat(
            [sizes.position**2 + lever**2 * turned, turned], 3))
    return variances


def least_squares(parts: Sequence[Statistics]) -> Fit:
    """
    Fit K and P so that the cup's wrench is the wrench required by the motion (4.66, 4.74).

    Parameters
    ----------
    parts : sequence of Statistics
        Statistics of recordings of one cup, all with one structure and cup length.

    Returns
    -------
    Fit
        K and P with standard errors by residuals of any covariance, constant within a filter
        window and independent between windows; infinite for unidentifiable parameters. An
        indefinite result is returned with a warning.

    Raises
    ------
    BellowsError
        If there are too few samples, or no parameter is identifiable.

    """
    structure, used = parts[0].structure, sum(each.used for each in parts)
    if 6 * used <= 2 * structure.size:
        raise UndeterminedError(
            f'{used} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or check in the report why samples were rejected.')
    products = np.sum([each.products for each in parts], axis=0)
    mean = np.sum([each.wrench for each in parts], axis=0) / used
    scatter = products[:, -1, :, -1] - used * np.outer(mean, mean)
    W = np.asarray(np.linalg.inv(regularised(structure.covariance(used, mean, scatter))))
    normal = np.einsum('ij,ipjq->pq', W, products)
    inverse, is_separable, condition = inverted(
        normal[:-1, :-1], _sizes_of_columns(normal[:-1, :-1], structure))
    if not is_separable.any():
        raise UndeterminedError(
            f'{", ".join(structure.labels[:4])} and all others are not identifiable from '
            'these recordings: nothing moves. Excite all six directions.')
    x = inverse @ normal[:-1, -1]
    r = np.append(x, -1.0)
    values, axes = np.linalg.eigh(np.einsum('p,ipjq,q->ij', r, products, r))
    squares = axes * np.maximum(values, 0.0) @ axes.T  # of the residual wrench, after rounding
    meat = np.einsum('ij,ipjq->pq', W @ squares @ W, products)[:-1, :-1] / used
    freedom = 6.0 * sum(each.windows for each in parts) - len(x)
    covariance = inverse @ meat @ inverse * (6.0 * used / freedom if freedom > 0.0 else np.inf)
    basis = np.array(structure.model_basis)
    energy = np.concatenate([np.einsum('aji,jk,aki,i->a', basis, W, basis, variances)
                             for variances in np.sum([each.noise for each in parts], axis=0)])
    is_identifiable = is_separable & (energy * np.diag(inverse) < MAX_NOISE_SHARE) & (
        np.sqrt(np.diag(covariance)) <= MAX_RELATIVE_ERROR * structure.sizes(
            *structure.matrices(x)))
    return Fit(
        method='least_squares',
        structure=structure.name,
        parameters=x,
        covariance=with_unidentifiable(covariance, ~is_identifiable),
        samples_used=used,
        samples_rejected=sum(each.rejected for each in parts),
        condition_number=condition,
        weight=W,
        residual_rms=np.sqrt(np.diag(squares) / used),
        notes=tuple(_notes(structure, is_identifiable)))


def regularised(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches, regularised in directions without a wrench."""
    force, moment = np.diag(covariance).reshape(2, 3).mean(axis=1)
    scale = np.repeat([max(force, moment), max(moment, MOMENT_LEVER**2 * force)], 3)
    if not scale[0] > 0.0:
        return np.eye(6)
    if np.linalg.eigvalsh(covariance / np.sqrt(np.outer(scale, scale)))[0] > NO_EFFECT:
        return covariance
    return np.asarray(covariance + NO_EFFECT * np.diag(scale))


def _sizes_of_columns(normal: Array, structure: Structure) -> Array:
    """Return the sizes (p,) of columns, infinite without effect among columns of its kind."""
    sizes = np.sqrt(np.diag(normal))
    angular = [(row > 2) + (column > 2) for row, column in structure.leads]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    return np.where(sizes > NO_EFFECT * largest, sizes, np.inf)


def _notes(structure: Structure, is_identifiable: Mask) -> Iterator[Finding]:
    """Yield a finding on each unidentifiable parameter, or one on all."""
    if not is_identifiable.any():
        yield Finding('not_identifiable', Level.WARN, {
            'label': 'Each entry of K and P', 'why': 'the recordings are too short',
            'how': 'Record longer'})
        return
    for label, is_known in zip(structure.labels, is_identifiable.tolist(), strict=True):
        if not is_known:
            yield Finding('not_identifiable', Level.WARN, {
                'label': label, 'why': 'its standard error is as large as itself, or larger',
                'how': remedy_for(label, structure)})
