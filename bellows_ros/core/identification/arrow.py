"""
Information on shared unknowns and on those that each recording has of its own.

No two recordings share an own unknown, so that those of each are eliminated alone (Schur
complement): work and memory grow with the number of recordings, not with its square. The shared
unknowns come first, then the own ones.
"""

from dataclasses import dataclass, replace
from functools import cached_property

from bellows_ros.core.geometry.arrays import Array, Mask, Places
import numpy as np


@dataclass(frozen=True, eq=False)
class Arrow:
    """
    A symmetric matrix (m, m), zero between own unknowns of two recordings.

    Parameters
    ----------
    shared : ndarray (s, s)
        Of the shared unknowns.
    coupling : ndarray (R, o, s)
        Between own unknowns of each of R recordings and the shared ones.
    own : ndarray (R, o, o)
        Of the own unknowns of each recording.
    places : int ndarray (R, o)
        Of the own unknowns among all.

    """

    shared: Array
    coupling: Array
    own: Array
    places: Places

    def plus(self, shared: Array | float) -> 'Arrow':
        """Return it with more information (s, s) on the shared unknowns."""
        return replace(self, shared=self.shared + shared)

    def damped(self, damping: float) -> 'Arrow':
        """Return it with its diagonal larger by a part."""
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
        """Own unknowns (R, o, s) that follow the shared ones, with the opposite sign."""
        return np.asarray(np.linalg.solve(self.own, self.coupling))

    @cached_property
    def reduced(self) -> Array:
        """Information (s, s) on the shared unknowns, with the own ones eliminated."""
        return self.along(self)

    def along(self, other: 'Arrow') -> Array:
        """Return it (s, s) along shared unknowns that own ones follow as with another."""
        crossed = np.einsum('ros,rot->st', self.coupling, other.carried)
        return np.asarray(self.shared - crossed - crossed.T + np.einsum(
            'ros,rop,rpt->st', other.carried, self.own, other.carried, optimize=True))

    def followed(self, g: Array) -> Array:
        """Return the slope (s,) along shared unknowns that the own ones follow."""
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

    def own_covariance(self, shared: Array, factor: float = 1.0) -> Array:
        """Return covariances (R, o, o) of own unknowns, with that (s, s) of shared ones."""
        return np.asarray(factor * np.linalg.inv(self.own) + np.einsum(
            'ros,st,rpt->rop', self.carried, shared, self.carried, optimize=True))

    def block(self, number: int) -> Array:
        """Return the covariance (q, q) of the shared unknowns and the own ones of a recording."""
        crossed = -self.carried[number] @ self.covariance
        own = np.linalg.inv(self.own[number]) - crossed @ self.carried[number].T
        return np.block([[self.covariance, crossed.T], [crossed, own]])

    def variances_with(self, shared: Array, factor: float = 1.0) -> Array:
        """Return variances (m,) of all unknowns, with a covariance (s, s) of the shared ones."""
        variances = np.empty(len(shared) + self.places.size)
        variances[:len(shared)] = np.diag(shared)
        variances[self.places] = np.einsum('roo->ro', self.own_covariance(shared, factor))
        return variances

    @cached_property
    def variances(self) -> Array:
        """Variances (m,) of the unknowns."""
        return self.variances_with(self.covariance)

    def within(self, used: Mask) -> 'Arrow':
        """Return it with the identity instead of unknowns (m,) that are not in use."""
        a, b = used[:len(self.shared)], used[self.places]
        return replace(
            self, shared=np.where(np.outer(a, a), self.shared, np.eye(len(a))),
            coupling=np.where(b[:, :, None] & a, self.coupling, 0.0),
            own=np.where(b[:, :, None] & b[:, None], self.own, np.eye(b.shape[1])))

    def fall(self, g: Array, used: Mask) -> float:
        """Return by how much the squares fall if the unknowns in use (m,) follow a slope (m,)."""
        slope = np.where(used, g, 0.0)
        return float(slope @ self.within(used).solve(slope))

    def step_by(self, g: Array, along: Array, used: Mask) -> Array:
        """Return the step (m,) by a slope along directions (s, d) and own unknowns in use (o,)."""
        size, count = along.shape
        part = replace(
            self, shared=along.T @ self.shared @ along,
            coupling=np.where(used[:, None], self.coupling @ along, 0.0),
            own=np.where(np.outer(used, used), self.own, np.eye(len(used))),
            places=self.places - size + count)
        slope = np.concatenate([along.T @ g[:size], g[size:]])
        slope[part.places] *= used
        step = part.solve(slope)
        return np.concatenate([along @ step[:count], step[count:]])
