"""Case of the measurement: a plate released beside its equilibrium."""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, STANDARD_GRAVITY
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import state_row
import numpy as np

CUP = Cup.thesis()
PACKAGE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
MODEL = model_tuple(CUP, PACKAGE, STANDARD_GRAVITY)

STILL = state_row((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def start() -> State:
    """Return the package's state 3 mm and 7 degrees from equilibrium, at rest."""
    position, *_ = static_equilibrium(MODEL, STILL)  # upright
    return state_row(np.add(position, [2e-3, -1e-3, 1.5e-3]),
                     rotation_to_quaternion(exp_so3([0.06, -0.04, 0.10])))
