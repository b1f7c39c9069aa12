"""What noise of the poses adds to the equations of least squares."""

from bellows_ros.core.identification.advice.added_noise import FilterNoise, SEED, with_noise
from bellows_ros.core.identification.regression.least_squares import equations, Samples
from bellows_ros.core.identification.structure import Structure
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ENOUGH = 20_000
"""Samples that tell it to a percent; a few more are looked at."""


def noise_products(
    recording: Samples, noise: FilterNoise, cup_length: float, structure: Structure
) -> Array:
    """
    Return the expected products (6, q, 6, q) of what noise adds to the rows [L c], q = p + 1.

    They are sums over all valid samples, of each two components of the wrench, seen by adding
    noise of the same kind once more. Those of several recordings can be added.
    """
    size = 2 * structure.size + 1
    products = np.zeros((6 * size, 6 * size))
    draw = np.random.default_rng(SEED)
    some = recording.thinned(ENOUGH)
    for block in some.blocks():
        L, c, _ = equations(block, cup_length, structure)
        noisy_L, noisy_c, _ = equations(with_noise(block, noise, draw), cup_length, structure)
        added = np.dstack([noisy_L - L, noisy_c - c]).reshape(-1, 6 * size)
        products += added.T @ added
    part = max(some.count, 1) / max(recording.count, 1)
    return products.reshape(6, size, 6, size) / part
