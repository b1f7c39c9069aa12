"""How long it takes to predict and to steer a plan."""

from functools import partial
import math
from time import process_time
from typing import Any

from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.planning.limits import fastest
from bellows_ros.core.planning.plan import PlanSimulation
from bellows_ros.core.planning.points import plan_of
from bellows_ros.core.planning.steering import METHODS, steer
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

from .step_case import CUP, PACKAGE
from .timing import interleaved, Work

MODEL = model_tuple(CUP, PACKAGE, 9.81)
GRIP = (60e3 * math.pi * 0.03 ** 2, 0.03, 0.5)
WAY, RATE = 0.4, 1000


def plan() -> Trajectory:
    """Return a quintic move by `WAY` (m) in 1 s, at `RATE` (Hz)."""
    s = np.linspace(0.0, 1.0, RATE + 1)
    position, twist = np.zeros((RATE + 1, 3)), np.zeros((RATE + 1, 6))
    position[:, 0] = WAY * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    twist[:, 0] = WAY * 30.0 * s**2 * (1.0 - s) ** 2
    return plan_of(np.round(s * 1e9).astype(np.int64), position,
                   np.tile([0.0, 0.0, 0.0, 1.0], (RATE + 1, 1)), twist)


def run(short: bool) -> dict[str, Any]:
    """Return seconds per second of plan."""
    tool = plan()
    along = PlanSimulation(MODEL, GRIP, tool, tail=0.0)
    subjects: dict[str, Work] = {
        'predict': along.predict,
        'shortest safe time': partial(fastest, KNOWN, MODEL, GRIP, tool, 1.5),
        **{f'steer, {method}': partial(steer, MODEL, tool, method) for method in METHODS},
    }
    return {'seconds': interleaved(subjects, 3 if short else 25, process_time)}


KNOWN = {
    'cup.stiffness': CUP.stiffness.ravel(), 'cup.damping': CUP.damping.ravel(),
    'cup.stiffness_std': 0.004 * CUP.stiffness.ravel(),
    'cup.damping_std': 0.02 * CUP.damping.ravel(),
    'package.mass': PACKAGE.mass, 'package.com': PACKAGE.com,
    'package.inertia': PACKAGE.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
    'package.mass_std': 0.005, 'package.com_std': np.full(3, 5e-4),
    'package.inertia_std': np.array([1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0]),
}
"""What is known of cup and package, as an identification leaves it."""
