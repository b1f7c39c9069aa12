"""Processor time of the prediction and of the steering of a plan."""

from functools import partial
import math
from time import process_time
from typing import Any

from bellows_ros.core.parameters.conversion import uncertain_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.limits import fastest
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.steering import METHODS, steer
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

from .paths import driven, step
from .step_case import CUP, MODEL, PACKAGE
from .timing import interleaved, Work

GRIP = (60e3 * math.pi * 0.03 ** 2, 0.03, 0.5)
DISTANCE, RATE = 0.4, 1000


def plan() -> Trajectory:
    """Return a quintic move by `DISTANCE` (m) in 1 s, at `RATE` (Hz)."""
    return driven(lambda t: np.outer(DISTANCE * step(t, 0.0, 1.0), [1.0, 0, 0, 0, 0, 0]),
                  (RATE + 1.5) / RATE, RATE)


def run(short: bool) -> dict[str, Any]:
    """Return seconds per second of plan."""
    tool = plan()
    along = PlanSimulation(MODEL, GRIP, tool, tail=0.0)
    subjects: dict[str, Work] = {
        'predict': along.predict,
        'shortest safe time': partial(fastest, uncertain_of(PARAMETERS), MODEL, GRIP, tool, 1.5),
        **{f'steer, {method}': partial(steer, MODEL, tool, method) for method in METHODS}}
    return {'seconds': interleaved(subjects, 3 if short else 25, process_time)}


PARAMETERS = Values({
    'cup.stiffness': CUP.stiffness.ravel(), 'cup.damping': CUP.damping.ravel(),
    'cup.stiffness_std': 0.004 * CUP.stiffness.ravel(),
    'cup.damping_std': 0.02 * CUP.damping.ravel(),
    'package.mass': PACKAGE.mass, 'package.com': PACKAGE.com,
    'package.inertia': PACKAGE.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
    'package.mass_std': 0.005, 'package.com_std': np.full(3, 5e-4),
    'package.inertia_std': np.array([1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0])})
"""Of cup and package, as an identification leaves them."""
