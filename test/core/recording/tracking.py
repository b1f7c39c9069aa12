"""Motions recorded by a motion capture system with its typical faults."""

from typing import NamedTuple

from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

START = 1_760_000_000_000_000_000


class Shake(NamedTuple):
    """A motion: samples per second, seconds, peak acceleration (g), highest frequency (Hz)."""

    rate_hz: float
    seconds: float = 20.0
    peak: float = 2.0
    highest_hz: float = 3.0


class Noise(NamedTuple):
    """Standard deviation in each axis, m and rad."""

    position: float = 1e-4
    rotation: float = 5e-4


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
    tool = shaken(rng, Shake(rate_hz, seconds, 1.0, 2.0))
    sway = shaken(rng, Shake(rate_hz, seconds, 0.3, 2.0))
    R_tool = tool.rotation @ tool.rotation[0].T
    R_package = R_tool @ (sway.rotation[0].T @ sway.rotation)
    package = tool.position + apply(R_tool, sway.position + [0.0, 0.0, -0.05])
    return (Trajectory(tool.stamps_ns, tool.position + origin, R_tool),
            Trajectory(tool.stamps_ns, package + apply(R_package, np.array(com)) + origin,
                       R_package))


def displaced(poses, samples, offset, turn, on_body):
    """Return poses with constant errors of some samples, in axes of the world or of the body."""
    position, rotation = poses.position.copy(), poses.rotation.copy()
    if on_body:
        position[samples] += rotation[samples] @ offset
        rotation[samples] = rotation[samples] @ exp_so3(turn)
    else:
        position[samples] += offset
        rotation[samples] = exp_so3(turn) @ rotation[samples]
    return Trajectory(poses.stamps_ns, position, rotation)


def vector(rng, length):
    """Give a vector of a length in any direction."""
    direction = rng.normal(size=3)
    return length * direction / np.linalg.norm(direction)


def with_excursions(rng, poses, count, metres, radians, samples):
    """
    Return poses with excursions, and the mask of wrong samples.

    Sizes and lengths are drawn evenly in their logarithms between two ends each; excursions keep
    eight samples between each other.
    """
    off = np.full(len(poses), False)
    for _ in range(count):
        length = int(np.exp(rng.uniform(*np.log([samples[0], samples[1] + 0.99]))))
        free = np.flatnonzero(~np.convolve(off, np.ones(2 * length + 17), 'same').astype(bool))
        first = int(rng.choice(free[(free > 10) & (free < len(poses) - length - 10)]))
        run = slice(first, first + length)
        offset = vector(rng, np.exp(rng.uniform(*np.log(metres))))
        turn = vector(rng, np.exp(rng.uniform(*np.log(radians))))
        poses = displaced(poses, run, offset, turn, bool(rng.integers(2)))
        off[run] = True
    return poses, off
