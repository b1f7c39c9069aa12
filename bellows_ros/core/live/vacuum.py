"""Vacuum, safety factor and distance from the validity range, live; checks of values."""

from collections.abc import Mapping
import math
import re

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry
from bellows_ros.core.geometry.tuples import Matrix, Quaternion, Vector
from bellows_ros.core.live.held_package import HeldPackage
from bellows_ros.core.live.uncertainty import Prediction, still
from bellows_ros.core.model import kernels
from bellows_ros.core.model.grip import least_factors, mode_name, safety_factors
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.validity_range import Distance, distance
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import ESTIMATE
from bellows_ros.core.parameters.conversion import NO_CUPS
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
import numpy as np

AMBIENT = 101_325.0
"""Absolute pressure around the cup, standard atmosphere, Pa."""

LEAST_ABSOLUTE = 5000.0
"""Absolute pressure below which no ejector evacuates a cup, Pa."""

GLITCHES = 3
"""Number of consecutive impossible pressures after possible ones that are no glitch."""

SMALLEST_TAG = 1e-3
"""Smallest side of a detected tag, m: ten pixels of a camera 10 mm away."""

ALL = -1
"""Index that stands for all cups of a gripper."""

lip_relative_to_tool = entry(kernels.lip_relative_to_tool)
"""`kernels.lip_relative_to_tool` for calls from Python."""


def deflection(
    model: ModelTuple, prediction: Prediction
) -> tuple[Vector, Matrix, Vector, Vector]:
    """
    Return pose and twist of the lip relative to its nominal pose (0, 0, -l0) in the tool.

    The results are shift (m) in tool axes, rotation E_R_S, and linear (m/s) and angular twist
    (rad/s) in lip axes.
    """
    o, R, v, w = lip_relative_to_tool(model[1][1], prediction.tool, prediction.body)
    return (o[0], o[1], o[2] + model[0][1]), R, v, w


def deflection_rotation(prediction: Prediction) -> Quaternion:
    """Return the rotation E_R_S of the lip in the tool (3.13), as [S] = [B]."""
    return t3.quaternion_product(
        t3.quaternion_conjugate(prediction.tool[1]), prediction.quaternion_xyzw)


def lip_position(model: ModelTuple, prediction: Prediction) -> Vector:
    """Return the centre of the lip S in the world (m)."""
    R = t3.rotation_matrix(prediction.quaternion_xyzw)
    return t3.subtract(prediction.position, t3.apply(R, model[1][1]))


def equivalent_box(values: Values) -> Vector:
    """
    Return the sides (m) of the homogeneous box with a package's mass and moments (A.2).

    The sides are along x, y, z of B, limited to 1 mm to 10 m; products of inertia are ignored.
    """
    xx, yy, zz = values.package.inertia[:3]
    squares = 6.0 * np.array([yy + zz - xx, xx + zz - yy, xx + yy - zz]) / values.package.mass
    x, y, z = np.sqrt(squares.clip(1e-6, 100.0)).tolist()
    return x, y, z


class Load:
    """
    Smallest safety factor of predictions, and their largest distance from the validity range.

    Parameters
    ----------
    values : mapping
        Parameters by name: inputs of `grip_of`, safety.least, package.mass, cup.valid_*.
    pressure : float, optional
        Last measured absolute pressure in the cup, Pa.
    of_cups : mapping of int to float
        Last measured absolute pressures in single cups of a gripper, Pa.

    Attributes
    ----------
    required : float
        Safety factor below which a warning is given.
    pressure : float or None
        Last measured pressure, Pa.
    grip : tuple or None
        Grip by this pressure, or by vacuum.holding; None without a grip model.

    """

    def __init__(
        self, values: Values, pressure: float | None = None, of_cups: Mapping[int, float] = NO_CUPS
    ) -> None:
        self._values = values
        self.set_pressure(pressure, of_cups)
        self.required = float(values.safety.least)
        self._envelope = conversion.parameter_envelope(values)
        self._clear()

    def _clear(self) -> None:
        self._safety: tuple[float, str] | None = None
        self._distance: Distance | None = None
        self._bending = 0.0

    def set_pressure(
        self, pressure: float | None, of_cups: Mapping[int, float] = NO_CUPS
    ) -> None:
        """Store the measured absolute pressures (Pa) in the cup and in single cups."""
        self.pressure = pressure
        self.grip = conversion.grip_of(
            self._values, None if pressure is None else AMBIENT - pressure,
            {cup: AMBIENT - of_cup for cup, of_cup in of_cups.items()})

    @property
    def has_envelope(self) -> bool:
        """Whether there is a validity range."""
        return self._envelope is not None

    def watch_force(
        self, model: ModelTuple, prediction: Prediction
    ) -> tuple[float, float] | None:
        """Record the safety factors of a prediction; return the factors of the worst cup."""
        if self.grip is None:
            return None
        f, m = prediction.force, prediction.moment
        if len(self.grip) == 3:
            peel, slip, peeling, slipping = *safety_factors(self.grip, f, m), 0, 0
        else:
            lip = lip_relative_to_tool(model[1][1], prediction.tool, prediction.body)
            peel, slip, peeling, slipping = least_factors(
                self.grip, model[0], *lip, prediction.strains, f, m)
        for mode, (factor, row) in enumerate(((peel, peeling), (slip, slipping))):
            if self._safety is None or factor < self._safety[0]:
                self._safety = factor, mode_name(self.grip, mode, row)
        return peel, slip

    def watch_deflection(self, model: ModelTuple, prediction: Prediction) -> None:
        """Record the distance of a prediction from the validity range."""
        shift, R, linear, angular = deflection(model, prediction)
        self._bending = max(self._bending, math.acos(min(1.0, max(-1.0, R[8]))))
        if self._envelope is None:
            return
        rotation = t3.rotation_between(prediction.tool[1], prediction.quaternion_xyzw)
        now = distance(
            self._envelope, (*shift, *rotation, *linear, *angular, self._values.package.mass,
                             self._vacuum()))
        if self._distance is None or now.value > self._distance.value:
            self._distance = now

    def _vacuum(self) -> float:
        """Return the pressure below ambient in the cup (Pa): measured, or vacuum.holding."""
        if self.pressure is None:
            return float(self._values.vacuum.holding)
        return max(AMBIENT - self.pressure, 0.0)

    def reset(self) -> tuple[tuple[float, str] | None, Distance | None, float]:
        """Return safety factor with its mode, distance and bending (rad) since the last call."""
        extremes = self._safety, self._distance, self._bending
        self._clear()
        return extremes


class Vacuum:
    """
    Absolute pressures in the cup, or in single cups of a gripper.

    Attributes
    ----------
    held : bool
        Whether the package is held, by at least one cup.
    pressure : float or None
        Newest pressure, Pa; with single cups the highest one of the holding cups, or None.
    of_cups : dict of int to float
        Newest pressures of the single cups that hold, Pa.
    open_cups : tuple of int
        Cups of cup.layout without vacuum; unchanged if no cup has vacuum.
    is_wrong : bool
        Whether the pressures are no absolute pressures in Pa, until a pressure of an open cup.

    """

    def __init__(self) -> None:
        self.held = self.is_wrong = False
        self._impossible = GLITCHES - 1  # one is enough before a possible pressure
        self.open_cups: tuple[int, ...] = ()
        self.pressure: float | None = None
        self.of_cups: dict[int, float] = {}
        self._measured: set[int] = set()  # cups with a sensor

    def update(
        self, values: Values, pressure: float, frame_id: str
    ) -> tuple[tuple[bool, int], ...] | str:
        """
        Return the holding cups by a new pressure (Pa), or the reason for its rejection.

        The thresholds are vacuum.*; a cup is given by its index in cup.layout, or `ALL`. A
        pressure with a frame_id that ends in cup_2 belongs to cup 2 alone.
        """
        cups = len(values.cup.layout) // 3
        of_cup = re.search(r'cup_(\d{1,3})$', frame_id) if cups > 1 else None
        cup = int(of_cup[1]) if of_cup else ALL
        if reason := self._why_rejected(values, pressure):
            return reason
        if cup >= cups > 1:
            return 'no_such_cup'
        was_held = self.held if cup == ALL else cup in self.of_cups
        held_below, released_above = values.vacuum.thresholds
        is_held = bool(pressure <= released_above if was_held else pressure < held_below)
        if cup == ALL:
            self.held, self.pressure = is_held, pressure
            return ((is_held, ALL),)
        self._measured.add(cup)
        self.of_cups.pop(cup, None)
        if is_held:
            self.of_cups[cup] = pressure
        self.held = bool(self.of_cups)
        self.pressure = max(self.of_cups.values(), default=None)
        if not self.held:  # the whole package is lost
            return ((False, ALL),)
        self.open_cups = tuple(sorted(self._measured - set(self.of_cups)))
        return (is_held, cup), (True, ALL)

    def _why_rejected(self, values: Values, pressure: float) -> str:
        """Return the reason for the rejection of a pressure, or ''."""
        if not math.isfinite(pressure):
            return 'nan'
        if pressure < LEAST_ABSOLUTE:
            self._impossible += 1
            if self._impossible >= GLITCHES:
                self.held, self.pressure, self.is_wrong = False, None, True
                self.of_cups.clear()
            return 'not_absolute'
        self.is_wrong = self.is_wrong and pressure <= values.vacuum.thresholds[1]
        if self.is_wrong:
            return 'not_absolute'
        self._impossible = 0
        return ''


def check_live(values: Values) -> None:
    """
    Raise BellowsError if valid values do not allow a live prediction in combination.

    Parameters
    ----------
    values : mapping
        All parameters by name, with the cup in use in cup.*.

    Raises
    ------
    BellowsError
        If values are inconsistent, or a prediction cannot be computed.

    """
    low, high = values.vacuum.thresholds
    if low > high:
        raise BellowsError(
            f'vacuum.thresholds are {low:g} and {high:g} Pa; expected the lower one first, as the '
            'pressure falls when a package is picked up.')
    if values.recording.package_world == ESTIMATE:
        raise BellowsError(
            f'recording.package_world: {ESTIMATE} is for recordings only. Give the node its '
            'seven numbers, from the file that bellows identify wrote.')
    measured = values.measured
    if measured.type == 'tf' and not measured.child_frame.strip('/'):
        raise BellowsError(
            'measured.type is tf, but measured.child_frame is not set. Set it to the frame of the '
            'tag on /tf, such as tag36h11:7.')
    if measured.type == 'detections' and measured.tag_size < SMALLEST_TAG:
        raise BellowsError(
            f'measured.type is detections, but measured.tag_size is {measured.tag_size:g} m; '
            f'expected at least {SMALLEST_TAG:g}. Set it to the side of the black square of the '
            'tag, in m.')
    conversion.release_law_of(values)  # a contradiction would only show at the first release
    held = (conversion.cup_of(values), conversion.package_of(values),
            conversion.gravity_of(values), values)
    load = Load(values, AMBIENT)  # compiled also before a vacuum is measured
    try:
        with np.errstate(all='ignore'):
            model = HeldPackage(*held).model
            load.watch_force(model, still(model))
            load.watch_deflection(model, still(model))
            equivalent_box(values)
    except (ArithmeticError, ValueError) as error:
        raise BellowsError(
            f'The prediction fails with these parameters ({error}). Check package.*, cup.*, '
            'cup.valid_low, cup.valid_high and their units.') from None
