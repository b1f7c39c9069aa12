"""How well a prediction meets a measurement, per axis of the package seen from the tool."""

from dataclasses import dataclass

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.lie import apply, log_so3
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

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


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    Predicted and measured package as seen from the tool.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
        Common stamps of prediction and recording.
    measured, predicted : ndarray (N, 6)
        Tool-relative coordinates: position of B (m) and rotation vector (rad) in E axes. NaN where
        the tool was lost; measured ones also where the package was.
    scores : Scores
        Errors per axis, where both are known.

    """

    stamps_ns: Stamps
    measured: Array
    predicted: Array
    scores: Scores

    @property
    def error(self) -> Array:
        """Predicted minus measured (N, 6); NaN where the tool or the package was lost."""
        return self.predicted - self.measured


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
    """Return the errors of predicted against measured coordinates, both (N, 6), NaN where lost."""
    both = np.isfinite(measured + predicted).all(axis=1)
    if not both.any():
        raise BellowsError('There is no sample at which prediction and measurement both exist.')
    measured, error = measured[both], (predicted - measured)[both]
    return Scores(
        rms=np.sqrt(np.mean(error**2, axis=0)),
        largest=np.abs(error).max(axis=0),
        motion=np.std(measured, axis=0),
        samples=len(measured),
    )


def compare(predicted: Trajectory, tool: Trajectory, package: Trajectory) -> Comparison:
    """
    Compare a prediction with what was measured.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world.
    tool, package : Trajectory
        Measured poses of E and B at the same stamps, aligned but not filtered.

    Raises
    ------
    BellowsError
        If stamps differ, or there is no sample at which both are known.

    """
    known = np.where(tool.valid, 1.0, np.nan)[:, None]
    measured = relative_coordinates(tool, package) * known
    measured[~package.valid] = np.nan
    coordinates = relative_coordinates(tool, predicted) * known
    return Comparison(tool.stamps_ns, measured, coordinates, score(measured, coordinates))
