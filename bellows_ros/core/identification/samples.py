"""
The filtered motions of a recording, and results that are kept without its poses.

The lip's motion, the required wrench c, and the equations L x = c, with x the parameters of K and
P (4.66-4.68).
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.model.cup_package import gravity_vector, Package, regressor
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.preparation import with_tool_earlier
from bellows_ros.core.recording.recording import PackageWorld, Recording, TimeOffset
from bellows_ros.core.signals.residuals import interpolated, Spectrum, spectrum
from bellows_ros.core.signals.savgol import BLOCK
from bellows_ros.core.signals.trajectory import Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

ENVELOPE_BAND = 0.95
"""Fraction of the deflection's power inside the frequency bands."""

DELAYS = np.arange(-25, 26) * 0.01
"""Delays that are compared, s: more than a swinging package lags behind the tool, in steps shorter
than a swing."""

MIN_CONTRAST = 0.2
"""Smallest fall of the mean logarithm of the unexplained wrench at the likeliest delay, relative
to the median of all; by noise alone it is below 0.05."""


class LipMotion(NamedTuple):
    """
    Motion of the lip in the tool, and the required wrench, at the valid samples.

    E_o_S (N, 3) in m, E_R_S (N, 3, 3), S_v_ES (N, 6) in m/s and rad/s, and c (N, 6) of (4.68) in N
    and N m.
    """

    position: Array
    rotation: Array
    twist: Array
    wrench: Array

    def displacement(self, cup_length: float) -> Array:
        """Return the displacement of the lip from nominal (N, 6): E_o_S + l0 z (m), rotation."""
        return np.hstack([self.position + [0.0, 0.0, cup_length], log_so3(self.rotation)])

    def equations(self, cup_length: float, structure: Structure) -> Iterator[Array]:
        """Yield rows [L c] (N, 6, p + 1) of (4.67), (4.68) in blocks, for a cup length l0 in m."""
        for start in range(0, max(len(self.wrench), 1), BLOCK):
            o, R, v, c = (values[start:start + BLOCK] for values in self)
            yield np.dstack([regressor(cup_length, structure.model_basis, o, R, v), c])


@dataclass(frozen=True, eq=False)
class Samples:
    """
    Filtered motions of tool and package at the same stamps.

    Parameters
    ----------
    tool : Trajectory
        N poses of E in the world with body twists.
    package : Trajectory
        N poses of B with body twists and accelerations, at the same stamps.
    payload : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float
        m/s^2 along -z of the world.
    window : float
        Duration of the package's filter window, the correlation length of residuals, s.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: float
    window: float

    @property
    def valid(self) -> Mask:
        """Mask (N,) of the samples with usable motion of both bodies."""
        return self.tool.valid & self.package.valid

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.valid))

    @cached_property
    def lip(self) -> LipMotion:
        """The motion of the lip, the basis of the equations."""
        tool, package = (body.select(self.valid) for body in (self.tool, self.package))
        return LipMotion(*lip_relative(tool, package, self.payload.com),
                         needed_wrench(self.payload, package, self.gravity))

    @property
    def windows(self) -> float:
        """Number of filter windows in the valid samples, which have independent residuals."""
        rate_hz = uniform_rate_hz(self.package.stamps_ns)
        return self.count / max(self.window * rate_hz, 1.0)


def samples_of(recording: Recording) -> Samples:
    """Return the filtered motions of a recording."""
    return recording.cached('filtered samples', lambda: Samples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.filters[1].weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns)))


def likely_delay(recording: Recording) -> float | None:
    """
    Return the delay (s) of the tool's stamps with which a linear cup explains most of the motion.

    The wrench of the package is regressed on displacement and twist of the lip. The result is
    None if no delay is distinguished, as with standstills alone.
    """
    unexplained = np.zeros(len(DELAYS))
    for number, delay in enumerate(DELAYS.tolist()):
        with suppress(BellowsError):  # nothing in common at this delay
            lip = samples_of(with_tool_earlier(recording, delay)).lip
            A = np.hstack([lip.displacement(0.0), lip.twist, np.ones((len(lip.wrench), 1))])
            left = lip.wrench - A @ np.linalg.lstsq(A, lip.wrench, rcond=None)[0]
            unexplained[number] = np.mean(np.log(left.var(axis=0) / lip.wrench.var(axis=0)))
    best = int(np.argmin(unexplained))
    if not unexplained[best] < np.median(unexplained) - MIN_CONTRAST:
        return None
    return float(DELAYS[best])


def lip_relative(
    tool: Trajectory, package: Trajectory, com: ArrayLike
) -> tuple[Array, Array, Array]:
    """
    Return E_o_S (N, 3), E_R_S (N, 3, 3) and the body twist S_v_ES (N, 6) of the lip in the tool.

    This is `kernels.lip_relative_to_tool` for arrays: S_v_ES = X(S_H_B) B_v_AB - X(E_H_S)^-1
    E_v_AE.
    """
    assert tool.twist is not None and package.twist is not None  # is filtered
    com = np.asarray(com, dtype=float)
    R_E_A = np.swapaxes(tool.rotation, 1, 2)
    R_E_S = R_E_A @ package.rotation
    o_E_S = apply(R_E_A, package.position - apply(package.rotation, com) - tool.position)
    v_B, w_B = package.twist[:, :3], package.twist[:, 3:]
    v_E, w_E = tool.twist[:, :3], tool.twist[:, 3:]
    R_S_E = np.swapaxes(R_E_S, 1, 2)
    linear = v_B + np.cross(com, w_B) - apply(R_S_E, v_E + np.cross(w_E, o_E_S))
    return o_E_S, R_E_S, np.hstack([linear, w_B - apply(R_S_E, w_E)])


def needed_wrench(package: Package, motion: Trajectory, gravity: ArrayLike) -> Array:
    """
    Return c (N, 6), the cup's wrench at the lip required by the package's motion (4.68).

    c = X(S_H_B)^-T (M dv + v x* M v - f_g) in lip axes; gravity is its magnitude along -z of the
    world, or its vector (3,) there, m/s^2.
    """
    assert motion.twist is not None and motion.acceleration is not None  # is filtered
    v, w = motion.twist[:, :3], motion.twist[:, 3:]
    dv, dw = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    g_B = apply(np.swapaxes(motion.rotation, 1, 2), gravity_vector(gravity))
    force = package.mass * (dv + np.cross(w, v) - g_B)
    moment = dw @ package.inertia + np.cross(w, w @ package.inertia)
    return np.hstack([force, moment + np.cross(package.com, force)])


def envelope(samples: Samples, cup_length: float) -> Envelope:
    """
    Return the validity range of a recording.

    Parameters
    ----------
    samples : Samples
        Samples of the fit; invalid samples are omitted.
    cup_length : float
        Cup length l0, m.

    Raises
    ------
    BellowsError
        If there are no valid samples.

    """
    if not samples.count:
        raise BellowsError('The recording has no valid samples, hence no validity range.')
    deflection, mass = samples.lip.displacement(cup_length), samples.payload.mass
    every: Array = np.full((len(samples.tool), 6), np.nan)
    every[samples.valid] = deflection
    strain = spectrum(interpolated(every), uniform_rate_hz(samples.package.stamps_ns))
    shift_and_rotation = np.column_stack([strain.density[:, i:i + 3].sum(axis=1) for i in (0, 3)])
    bands = np.column_stack(Spectrum(strain.frequency, shift_and_rotation).band(ENVELOPE_BAND))
    return Envelope(
        deflection.min(axis=0), deflection.max(axis=0), np.abs(samples.lip.twist).max(axis=0),
        np.nan_to_num(bands), np.array([mass, mass]))


class ReducedRecording(NamedTuple):
    """
    Facts on a recording, without its rows and poses.

    Parameters
    ----------
    report : mapping
        Report on the recording, as in the JSON file of a fit.
    digest : str
        Digest of its stored messages.
    files : tuple of mapping
        Name, bytes and sha256 of each of its files.
    payload : Package
        The package in it.
    time_offset : TimeOffset or None
        Offset subtracted from the tool's stamps, None if not requested or not identifiable.
    package_world : PackageWorld or None
        Transform between two worlds, if estimated.
    rate_hz : float
        Rate of the package's poses.
    cup_length : float
        Cup length l0 of the validity range, m.
    envelope : Envelope
        Its validity range.
    remarks : tuple of Finding
        Findings of the preparation and of the checks.

    """

    report: Mapping[str, Any]
    digest: str
    files: tuple[Mapping[str, Any], ...]
    payload: Package
    time_offset: TimeOffset | None
    package_world: PackageWorld | None
    rate_hz: float
    cup_length: float
    envelope: Envelope
    remarks: tuple[Finding, ...] = ()

    @property
    def name(self) -> str:
        """Name of the recording as the user gave it."""
        return str(self.report['bag'])


AnyRecording = Recording | ReducedRecording


def whole_recordings(recordings: Sequence[AnyRecording]) -> list[Recording]:
    """Return the recordings that are not reduced."""
    return [recording for recording in recordings if isinstance(recording, Recording)]


def reduced(recording: AnyRecording, cup_length: float) -> ReducedRecording:
    """
    Return a recording reduced, if it is not.

    Raises
    ------
    BellowsError
        If the recording has no valid samples, or the package is not below the tool.

    """
    if isinstance(recording, ReducedRecording):
        return recording
    whole = recording
    return whole.cached(('reduced', cup_length), lambda: _reduced(whole, cup_length))


def envelope_of(recording: Recording, cup_length: float) -> Envelope:
    """Return the validity range of a recording."""
    return recording.cached(
        ('envelope', cup_length), lambda: envelope(samples_of(recording), cup_length))


def _reduced(recording: Recording, length: float) -> ReducedRecording:
    """Return a recording reduced."""
    return ReducedRecording(
        recording.as_json(), recording.digest, recording.files, recording.payload,
        recording.report.time_offset, recording.report.package_world,
        recording.report.package.timing.rate_hz, length, envelope_of(recording, length),
        recording.report.remarks)
