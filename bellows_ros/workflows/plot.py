"""Data of pictures of a recording: motion, spectra, loads against deflections, predictions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3, wrench_transform
from bellows_ros.core.identification import samples
from bellows_ros.core.identification.result import POSE_UNITS, WRENCH_UNITS
from bellows_ros.core.live.load import equivalent_box
from bellows_ros.core.model import cup_package, kernels
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.pose_faults import NO_INERTIA
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals import residuals, trajectory
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.results import with_units
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.replay import compared_poses, Live, Margins, predicted_live
import numpy as np

SPECTRUM_SECONDS = 4.0  # of a segment: resolution 0.25 Hz


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """
    Measured motion of tool and package at common times.

    Parameters
    ----------
    seconds : array (N,)
        Times from the recording's first stamp, s.
    tool_position, package_position : array (N, 3)
        Positions of E and B in the world, m.
    tool_rotation, package_rotation : array (N, 3, 3)
        R_world_E and R_world_B.
    relative : array (N, 6)
        Position (m) and rotation vector (rad) of B in E.
    valid : bool array (N,)
        False for a missing or wrong pose.

    """

    seconds: Array
    tool_position: Array
    tool_rotation: Array
    package_position: Array
    package_rotation: Array
    relative: Array
    valid: Mask


@dataclass(frozen=True, eq=False)
class Spectra:
    """
    Amplitude spectral densities of the tool-relative coordinates.

    Parameters
    ----------
    frequency_hz : array (F,)
    measured : array (F, 6)
        Spectra of the measured coordinates, m/sqrt(Hz) and rad/sqrt(Hz).
    error : array (F, 6) or None
        Spectrum of predicted minus measured coordinates.

    """

    frequency_hz: Array
    measured: Array
    error: Array | None


@dataclass(frozen=True, eq=False)
class Loads:
    """
    Load and deflection of the cup: at S1, in axes halfway between tool and lip.

    In these axes load and deflection of a bent cup are parallel; in axes of the tool or the lip
    the weight would have a lateral component.

    Parameters
    ----------
    seconds : array (N,)
        Times from the recording's first stamp, s.
    deflection : array (N, 6)
        Position of S1 in S2 (m), and rotation vector (rad).
    load : array (N, 6)
        Wrench of the package on the cup required by its motion, N and N m.
    residual : array (N, 6)
        Load minus the wrench predicted by the parameters' cup.
    stiffness : array (6,)
        Diagonal of K of this cup.
    valid : bool array (N,)

    """

    seconds: Array
    deflection: Array
    load: Array
    residual: Array
    stiffness: Array
    valid: Mask


@dataclass(frozen=True, eq=False)
class Scene:
    """
    Tool, cup and package in the world, over time.

    Parameters
    ----------
    seconds : array (N,)
        Times from the recording's first stamp, s.
    tool, package, outline : Trajectory
        N poses of E, of B, and of B as an outline for comparison.
    cup_length : float
        Length of the cup, m.
    com, box : array (3,)
        B in S, and depth, width and height of the box with the package's inertia, m.

    """

    seconds: Array
    tool: Trajectory
    package: Trajectory
    outline: Trajectory
    cup_length: float
    com: Array
    box: Array


@dataclass(frozen=True, eq=False)
class Replayed(Scene):
    """
    A replayed recording at the samples with a pose of the tool; the outline is measured.

    Parameters
    ----------
    live : Live
        The live prediction.
    deflection : array (N, 6)
        Deflection of the predicted lip from its nominal pose in tool axes: shift (m), rotation
        vector (rad).

    """

    live: Live
    deflection: Array


DRAWN_UNITS: Mapping[type, Mapping[str, Any]] = {
    MeasuredMotion: {
        'tool_position': 'm', 'tool_rotation': '1', 'package_position': 'm',
        'package_rotation': '1', 'relative': POSE_UNITS},
    Spectra: dict.fromkeys(('measured', 'error'), [f'{unit}/sqrt(Hz)' for unit in POSE_UNITS]),
    Loads: {
        'deflection': POSE_UNITS, 'load': WRENCH_UNITS, 'residual': WRENCH_UNITS,
        'stiffness': [*3 * ['N/m'], *3 * ['N m/rad']]},
    Margins: {'factors': '1', 'std': '1', 'least': '1'}}
"""Units of the drawn quantities, by class and key."""

Timed = TypeVar('Timed', MeasuredMotion, Loads, Margins, Replayed)


def recorded(
    bag: File, settings: Mapping[str, Any], needs_package: bool
) -> tuple[Values, Recording]:
    """Return all parameters, and a recording; without package.com, B is the tracked point."""
    given = {} if needs_package else {
        'recording.package_frame': 'com', 'package.mass': 1.0, 'package.inertia': NO_INERTIA,
        'package.com': (0.0, 0.0, 0.0)}
    values = resolve({**given, **settings}, PACKAGE_PARAMETERS)
    return values, load(bag, values)


def motion(recording: Recording) -> MeasuredMotion:
    """Return tool and package of a recording as measured."""
    tool, package = recording.measured_tool, recording.measured_package
    return MeasuredMotion(
        recording.since_start(tool.stamps_ns), tool.position, tool.rotation,
        package.position, package.rotation, residuals.relative_coordinates(tool, package),
        tool.valid & package.valid)


def spectra(values: Values, recording: Recording, cup: bool) -> Spectra:
    """
    Return the spectra of a recording and, with a cup, of the prediction error.

    Missing samples are interpolated linearly.
    """
    shown = motion(recording)
    rate_hz = trajectory.uniform_rate_hz(recording.measured_package.stamps_ns)
    relative = np.where(shown.valid[:, None], shown.relative, np.nan)
    measured = residuals.spectrum(residuals.interpolated(relative), rate_hz, SPECTRUM_SECONDS)
    error = None
    if cup:
        live = predicted_live(recording, values)
        difference = np.full_like(relative, np.nan)
        at = np.searchsorted(recording.measured_package.stamps_ns, live.stamps_ns)
        difference[at] = residuals.interpolated(live.error)
        error = np.sqrt(residuals.spectrum(difference, rate_hz, SPECTRUM_SECONDS).density)
    return Spectra(measured.frequency, np.sqrt(measured.density), error)


def loads(values: Values, recording: Recording) -> Loads:
    """Return the load of the cup in a recording, by inverse dynamics, and its deflection."""
    cup, package = conversion.cup_of(values), conversion.package_of(values)
    o, R, v = samples.lip_relative(recording.tool, recording.package, package.com)
    at_lip = samples.needed_wrench(package, recording.package, values.gravity.magnitude)
    T_middle_lip = np.eye(4)
    T_middle_lip[2, 3] = -cup.length / 2.0
    to_middle = wrench_transform(T_middle_lip)
    bending = log_so3(R)
    halfway = exp_so3(0.5 * bending)
    flat: Any = R.reshape(len(R), 9).tolist()
    middle = np.array([  # of S1 in S2 (3.13)
        kernels.spring_frames(cup.as_tuple, tuple(position), tuple(rotation))
        for position, rotation in zip(o.tolist(), flat, strict=True)])
    moved = apply(np.swapaxes(halfway, 1, 2), middle)
    columns = cup_package.regressor(cup.length, [cup.stiffness, cup.damping], o, R, v)
    modelled = columns[:, :, 0] + columns[:, :, 3]  # K as stiffness, P as damping
    needed, residual = (
        apply(halfway[:, None], (wrench @ to_middle.T).reshape(-1, 2, 3)).reshape(-1, 6)
        for wrench in (-at_lip, modelled - at_lip))
    return Loads(
        seconds=recording.since_start(recording.package.stamps_ns),
        deflection=np.hstack([moved, bending]),
        load=needed, residual=residual,
        stiffness=np.diag(cup.stiffness),
        valid=recording.valid)


def with_bodies(values: Values, recording: Recording, live: Live) -> Replayed:
    """
    Return the poses of all bodies of a live prediction, at poses of the tool.

    Parameters
    ----------
    values : mapping
        Parameters by name: cup and package.
    recording : Recording
        Prepared recording.
    live : Live
        Live prediction of the recording.

    """
    live = replace(live, **vars(live.select(np.isfinite(live.predicted[:, 0]))))
    tool, measured = compared_poses(recording)
    at = np.isin(measured.stamps_ns, live.stamps_ns)
    tool, measured = tool.select(at), measured.select(at)
    package, length = conversion.package_of(values), conversion.cup_of(values).length
    place, bent = live.predicted[:, :3], exp_so3(live.predicted[:, 3:])
    predicted = Trajectory(
        tool.stamps_ns, tool.position + apply(tool.rotation, place), tool.rotation @ bent)
    shift = place - bent @ package.com + np.array([0.0, 0.0, length])
    return Replayed(
        recording.since_start(tool.stamps_ns), tool, predicted, measured, length, package.com,
        np.array(equivalent_box(values)), live, np.hstack([shift, live.predicted[:, 3:]]))


def within(shown: Timed, first: float, last: float) -> Timed:
    """
    Return the data of a picture for an interval.

    Parameters
    ----------
    shown : MeasuredMotion, Loads, Margins or Replayed
        Data of the whole recording.
    first, last : float
        Interval from the recording's first stamp, s.

    Raises
    ------
    BellowsError
        If there are fewer than two usable samples.

    """
    seconds = shown.seconds
    part = (seconds >= first) & (seconds <= last)
    if np.count_nonzero(part & getattr(shown, 'valid', True)) < 2:
        raise BellowsError(
            f'There are fewer than two usable samples from {first:g} to {last:g} s; the '
            f'recording covers {seconds[0]:.2f} to {seconds[-1]:.2f} s.')

    def chosen(value: Any) -> Any:
        if isinstance(value, Live):
            return replace(value, **vars(value.select(part)))
        if isinstance(value, Trajectory):
            return value.select(part)
        is_timed = isinstance(value, np.ndarray) and len(value) == len(part)
        return value[part] if is_timed else value

    return replace(shown, **{name: chosen(value) for name, value in vars(shown).items()})


def data_json(shown: MeasuredMotion | Spectra | Loads | Margins | Replayed) -> dict[str, Any]:
    """Return the data of a picture for a JSON file; SI units."""
    if not isinstance(shown, Replayed):
        return with_units({**vars(shown), 'units': DRAWN_UNITS[type(shown)]})
    return with_units({
        'seconds': shown.seconds,
        'measured': shown.live.measured,
        'predicted': shown.live.predicted,
        'deflection': shown.deflection,
        'position': shown.package.position,
        'rotation': shown.package.rotation,
        'scores': shown.live,
        'units': {'rotation': '1'}})
