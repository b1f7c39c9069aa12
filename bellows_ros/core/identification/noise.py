"""White measurement noise of recorded poses, estimated from the data."""

from typing import NamedTuple

from bellows_ros.core.lie import log_so3
from bellows_ros.core.savgol import weights
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF_WINDOW, ORDER = 4, 4
"""A quartic through nine samples follows any motion of a package; what it leaves is noise."""

ENOUGH = 20_000
"""Windows from which the noise is known to half a percent; a few more are looked at."""

TOOL_HALF_WINDOW, TOOL_ORDER = 6, 6
"""
Polynomials through so many of the tool's poses give its pose and twist beside poses as measured.

At 125 Hz a motion of 3 Hz is off by 1e-5. Shorter windows leave more noise in the twists, whose
products with the noise of the poses (not seen by linearised noise models) then bias the damping.
"""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class Noise(NamedTuple):
    """Standard deviation per axis of white noise: position (m) and rotation vector (rad)."""

    position: float
    rotation: float


def noise_of(poses: Trajectory) -> Noise:
    """
    Estimate the white noise of poses at a uniform rate.

    It is the median size of what a local polynomial leaves of each sample, so that outliers do
    not count. Noise-free recordings give what rounding leaves.

    Raises
    ------
    BellowsError
        If there is no window of valid samples.

    """
    n = HALF_WINDOW
    W = weights(n, ORDER, 1.0)[0]
    count = max(len(poses) - 2 * n, 0)
    centres = np.arange(n, n + count, max(count // ENOUGH, 1))
    windows = np.ones(len(centres), dtype=bool)
    position = np.zeros((len(centres), 3))
    rotation = np.zeros_like(position)
    R_centre = np.swapaxes(poses.rotation[centres], 1, 2)
    for j in range(2 * n + 1):
        part = centres + (j - n)
        windows &= poses.valid[part]
        position += W[j] * (poses.position[part] - poses.position[centres])
        rotation += W[j] * log_so3(R_centre @ poses.rotation[part])
    if not windows.any():
        raise BellowsError(
            f'No {2 * n + 1} valid samples in a row from which to estimate the measurement noise.'
        )
    scale = MAD_TO_STD / np.sqrt(1.0 - W[n])  # the centre is part of its own fit
    return Noise(
        float(scale * np.median(np.abs(position[windows]))),
        float(scale * np.median(np.abs(rotation[windows]))),
    )
