"""A motion in closed form, sampled at a rate, and noise of poses."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

# An epoch in 2023: a float of seconds would round such stamps to 0.2 us.
EPOCH_NS = 1_700_000_000_000_000_000


def stamps(count, rate_hz):
    """Return that many stamps at a rate (Hz), from 2023 on, ns."""
    return EPOCH_NS + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def poses_at(stamps_ns):
    """Give positions, rotations and body twists of a motion with changing axis, in closed form."""
    t = (np.asarray(stamps_ns) - EPOCH_NS)[:, None] / 1e9
    amplitude, phase = np.array([0.6, -0.4, 0.5]), np.array([0.0, 0.7, 1.9])
    frequency = np.array([3.0, 4.0, 5.0])
    o = amplitude * np.sin(frequency * t + phase)
    o_rate = amplitude * frequency * np.cos(frequency * t + phase)
    phi = 2.0 * o + np.array([0.5, 0.2, -0.4])
    R = lie.exp_so3(phi)
    body_rate = lie.apply(lie.dexp(-phi), 2.0 * o_rate)
    v = lie.apply(np.swapaxes(R, -1, -2), o_rate)
    return o, R, np.concatenate([v, body_rate], axis=1)


def motion(count, rate_hz, with_twist=True):
    """Return that many samples of the motion at a rate (Hz)."""
    o, R, twist = poses_at(stamps(count, rate_hz))
    return Trajectory(stamps(count, rate_hz), o, R, twist if with_twist else None)


def with_errors(poses, e):
    """Return poses without twists that are off by (N, 6), in world and body axes."""
    return Trajectory(
        poses.stamps_ns, poses.position + e[:, :3], poses.rotation @ lie.exp_so3(e[:, 3:]))


def noisy(rng, poses, noise):
    """Return poses with white noise of standard deviations in position and rotation, m and rad."""
    return with_errors(poses, np.hstack([
        size * rng.standard_normal(poses.position.shape) for size in noise]))
