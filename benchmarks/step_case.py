"""The case that is measured: a plate let go of beside its rest."""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
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
