"""
Weighted linear least squares on accelerations (4.66-4.81).

The rows of all samples are reduced to one small triangle by QR factorisations, block by block:
the normal equations of the raw data are never formed, memory does not grow with the regressor,
and the triangles of several recordings can be joined.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from bellows_ros.core.identification.result import definiteness_warnings, Fit
from bellows_ros.core.identification.structure import Structure
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
"""Scaled condition number above which the data do not determine the parameters."""

CLUSTER_WINDOWS = 4
"""Residuals this many filter windows apart are taken as independent for standard errors."""

SMALLEST_SHARE = 1e-3
"""Least part of a direction that other clusters must tell, for a cluster's residual to count."""


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

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.tool.valid & self.package.valid))


def least_squares(recordings: list[Samples], cup_length: float, structure: Structure) -> Fit:
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

    Returns
    -------
    Fit
        K and P with standard errors that allow for the correlation that the filter's window puts
        into the residuals. A result that is not positive definite is returned as it is, with a
        warning that says so.

    Raises
    ------
    BellowsError
        If there are too few samples, or they do not determine all parameters.

    """
    count = sum(samples.count for samples in recordings)
    if 6 * count <= 2 * structure.size:
        raise BellowsError(
            f'{count} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or see in the report why samples were rejected.'
        )
    whitening = np.linalg.inv(np.linalg.cholesky(wrench_covariance(recordings, structure)))
    problem = _Problem(recordings, cup_length, structure, whitening)
    triangle = problem.triangle()
    x, inverse, condition = _solve(triangle, structure)
    covariance, residual_rms = problem.uncertainty(x, inverse)
    stiffness, damping = structure.matrices(x)
    stiffness_std, damping_std = structure.matrices(np.sqrt(np.diag(covariance)))
    return Fit(
        method='least_squares',
        structure=structure.name,
        stiffness=stiffness,
        damping=damping,
        stiffness_std=stiffness_std,
        damping_std=damping_std,
        covariance=covariance,
        labels=structure.labels,
        samples_used=count,
        samples_rejected=sum(len(samples.tool) for samples in recordings) - count,
        condition_number=condition,
        weight=whitening.T @ whitening,
        residual_rms=residual_rms,
        warnings=definiteness_warnings(stiffness, damping, structure.name),
    )


def wrench_covariance(recordings: list[Samples], structure: Structure) -> Array:
    """
    Return Q (6, 6) of the needed wrenches: full (4.69), or pooled variances otherwise (4.80).

    Both lateral forces share a variance, and both lateral moments, when the structure ties them.
    """
    c = np.concatenate(
        [needed_wrench(s.held, s.package, s.gravity) for r in recordings for s in r.blocks()]
    )
    if structure.name == 'full':
        return np.cov(c.T)
    if structure.name == 'diagonal':
        return np.diag(np.var(c, axis=0, ddof=1))
    force, moment = np.var(c[:, :2], ddof=1), np.var(c[:, 3:5], ddof=1)
    return np.diag([
        force, force, np.var(c[:, 2], ddof=1), moment, moment, np.var(c[:, 5], ddof=1),
    ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Problem:
    """The whitened rows of the problem, made block by block whenever they are needed."""

    recordings: list[Samples]
    cup_length: float
    structure: Structure
    whitening: Array

    def rows(self) -> Iterator[tuple[Samples, Array, Array]]:
        """Yield blocks with their whitened regressor (N, 6, p) and needed wrench (N, 6)."""
        for recording in self.recordings:
            for block in recording.blocks():
                o_E_S, R_E_S, twist = lip_relative(block.tool, block.package, block.held.com)
                L = regressor(self.cup_length, self.structure.basis, o_E_S, R_E_S, twist)
                c = needed_wrench(block.held, block.package, block.gravity)
                yield block, self.whitening @ L, c @ self.whitening.T

    def triangle(self) -> Array:
        """Return R of the QR factorisation of [A b] (p + 1, p + 1) (4.71, 4.72)."""
        size = 2 * self.structure.size + 1
        R: Array = np.zeros((0, size))
        for _, A, b in self.rows():
            rows = np.hstack([A.reshape(-1, size - 1), b.reshape(-1, 1)])
            R = np.asarray(np.linalg.qr(np.vstack([R, rows]), mode='r'))
        return R

    def uncertainty(self, x: Array, inverse: Array) -> tuple[Array, Array]:
        """
        Return the covariance (p, p) of x and the RMS (6,) of the wrench residuals.

        The covariance needs no independence of residuals that are less than a cluster apart, and
        no equal noise (the cluster-robust estimator; with Z = A R^-1 it is
        R^-1 (sum of u u^T) R^-T, u = (I - Z_j^T Z_j)^-1/2 Z_j^T r_j for cluster j, in which the
        root makes up for residuals that the fit itself has shrunk).
        """
        meat, squares, count = np.zeros_like(inverse), np.zeros(6), 0
        colour = np.linalg.inv(self.whitening)
        for block, A, b in self.rows():
            r = b - A @ x
            squares += np.sum((r @ colour.T) ** 2, axis=0)
            count += len(r)
            for part in _clusters(block):
                Z = A[part].reshape(-1, len(x)) @ inverse
                share, V = np.linalg.eigh(np.eye(len(x)) - Z.T @ Z)
                root = V / np.sqrt(np.maximum(share, SMALLEST_SHARE))
                u = root @ (V.T @ (Z.T @ r[part].ravel()))
                meat += np.outer(u, u)
        return inverse @ meat @ inverse.T, np.sqrt(squares / count)


def _clusters(block: Samples) -> list[slice]:
    """Return the samples of a block cut into clusters that are several filter windows long."""
    cluster_ns = int(CLUSTER_WINDOWS * block.window * NS_PER_S)
    stamps = block.package.stamps_ns
    starts = np.unique((stamps - stamps[0]) // cluster_ns, return_index=True)[1]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(stamps)], strict=True)]


def _solve(triangle: Array, structure: Structure) -> tuple[Array, Array, float]:
    """Return x, the inverse of R, and the condition number of the scaled problem (4.74)."""
    R, d = triangle[:-1, :-1], triangle[:-1, -1]
    scale = np.linalg.norm(R, axis=0)
    _refuse_unseen(scale, structure)
    U, singular, Vt = np.linalg.svd(R / scale)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf
    if condition > LARGEST_CONDITION:
        weak = [structure.labels[i] for i in np.argsort(-np.abs(Vt[-1]))[:3]]
        raise BellowsError(
            f'The recording does not tell all {len(scale)} parameters apart (scaled condition '
            f'number {condition:.2g}, at most {LARGEST_CONDITION:.0g} can be solved); the weakest '
            f'combination holds {", ".join(weak)}. Excite all six directions, or take a simpler '
            'fit.structure.'
        )
    inverse = (Vt.T / singular) @ U.T / scale[:, None]
    return inverse @ d, inverse, condition


def _refuse_unseen(scale: Array, structure: Structure) -> None:
    """Raise BellowsError for parameters that have no effect at all on the recording."""
    unseen = [label for label, size in zip(structure.labels, scale, strict=True) if size == 0.0]
    if unseen:
        raise BellowsError(
            f'The recording tells nothing about {", ".join(unseen)}: nothing moves in that '
            'direction. Excite all six directions, or take a simpler fit.structure.'
        )
