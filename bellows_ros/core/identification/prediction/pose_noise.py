"""Noise of measured poses as the prediction error takes it: per axis, and correlated in time."""

from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.lie import apply, log_so3
from bellows_ros.core.recording.noise import HALF_WINDOW, MAD_TO_STD, ORDER
from bellows_ros.core.savgol import weights
from bellows_ros.core.trajectory import Trajectory, valid_windows
from bellows_ros.errors import BellowsError
import numpy as np

CUT_AT = 5.0
"""What is left of a pose counts as so many typical deviations at most: outliers do not count."""

SMALLEST = np.repeat([2e-7, 2e-6], 3)
"""Noise (m, rad) below which no pose is taken to be: interpolation and rounding."""


class PoseNoise(NamedTuple):
    """
    First-order noise of the poses of one body, n_k = kept n_(k-1) + e_k, in its own axes.

    Ripple (6,): the standard deviation (m, rad) that white noise would have of which a local
    polynomial leaves as much.
    """

    ripple: Array
    kept: float = 0.0

    @property
    def fresh(self) -> Array:
        """Standard deviations (6,) of e."""
        return np.asarray(self.ripple * np.sqrt(_ripple_part(0.0) / _ripple_part(self.kept)))

    @property
    def std(self) -> Array:
        """Standard deviations (6,) of n."""
        return np.asarray(self.fresh / np.sqrt(1.0 - self.kept**2))


def pose_noise(poses: Trajectory) -> PoseNoise:
    """
    Estimate the noise of poses at a uniform rate, per axis, as white.

    Raises
    ------
    BellowsError
        If there is no window of valid samples.

    """
    good = valid_windows(poses.valid, HALF_WINDOW)
    if not good.any():
        raise BellowsError(
            f'No {2 * HALF_WINDOW + 1} valid samples in a row from which to estimate the '
            'measurement noise.')
    ripple = _ripple(poses)[good]
    typical = MAD_TO_STD * np.median(np.abs(ripple), axis=0)
    squares = np.mean(np.minimum(ripple**2, (CUT_AT * typical) ** 2), axis=0)
    return PoseNoise(np.maximum(np.sqrt(squares / _ripple_part(0.0)), SMALLEST))


def _ripple(poses: Trajectory) -> Array:
    """Return what a quartic through nine poses leaves of the middle one (N - 8, 6), own axes."""
    n = HALF_WINDOW
    count = len(poses) - 2 * n
    centre = slice(n, n + count)
    R_inverse = np.swapaxes(poses.rotation[centre], 1, 2)
    total = np.zeros((count, 6))
    for j, weight in enumerate(weights(n, ORDER, 1.0)[0].tolist()):
        part = slice(j, j + count)
        total[:, :3] += weight * (poses.position[part] - poses.position[centre])
        total[:, 3:] += weight * log_so3(R_inverse @ poses.rotation[part])
    total[:, :3] = apply(R_inverse, total[:, :3])
    return total


def _ripple_part(kept: float) -> float:
    """Return the variance of the ripple of first-order noise over that of its e."""
    residue = weights(HALF_WINDOW, ORDER, 1.0)[0].copy()
    residue[HALF_WINDOW] -= 1.0
    steps = np.arange(len(residue))
    lags = np.abs(np.subtract.outer(steps, steps))
    return float(residue @ kept**lags @ residue) / (1.0 - kept**2)
