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
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from bellows_ros.core.identification.equations import BLOCK, LipMotion, NO_HISTORY, strain_history
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.parameters.checks import ESTIMATE
from bellows_ros.core.parameters.table import THESIS_LENGTH
from bellows_ros.core.recording.conventions import (
    convention_sentence,
    conventions_of,
    converted,
    FARTHEST,
)
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import FilterNoise, PrepareSettings, Recording
from bellows_ros.core.signals.residuals import interpolated, Spectrum, spectrum
from bellows_ros.core.signals.trajectory import (
    PoseStream,
    Trajectory,
    TwistStream,
    uniform_rate_hz,
)
from bellows_ros.errors import BellowsError, MisreadError
import numpy as np
from numpy.typing import ArrayLike

ONE_BODY = 1e-3
"""Poses that stay within this distance (m) of each other are of one body."""

HELD = 0.3
"""In its own world the lip moves by at most this part of what it does in another."""

LOOKED_AT_EVERY = 20
"""Every such sample is used where only the arrangement matters."""


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

    return recording.once('samples', checked)


def filtered_samples(recording: Recording) -> Samples:
    """Return the filtered motions of any recording."""
    return recording.once('filtered samples', lambda: Samples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.package_weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns),
        recording.relaxation.strengths))


def require_hanging(recording: Recording) -> None:
    """Refuse a recording whose package is mostly not below the tool, by what is the cause."""
    some = np.flatnonzero(recording.valid)[::LOOKED_AT_EVERY]
    if not len(some):
        return
    tool, package = recording.measured_tool.select(some), recording.measured_package.select(some)
    way = package.position - apply(package.rotation, recording.payload.com) - tool.position
    lip = apply(np.swapaxes(tool.rotation, 1, 2), way)
    away, above = float(np.median(np.linalg.norm(lip, axis=1))), float(np.median(lip[:, 2]))
    if wrong := convention_sentence(recording.tool_pose, recording.package_pose, recording.name):
        both = recording.tool_pose, recording.package_pose
        seen, known = map(converted, both, conventions_of(*both))
        raise MisreadError(wrong, recording, lambda: prepared_again(
            recording, seen, known, recording.tool_twist))
    centre = apply(np.swapaxes(tool.rotation, 1, 2), package.position - tool.position)
    if min(away, float(np.median(np.linalg.norm(centre, axis=1)))) < ONE_BODY:
        raise BellowsError(
            f"topics.tool_pose ('{recording.tool_pose.name}') and topics.package_pose "
            f"('{recording.package_pose.name}') are poses of one body. Name that of the package; "
            "'bellows info BAG' lists the topics.")
    if away <= FARTHEST and above <= 0.0:
        return
    _require_one_world(recording, tool, package, lip)
    if away > FARTHEST:
        raise BellowsError(
            f"The poses of '{recording.tool_pose.name}' and '{recording.package_pose.name}' use "
            f'different worlds: the lip of the cup is {away:.3g} m from the tool tip. Set '
            'recording.package_world.')
    below = -float(np.median(centre[:, 2]))
    if recording.settings.package_frame == 'com' and below > 0.0:
        raise MisreadError(
            f'The package is tracked {1e3 * below:.0f} mm below the tool tip, but the lip of the '
            f'cup would be {1e3 * above:.0f} mm above it. If the poses are those of the lip, set '
            'recording.package_frame: lip; else check package.com.', recording,
            lambda: prepared_again(
                recording, recording.tool_pose, recording.package_pose, recording.tool_twist,
                replace(recording.settings, package_frame='lip')), 'recording.package_frame')
    upward = float(np.median(way[:, 2]))
    if upward > 0.0:
        raise MisreadError(
            'topics.tool_pose and topics.package_pose are exchanged: the lip of the cup would be '
            f'{1e3 * above:.0f} mm above the tool tip in tool axes, and {1e3 * upward:.0f} mm in '
            'the world. Exchange the two; if they are right, check recording.world.',
            recording,
            lambda: prepared_again(recording, recording.package_pose, recording.tool_pose, None))
    raise BellowsError(
        'z of the tool points the wrong way: it must point from the cup back into the arm. In '
        f'tool axes the lip of the cup is {1e3 * above:.0f} mm above the tool tip, in the world '
        f'{-1e3 * upward:.0f} mm below it. Turn the frame in its driver; if it is right, check '
        'package.com.')


def prepared_again(
    recording: Recording, tool: PoseStream, package: PoseStream, twist: TwistStream | None,
    settings: PrepareSettings | None = None,
) -> Recording:
    """Return a recording prepared from other streams, or with other settings."""
    return replace(prepare(tool, package, settings or recording.settings, twist),
                   name=recording.name)


def _require_one_world(
    recording: Recording, tool: Trajectory, package: Trajectory, lip: Array
) -> None:
    """Refuse a recording where another world of the package keeps its lip in place."""
    from bellows_ros.core.recording.alignment import (  # late: rare
        closed_form,
        in_tool_world,
        motion_of,
        motion_sentence,
    )

    def wandering(at: Array) -> float:
        """Return how far a lip (N, 3) in axes of the tool moves there, m."""
        return float(np.linalg.norm(np.subtract(*np.percentile(at, (75, 25), axis=0))))

    com, own = recording.payload.com, recording.measured_package
    try:
        pose = closed_form(recording.measured_tool, own, THESIS_LENGTH, -com, False)
    except BellowsError:  # too short to say
        return
    R = quaternion_to_rotation(pose[3:])
    there = apply(R, package.position - apply(package.rotation, com)) + pose[:3] - tool.position
    left = wandering(apply(np.swapaxes(tool.rotation, 1, 2), there))
    if left > HELD * wandering(lip):
        return
    middle = own.position[own.valid].mean(axis=0)
    turn, way = recording.settings.R_world_recorded, np.zeros(7)
    way[:3], way[3:] = turn.T @ pose[:3], rotation_to_quaternion(turn.T @ R @ turn)
    raise MisreadError(
        f'{motion_sentence(motion_of(pose, middle))}: seen from the tool, the lip of the cup '
        f'moves by {1e3 * wandering(lip):.0f} mm, and by {1e3 * left:.0f} mm without that. '
        f'Set recording.package_world: {ESTIMATE}, or give its seven numbers.', recording,
        lambda: prepared_again(
            recording, recording.tool_pose, in_tool_world(
                recording.package_pose, way, recording.tool_pose.frame_id),
            recording.tool_twist), 'package_world')


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
