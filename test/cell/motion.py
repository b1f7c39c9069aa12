"""Motions of the tool: in closed form, drawn, and of the synthetic recordings."""

import functools
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import apply, dexp, exp_so3
from bellows_ros.core.planning.points import plan_of
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic.motion import MoveAndHold, oscillation, Pose, Sine, waypoints
import numpy as np

START = 1_760_000_000_000_000_000


MS = 1_000_000


UPRIGHT = (0.0, 0.0, 0.0, 1.0)


# An epoch in 2023: a float of seconds would round such stamps to 0.2 us.
EPOCH_NS = 1_700_000_000_000_000_000


def stamps(count, rate_hz):
    """Return that many stamps at a rate (Hz), from 2023 on, ns."""
    return EPOCH_NS + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def still_tool(T_world_tool, duration_ns, steps):
    """Return a tool at rest."""
    T = np.tile(T_world_tool, (steps + 1, 1, 1))
    stamps = np.arange(steps + 1) * (duration_ns // steps)
    return Trajectory(stamps, T[:, :3, 3], T[:, :3, :3], np.zeros((steps + 1, 6)))


class ShakenTool:
    """A smooth tool motion known analytically: sines in position and rotation vector."""

    def __init__(self, rng, frequency=2.0, travel=0.02, angle=0.15):
        self.a, self.b = travel * rng.standard_normal((2, 3))
        self.c, self.d = angle * rng.standard_normal((2, 3))
        self.w = 2 * np.pi * frequency

    def at(self, t):
        """Return positions, rotations and body twists at times (s)."""
        w, t = self.w, np.asarray(t)[..., None]
        s, c = np.sin(w * t), np.cos(w * t)
        phi = self.c * s + self.d * (1 - c)
        R = exp_so3(phi)
        velocity, rate = w * (self.a * c + self.b * s), w * (self.c * c + self.d * s)
        return self.a * s + self.b * (1 - c), R, np.concatenate([
            apply(np.swapaxes(R, -1, -2), velocity), apply(dexp(-phi), rate)], axis=-1)

    def trajectory(self, duration, rate_hz):
        """Return the motion sampled, stamps as exact as nanoseconds are."""
        stamps = np.round(np.arange(int(duration * rate_hz) + 1) / rate_hz * 1e9).astype(np.int64)
        return Trajectory(stamps, *self.at(stamps * 1e-9))


TOOL = ShakenTool(np.random.default_rng(0), 0.6, 0.4, 0.6)


def poses_at(stamps_ns):
    """Give positions, rotations and body twists of a motion with changing axis, in closed form."""
    return TOOL.at((np.asarray(stamps_ns) - EPOCH_NS) / 1e9)


def motion(count, rate_hz):
    """Return that many samples of the motion at a rate (Hz)."""
    return Trajectory(stamps(count, rate_hz), *poses_at(stamps(count, rate_hz)))


class Move:
    """A quintic move by a way (m, world) and a rotation vector (rad) in a time (s), or many."""

    def __init__(self, way, turn, duration):
        self.way, self.turn = np.asarray(way, dtype=float), np.asarray(turn, dtype=float)
        self.duration = np.asarray(duration, dtype=float)

    def steps(self, s):
        """Return the step and its slope over the part of the time that has passed."""
        return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s)**2

    def at(self, t):
        """Return position, rotation and body twist at times (N,)."""
        s = np.clip(np.asarray(t) / self.duration, 0.0, 1.0)[..., None]
        step, rate = self.steps(s)
        rate = rate / self.duration[..., None]
        phi = step * self.turn
        R = lie.exp_so3(phi)
        v = np.einsum('...ji,...j->...i', R, rate * self.way)
        w = np.einsum('...ij,...j->...i', lie.dexp(-phi), rate * self.turn)
        return step * self.way, R, np.concatenate([v, w], axis=-1)

    def points(self, rate_hz):
        """Return times, poses (N, 7) and body twists at a rate."""
        count = round(float(self.duration) * rate_hz)
        stamps = np.round(np.linspace(0.0, float(self.duration), count + 1) * 1e9).astype(np.int64)
        o, R, v = self.at(stamps * 1e-9)
        return stamps, np.hstack([o, lie.rotation_to_quaternion(R)]), v

    def plan(self, rate_hz=1000):
        """Return the plan sampled."""
        return plan_of(*self.points(rate_hz), twist_frame='tool').trajectory()


class Shake:
    """A tool motion of many sines in all six directions, starting at rest."""

    def __init__(self, seed, lines=6, lowest=0.4, highest=3.5):
        rng = np.random.default_rng(seed)
        self.w = 2 * np.pi * rng.uniform(lowest, highest, (lines, 6))
        self.phase = rng.uniform(0, 2 * np.pi, (lines, 6))
        size = np.array([0.012, 0.012, 0.008, 0.05, 0.05, 0.08])
        self.a = size * rng.uniform(0.5, 1.0, (lines, 6)) / np.sqrt(lines)

    def trajectory(self, duration, rate_hz, later=0.0):
        """Return poses and twists from a second of rest on, the motion a time later."""
        stamps = np.round(np.arange(int(duration * rate_hz)) / rate_hz * 1e9).astype(np.int64)
        t = np.maximum(stamps * 1e-9 - later - 1.0, 0.0)[:, None, None]
        ramp, slope = _ramp(t)
        sine, cosine = np.sin(self.w * t + self.phase), np.cos(self.w * t + self.phase)
        x = np.sum(self.a * ramp * sine, axis=1)
        v = np.sum(self.a * (slope * sine + ramp * self.w * cosine), axis=1)
        R = exp_so3(x[:, 3:])
        linear = np.einsum('nji,nj->ni', R, v[:, :3])
        angular = np.einsum('nij,nj->ni', dexp(-x[:, 3:]), v[:, 3:])
        return Trajectory(stamps, x[:, :3], R, np.hstack([linear, angular]))


def _ramp(t):
    """Return a smooth step over a second and its derivative."""
    s = np.clip(t, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 * (t < 1.0)


class Shaking(NamedTuple):
    """A motion: samples per second, seconds, peak acceleration (g), highest frequency (Hz)."""

    rate_hz: float
    seconds: float = 20.0
    peak: float = 2.0
    highest_hz: float = 3.0


def shaken(rng, shake, rest=2.0, at_once=False):
    """
    Give a body at rest that then moves and turns in all directions.

    Its angular acceleration peaks at 4 rad/s^2 per m/s^2. It sets off smoothly, or at once with
    a velocity.
    """
    time = np.arange(int(shake.seconds * shake.rate_hz)) / shake.rate_hz
    moving = np.maximum(time - rest, 0.0)
    coordinates = np.zeros((len(time), 6))
    for _ in range(3):
        frequency, phase = rng.uniform(0.3, shake.highest_hz, 6), rng.uniform(0.0, 2 * np.pi, 6)
        wave = np.sin(2 * np.pi * frequency * moving[:, None] + phase) - np.sin(phase)
        coordinates += rng.uniform(0.2, 1.0, 6) * wave
    if not at_once:
        coordinates *= (1.0 - np.exp(-((moving / 0.3) ** 2)))[:, None]
    peak = np.array([9.81 * shake.peak] * 3 + [4 * 9.81 * shake.peak] * 3)
    coordinates *= peak / np.max(np.abs(np.diff(coordinates, 2, axis=0)) * shake.rate_hz**2)
    rotation = exp_so3(rng.normal(size=3)) @ exp_so3(coordinates[:, 3:])
    stamps = START + np.floor(time * 1e9).astype(np.int64)
    return Trajectory(stamps, coordinates[:, :3], rotation)


def held(seed, rate_hz=360.0, seconds=20.0, com=(0.0, 0.0, -0.03), origin=(0.0, 0.0, 0.0)):
    """Give poses of E and of B, which hangs below it and sways: at rest with axes of the world."""
    rng = np.random.default_rng(seed)
    tool = shaken(rng, Shaking(rate_hz, seconds, 1.0, 2.0))
    sway = shaken(rng, Shaking(rate_hz, seconds, 0.3, 2.0))
    R_tool = tool.rotation @ tool.rotation[0].T
    R_package = R_tool @ (sway.rotation[0].T @ sway.rotation)
    package = tool.position + apply(R_tool, sway.position + [0.0, 0.0, -0.05])
    return (Trajectory(tool.stamps_ns, tool.position + origin, R_tool),
            Trajectory(tool.stamps_ns, package + apply(R_package, np.array(com)) + origin,
                       R_package))


# Amplitude (m, rad) and frequency (Hz) of the lines of each axis.
LINES = (
    ((0.03, 0.6), (0.004, 2.3)), ((0.03, 0.7), (0.004, 2.6)), ((0.03, 0.8), (0.006, 3.7)),
    ((0.08, 0.5), (0.02, 2.1)), ((0.08, 0.9), (0.02, 2.4)), ((0.20, 0.4), (0.10, 1.9)),
)


@functools.cache
def shake(axes=(0, 1, 2, 3, 4, 5), duration=10.0, seed=1, rest=0.5, lines=LINES):
    """Return a tool motion that drives some axes."""
    sines = [Sine(axis, size, f) for axis in axes for size, f in lines[axis]]
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(sines))
    return oscillation(Pose(np.zeros(3), np.eye(3)), rest, 1.0, duration, sines, phase)


def standstills(rotation_vectors, hold=2.0):
    """Return a tool motion from pose to pose, each held still."""
    segments = tuple(
        MoveAndHold(Pose(np.zeros(3), exp_so3(np.array(phi, float))), 0.8, hold)
        for phi in rotation_vectors)
    return waypoints(Pose(np.zeros(3), np.eye(3)), hold, segments)
