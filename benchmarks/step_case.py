"""The case that is measured: a plate let go of beside its rest, and tool samples."""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, dexp, exp_so3, rotation_to_quaternion
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, STANDARD_GRAVITY
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.kernels import State
import numpy as np

CUP = Cup.thesis()
PACKAGE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
MODEL = model_tuple(CUP, PACKAGE, STANDARD_GRAVITY)

STILL: State = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
PUSH = np.array([2e-3, -1e-3, 1.5e-3])
"""How far from rest the package starts, m."""
TURN = np.array([0.06, -0.04, 0.10])
"""... and how much turned, rad."""


def start() -> State:
    """Return the package's state at the beginning of the free motion, at rest."""
    position, quaternion, _, _ = static_equilibrium(MODEL, STILL)
    turned = exp_so3(TURN)  # the rest under a still tool is upright
    x, y, z, w = rotation_to_quaternion(turned).tolist()
    a, b, c = (np.array(position) + PUSH).tolist()
    return (a, b, c), (x, y, z, w), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def shaken_tool(count: int, rate_hz: float) -> Array:
    """Return rows (count, 13) of a tool that moves in all directions: pose and body twist."""
    t = np.arange(count)[:, None] / rate_hz
    speed = 2.0 * np.pi * np.array([1.1, 1.3, 1.7])
    size, angle = np.array([0.02, 0.02, 0.01]), np.array([0.05, 0.05, 0.1])
    rate = size * speed * np.cos(speed * t)
    phi, phi_rate = angle * np.sin(0.7 * speed * t), 0.7 * angle * speed * np.cos(0.7 * speed * t)
    R = exp_so3(phi)
    twist = np.hstack([apply(np.swapaxes(R, 1, 2), rate), apply(dexp(-phi), phi_rate)])
    return np.hstack([size * np.sin(speed * t), rotation_to_quaternion(R), twist])
