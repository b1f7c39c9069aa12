"""Sensors of the cell, with noise, excursions and delays, and its recordings."""

from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import least_squares as fit_statistics
from bellows_ros.core.identification.least_squares import statistics
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
import numpy as np
from scipy.signal import lfilter

from .cup import GRAVITY, PLATE, THESIS


def with_errors(poses, e):
    """Return poses without twists that are off by (N, 6), in world and body axes."""
    return Trajectory(
        poses.stamps_ns, poses.position + e[:, :3], poses.rotation @ lie.exp_so3(e[:, 3:]))


def noisy(rng, poses, noise):
    """Return poses with white noise of standard deviations in position and rotation, m and rad."""
    return with_errors(poses, np.hstack([
        size * rng.standard_normal(poses.position.shape) for size in noise]))


def sent_by(tool, start_ns=0, in_world=False):
    """Return stamps, positions, quaternions, linear and angular twists as a driver sends them."""
    v = tool.twist.reshape(-1, 2, 3)
    if in_world:
        v = np.einsum('nij,naj->nai', tool.rotation, v)
    parts = tool.position, lie.rotation_to_quaternion(tool.rotation), v[:, 0], v[:, 1]
    return [(tool.stamps_ns + start_ns).tolist(), *(
        list(map(tuple, part.tolist())) for part in parts)]


class Noise(NamedTuple):
    """Standard deviation in each axis, m and rad."""

    position: float = 1e-4
    rotation: float = 5e-4


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


NO_NOISE = (0.0, 0.0)


TRUTHS = {}


def truth_of(motion, cup, payload, rate_hz):
    """Return the true motions of tool and package, computed once for the same objects."""
    key = motion, id(cup), id(payload), rate_hz
    if key not in TRUTHS:
        tool = motion.at_rate(rate_hz, 0)
        TRUTHS[key] = tool, simulate(cup, payload, tool, gravity=GRAVITY), cup, payload
    return TRUTHS[key][:2]


def record(
    motion, cup=THESIS, payload=PLATE, tool=NO_NOISE, package=NO_NOISE, rate_hz=120.0, seed=1,
    half_window=0, later=0.0, kept=0.0,
):
    """
    Return the prepared recording of a motion, with noise (m, rad per axis), tool late.

    The noise is white, or first-order autoregressive.
    """
    truth, moved = truth_of(motion, cup, payload, rate_hz)
    draw = np.random.default_rng((seed, 2))

    def drawn():
        white = draw.standard_normal((len(truth), 3))
        return np.sqrt(1.0 - kept**2) * lfilter([1.0], [1.0, -kept], white, axis=0)

    streams = [
        PoseStream(
            name, 'world', body.stamps_ns + round(1e9 * behind),
            body.position + noise[0] * drawn(), body.rotation @ exp_so3(noise[1] * drawn()))
        for name, body, noise, behind in (
            ('tool', truth, tool, later), ('package', moved, package, 0.0))]
    return prepare(*streams, PrepareSettings(
        payload=payload, gravity=GRAVITY, tool_half_window=half_window,
        package_half_window=half_window))


def least_squares(recordings, cup_length, structure):
    """Return the fit of samples."""
    return fit_statistics([
        statistics(samples, cup_length, structure) for samples in recordings])


TOPICS = {
    'tool_pose': '/tool_arm/pose', 'tool_twist': '/tool_arm/twist',
    'package_pose': '/package/pose'}
