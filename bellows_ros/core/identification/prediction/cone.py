"""Minimum of a quadratic function of K and P where both are definite."""

from bellows_ros.core.arrays import Array
import numpy as np

LAST_WEIGHT = 1e-3
"""Weight of the barrier in what is minimised in the end."""

FALL = 5.0
"""By which factor the weight falls from stage to stage."""

MOST_STEPS = 100
NEAR = 1e-6
"""Newton decrement at which a stage ends."""


def minimum_in_cone(H: Array, best: Array, inside: Array, units: Array) -> Array:
    """
    Return the x nearest to the best one, in the metric H, whose K and P are positive definite.

    By Newton's method on (x - best)^T H (x - best) / 2 with a barrier, -log det of both matrices,
    that is taken away in stages. Steps are damped so that they never leave the cone.

    Parameters
    ----------
    H, best : ndarray (n, n), (n,)
        H positive definite. Numbers beyond those of K and P are free.
    inside : ndarray (n,)
        Where K and P are definite.
    units : ndarray (2, k, 6, 6)
        What K and P are sums of, times the first k numbers and the next k: scaled so that their
        diagonals are near one.

    """
    x = inside
    weight = max(float((x - best) @ H @ (x - best)), LAST_WEIGHT)
    while True:
        for _ in range(MOST_STEPS):
            slope, curvature = _barrier(x, units)
            total = H + weight * curvature
            step = -np.linalg.solve(total, H @ (x - best) + weight * slope)
            decrement = float(np.sqrt(step @ total @ step / weight))
            x = x + step * (1.0 if decrement < 0.25 else 1.0 / (1.0 + decrement))
            if decrement < NEAR:
                break
        if weight <= LAST_WEIGHT:
            return x
        weight = max(weight / FALL, LAST_WEIGHT)


def _barrier(x: Array, units: Array) -> tuple[Array, Array]:
    """Return gradient (n,) and Hessian (n, n) of -log det K - log det P."""
    slope, curvature = np.zeros(len(x)), np.zeros((len(x), len(x)))
    size = units.shape[1]
    for half, unit in enumerate(units):
        index = slice(half * size, (half + 1) * size)
        turned = np.linalg.inv(np.tensordot(x[index], unit, axes=1)) @ unit
        slope[index] = -np.trace(turned, axis1=1, axis2=2)
        curvature[index, index] = np.einsum('aij,bji->ab', turned, turned)
    return slope, curvature
