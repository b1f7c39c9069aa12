"""
Predictions, and the error of a start.

A package starts at rest below its tool. If the tool moves then, or if its poses jump implausibly
later, the prediction has an error that decays with the package's modes. Until then the prediction
settles (`Settling`). While the tool is extrapolated, its unknown acceleration adds to the
covariance of the filter.
"""

import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Quaternion, rotation_matrix, Vector, ZERO
from bellows_ros.core.model.equilibrium import pose_error, resting_on_tool
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Strains
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

COASTING_STD = np.tile(np.repeat([5.0, 25.0], 3), 2)
"""Standard deviations of the acceleration of an arm without poses: m/s^2, rad/s^2."""

UNKNOWN: Array = 1e6 * np.eye(12)
"""Covariance of an unknown state (m, rad, m/s, rad/s)."""

NEGLIGIBLE = 1e-3, 5e-3
"""Negligible error of a prediction, m and rad."""

SPAN_NS = 100_000_000
"""Time after a start in which the tool's motion is estimated from three poses, ns."""

MIN_DECAY_RATE = 0.1
"""Smallest assumed decay rate of a package, 1/s."""

MIN_FREQUENCY = 1.0
"""Smallest assumed frequency of a package, rad/s."""


class Prediction(NamedTuple):
    """The package at one stamp; SI units."""

    stamp_ns: int
    position: Vector
    """Origin of B in the world, m."""
    quaternion_xyzw: Quaternion
    """Orientation of B in the world."""
    linear: Vector
    """Linear body twist, R^T do/dt, in B axes, m/s."""
    angular: Vector
    """Body rate in B axes, rad/s."""
    force: Vector
    """Force of the cup on the package, in lip axes, N."""
    moment: Vector
    """Moment of the cup on the package about the lip's centre, in lip axes, N m."""
    tool: State = ORIGIN
    """Pose and body twist of the tool used for the prediction."""
    coasting: bool = False
    """Whether the tool is extrapolated for lack of poses."""
    strains: Strains = ()
    """Internal strains of the cup, if it relaxes."""

    @property
    def body(self) -> State:
        """Pose and body twist of the package, as the kernels take them."""
        return (self.position, self.quaternion_xyzw, self.linear, self.angular, *self.strains)


STILL = Prediction(1, *ORIGIN, ZERO, ZERO)
"""Prediction for a package of unknown state."""


def still(model: ModelTuple) -> Prediction:
    """Return `STILL` with the internal strains of a cup that relaxes."""
    return STILL._replace(strains=resting_on_tool(model, ORIGIN)[4:])


def coasting(seconds: float) -> Array:
    """Return the covariance (12, 12) by the acceleration of a tool extrapolated for a time (s)."""
    return np.diag(np.square(np.repeat([0.5 * seconds ** 2, seconds], 6) * COASTING_STD))


def in_world_axes(P: Array, quaternion_xyzw: Quaternion) -> Array:
    """Return a covariance (6, 6) about fixed world axes (REP-103) from one in body axes."""
    R = np.kron(np.eye(2), np.reshape(rotation_matrix(quaternion_xyzw), (3, 3)))
    turned = R @ P @ R.T
    return np.asarray(0.5 * (turned + turned.T))


class Modes(NamedTuple):
    """Small motions of a package about its rest."""

    decay: float
    """Decay rate of the least damped mode, 1/s."""
    frequency: float
    """Frequency of the slowest mode, rad/s."""
    compliance: tuple[float, float, float]
    """Shift (m) and rotation (rad) per m/s^2 of the tool, and rotation per rad/s^2 of the tool."""


def modes_of(system: Array) -> Modes:
    """Return the modes of the small motions with a system matrix (12, 12), without relaxation."""
    eigenvalues = np.linalg.eigvals(system)
    compliance = np.linalg.inv(system[6:, :6])
    shift, angle, by_angular = (float(np.linalg.norm(part, 2)) for part in (
        compliance[:3, :3], compliance[3:, :3], compliance[3:, 3:]))
    return Modes(max(MIN_DECAY_RATE, -float(eigenvalues.real.max())),
                 max(MIN_FREQUENCY, float(np.abs(eigenvalues).min())), (shift, angle, by_angular))


class Settling:
    """
    Error of the state after a start under a moving tool.

    Attributes
    ----------
    modes : Modes
        Modes of the package, to be set first; a running decay keeps its end when they change.
    is_known : bool
        Whether the error is estimated.
    until_ns : int
        Stamp at which the error is negligible, ns.

    """

    def __init__(self) -> None:
        self.modes: Modes
        self.until_ns, self.is_known = 0, False
        self._samples: list[tuple[int, State]] = []

    def begin(self, stamp_ns: int, tool: State) -> None:
        """Start at rest below a tool whose motion is not yet estimated."""
        self._samples, self.is_known = [(stamp_ns, tool)], False
        self.until_ns = stamp_ns + SPAN_NS + 1

    def update(self, stamp_ns: int, tool: State) -> bool:
        """Process a sample of the tool; return whether the error is estimated now."""
        if self.is_known:
            return False
        start_ns, start = self._samples[0]
        if stamp_ns - start_ns < len(self._samples) * SPAN_NS // 2:
            return False
        self._samples.append((stamp_ns, tool))
        if len(self._samples) == 3:
            self._estimate(start_ns, start)
        return self.is_known

    def error_at(self, stamp_ns: int) -> Array:
        """Return the standard deviations (12,) of the state at a stamp, once they are known."""
        seconds = (stamp_ns - self._samples[0][0]) / NS_PER_S
        return np.repeat(math.exp(-self.modes.decay * seconds) * self._error, 3)

    def _estimate(self, start_ns: int, start: State) -> None:
        """Estimate the error, and its end, from the quadratics through three poses of the tool."""
        s, t = ((stamp_ns - start_ns) / NS_PER_S for stamp_ns, _ in self._samples[1:])
        x, y = (np.ravel(pose_error(start, *tool[:2])) for _, tool in self._samples[1:])
        half = (y / t - x / s) / (t - s)
        speed, rate, acceleration, turning = np.linalg.norm(
            np.reshape([x / s - s * half, 2.0 * half], (4, 3)), axis=1).tolist()
        shift, rotation, by_angular = self.modes.compliance
        shift, rotation = shift * acceleration, rotation * acceleration + by_angular * turning
        swing = 1.0 / self.modes.frequency
        ratio = max(1.0, (shift + swing * speed) / NEGLIGIBLE[0],
                    (rotation + swing * rate) / NEGLIGIBLE[1])
        self.until_ns = start_ns + round(NS_PER_S * math.log(ratio) / self.modes.decay)
        self._error, self.is_known = np.array([shift, rotation, speed, rate]), True
