"""
Further sensors beside the poses of the package, as a fit by simulation needs them.

A further sensor is a class with the members of `Readings`, in a module of its own, and a row of
`table.SENSORS`; settings, reading, fit and written files follow from these.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, Self

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.sensors.body import Values
from bellows_ros.core.signals.trajectory import Trajectory


class Kind(NamedTuple):
    """
    A kind of quantity that may be estimated jointly with K and P, see `quantities.toml`.

    Parameters
    ----------
    unit : float
        Unit of the search, SI units.
    size : int
        Number of values.
    max_std : float
        Largest standard error of an identifiable quantity.
    prior_std : float
        Standard deviation of a weak prior.
    each : bool
        Whether every recording has values of its own.
    parameter : str
        Parameter with the stated uncertainty of a further sensor's quantity.

    """

    unit: float
    size: int
    max_std: float
    prior_std: float
    each: bool = False
    parameter: str = ''


class SimulatedMotion(NamedTuple):
    """
    A simulated motion at M nodes.

    Fields in order: the package, and gravity (3,) in the world; states of the package (M, 13) with
    its acceleration (M, 6) in body axes, m/s^2 and rad/s^2; states of the tool (M, 13).
    """

    payload: Package
    gravity: Array
    package: Array
    tool: Array


class ComparedReadings(Protocol):
    """
    Measured values of a segment, to be compared with predictions.

    Values of a quick sensor are means over some 50 ms, with the predictions averaged alike: single
    predictions follow the noise of the tool's path, and their derivatives would count as
    information by noise.
    """

    @property
    def values(self) -> Array:
        """Measured numbers (B, d)."""

    @property
    def period(self) -> float:
        """Time between values, s."""

    def predicted(self, motion: SimulatedMotion, free: Values) -> Array:
        """Return values (B, d) by a simulated motion and own quantities."""

    def whitened(self, J: Array, r: Array) -> tuple[Array, Array]:
        """Return derivatives (B, d, q) and residuals (B, d), in standard deviations of noise."""


class Readings(Protocol):
    """
    Measurements of a further sensor in one recording.

    The class has the quantities of the sensor by name, given quantities that the sensor
    determines, the prefixes of its parameters, and the remedy for a contradiction to the poses.
    """

    quantities: ClassVar[Mapping[str, Kind]]
    determined: ClassVar[tuple[str, ...]]
    parameters: ClassVar[tuple[str, ...]]
    remedy: ClassVar[str]

    @classmethod
    def of(
        cls, stream: Any, tool: Trajectory, world: str, R_world_recorded: Array,
        values: Mapping[str, Any],
    ) -> Self:
        """
        Return the measurements of a stream during the motion of a tool.

        Parameters
        ----------
        stream : PoseStream or TwistStream
            Recorded measurements, on the clock of the tool.
        tool : Trajectory
            Motion of the tool in the world.
        world : str
            Frame of the tool's recorded poses.
        R_world_recorded : ndarray (3, 3)
            Rotation of the recorded axes in the world.
        values : mapping
            Parameters by name.

        """

    @property
    def deviations(self) -> Values:
        """Standard deviations of the own quantities, SI units."""

    def compared(
        self, tool: Array, nodes_ns: Stamps, gravity: Array, begin_ns: int
    ) -> ComparedReadings:
        """
        Return the measurements within a segment.

        By states (M, 13) of the tool at nodes (M,), gravity (3,), and the recording's begin.
        """
