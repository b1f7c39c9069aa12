"""
A force-torque sensor by Newton and Euler, from positions of point masses alone.

Gripper and package are point masses in the moving frames of tool and package; the load on the
sensor is the sum of m (g - a) over both, and its moment, with accelerations a from differences of
positions. Nothing comes from the package's formulas of wrenches.
"""

from bellows_ros.core.geometry import lie
import numpy as np

GRAVITY = np.array([0.0, 0.0, -9.81])


def points_of(mass, com, inertia):
    """Return six point masses and their places: two on each principal axis."""
    moments, axes = np.linalg.eigh(inertia)
    squares = (moments.sum() / 2 - moments) / (2 * mass / 6)
    places = np.vstack([sign * np.sqrt(squares) * np.eye(3) for sign in (1, -1)]) @ axes.T
    return np.full(6, mass / 6), com + places


def numbers_of(masses, places):
    """Return mass, com and inertia at the com (xx, yy, zz, xy, xz, yz) of point masses."""
    com = masses @ places / masses.sum()
    r = places - com
    S = (masses[:, None] * r).T @ r
    inertia = np.trace(S) * np.eye(3) - S
    return masses.sum(), com, inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def second_differences(x, h):
    """Differentiate samples of a time h twice, to fourth order; two are lost at each end."""
    return (-x[:-4] + 16 * x[1:-3] - 30 * x[2:-2] + 16 * x[3:-1] - x[4:]) / (12 * h * h)


def loads(tool, body, package, gripper, T_tool_sensor, h):
    """
    Return force and moment (N - 4, 6) in the axes of a sensor, without two samples at each end.

    Tool and body are poses (N, 3), (N, 3, 3) at samples of a time h; the package and the gripper
    are masses with places in B and in the sensor.
    """
    o = tool[0] + lie.apply(tool[1], T_tool_sensor[:3, 3])
    R = tool[1] @ T_tool_sensor[:3, :3]
    total = np.zeros((len(o) - 4, 6))
    for (position, rotation), (masses, places) in (((o, R), gripper), (body, package)):
        for mass, place in zip(masses, places, strict=True):
            p = position + rotation @ place
            force = mass * (GRAVITY - second_differences(p, h))
            total[:, :3] += force
            total[:, 3:] += np.cross((p - o)[2:-2], force)
    back = np.swapaxes(R[2:-2], 1, 2)
    return np.hstack([lie.apply(back, total[:, :3]), lie.apply(back, total[:, 3:])])


class Errors:
    """Errors of a real sensor: noise, drift, gain by axis, hysteresis of its range, delay."""

    def __init__(self, noise, drift, gain, hysteresis, delay):
        self.noise, self.drift = np.repeat(noise, 3), np.repeat(drift, 3)
        self.gain, self.hysteresis, self.delay = gain, hysteresis, delay

    def applied(self, loads, h, rng):
        """Return readings (N, 6) of loads with zero taken at rest with the first of them."""
        late = round(self.delay / h)
        shown = loads[np.maximum(np.arange(len(loads)) - late, 0)]
        shown = shown * (1.0 + self.gain * rng.choice([-1.0, 1.0], 6))
        lag, play = np.zeros(6), self.hysteresis * np.abs(shown).max(axis=0)
        for k, each in enumerate(shown.copy()):  # backlash: an element that follows its ends
            lag = np.clip(lag, each - play, each + play)
            shown[k] = each + 0.5 * (lag - each)
        walk = np.cumsum(rng.normal(size=shown.shape) * self.drift * np.sqrt(h), axis=0)
        return shown + walk + rng.normal(size=shown.shape) * self.noise


ATI = {'noise': (0.05, 0.002), 'drift': (0.01, 5e-4), 'delay': 0.002}
UR = {'noise': (0.5, 0.03), 'drift': (0.05, 3e-3), 'delay': 0.004}
