"""Information matrices of many recordings, and their covariances."""

from dataclasses import dataclass, replace
from functools import cached_property
import math

from bellows_ros.core.geometry.arrays import Array, Mask, Places
import numpy as np

MAX_CONDITION = 1e6
"""Largest ratio of singular values of identifiable combinations of parameters."""

IN_NULL_SPACE = 0.05
"""Largest component of an identifiable parameter in the null space."""


def inverted(information: Array, unit: Array) -> tuple[Array, Mask, float]:
    """
    Return the inverse of an information matrix (p, p) up to its rank (4.74).

    Further results are the mask (p,) of the identifiable parameters, and the condition number of
    the regressor with columns in units of their sizes (p,), infinite without effect.
    """
    scale = np.outer(unit, unit)
    values, V = np.linalg.eigh(information / scale)
    used = values > values[-1] / MAX_CONDITION**2
    condition = float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else np.inf
    return ((V[:, used] / values[used]) @ V[:, used].T / scale,
            ~np.any(np.abs(V[:, ~used]) > IN_NULL_SPACE, axis=1), condition)


def covariance_of(information: Array) -> Array:
    """
    Return the covariance (n, n) of parameters with a given information.

    Unidentifiable parameters have inf on the diagonal and 0 elsewhere.
    """
    diagonal = np.diag(information)
    inverse, identifiable, _ = inverted(
        information, np.where(diagonal > 0.0, np.sqrt(np.maximum(diagonal, 0.0)), np.inf))
    return with_unidentifiable(inverse, ~identifiable)


def with_unidentifiable(covariance: Array, unidentifiable: Mask) -> Array:
    """Return a covariance with some parameters (n,) unidentifiable."""
    identifiable = ~unidentifiable
    result = np.where(np.outer(identifiable, identifiable), covariance, 0.0)
    result[np.diag_indices_from(result)] = np.where(identifiable, np.diag(covariance), np.inf)
    return result


@dataclass(frozen=True, eq=False)
class Arrow:
    """
    A symmetric matrix (m, m) without coupling between own unknowns of two recordings.

    The own unknowns of each recording are eliminated separately (Schur complement): work and
    memory grow linearly with the number of recordings.

    Parameters
    ----------
    shared : ndarray (s, s)
        Information on the shared unknowns.
    coupling : ndarray (R, o, s)
        Information between own unknowns of each of R recordings and the shared ones.
    own : ndarray (R, o, o)
        Information on the own unknowns of each recording.
    places : int ndarray (R, o)
        Indices of the own unknowns among all.

    """

    shared: Array
    coupling: Array
    own: Array
    places: Places

    def damped(self, damping: float) -> 'Arrow':
        """Return the matrix with its diagonal increased by a fraction."""
        return replace(self, shared=self.shared * (1.0 + damping * np.eye(len(self.shared))),
                       own=self.own * (1.0 + damping * np.eye(self.own.shape[1])))

    def times(self, x: Array) -> Array:
        """Return the product with a vector (m,)."""
        y, own, size = np.empty_like(x), x[self.places], len(self.shared)
        y[:size] = self.shared @ x[:size] + np.einsum('ros,ro->s', self.coupling, own)
        y[self.places] = self.coupling @ x[:size] + np.einsum('rop,rp->ro', self.own, own)
        return y

    @cached_property
    def carried(self) -> Array:
        """Negative change (R, o, s) of own unknowns per unit of shared ones, at the minimum."""
        return np.asarray(np.linalg.solve(self.own, self.coupling))

    @cached_property
    def reduced(self) -> Array:
        """Information (s, s) on the shared unknowns, with the own ones eliminated."""
        return self.along(self)

    def along(self, other: 'Arrow') -> Array:
        """Return the matrix (s, s) along shared unknowns, with own ones as in another matrix."""
        crossed = np.einsum('ros,rot->st', self.coupling, other.carried)
        return np.asarray(self.shared - crossed - crossed.T + np.einsum(
            'ros,rop,rpt->st', other.carried, self.own, other.carried, optimize=True))

    def followed(self, g: Array) -> Array:
        """Return the slope (s,) along shared unknowns, with own ones following."""
        return np.asarray(g[:len(self.shared)] - np.einsum(
            'ros,ro->s', self.carried, g[self.places]))

    def solve(self, g: Array) -> Array:
        """Return the solution (m,) with a right-hand side (m,)."""
        x, size = np.empty_like(g), len(self.shared)
        x[:size] = np.linalg.solve(self.reduced, self.followed(g))
        x[self.places] = np.linalg.solve(
            self.own, g[self.places][..., None])[..., 0] - self.carried @ x[:size]
        return x

    @cached_property
    def covariance(self) -> Array:
        """Covariance (s, s) of the shared unknowns."""
        return np.asarray(np.linalg.inv(self.reduced))

    def block(self, number: int) -> Array:
        """Return the covariance (q, q) of the shared unknowns and the own ones of a recording."""
        crossed = -self.carried[number] @ self.covariance
        own = np.linalg.inv(self.own[number]) - crossed @ self.carried[number].T
        return np.block([[self.covariance, crossed.T], [crossed, own]])

    def variances_with(self, shared: Array, factor: float = 1.0) -> Array:
        """Return variances (m,) of all unknowns, with a covariance (s, s) of the shared ones."""
        variances = np.empty(len(shared) + self.places.size)
        variances[:len(shared)] = np.diag(shared)
        variances[self.places] = np.einsum(
            'roo->ro', factor * np.linalg.inv(self.own)) + np.einsum(
            'ros,st,rot->ro', self.carried, shared, self.carried, optimize=True)
        return variances

    @cached_property
    def variances(self) -> Array:
        """Variances (m,) of the unknowns."""
        return self.variances_with(self.covariance)

    def within(self, used: Mask) -> 'Arrow':
        """Return the matrix with the identity for unused unknowns (m,)."""
        a, b = used[:len(self.shared)], used[self.places]
        return replace(
            self, shared=np.where(np.outer(a, a), self.shared, np.eye(len(a))),
            coupling=np.where(b[:, :, None] & a, self.coupling, 0.0),
            own=np.where(b[:, :, None] & b[:, None], self.own, np.eye(b.shape[1])))

    def fall(self, g: Array, used: Mask) -> float:
        """Return the fall of chi² if the used unknowns (m,) follow a slope (m,)."""
        slope = np.where(used, g, 0.0)
        try:
            return float(slope @ self.within(used).solve(slope))
        except np.linalg.LinAlgError:  # diverging simulation
            return math.nan


def symmetric_roots(M: Array) -> tuple[Array, Array]:
    """Return the symmetric root of a definite matrix, and its inverse."""
    values, vectors = np.linalg.eigh(M)
    root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
