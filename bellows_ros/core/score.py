"""How well a prediction meets a measurement, per axis of the package seen from the tool."""

from dataclasses import dataclass

from bellows_ros.core.lie import apply, log_so3
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
"""The tool-relative coordinates: position of B (m), then its rotation vector (rad), in E axes."""


@dataclass(frozen=True, eq=False)
class Scores:
    """
    Errors of predicted tool-relative coordinates, each (6,): m for x, y, z and rad for rx, ry, rz.

    Parameters
    ----------
    rms, largest : ndarray (6,)
        RMS and largest absolute error.
    motion : ndarray (6,)
        RMS deviation of the measured coordinate from its mean.
    samples : int
        Number of samples compared.

    """

    rms: Array
    largest: Array
    motion: Array
    samples: int

    @property
    def nrmse(self) -> Array:
        """RMS error over RMS deviation of the measured coordinate from its mean, (6,)."""
        ratio: Array = np.full(6, np.nan)
        np.divide(self.rms, self.motion, out=ratio, where=self.motion > 0.0)
        return ratio


def relative_coordinates(tool: Trajectory, package: Trajectory) -> Array:
    """
    Return position (m) and rotation vector (rad) of the package in the tool frame (N, 6).

    Both trajectories are in the world, at the same N stamps.
    """
    if not np.array_equal(tool.stamps_ns, package.stamps_ns):
        raise BellowsError('Tool and package must have the same stamps; resample one of them.')
    R_tool_world = np.swapaxes(tool.rotation, 1, 2)
    position = apply(R_tool_world, package.position - tool.position)
    return np.hstack([position, log_so3(R_tool_world @ package.rotation)])


def score(measured: Array, predicted: Array) -> Scores:
    """Return the errors of predicted against measured coordinates, both (N, 6)."""
    if len(measured) == 0:
        raise BellowsError('There is no sample at which prediction and measurement both exist.')
    error = predicted - measured
    return Scores(
        rms=np.sqrt(np.mean(error**2, axis=0)),
        largest=np.abs(error).max(axis=0),
        motion=np.std(measured, axis=0),
        samples=len(measured),
    )
