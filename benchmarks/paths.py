"""Motions of tools along given functions of time."""

from collections.abc import Callable

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, dexp, exp_so3
from bellows_ros.core.model.simulation import tool_rows
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic.motion import smooth_step
import numpy as np

Path = Callable[[Array], Array]
"""Function from times (N,), s, to position (m) and rotation vector (rad) of the tool (N, 6)."""


def step(t: Array, start: float, duration: float) -> Array:
    """Return a smooth step from 0 to 1."""
    return np.asarray(smooth_step((t - start) / duration)[0])


def driven(path: Path, seconds: float, rate_hz: float = 360.0) -> Trajectory:
    """Return a path as a trajectory with twists."""
    stamps = np.round(np.arange(int(seconds * rate_hz)) * 1e9 / rate_hz).astype(np.int64)
    t, h = stamps * 1e-9, 1e-5
    x, rate = path(t), (path(t + h) - path(t - h)) / (2.0 * h)
    R = exp_so3(x[:, 3:])
    return Trajectory(stamps + 10**9, x[:, :3], R, np.hstack([
        apply(np.swapaxes(R, 1, 2), rate[:, :3]),
        apply(dexp(-x[:, 3:]), rate[:, 3:])]))


def shaken_tool(count: int, rate_hz: float) -> Array:
    """Return rows (count, 13) of a tool that moves in all directions: pose and body twist."""
    speed = 2.0 * np.pi * np.array([1.1, 1.3, 1.7, 0.77, 0.91, 1.19])
    size = np.array([0.02, 0.02, 0.01, 0.05, 0.05, 0.1])
    return tool_rows(driven(
        lambda t: size * np.sin(speed * t[:, None]), (count + 0.5) / rate_hz, rate_hz))
