"""How long it takes to predict and to steer a plan, against SciPy's integrator."""

import math
from typing import Any

from bellows_ros.core.fastest import fastest
from bellows_ros.core.kernels import body_acceleration
from bellows_ros.core.lie import exp_so3, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.model import model_tuple
from bellows_ros.core.plan import rest, Run
from bellows_ros.core.plan_points import plan_of
from bellows_ros.core.simulation import state_row, tool_rows
from bellows_ros.core.steering import hanging, METHODS, steer
from bellows_ros.core.trajectory import Trajectory
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from .step_case import CUP, PACKAGE
from .timing import interleaved, Work

MODEL = model_tuple(CUP, PACKAGE, 9.81)
GRIP = (60e3 * math.pi * 0.03 ** 2, 0.03, 0.5)
WAY, RATE = 0.4, 1000
ACCURACY = 1e-6
"""Relative tolerance of SciPy's DOP853."""


def plan() -> Trajectory:
    """Return a quintic move by `WAY` (m) in 1 s, at `RATE` (Hz)."""
    s = np.linspace(0.0, 1.0, RATE + 1)
    position, twist = np.zeros((RATE + 1, 3)), np.zeros((RATE + 1, 6))
    position[:, 0] = WAY * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    twist[:, 0] = WAY * 30.0 * s**2 * (1.0 - s) ** 2
    return plan_of(np.round(s * 1e9).astype(np.int64), position,
                   np.tile([0.0, 0.0, 0.0, 1.0], (RATE + 1, 1)), twist)


def run(short: bool) -> dict[str, Any]:
    """Return seconds per second of plan, and what is left of the swing, degrees."""
    tool = plan()
    slow = interleaved({'predict, SciPy DOP853': lambda: _once(scipy_prediction, tool)}, 1)
    along = Run(MODEL, GRIP, tool, tail=0.0)
    subjects: dict[str, Work] = {
        'predict': lambda: _once(along.at, 1.0),
        'shortest safe time': lambda: _once(fastest, EXACT, MODEL, GRIP, tool, 1.5),
        **{f'steer, {method}': _steering(tool, method) for method in METHODS},
    }
    swings = {'as planned': _swing(tool, hanging(MODEL, tool))}
    for method in METHODS:
        steered = steer(MODEL, tool, method)
        swings[method] = _swing(steered.tool, steered.package)
    return {'seconds': interleaved(subjects, 3 if short else 15) | slow, 'motions': swings}


EXACT = {
    'cup.stiffness': CUP.stiffness.ravel(), 'cup.damping': CUP.damping.ravel(),
    'cup.stiffness_std': np.zeros(36), 'cup.damping_std': np.zeros(36),
    'package.mass': PACKAGE.mass, 'package.com': PACKAGE.com,
    'package.inertia': PACKAGE.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
    'package.mass_std': 0.0, 'package.com_std': np.zeros(3), 'package.inertia_std': np.zeros(6),
}


def _once(work: Any, *arguments: Any) -> int:
    """Do something once."""
    work(*arguments)
    return 1


def _steering(tool: Trajectory, method: str) -> Work:
    """Return what steers a plan."""
    return lambda: _once(steer, MODEL, tool, method)


def _swing(tool: Trajectory, wanted: Trajectory) -> dict[str, float]:
    """Return time (s), largest tilt from where it is wanted and swing left (degrees)."""
    found = Run(MODEL, GRIP, tool, tail=2.0).at(1.0)
    R = quaternion_to_rotation(found.states[:, 3:7])
    cosine = np.sum(R[:, :, 2] * wanted.rotation[:, :, 2], axis=1)
    return {
        'duration': float(tool.seconds[-1]),
        'tilt': float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)).max())),
        'swing_left': math.degrees(found.figures()['swing_left']),
    }


def scipy_prediction(tool: Trajectory) -> np.ndarray:
    """Return the package's states at the plan's points by `solve_ivp` on this model's law."""
    rows = tool_rows(tool)
    curve = CubicHermiteSpline(tool.seconds, tool.position, rows[:, 7:10])
    slope = curve.derivative()
    start = rest(MODEL, rows[0])
    R0 = quaternion_to_rotation(np.array(start[1]))

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        R = R0 @ exp_so3(y[3:6])
        q = rotation_to_quaternion(R)
        e = state_row(curve(t), rows[0, 3:7], np.concatenate([slope(t), np.zeros(3)]))
        dv, dw = body_acceleration(MODEL, e, state_row(y[:3], q, y[6:]))
        return np.concatenate([R @ y[6:9], y[9:] + 0.5 * np.cross(y[3:6], y[9:]), dv, dw])

    y0 = np.concatenate([start[0], np.zeros(3), start[2], start[3]])
    found: np.ndarray = solve_ivp(
        rates, (0.0, 1.0), y0, 'DOP853', tool.seconds, rtol=ACCURACY, atol=1e-8).y.T
    return found
