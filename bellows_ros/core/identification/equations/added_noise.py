"""Samples as they would be if the sensors had added their noise once more."""

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.equations.samples import Samples
from bellows_ros.core.lie import apply, exp_so3
from bellows_ros.core.recording.noise import ENOUGH, FilterNoise, Noise
from bellows_ros.core.structure import Structure
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

SEED = 20210801
"""Of the noise that is added; the same recording always gets the same answer."""


def draws(count: int) -> list[np.random.Generator]:
    """Return the generators of so many draws of noise, the first ones always the same."""
    return np.random.default_rng(SEED).spawn(count)


def with_noise(samples: Samples, noise: FilterNoise, draw: np.random.Generator) -> Samples:
    """Return samples as they would be if the poses had as much noise once more."""
    return Samples(
        _noisy(samples.tool, noise.tool, noise.tool_weights, draw),
        _noisy(samples.package, noise.package, noise.package_weights, draw),
        samples.payload, samples.gravity, samples.window,
    )


def _noisy(
    motion: Trajectory, noise: Noise, weights: Array, draw: np.random.Generator
) -> Trajectory:
    """
    Return a filtered motion with filtered white noise added to its value and derivatives.

    Noise of one sample is as the filter makes it, correlated between value and derivatives; that
    of neighbours is independent, which no mean square and no mean product notices.
    """
    root = np.linalg.cholesky(weights @ weights.T)
    o, phi = (
        sigma * np.einsum('ij,jnk->ink', root, draw.standard_normal((3, len(motion), 3)))
        for sigma in noise
    )
    if motion.twist is None:
        raise BellowsError('Samples need twists; filter the recording first.')
    R, v, w = motion.rotation, motion.twist[:, :3], motion.twist[:, 3:]
    R_new = exp_so3(phi[0]) @ R
    R_inverse = np.swapaxes(R_new, -1, -2)
    v_new = apply(R_inverse, apply(R, v) + o[1])
    w_new = apply(R_inverse, apply(R, w) + phi[1])
    acceleration = None
    if motion.acceleration is not None:
        dv, dw = motion.acceleration[:, :3], motion.acceleration[:, 3:]
        linear = apply(R_inverse, apply(R, dv + np.cross(w, v)) + o[2]) - np.cross(w_new, v_new)
        acceleration = np.hstack([linear, apply(R_inverse, apply(R, dw) + phi[2])])
    return Trajectory(
        motion.stamps_ns, motion.position + o[0], R_new, np.hstack([v_new, w_new]),
        acceleration, motion.valid,
    )


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
    for block, own in zip(some.blocks(), some.lip.equations(cup_length, structure), strict=False):
        noisy = with_noise(block, noise, draw).lip.equations(cup_length, structure, keep=False)
        added = (next(noisy).stacked - own.stacked).reshape(-1, 6 * size)
        products += added.T @ added
    part = max(some.count, 1) / max(recording.count, 1)
    return products.reshape(6, size, 6, size) / part
