"""One step of the model, and accuracy against cost, side by side."""

from collections.abc import Callable
from pathlib import Path
import tempfile
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.model.cup_package import STANDARD_GRAVITY
from bellows_ros.core.model.simulation import simulate_rows
from bellows_ros.errors import BellowsError
import numpy as np

from .c_kernel import CKernel
from .plain_numpy import PlainModel
from .step_case import CUP, MODEL, PACKAGE, shaken_tool, start, still_tool
from .timing import figures, in_process, interleaved, Work

Pose = tuple[Array, Array]
"""Position (3,), m, and rotation (3, 3) at the end of the free motion."""
End = Callable[[], Pose]
Case = tuple[str, float, End, Pose]
"""A method, its rate (Hz) or tolerance, what it comes to, and the truth."""

RATE = 360.0
OURS = 'bellows_ros, compiled' if COMPILED else 'bellows_ros, interpreted'
C_OPTIONS = {
    'C, gcc -O3': ('-O3',),
    'C, gcc -O3 -march=native': ('-O3', '-march=native', '-ffp-contract=fast'),
}
SECONDS = 1.0
"""Simulated for the accuracy, s."""

INTERPRETED = """
import json, time
from benchmarks.step import our_steps
steps = our_steps(200)
steps()
start = time.perf_counter()
steps()
print(json.dumps((time.perf_counter() - start) / 199))
"""


def run(short: bool) -> dict[str, Any]:
    """Return microseconds per step, and errors against milliseconds per simulated second."""
    missing: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        steps = interleaved(_subjects(Path(folder), missing, short), 3 if short else 15)
    if COMPILED:
        seconds = [
            in_process(INTERPRETED, environment={'NUMBA_DISABLE_JIT': '1'})
            for _ in range(1 if short else 3)
        ]
        steps['bellows_ros, interpreted'] = figures(seconds)
    return {
        'seconds_per_step': steps,
        'accuracy': _accuracy(short),
        'missing': missing,
    }


def our_steps(count: int) -> Work:
    """Return the work of so many tool samples (steps with Hermite motion), less one."""
    tool, begin = shaken_tool(count, RATE), start()
    durations, once = np.full(count - 1, 1.0 / RATE), np.ones(count - 1, dtype=np.int64)

    def work() -> int:
        simulate_rows(MODEL, begin, tool, durations, once)
        return count - 1

    return work


def _subjects(folder: Path, missing: dict[str, str], short: bool) -> dict[str, Work]:
    """Return what is timed step by step."""
    many, some, few = (500, 100, 10) if short else (20_000, 2000, 200)
    subjects = {OURS: our_steps(many if COMPILED else some)}
    for name, options in C_OPTIONS.items():
        try:
            subjects[name] = _c_steps(CKernel(folder, options), many)
        except BellowsError as error:
            missing[name] = str(error)
    plain, state = PlainModel(CUP, PACKAGE, STANDARD_GRAVITY), _plain_start()
    subjects['NumPy, 6x6 matrices, RK4'] = lambda: _counted(plain.rk4(state, 1.0 / RATE, few), few)
    seconds = few / RATE
    subjects['SciPy solve_ivp, RK45'] = lambda: plain.solve(state, seconds, 'RK45', 1e-6)[1]
    return subjects


def _c_steps(kernel: CKernel, count: int) -> Work:
    """Return the work of `our_steps` by C."""
    tool, begin, durations = shaken_tool(count, RATE), start(), np.full(count - 1, 1.0 / RATE)
    return lambda: _counted(kernel.simulate(MODEL, begin, tool, durations), count - 1)


def _counted(result: Array, units: int) -> int:
    """Return the units of a result that is not looked at."""
    return units


def _plain_start() -> Array:
    """Return the start as `PlainModel` takes it."""
    position, quaternion, _, _ = start()
    R = quaternion_to_rotation(np.array(quaternion))
    return np.concatenate([position, R.ravel(), np.zeros(6)])


def _accuracy(short: bool) -> list[dict[str, Any]]:
    """Return for methods and step sizes the cost and the error after the free motion."""
    rates = (128, 256) if short else (128, 512, 2048)
    plain, state = PlainModel(CUP, PACKAGE, STANDARD_GRAVITY), _plain_start()
    truth = _pose(plain.solve(state, SECONDS, 'DOP853', 1e-13)[0])
    cases: list[Case] = [(OURS, rate, _ours_free(rate), truth) for rate in rates]
    cases += [
        ('NumPy, 6x6 matrices, RK4', rate,
         lambda rate=rate: _pose(plain.rk4(state, SECONDS / rate, rate)), truth)
        for rate in rates[:2]
    ]
    cases += [
        ('SciPy solve_ivp, RK45', rtol,
         lambda rtol=rtol: _pose(plain.solve(state, SECONDS, 'RK45', rtol)[0]), truth)
        for rtol in ((1e-4,) if short else (1e-3, 1e-7))
    ]
    timed = interleaved({f'{case[0]} {case[1]}': _once(case[2]) for case in cases}, 3)
    return [_row(*case, timed[f'{case[0]} {case[1]}']['median']) for case in cases]


def _ours_free(rate: int) -> End:
    """Return the free motion at a rate by this package."""
    tool, begin = still_tool(rate + 1), start()
    durations, once = np.full(rate, SECONDS / rate), np.ones(rate, dtype=np.int64)

    def end() -> Pose:
        row = simulate_rows(MODEL, begin, tool, durations, once)[-1]
        return row[:3], quaternion_to_rotation(row[3:7])

    return end


def _row(name: str, setting: float, end: End, truth: Pose, seconds: float) -> dict[str, Any]:
    """Return what a method costs (s) and errs at one rate (Hz) or tolerance."""
    position, R = end()
    return {
        'method': name,
        'setting': setting,
        'seconds_per_simulated_second': seconds / SECONDS,
        'position_error': float(np.linalg.norm(position - truth[0])),
        'rotation_error': float(np.linalg.norm(log_so3(truth[1].T @ _nearest(R)))),
    }


def _once(end: End) -> Work:
    """Return the work of coming to the end once."""

    def work() -> int:
        end()
        return 1

    return work


def _nearest(matrix: Array) -> Array:
    """Return the rotation nearest to a matrix: plain RK4 leaves SO(3)."""
    U, _, Vt = np.linalg.svd(matrix)
    return np.asarray(U @ Vt)


def _pose(state: Array) -> Pose:
    """Return position and rotation of a state of `PlainModel`."""
    return state[:3], state[3:12].reshape(3, 3)
