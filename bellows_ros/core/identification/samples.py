"""
The filtered motions of a recording, as inputs of the identification.

The wrench that a motion needs and how the lip moves, what of the cup the motion has seen (its
validity range), and whether the filter follows it: of a fast motion it leaves less, and of each
derivative another part, so that K and P of least squares are off, which their standard errors do
not know.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import (
    apply,
    exp_so3,
    log_so3,
)
from bellows_ros.core.identification.causes import require_hanging
from bellows_ros.core.identification.equations import BLOCK, LipMotion, NO_HISTORY, strain_history
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.recording import FilterNoise, Recording
from bellows_ros.core.signals.residuals import interpolated, Spectrum, spectrum
from bellows_ros.core.signals.trajectory import (
    Trajectory,
    uniform_rate_hz,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike


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
        Duration of the package's filter window, s: so far residuals are correlated.
    relaxation : (float, float)
        Strengths r_b of a cup that relaxes.
    history : ndarray (N, 2, 9), optional
        What its internal strains follow from, where these are samples of a longer motion.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: float
    window: float
    relaxation: tuple[float, float] = (0.0, 0.0)
    history: Array | None = None

    @property
    def valid(self) -> Mask:
        """Where both motions can be used (N,)."""
        return self.tool.valid & self.package.valid

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.valid))

    @cached_property
    def lip(self) -> LipMotion:
        """The motion of the lip, the basis of the equations."""
        index = np.flatnonzero(self.valid)
        some = slice(None) if len(index) == len(self.tool) else index  # which copies nothing
        tool, package = self.tool.select(some), self.package.select(some)
        return LipMotion(
            index, tool.stamps_ns, self.window, *lip_relative(tool, package, self.payload.com),
            needed_wrench(self.payload, package, self.gravity), self.relaxation,
            self.histories[index] if any(self.relaxation) else NO_HISTORY)

    @cached_property
    def histories(self) -> Array:
        """What the internal strains follow from (N, 2, 9); see `strain_history`."""
        if self.history is not None:
            return self.history
        index = np.flatnonzero(self.valid)
        o, R, _ = lip_relative(
            self.tool.select(index), self.package.select(index), self.payload.com)
        every = np.full((len(self.tool), 6), np.nan)
        every[index] = np.hstack([o, log_so3(R)])
        every = interpolated(every)
        return strain_history(
            every[:, :3], exp_so3(every[:, 3:]), uniform_rate_hz(self.package.stamps_ns))

    def relaxing(self, relaxation: tuple[float, float]) -> 'Samples':
        """Return the samples for a cup that relaxes."""
        return replace(self, relaxation=relaxation, history=self.histories)

    @cached_property
    def twist_spectrum(self) -> Spectrum:
        """Of the lip's twist in the tool, m/s and rad/s."""
        return self.spectrum_of(self.lip.twist)

    def spectrum_of(self, values: Array) -> Spectrum:
        """Return the spectrum of numbers (N, 6) at the valid samples; others are interpolated."""
        every = values
        if len(values) < len(self.tool):
            every = np.full((len(self.tool), 6), np.nan)
            every[self.lip.index] = values
        return spectrum(interpolated(every), uniform_rate_hz(self.package.stamps_ns))

    def select(self, index: slice | Mask | Stamps) -> 'Samples':
        """Return the samples that a slice, a mask or increasing indices pick."""
        return replace(
            self, tool=self.tool.select(index), package=self.package.select(index),
            history=self.histories[index] if any(self.relaxation) else None)

    def blocks(self) -> 'Iterator[Samples]':
        """Yield the valid samples in blocks, in the order of time."""
        valid = np.flatnonzero(self.valid)
        for start in range(0, len(valid), BLOCK):
            yield self.select(valid[start:start + BLOCK])

    def thinned(self, most: int) -> 'Samples':
        """Return every n-th sample, to about the number asked for."""
        step = max(len(self.tool) // most, 1)
        if step == 1:
            return self
        some = self.select(slice(None, None, step))
        if 'lip' in vars(self):  # with what is known of it
            vars(some)['lip'] = self.lip.thinned(step)
        return some


def samples_of(recording: Recording) -> Samples:
    """
    Return the filtered motions of a recording, after checking that they are of a cup.

    Raises
    ------
    BellowsError
        If the package is not on that side of the tool where the cup is.

    """
    def checked() -> Samples:
        require_hanging(recording)
        return filtered_samples(recording)

    return recording.cached('samples', checked)


def filtered_samples(recording: Recording) -> Samples:
    """Return the filtered motions of any recording."""
    return recording.cached('filtered samples', lambda: Samples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.filters[1].weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns),
        recording.relaxation.strengths))


def lip_relative(
    tool: Trajectory, package: Trajectory, com: ArrayLike
) -> tuple[Array, Array, Array]:
    """
    Return E_o_S (N, 3), E_R_S (N, 3, 3) and the body twist S_v_ES (N, 6) of the lip in the tool.

    `kernels.lip_relative_to_tool` for arrays: S_v_ES = X(S_H_B) B_v_AB - X(E_H_S)^-1 E_v_AE.
    """
    if tool.twist is None or package.twist is None:
        raise BellowsError('Tool and package need twists; filter the recording first.')
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
    Return c (N, 6), the cup's wrench at the lip that the motion of the package needs (4.68).

    c = X(S_H_B)^-T (M dv + v x* M v - f_g) in lip axes; gravity is its size along -z of the
    world, or the vector (3,) there, m/s^2.
    """
    if motion.twist is None or motion.acceleration is None:
        raise BellowsError('The package needs twists and accelerations; filter the recording.')
    g = np.asarray(gravity, dtype=float)
    g = np.array([0.0, 0.0, -float(g)]) if g.ndim == 0 else g
    v, w = motion.twist[:, :3], motion.twist[:, 3:]
    dv, dw = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    g_B = apply(np.swapaxes(motion.rotation, 1, 2), np.broadcast_to(g, dv.shape))
    force = package.mass * (dv + np.cross(w, v) - g_B)
    moment = dw @ package.inertia + np.cross(w, w @ package.inertia)
    return np.hstack([force, moment + np.cross(package.com, force)])


FOLLOWED = 0.013
"""Largest fraction of a velocity that a suitable filter removes; automatic filters reach 6 Hz."""

RESOLUTION = 0.05
"""Resolution (Hz) of the end of a pass band."""

LOST, STANDS_OUT = 0.03, 5.0
"""
A direction is too fast if the filter takes more than this part of its velocities.

Velocities count as so many times the power of the noise at least, which is known to some percent.
"""

NO_FLOOR = 1e-3
"""Transmission of white noise below which the spectrum shows no noise floor."""

BAND = 0.95
"""Fraction of the deflection's power inside the frequency bands."""


def envelope(samples: Samples, cup_length: float) -> Envelope:
    """
    Return the validity range of a recording.

    Parameters
    ----------
    samples : Samples
        As they go into the fit; samples that are not valid are left out.
    cup_length : float
        Nominal length l0, m.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    if not samples.count:
        raise BellowsError('The recording has no valid samples, hence no validity range.')
    deflection, mass = samples.lip.displacement(cup_length), samples.payload.mass
    strain = samples.spectrum_of(deflection)
    shift_and_turn = np.column_stack([strain.density[:, i:i + 3].sum(axis=1) for i in (0, 3)])
    bands = np.column_stack(Spectrum(strain.frequency, shift_and_turn).band(BAND))
    return Envelope(
        deflection.min(axis=0), deflection.max(axis=0), np.abs(samples.lip.twist).max(axis=0),
        np.nan_to_num(bands), np.array([mass, mass]))


def left(weights: Array, rate_hz: float, frequency: Array) -> Array:
    """Return the transmission (F,) of a filter for velocities at frequencies (F,) in Hz."""
    half_window = weights.shape[1] // 2
    time = np.arange(-half_window, half_window + 1) / rate_hz
    omega = 2.0 * np.pi * np.maximum(frequency, RESOLUTION)
    return np.asarray(np.sin(omega[:, None] * time) @ weights[1] / omega)


def pass_band(weights: Array, rate_hz: float) -> float:
    """Return the frequency (Hz) up to which a filter with weights (3, 2n+1) follows."""
    frequency = np.arange(RESOLUTION, 0.5 * rate_hz, RESOLUTION)
    beyond = left(weights, rate_hz, frequency) < 1.0 - FOLLOWED
    return float(frequency[np.argmax(beyond)]) if beyond.any() else 0.5 * rate_hz


class PassBand(NamedTuple):
    """
    The transmission of a package's filter for the lip's twist.

    Mean squares (6,) of what the filter took of the motion, lost, and the least of them that are
    too much; the end (Hz) of its pass band; half windows (samples) of the filters of tool and
    package.
    """

    lost: Array
    least: Array
    end_hz: float
    half_windows: tuple[int, int]

    @classmethod
    def of(cls, samples: Samples, noise: FilterNoise, size: Array) -> 'PassBand':
        """
        Return that of all samples of a recording, whose twists have noise of a size (6,).

        In an axis where noise is larger, the spectrum beyond the pass band shows it.
        """
        twist, rate_hz = samples.twist_spectrum, uniform_rate_hz(samples.package.stamps_ns)
        part = left(noise.package_weights, rate_hz, twist.frequency)
        white = (part * twist.frequency) ** 2
        end = pass_band(noise.package_weights, rate_hz)
        beyond = (twist.frequency > 2.0 * end) & (white > NO_FLOOR * white.max())
        back = np.exp(-2j * np.pi * twist.frequency / rate_hz)  # to the sample before
        colour = np.abs(1.0 - np.multiply.outer(back, noise.correlation)) ** -2.0
        seen = white[:, None] * np.repeat(colour, 3, axis=1)
        level = twist.density[beyond] / seen[beyond]
        floor = np.median(level, axis=0) * seen.sum(axis=0) if beyond.any() else np.zeros(6)
        variance = np.maximum(size**2, twist.frequency[1] * floor)
        moving = twist.frequency[1] * twist.density.sum(axis=0) - variance
        lost = (twist.frequency[1] * (1.0 - part) @ twist.density
                - (1.0 - part) @ seen / seen.sum(axis=0) * variance)
        return cls(
            lost, LOST * np.maximum(moving, STANDS_OUT * variance), end,
            (noise.tool_half_window, noise.package_weights.shape[1] // 2))
