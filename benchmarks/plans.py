"""How long it takes to predict and to steer a plan, beside SciPy, plain NumPy and plain Python."""

import math
from time import process_time
from typing import Any

from bellows_ros.core.geometry.lie import (
    exp_so3,
    quaternion_to_rotation,
    rotation_to_quaternion,
    transform,
)
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.kernels import body_acceleration
from bellows_ros.core.model.simulation import state_row, tool_rows
from bellows_ros.core.planning.fastest import fastest
from bellows_ros.core.planning.plan import PlanSimulation, rest
from bellows_ros.core.planning.points import plan_of
from bellows_ros.core.planning.steering import hanging, impulses, METHODS, shaped, steer
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from .plain_numpy import adjoint, EYE, hat, PlainModel, upper, vee
from .step_case import CUP, PACKAGE
from .timing import figures, in_process, interleaved, Work

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
    slow = interleaved({
        'predict, SciPy DOP853': lambda: _once(scipy_prediction, tool),
        'steer, inverse, NumPy and SciPy DOP853': lambda: _once(
            numpy_inverse, tool, steer(MODEL, tool, 'inverse').package),
    }, 1, process_time)
    plain = in_process(INTERPRETED, environment={'NUMBA_DISABLE_JIT': '1'})
    slow |= {f'{name}, interpreted': figures([seconds]) for name, seconds in plain.items()}
    along = PlanSimulation(MODEL, GRIP, tool, tail=0.0)
    zvd = impulses(steer(MODEL, tool, 'zvd').modes, 'zvd')
    subjects: dict[str, Work] = {
        'predict': lambda: _once(along.at, 1.0),
        'shortest safe time': lambda: _once(fastest, KNOWN, MODEL, GRIP, tool, 1.5),
        **{f'steer, {method}': _steering(tool, method) for method in METHODS},
        'shape for known modes (zvd)': lambda: _once(shaped, tool, *zvd),
        'shape for known modes (zvd), NumPy, positions only': lambda: _once(
            numpy_shaped, tool, *zvd),
    }
    swings = {'as planned': _swing(tool, hanging(MODEL, tool))}
    for method in METHODS:
        steered = steer(MODEL, tool, method)
        swings[method] = _swing(steered.tool, steered.package)
    seconds = interleaved(subjects, 3 if short else 25, process_time) | slow
    return {'seconds': seconds, 'motions': swings}


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

INTERPRETED = """
import json
from time import process_time
from timeit import timeit
from benchmarks.plans import GRIP, MODEL, plan
from bellows_ros.core.planning.plan import PlanSimulation
from bellows_ros.core.planning.steering import steer
tool = plan()
along = PlanSimulation(MODEL, GRIP, tool, tail=0.0)
print(json.dumps({
    'predict': timeit(lambda: along.predict(1.0), timer=process_time, number=1),
    'steer, inverse': timeit(lambda: steer(MODEL, tool, 'inverse'), timer=process_time,
                             number=1)}))
"""


def _once(work: Any, *arguments: Any) -> int:
    """Do something once."""
    work(*arguments)
    return 1


def _steering(tool: Trajectory, method: str) -> Work:
    """Return what steers a plan."""
    return lambda: _once(steer, MODEL, tool, method)


def _swing(tool: Trajectory, wanted: Trajectory) -> dict[str, float]:
    """Return time (s), largest tilt from where it is wanted and swing left (degrees)."""
    found = PlanSimulation(MODEL, GRIP, tool, tail=2.0).predict(1.0)
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


def numpy_inverse(tool: Trajectory, wanted: Trajectory) -> np.ndarray:
    """
    Return the tool's positions (N, 3), from where a plan begins, under which B moves as wanted.

    As a user would write it for a package that does not turn: 6x6 matrices, a quintic spline
    through the package's positions, and SciPy's DOP853 for the tool's pose.
    """
    model, t = PlainModel(CUP, PACKAGE, 9.81), wanted.seconds
    curve = make_interp_spline(t[::5], wanted.position[::5], 5)
    R_B = wanted.rotation[0]

    def rates(now: float, y: np.ndarray) -> np.ndarray:
        R_E, dv = y[3:].reshape(3, 3), R_B.T @ curve(now, 2)
        v_B = np.concatenate([R_B.T @ curve(now, 1), np.zeros(3)])
        T = np.linalg.inv(transform(R_E, y[:3])) @ transform(R_B, curve(now))
        R, E_o_S = T[:3, :3], T[:3, 3] + T[:3, :3] @ model.B_o_S
        o = model.z + R @ model.z + E_o_S
        strain = np.concatenate([o + R.T @ o, vee(R - R.T)])
        J = upper(R + EYE, hat(R.T @ o), np.trace(R) * EYE - R.T)
        X = adjoint(R, o)
        D = 0.5 * (model.P + X.T @ model.P @ X)
        needed = np.concatenate([model.M[0, 0] * (dv + R_B.T @ [0.0, 0.0, 9.81]), np.zeros(3)])
        spring = -0.25 * J.T @ (model.K @ strain)
        v_S1 = np.linalg.solve(D, spring - np.linalg.solve(model.to_S1.T, needed))
        v_E = adjoint(R, E_o_S + R @ model.z) @ (model.to_S1 @ v_B - v_S1)
        return np.concatenate([R_E @ v_E[:3], (R_E @ hat(v_E[3:])).ravel()])

    y0 = np.concatenate([tool.position[0], tool.rotation[0].ravel()])
    found: np.ndarray = solve_ivp(
        rates, (0.0, float(t[-1])), y0, 'DOP853', t, rtol=ACCURACY, atol=1e-8).y[:3].T
    return found


def numpy_shaped(tool: Trajectory, delays: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the sum of delayed positions (N, 3) at 1 ms, interpolated linearly."""
    t = np.arange(0.0, float(tool.seconds[-1]) + delays.max(), 1.0 / RATE)
    found: np.ndarray = sum(
        size * np.stack([np.interp(t - delay, tool.seconds, axis) for axis in tool.position.T], 1)
        for delay, size in zip(delays, sizes, strict=True))
    return found
