"""Inputs and outputs of the live predictor; SI units, stamps in nanoseconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.model.kernels import ORIGIN, State, Strains


class PoseSample(NamedTuple):
    """A pose of the tool in the world that has been accepted."""

    stamp_ns: int
    position: Vector
    quaternion_xyzw: Quaternion


class TwistSample(NamedTuple):
    """A twist of the tool in the axes its driver uses, m/s and rad/s."""

    stamp_ns: int
    linear: Vector
    angular: Vector


class Unsettled(NamedTuple):
    """Possible error of the package's state at one time, in each direction."""

    since_ns: int
    shift: float
    """m."""
    turn: float
    """rad."""
    speed: float
    """m/s."""
    rate: float
    """rad/s."""


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
    """Whether the tool is extrapolated because no pose has come."""
    unsettled: Unsettled | None = None
    """The remaining error of the start or of doubtful poses; None if there is none."""
    covariance: Callable[[], Array | None] | None = None
    """Returns the covariance of the state (12, 12), in body axes, if an observer knows it."""
    strains: Strains = ()
    """Internal strains of the cup, if it relaxes."""
    flies: bool = False
    """Whether the cup has let go of the package."""

    @property
    def body(self) -> State:
        """Pose and body twist of the package, as the kernels take them."""
        return (self.position, self.quaternion_xyzw, self.linear, self.angular, *self.strains)


STILL = Prediction(1, *ORIGIN, ZERO, ZERO)
"""Stands for a package of unknown state."""
