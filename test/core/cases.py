"""The thesis' validation case and random models, shared by the tests of the core."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import dexp, exp_so3, nearest_rotation, transform
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

START = 1_760_000_000_000_000_000
MS = 1_000_000
UPRIGHT = (0.0, 0.0, 0.0, 1.0)

K_THESIS = np.array([  # (3.45)
    [200, 10, 30, 3.2, 2, 1.3],
    [10, 180, 20, 0.7, 4.3, 2.5],
    [30, 20, 1.55e3, 1, 0.9, 3.5],
    [3.2, 0.7, 1, 2, 0.8, 1],
    [2, 4.3, 0.9, 0.8, 3, 0.5],
    [1.3, 2.5, 3.5, 1, 0.5, 4],
])
PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
T_WORLD_PACKAGE = np.array([  # (3.48)
    [0.5956, -0.1185, 0.7945, -0.2004],
    [-0.1408, 0.9584, 0.2485, 0.2661],
    [-0.7909, -0.2598, 0.5541, 0.0301],
    [0, 0, 0, 1],
])
T_WORLD_TOOL = np.array([  # (3.49)
    [0.9865, -0.1459, 0.0743, -0.2000],
    [0.1307, 0.9751, 0.1789, 0.3000],
    [-0.0986, -0.1668, 0.9811, 0.1800],
    [0, 0, 0, 1],
])


def orthonormal(T):
    """Return a pose printed with four digits, with its rotation orthonormalised."""
    return transform(nearest_rotation(T[:3, :3]), T[:3, 3])


def state_of(o, R, twist=(0.0,) * 6):
    """Return a state as the kernels take it."""
    return state_row(o, lie.rotation_to_quaternion(R), twist)


def random_pose(rng, angle=1.0, distance=0.1):
    """Return a pose turned and moved by about the given sizes."""
    R = exp_so3(angle * rng.standard_normal(3))
    return transform(R, distance * rng.standard_normal(3))


def random_cup(rng, damping=True):
    """Return a cup with full K and P, both positive definite, in the range of real ones."""
    scale = np.array([80.0, 80.0, 110.0, 2.0, 2.0, 1.2])
    damper = np.array([8.0, 8.0, 5.0, 0.25, 0.25, 0.3])

    def matrix(diagonal):
        A = np.eye(6) + 0.2 * rng.standard_normal((6, 6))
        return diagonal[:, None] * (A @ A.T) * diagonal

    return Cup(matrix(scale), matrix(damper) if damping else np.zeros((6, 6)), 0.05)


def random_package(rng):
    """Return a package with products of inertia and its centre of mass off the cup's axis."""
    R = exp_so3(rng.standard_normal(3))
    return Package(1.7, R @ np.diag([0.008, 0.011, 0.013]) @ R.T, (0.01, -0.02, -0.05))


def still_tool(T_world_tool, duration_ns, steps):
    """Return a tool at rest."""
    T = np.tile(T_world_tool, (steps + 1, 1, 1))
    stamps = np.arange(steps + 1) * (duration_ns // steps)
    return Trajectory(stamps, T[:, :3, 3], T[:, :3, :3], np.zeros((steps + 1, 6)))


def messages(tool, start_ns=0, in_world=False):
    """Return stamps, positions, quaternions, linear and angular twists as a driver sends them."""
    v = tool.twist.reshape(-1, 2, 3)
    if in_world:
        v = np.einsum('nij,naj->nai', tool.rotation, v)
    parts = tool.position, lie.rotation_to_quaternion(tool.rotation), v[:, 0], v[:, 1]
    return [(tool.stamps_ns + start_ns).tolist(), *(
        list(map(tuple, part.tolist())) for part in parts)]


class ShakenTool:
    """A smooth tool motion known analytically: sines in position and rotation vector."""

    def __init__(self, rng, frequency=2.0, travel=0.02, angle=0.15):
        self.a, self.b = travel * rng.standard_normal((2, 3))
        self.c, self.d = angle * rng.standard_normal((2, 3))
        self.w = 2 * np.pi * frequency

    def at(self, t):
        """Return position, rotation and body twist at a time (s)."""
        s, c, w = np.sin(self.w * t), np.cos(self.w * t), self.w
        position = self.a * s + self.b * (1 - c)
        velocity = w * (self.a * c + self.b * s)
        phi = self.c * s + self.d * (1 - c)
        rate = w * (self.c * c + self.d * s)
        R = exp_so3(phi)
        return position, R, np.concatenate([R.T @ velocity, dexp(-phi) @ rate])

    def trajectory(self, duration, rate_hz):
        """Return the motion sampled, stamps as exact as nanoseconds are."""
        stamps = np.round(np.arange(int(duration * rate_hz) + 1) / rate_hz * 1e9).astype(np.int64)
        parts = [self.at(stamp * 1e-9) for stamp in stamps]
        return Trajectory(stamps, *(np.array(part) for part in zip(*parts, strict=True)))
