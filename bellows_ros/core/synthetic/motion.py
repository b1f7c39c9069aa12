"""
Smooth motions of the tool tip E, with pose and velocity at any time.

A motion begins at rest and has continuous accelerations (C2). Times are seconds since its
beginning. Displacements are in world axes; rotations are ``R_world_tool = R_start exp(phi)``, with
the rotation vector phi in the tool's axes at the start.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.parameters.checks import Settings, WRITTEN_UNIT_TOLERANCE
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.random import Generator

HOLD_MOVE = 1.0
"""Time in which an oscillation fades into its hold, s."""

MOTION_KINDS = ('multi_sine', 'chirp', 'waypoints', 'static')

MAX_DURATION = 3600.0
"""Longest motion, s."""
MAX_FREQUENCY = 100.0
"""Highest frequency of a motion, Hz, beyond any robot."""


class Pose(NamedTuple):
    """A pose of E in the world: position (3,) in m and R_world_tool (3, 3)."""

    position: Array
    rotation: Array


class Motion(ABC):
    """
    A motion of the tool.

    Attributes
    ----------
    start : Pose
        Pose of the tool at rest at the beginning.
    rest_duration : float
        Duration of the initial rest, s.
    duration : float
        Duration with the rest, s.

    """

    start: Pose
    rest_duration: float
    duration: float

    @abstractmethod
    def state(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """
        Return pose and twist of the tool.

        Parameters
        ----------
        t : array (N,)
            Times, s; before the beginning the tool is at rest.

        Returns
        -------
        position, velocity : arrays (N, 3)
            In world axes, m and m/s.
        rotation : array (N, 3, 3)
            R_world_tool.
        body_rate : array (N, 3)
            Angular velocity in tool axes, rad/s.

        """

    @property
    @abstractmethod
    def highest_frequency(self) -> float:
        """Highest frequency in the motion, Hz; estimated for motions without a line spectrum."""

    def trajectory(self, stamps_ns: Stamps, start_ns: int) -> Trajectory:
        """
        Return the tool's poses and body twists at given stamps.

        Parameters
        ----------
        stamps_ns : int array (N,)
            Strictly increasing, ns.
        start_ns : int
            Stamp of the motion's beginning, ns.

        """
        o, o_rate, R, w = self.state((stamps_ns - start_ns) / NS_PER_S)
        twist = np.hstack([lie.apply(np.swapaxes(R, -1, -2), o_rate), w])
        return Trajectory(stamps_ns, o, R, twist)

    def at_rate(self, rate_hz: float, start_ns: int = 10**9) -> Trajectory:
        """Return the motion from its beginning to its end."""
        return self.trajectory(sample_stamps(rate_hz, self.duration, start_ns), start_ns)


def sample_stamps(rate_hz: float, duration: float, start_ns: int) -> Stamps:
    """Return the evenly spaced stamps (N,) of a recording, both ends included, ns."""
    count = int(np.floor(duration * rate_hz + 1e-6)) + 1
    steps = np.round(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)
    return start_ns + steps


def smooth_step(s: Array) -> Array:
    """
    Return the quintic from 0 to 1 and its rate (2, N).

    Velocity and acceleration are zero at both ends, and the integral of its squared jerk is
    minimal. Outside 0..1 it is constant.
    """
    s = np.clip(s, 0.0, 1.0)
    return np.array([s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * (s - s**2) ** 2])


class Vibration(Motion):
    """A motion about the start, given by its displacement."""

    @abstractmethod
    def displacement(self, t: Array) -> Array:
        """
        Return the displacement since the start and its rate (2, N, 6).

        The displacement is in world axes (m, m/s), followed by the rotation vector in axes of the
        start (rad, rad/s).
        """

    def state(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Return pose and twist of the tool; the body rate is dexp(-phi) dphi/dt."""
        value, rate = self.displacement(t)
        phi = value[:, 3:]
        return (
            self.start.position + value[:, :3],
            rate[:, :3],
            self.start.rotation @ lie.exp_so3(phi),
            lie.apply(lie.dexp(-phi), rate[:, 3:]))


@dataclass(frozen=True, eq=False)
class Oscillation(Vibration):
    """
    Oscillations with smoothly increasing amplitude after the rest.

    Parameters
    ----------
    start : Pose
    rest_duration, ramp_duration, duration : float
        Rest, ramp of the amplitude, and total duration, s.
    amplitude : array (M,)
        Amplitude of each component, m or rad.
    axis : int array (M,)
        Displacement of each component: 0..2 in world axes, 3..5 in the rotation vector.
    frequency : array (M, 2)
        Frequencies at the end of the rest and at the end of the motion, Hz, changing linearly in
        between.
    phase : array (M,)
        Phase at the end of the rest, rad.
    hold : array (3,)
        Rotation vector of the hold at the end, in axes of the start, rad.
    hold_duration : float
        Duration of the hold, s; 0 for none.

    """

    start: Pose
    rest_duration: float
    ramp_duration: float
    duration: float
    amplitude: Array
    axis: Stamps
    frequency: Array
    phase: Array
    hold: Array = field(default_factory=lambda: np.zeros(3))
    hold_duration: float = 0.0

    def displacement(self, t: Array) -> Array:
        """Return displacement and rotation vector since the start, and their rates (2, N, 6)."""
        tau = t - self.rest_duration
        ramp, slope = smooth_step(tau / self.ramp_duration)
        slope = slope / self.ramp_duration
        moved = np.zeros((2, len(t), 6))
        if self.hold_duration > 0.0:
            begin = self.duration - self.hold_duration - HOLD_MOVE
            held, rate = smooth_step((t - begin) / HOLD_MOVE) / [[1.0], [HOLD_MOVE]]
            ramp, slope = ramp * (1.0 - held), slope * (1.0 - held) - ramp * rate
            moved[:, :, 3:] = np.multiply.outer([held, rate], self.hold)
        for i, axis in enumerate(self.axis):
            first, last = 2.0 * np.pi * self.frequency[i]
            sweep = (last - first) / (self.duration - self.rest_duration)
            angle = self.phase[i] + first * tau + 0.5 * sweep * tau**2
            wave = self.amplitude[i] * np.sin(angle)
            wave_rate = self.amplitude[i] * (first + sweep * tau) * np.cos(angle)
            moved[0, :, axis] += ramp * wave
            moved[1, :, axis] += ramp * wave_rate + slope * wave
        return moved

    @property
    def highest_frequency(self) -> float:
        """Highest frequency of a component, Hz."""
        return float(np.max(self.frequency, initial=0.0))


class MoveAndHold(NamedTuple):
    """A move to a pose along a smooth step, and a hold there; times in s."""

    goal: Pose
    move: float
    hold: float


@dataclass(frozen=True, eq=False)
class Waypoints(Motion):
    """
    Moves from pose to pose, each with a stop at its end.

    Positions move straight and orientations about a fixed axis, both along the smooth step.

    Parameters
    ----------
    start : Pose
    rest_duration : float
        Duration of the rest, s.
    segments : tuple of MoveAndHold
        Moves, at least one.

    """

    start: Pose
    rest_duration: float
    segments: tuple[MoveAndHold, ...]

    @property
    def duration(self) -> float:  # type: ignore[override]
        """Duration with the rest, s."""
        return self.rest_duration + sum(each.move + each.hold for each in self.segments)

    def state(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Return pose and twist of the tool; at rest before the first segment."""
        still = np.zeros((len(t), 3))
        position, rotation = still + self.start.position, still[..., None] + self.start.rotation
        velocity, body_rate = still.copy(), still.copy()
        begin, start = self.rest_duration, self.start
        for segment in self.segments:
            now = t >= begin  # a later segment overwrites its interval
            step, slope = smooth_step((t[now] - begin) / segment.move)[:, :, None]
            slope = slope / segment.move
            shift = segment.goal.position - start.position
            phi = lie.log_so3(start.rotation.T @ segment.goal.rotation)
            position[now], velocity[now] = start.position + step * shift, slope * shift
            rotation[now], body_rate[now] = start.rotation @ lie.exp_so3(step * phi), slope * phi
            begin, start = begin + segment.move + segment.hold, segment.goal
        return position, velocity, rotation, body_rate

    @property
    def highest_frequency(self) -> float:
        """Inverse of the shortest move, Hz."""
        return 1.0 / min(segment.move for segment in self.segments)


class Planned(Motion):
    """
    The motion of a plan.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world with body twists.

    """

    def __init__(self, tool: Trajectory) -> None:
        self.tool, self.start = tool, Pose(tool.position[0], tool.rotation[0])
        moving = np.asarray(tool.twist).any(axis=1)
        self.rest_duration = float(tool.seconds[max(int(np.argmax(moving)) - 1, 0)])
        self.duration = float(tool.seconds[-1])

    @property
    def highest_frequency(self) -> float:
        """A hundredth of the rate of its points, Hz."""
        return 0.01 * (len(self.tool) - 1) / self.duration

    def state(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """Return the motion between the points, and the last pose after them."""
        first, last = self.tool.stamps_ns[[0, -1]]
        stamps = np.clip(first + np.round(t * NS_PER_S).astype(np.int64), first, last)
        at, places = np.unique(stamps, return_inverse=True)
        sampled = resample(self.tool, at)
        R, twist = sampled.rotation, np.asarray(sampled.twist)
        return (sampled.position[places], lie.apply(R, twist[:, :3])[places], R[places],
                twist[places, 3:])


def motion_from(settings: Settings, phases: Generator) -> Motion:
    """
    Return the motion of settings; see config/motion_example.yaml.

    Parameters
    ----------
    settings : Settings
        Settings with `kind`, and a block of that name.
    phases : Generator
        Generator of the phases of oscillations.

    Raises
    ------
    BellowsError
        If a setting is missing, unknown or out of range.

    """
    kind = settings.choice('kind', MOTION_KINDS)
    start = pose_from(settings.block('start'))
    rest = settings.number('rest_duration', 2.0, 's', minimum=0.0, maximum=MAX_DURATION)
    motion: Oscillation | Waypoints
    if kind in ('multi_sine', 'chirp'):
        motion = _oscillation(settings, kind, start, rest, phases)
    else:  # waypoints have individual times, static poses common ones
        block = settings.block(kind)
        common = _times(block) if kind == 'static' else None
        segments = tuple(MoveAndHold(pose_from(each), *(common or _times(each)))
                         for each in block.blocks('poses'))
        motion = Waypoints(
            start, rest, (1 + block.integer('repeat', 0, maximum=1000)) * segments)
    if motion.duration > MAX_DURATION:
        raise BellowsError(
            f'The motion takes {motion.duration:g} s; at most {MAX_DURATION:g} s are possible. '
            'Split it into several recordings.')
    return motion


def pose_from(settings: Settings) -> Pose:
    """Return a pose given by position and rpy or quaternion_xyzw; default: identity."""
    position = settings.vector('position', 3, (0.0, 0.0, 0.0), unit='m')
    rpy = settings.vector('rpy', 3, (0.0, 0.0, 0.0), unit='rad')
    quaternion = settings.vector('quaternion_xyzw', 4, (0.0, 0.0, 0.0, 1.0))
    if 'rpy' in settings and 'quaternion_xyzw' in settings:
        raise BellowsError(
            f"Settings '{settings.name('rpy')}' and '{settings.name('quaternion_xyzw')}' are both "
            'given. Give one of them.')
    if 'quaternion_xyzw' in settings:
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > WRITTEN_UNIT_TOLERANCE:
            raise settings.refuse('quaternion_xyzw', 'of length 1', quaternion.tolist())
        return Pose(position, lie.quaternion_to_rotation(quaternion / length))
    return Pose(position, lie.rpy_rotation(rpy))


def _oscillation(
    settings: Settings, kind: str, start: Pose, rest: float, phases: Generator
) -> Oscillation:
    """Return a multi-sine or a chirp."""
    duration = settings.number('duration', unit='s', above=rest, maximum=MAX_DURATION)
    ramp = settings.number('ramp_duration', 1.0, 's', above=0.0, maximum=MAX_DURATION)
    block = settings.block(kind)
    lines = _sines(block) if kind == 'multi_sine' else _sweeps(block)
    block.done()
    if not lines:
        raise BellowsError(
            f"Setting '{kind}' moves nothing. Give it an amplitude on one axis at least, of "
            'position or of rotation.')
    axis, amplitude, *frequency = np.transpose(lines)
    phase = phases.uniform(0.0, 2.0 * np.pi, len(axis))
    hold, held = np.zeros(3), 0.0
    if 'hold' in settings:
        block = settings.block('hold')
        hold = block.vector('rotation', 3, unit='rad')
        longest = duration - rest - ramp - HOLD_MOVE
        held = block.number('duration', unit='s', above=0.0, maximum=longest)
        block.done()
    return Oscillation(start, rest, ramp, duration, amplitude, axis.astype(np.int64),
                       np.transpose(frequency), phase, hold, held)


def _sines(settings: Settings) -> list[tuple[float, ...]]:
    """Return axis, amplitude, first and last frequency of the components of a multi-sine."""
    parts = list[tuple[float, ...]]()
    for offset, name, unit in ((0, 'position', 'm'), (3, 'rotation', 'rad')):
        block = settings.block(name)
        for index, axis in enumerate(('x', 'y', 'z')):
            lines, default = block.block(axis), () if axis not in block else None
            amplitude = lines.numbers('amplitude', unit, default=default)
            frequency = lines.numbers(
                'frequency', 'Hz', minimum=0.0, maximum=MAX_FREQUENCY, default=default)
            if len(amplitude) != len(frequency):
                raise BellowsError(
                    f"Settings '{lines.name('amplitude')}' and '.frequency' must be equally "
                    f'long, got {len(amplitude)} and {len(frequency)} numbers.')
            parts += [(offset + index, a, f, f) for a, f in zip(amplitude, frequency, strict=True)]
    return parts


def _sweeps(settings: Settings) -> list[tuple[float, ...]]:
    """Return axis, amplitude, first and last frequency of the components of a chirp."""
    amplitude = np.concatenate([
        settings.vector('position', 3, (0.0, 0.0, 0.0), unit='m'),
        settings.vector('rotation', 3, (0.0, 0.0, 0.0), unit='rad')])
    ends = [
        settings.number(name, unit='Hz', minimum=0.0, maximum=MAX_FREQUENCY)
        for name in ('from', 'to')]
    return [(axis, size, *ends) for axis, size in enumerate(amplitude) if size]


def _times(settings: Settings) -> tuple[float, float]:
    """Return the durations of a move and of the hold after it, s."""
    move = settings.number('move', unit='s', minimum=0.01, maximum=MAX_DURATION)  # m
    return move, settings.number('hold', 0.0, 's', minimum=0.0, maximum=MAX_DURATION)
