"""The estimate of a held package, its evidence of deviations, and its payload."""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.pseudo_inertia import second_moments
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import Moving
from bellows_ros.core.observer.measurement import Corrected, Means, NO_MEANS
import numpy as np

USUAL = 16.81
"""Normalised square of a mean that is usual: 99 % of chi^2 of 6."""


class Evidence(NamedTuple):
    """Evidence of deviations after a measurement."""

    means: Means = NO_MEANS
    """Moving means of whitened innovations."""
    poses: int = 0
    """Number of poses since the start or an alarm."""
    usual: Estimate | None = None
    """The last estimate with usual means, or the first; without its own evidence."""
    differing: int = 0
    """Number of successive poses in which a parameter differs."""
    seen: Corrected | None = None
    """The last measured pose."""

    @property
    def since_ns(self) -> int:
        """Stamp of the last usual means, ns."""
        return self.usual.stamp_ns if self.usual else 0

    def after(self, seen: Corrected, estimate: Estimate) -> Evidence:
        """Return the evidence after another pose and its estimate."""
        is_usual = self.usual is None or seen.means[2].max() <= USUAL
        return self._replace(
            means=seen.means, poses=self.poses + 1, seen=seen,
            usual=estimate._replace(evidence=Evidence()) if is_usual else self.usual)


class Estimate(NamedTuple):
    """The estimated package at one stamp."""

    stamp_ns: int
    tool: State
    body: State
    theta: Array
    """Rows of the error from `MASS` on (n - 12,)."""
    covariance: Array
    """Covariance (n, n) of the error."""
    memory: Array
    """Memory (17,) of the noise, with indices from `filter.PERIOD` on."""
    evidence: Evidence = Evidence()
    """Evidence of deviations."""
    gated_ns: tuple[int, ...] = ()
    """Stamps (ns) of consecutive measurements outside the gate."""
    away_ns: int = 0
    """Stamp of the first of consecutive measurements out of reach, after a measurement within
    reach; 0 for none, -1 after an assessment."""
    support: int = 0
    """Whether a support was `NEAR` or in `CONTACT`; 0 without."""
    has_slipped: bool = False
    """Whether poses have deviated since the grip."""
    wrench_memory: tuple[float, ...] = ()
    """Factors of the variances of force and moment, see `wrenches`; empty before the first."""
    outside: int = 0
    """Number of successive blocks of wrenches outside the gate, at most `wrenches.PERSISTING`."""

    @property
    def moving(self) -> Moving:
        """The moving package, as the kernels take it."""
        return self.stamp_ns, self.tool, self.body, self.theta

    def with_rows(self, other: Estimate, rows: Any) -> Estimate:
        """Return an estimate with some rows (k,) of another, independent of the rest."""
        rows = np.asarray(rows)[np.less(rows, len(other.covariance))]
        n, block = max(len(self.covariance), 1 + rows.max(initial=0)), np.ix_(rows, rows)
        theta, P = np.zeros(n - states.STATE), np.zeros((n, n))
        theta[:len(self.theta)] = self.theta
        P[:len(self.covariance), :len(self.covariance)] = self.covariance
        theta[rows - states.STATE] = other.theta[rows - states.STATE]
        P[rows, :], P[:, rows] = 0.0, 0.0
        P[block] = other.covariance[block]
        return self._replace(theta=theta, covariance=P)


class Payload(NamedTuple):
    """An estimated payload: kg, m in S, kg m^2 at B, and standard deviations."""

    stamp_ns: int
    mass: float
    com: Vector
    inertia: Matrix
    mass_std: float
    com_std: Array
    inertia_std: Array
    """Standard deviations of the three moments of inertia, kg m^2."""


def payload_of(estimate: Estimate, model: ModelTuple) -> Payload:
    """Return the payload of an estimate, and of its model."""
    mass, com, inertia, _ = model[1]
    P, rows = estimate.covariance, slice(states.INERTIA, states.INERTIA + 3)
    std = np.sqrt(np.diag(P)[states.MASS:states.MASS + 4])
    by_moment = (1.0 - np.eye(3)) * np.array(second_moments(inertia))
    own = np.diag(by_moment @ P[rows, rows] @ by_moment.T)
    return Payload(
        estimate.stamp_ns, mass, com, inertia, float(std[0] * mass), std[1:],
        np.hypot(std[0] * np.array(inertia[::4]), np.sqrt(own)))
