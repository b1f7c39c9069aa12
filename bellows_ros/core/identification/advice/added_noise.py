"""Samples as they would be if the sensors had added their noise once more."""

from dataclasses import dataclass

from bellows_ros.core.identification.noise import Noise, noise_of
from bellows_ros.core.identification.regression.least_squares import Samples
from bellows_ros.core.lie import apply, exp_so3
from bellows_ros.core.recording.preparation import Recording
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLACES = 8
"""Places between two poses of the tool that stand for all."""

SEED = 20210801
"""Of the noise that is added; the same recording always gets the same answer."""


@dataclass(frozen=True, eq=False)
class FilterNoise:
    """
    Noise of a recording's poses and the filters that it went through.

    Parameters
    ----------
    tool, package : Noise
        White noise of the measured poses, m and rad per axis.
    tool_weights, package_weights : ndarray (3, m)
        Weights of the filters (see `trajectory.Filtered`), or others with the same products.

    """

    tool: Noise
    package: Noise
    tool_weights: Array
    package_weights: Array

    @classmethod
    def of(cls, recording: Recording) -> 'FilterNoise':
        """Return that of a prepared recording, estimated from its poses as they were measured."""
        return cls(
            noise_of(recording.aligned_tool),
            noise_of(recording.aligned_package),
            _resampled(recording),
            recording.package_weights,
        )

    def times(self, factor: float) -> 'FilterNoise':
        """Return so many times the noise, through the same filters."""
        tool, package = (Noise(factor * n.position, factor * n.rotation)
                         for n in (self.tool, self.package))
        return FilterNoise(tool, package, self.tool_weights, self.package_weights)


def _resampled(recording: Recording) -> Array:
    """
    Return weights (3, m) of the tool whose products are those at the package's stamps on average.

    Between two filtered poses are the cubic polynomials of `resample`, whose slope holds the
    difference of the two poses, and so more noise than the twists at its ends.
    """
    stamps = recording.aligned_tool.stamps_ns
    step_ns = float(np.median(np.diff(stamps)))
    fractions = (recording.tool.stamps_ns - stamps[0]) % step_ns / step_ns
    step_s = step_ns / NS_PER_S
    first, second = (np.pad(recording.tool_weights, ((0, 0), ends)) for ends in ((0, 1), (1, 0)))
    parts = []
    for s in np.quantile(fractions, (np.arange(PLACES) + 0.5) / PLACES).tolist():
        moved, slopes = second[0] - first[0], (step_s * first[1], step_s * second[1])
        value = (first[0] + s**2 * (3.0 - 2.0 * s) * moved
                 + s * (1.0 - s) ** 2 * slopes[0] - s**2 * (1.0 - s) * slopes[1])
        slope = (6.0 * s * (1.0 - s) * moved
                 + (1.0 - s) * (1.0 - 3.0 * s) * slopes[0] - s * (2.0 - 3.0 * s) * slopes[1])
        parts.append([value, slope / step_s, first[2]])
    return np.asarray(np.hstack(parts) / np.sqrt(PLACES))


def with_noise(samples: Samples, noise: FilterNoise, draw: np.random.Generator) -> Samples:
    """Return samples as they would be if the poses had as much noise once more."""
    return Samples(
        _noisy(samples.tool, noise.tool, noise.tool_weights, draw),
        _noisy(samples.package, noise.package, noise.package_weights, draw),
        samples.held, samples.gravity, samples.window,
    )  # fmt: skip


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
    )  # fmt: skip
