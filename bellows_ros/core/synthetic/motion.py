"""
Smooth motions of the tool tip E, with pose and velocity at any time.

A motion begins at rest and has continuous accelerations (C2). Times are seconds since its
beginning. Displacements are in world axes; rotations are ``R_world_tool = R_start exp(phi)``, with
the rotation vector phi in the tool's axes at the start.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.random import Generator

HOLD_MOVE = 1.0
"""Time in which an oscillation fades into its hold, s."""

MOTION_KINDS = ('multi_sine', 'waypoints', 'static')

MAX_DURATION = 3600.0
"""Longest motion, s."""
MAX_FREQUENCY = 100.0
"""Highest frequency of a motion, Hz, beyond any robot."""


class Pose(NamedTuple):
    """A pose of E in the world: position (3,) in m and R_world_tool (3, 3)."""

    position: Array
    rotation: Array


MotionState = tuple[Array, Array, Array, Array]
"""Positions (N, 3) and velocities (N, 3) in world axes (m, m/s), R_world_tool (N, 3, 3), and body
rates (N, 3) in tool axes (rad/s)."""


@dataclass(frozen=True, eq=False)
class Motion:
    """
    A motion of the tool.

    Parameters
    ----------
    rest_duration, duration : float
        Durations of the initial rest, and of the motion with the rest, s.
    highest_frequency : float
        Highest frequency, Hz; estimated for motions without a line spectrum.
    state : callable
        Function from times (N,), s, to the `MotionState`; before the beginning the tool is at
        rest.

    """

    rest_duration: float
    duration: float
    highest_frequency: float
    state: Callable[[Array], MotionState]

    def trajectory(self, stamps_ns: Stamps, start_ns: int) -> Trajectory:
        """Return poses and body twists at stamps (N,), ns; the motion begins at `start_ns`."""
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


class Sine(NamedTuple):
    """
    A component of an oscillation.

    The axis is 0 to 2 in world axes, 3 to 5 in the rotation vector; amplitudes are in m or rad,
    frequencies in Hz.
    """

    axis: int
    amplitude: float
    frequency: float


def oscillation(
    start: Pose, rest: float, ramp: float, duration: float, sines: Sequence[Sine], phase: Array,
    hold: tuple[Array, float] = (np.zeros(3), 0.0),
) -> Motion:
    """
    Return oscillations with smoothly increasing amplitude after the rest.

    Parameters
    ----------
    start : Pose
        Pose at rest.
    rest, ramp, duration : float
        Rest, ramp of the amplitude, and total duration, s.
    sines : sequence of Sine
        M components.
    phase : array (M,)
        Phase of each component at the end of the rest, rad.
    hold : (array (3,), float)
        Rotation vector of a hold at the end, in axes of the start (rad), and its duration (s).

    """
    def displacement(t: Array) -> Array:
        """Return displacement and rotation vector since the start, and their rates (2, N, 6)."""
        tau, moved = t - rest, np.zeros((2, len(t), 6))
        size, slope = smooth_step(tau / ramp) / [[1.0], [ramp]]
        if hold[1] > 0.0:
            held, rate = smooth_step(
                (t - duration + hold[1] + HOLD_MOVE) / HOLD_MOVE) / [[1.0], [HOLD_MOVE]]
            size, slope = size * (1.0 - held), slope * (1.0 - held) - size * rate
            moved[:, :, 3:] = np.multiply.outer([held, rate], hold[0])
        for sine, at_rest in zip(sines, phase, strict=True):
            rate = 2.0 * np.pi * sine.frequency
            wave = sine.amplitude * np.sin(at_rest + rate * tau)
            moved[0, :, sine.axis] += size * wave
            moved[1, :, sine.axis] += (
                slope * wave + size * sine.amplitude * rate * np.cos(at_rest + rate * tau))
        return moved

    def state(t: Array) -> MotionState:
        """Return the motion; the body rate is dexp(-phi) dphi/dt."""
        value, rate = displacement(t)
        phi = value[:, 3:]
        return (start.position + value[:, :3], rate[:, :3], start.rotation @ lie.exp_so3(phi),
                lie.apply(lie.dexp(-phi), rate[:, 3:]))

    return Motion(
        rest, duration, max((sine.frequency for sine in sines), default=0.0), state)


class MoveAndHold(NamedTuple):
    """A move to a pose along a smooth step, and a hold there; times in s."""

    goal: Pose
    move: float
    hold: float


def waypoints(start: Pose, rest: float, segments: Sequence[MoveAndHold]) -> Motion:
    """
    Return moves from pose to pose after a rest (s), each with a stop at its end.

    Positions move straight and orientations about a fixed axis, both along the smooth step.
    """
    def state(t: Array) -> MotionState:
        still = np.zeros((len(t), 3))
        position, rotation = still + start.position, still[..., None] + start.rotation
        velocity, body_rate, begin, before = still.copy(), still.copy(), rest, start
        for goal, move, hold in segments:
            now = t >= begin  # a later segment overwrites its interval
            step, slope = smooth_step((t[now] - begin) / move)[:, :, None] / [[[1.0]], [[move]]]
            shift = goal.position - before.position
            phi = lie.log_so3(before.rotation.T @ goal.rotation)
            position[now], velocity[now] = before.position + step * shift, slope * shift
            rotation[now], body_rate[now] = before.rotation @ lie.exp_so3(step * phi), slope * phi
            begin, before = begin + move + hold, goal
        return position, velocity, rotation, body_rate

    return Motion(rest, rest + sum(each.move + each.hold for each in segments),
                  1.0 / min(each.move for each in segments), state)


def planned(tool: Trajectory) -> Motion:
    """Return the motion of a plan with body twists; after its end the last pose."""
    def state(t: Array) -> MotionState:
        first, last = tool.stamps_ns[[0, -1]]
        stamps = np.clip(first + np.round(t * NS_PER_S).astype(np.int64), first, last)
        at, places = np.unique(stamps, return_inverse=True)
        sampled = resample(tool, at)
        R, twist = sampled.rotation[places], np.asarray(sampled.twist)[places]
        return sampled.position[places], lie.apply(R, twist[:, :3]), R, twist[:, 3:]

    moving, duration = np.asarray(tool.twist).any(axis=1), float(tool.seconds[-1])
    return Motion(
        float(tool.seconds[max(int(np.argmax(moving)) - 1, 0)]), duration,
        0.01 * (len(tool) - 1) / duration, state)  # a hundredth of the rate of its points


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
    if kind == 'multi_sine':
        motion = _multi_sine(settings, start, rest, phases)
    else:  # waypoints have individual times, static poses common ones
        block = settings.block(kind)
        common = _times(block) if kind == 'static' else None
        motion = waypoints(start, rest, [
            MoveAndHold(pose_from(each), *(common or _times(each)))
            for each in block.blocks('poses')])
    if motion.duration > MAX_DURATION:
        raise BellowsError(
            f'The motion takes {motion.duration:g} s; at most {MAX_DURATION:g} s are possible. '
            'Split it into several recordings.')
    return motion


def pose_from(settings: Settings) -> Pose:
    """Return a pose given by position and rpy; default: identity."""
    return Pose(settings.vector('position', 3, (0.0, 0.0, 0.0), unit='m'), lie.rpy_rotation(
        settings.vector('rpy', 3, (0.0, 0.0, 0.0), unit='rad')))


def _multi_sine(settings: Settings, start: Pose, rest: float, phases: Generator) -> Motion:
    """Return sums of sines, and a hold."""
    duration = settings.number('duration', unit='s', above=rest, maximum=MAX_DURATION)
    ramp = settings.number('ramp_duration', 1.0, 's', above=0.0, maximum=MAX_DURATION)
    block = settings.block('multi_sine')
    sines = _sines(block)
    block.done()
    if not sines:
        raise BellowsError(
            "Setting 'multi_sine' moves nothing. Give it an amplitude on one axis at least, of "
            'position or of rotation.')
    phase, hold = phases.uniform(0.0, 2.0 * np.pi, len(sines)), (np.zeros(3), 0.0)
    if 'hold' in settings:
        block = settings.block('hold')
        hold = (block.vector('rotation', 3, unit='rad'), block.number(
            'duration', unit='s', above=0.0, maximum=duration - rest - ramp - HOLD_MOVE))
    return oscillation(start, rest, ramp, duration, sines, phase, hold)


def _sines(settings: Settings) -> list[Sine]:
    """Return the components of a multi-sine."""
    parts = list[Sine]()
    for offset, name, unit in ((0, 'position', 'm'), (3, 'rotation', 'rad')):
        block = settings.block(name)
        for index, axis in enumerate(('x', 'y', 'z')):
            lines, default = block.block(axis), () if axis not in block else None
            amplitude = lines.vector('amplitude', 0, default, unit)
            frequency = lines.vector(
                'frequency', 0, default, 'Hz', minimum=0.0, maximum=MAX_FREQUENCY)
            if len(amplitude) != len(frequency):
                raise BellowsError(
                    f"Settings '{lines.name('amplitude')}' and '.frequency' must be equally "
                    f'long, got {len(amplitude)} and {len(frequency)} numbers.')
            parts += [Sine(offset + index, a, f)
                      for a, f in zip(amplitude, frequency, strict=True)]
    return parts


def _times(settings: Settings) -> tuple[float, float]:
    """Return the durations of a move and of the hold after it, s."""
    move = settings.number('move', unit='s', minimum=0.01, maximum=MAX_DURATION)  # m
    return move, settings.number('hold', 0.0, 's', minimum=0.0, maximum=MAX_DURATION)
