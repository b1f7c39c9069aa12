"""White measurement noise of recorded poses, estimated from the data."""

from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.lie import log_so3
from bellows_ros.core.savgol import weights
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import UndeterminedError
import numpy as np
from scipy.signal import lfilter

HALF_WINDOW, ORDER = 4, 4
"""A quartic through nine samples follows any motion of a package; what it leaves is noise."""

ENOUGH = 20_000
"""Windows or samples that give what noise does to a percent; a few more are looked at."""

TOOL_HALF_WINDOW, TOOL_ORDER = 6, 6
"""
Polynomials through so many of the tool's poses give its pose and twist beside poses as measured.

At 125 Hz a motion of 3 Hz is off by 1e-5. Shorter windows leave more noise in the twists, whose
products with the noise of the poses (not seen by linearised noise models) then bias the damping.
"""

PLACES = 8
"""Places between two poses of the tool that stand for all."""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


WIDE_WINDOW, COLOURED = 0.06, 1.15
"""Time (s) over which poses are compared for the colour of noise, and by how much more is seen."""


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
        raise UndeterminedError(
            f'The measurement noise cannot be estimated: no {2 * n + 1} valid samples in a row.'
        )
    scale = MAD_TO_STD / np.sqrt(1.0 - W[n])  # the centre is part of its own fit
    return Noise(
        float(scale * np.median(np.abs(position[windows]))),
        float(scale * np.median(np.abs(rotation[windows]))),
    )


class Colour(NamedTuple):
    """Noise of first order: its standard deviation, and its correlation with the sample before."""

    size: float
    correlation: float

    def drawn(self, count: int, draw: np.random.Generator) -> Array:
        """Return so many samples of it in three axes (N, 3)."""
        white = self.size * draw.standard_normal((count, 3))
        root = np.sqrt(1.0 - self.correlation**2)
        return np.asarray(lfilter([root], [1.0, -self.correlation], white, axis=0))


def colours_of(poses: Trajectory, noise: Noise) -> tuple[Colour, Colour]:
    """
    Return the noise of positions (m) and of rotations (rad) of poses at a uniform rate.

    It is white, or correlated over the time that makes the noise of poses a stride apart as much
    larger than that of neighbours, which is given, as it is.
    """
    rate_hz = NS_PER_S / float(np.median(np.diff(poses.stamps_ns)))
    stride = max(round(WIDE_WINDOW * rate_hz / (2 * HALF_WINDOW)), 1)
    try:
        wide = noise_of(poses.select(slice(None, None, stride))) if stride > 1 else noise
    except UndeterminedError:
        wide = noise
    times = np.array([0.0, *np.geomspace(1.0, 200.0, 24)]) / 1e3
    seen = np.array([[_seen(time * rate_hz / step) for step in (1, stride)] for time in times])
    parts = []
    for one, other in zip(noise, wide, strict=True):
        ratio = other / one if one > 0.0 else 1.0
        at = int(np.argmin(np.abs(seen[:, 1] / seen[:, 0] - ratio))) if ratio > COLOURED else 0
        parts.append(Colour(
            one / float(seen[at, 0]), float(np.exp(-1.0 / (times[at] * rate_hz))) if at else 0.0))
    return parts[0], parts[1]


def _seen(samples: float) -> float:
    """Return what `noise_of` finds of noise of size 1, correlated over so many samples."""
    n = HALF_WINDOW
    left = -weights(n, ORDER, 1.0)[0]
    scale = np.sqrt(1.0 + left[n])
    left[n] += 1.0
    apart = np.abs(np.subtract.outer(np.arange(2 * n + 1), np.arange(2 * n + 1)))
    correlation = np.exp(-apart / samples) if samples > 0.0 else np.eye(2 * n + 1)
    return float(np.sqrt(left @ correlation @ left) / scale)


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
    tool_half_window : int
        Of the tool's filter, samples.

    """

    tool: Noise
    package: Noise
    tool_weights: Array
    package_weights: Array
    tool_half_window: int = 0

    def times(self, factor: float) -> 'FilterNoise':
        """Return so many times the noise, through the same filters."""
        tool, package = (Noise(factor * n.position, factor * n.rotation)
                         for n in (self.tool, self.package))
        return replace(self, tool=tool, package=package)


def resampled_weights(measured_ns: Stamps, wanted_ns: Stamps, weights: Array) -> Array:
    """
    Return weights (3, m) with the products of a filtered motion at other stamps, on average.

    Between two filtered poses are the cubic polynomials of `resample`, whose slope holds the
    difference of the two poses, and so more noise than the twists at its ends.

    Parameters
    ----------
    measured_ns, wanted_ns : int ndarray (N,), (M,)
        Stamps at a uniform rate of what was filtered, and those that it was brought to, ns.
    weights : ndarray (3, 2n+1)
        Of the filter.

    """
    step_ns = float(np.median(np.diff(measured_ns)))
    fractions = (wanted_ns - measured_ns[0]) % step_ns / step_ns
    step_s = step_ns / NS_PER_S
    first, second = (np.pad(weights, ((0, 0), ends)) for ends in ((0, 1), (1, 0)))
    parts = []
    for s in np.quantile(fractions, (np.arange(PLACES) + 0.5) / PLACES).tolist():
        moved, jacobian = second[0] - first[0], (step_s * first[1], step_s * second[1])
        value = (first[0] + s**2 * (3.0 - 2.0 * s) * moved
                 + s * (1.0 - s) ** 2 * jacobian[0] - s**2 * (1.0 - s) * jacobian[1])
        slope = (6.0 * s * (1.0 - s) * moved
                 + (1.0 - s) * (1.0 - 3.0 * s) * jacobian[0] - s * (2.0 - 3.0 * s) * jacobian[1])
        parts.append([value, slope / step_s, first[2]])
    return np.asarray(np.hstack(parts) / np.sqrt(PLACES))
