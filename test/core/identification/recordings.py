"""Simulated motions for the tests of identification."""

from bellows_ros.core.geometry.lie import dexp, exp_so3
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

GRAVITY = 9.81
PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))


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
