"""Results of an estimate: the payload."""

from __future__ import annotations

from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.pseudo_inertia import second_moments
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import Estimate
import numpy as np


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
