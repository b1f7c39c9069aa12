"""One step of the model, compiled and interpreted."""

from typing import Any

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.model.simulation import simulate_rows
import numpy as np

from .paths import shaken_tool
from .step_case import MODEL, start
from .timing import figures, in_process, interleaved, Work

RATE = 360.0

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
    """Return seconds per step."""
    count = (500 if short else 20_000) if COMPILED else 100
    steps = interleaved({'compiled' if COMPILED else 'interpreted': our_steps(count)},
                        3 if short else 15, units=count - 1)
    if COMPILED:
        steps['interpreted'] = figures([
            in_process(INTERPRETED, environment={'NUMBA_DISABLE_JIT': '1'})
            for _ in range(1 if short else 3)])
    return {'seconds': steps}


def our_steps(count: int) -> Work:
    """Return the work of so many tool samples (steps with Hermite motion), less one."""
    tool, begin = shaken_tool(count, RATE), start()
    durations, once = np.full(count - 1, 1.0 / RATE), np.ones(count - 1, dtype=np.int64)

    return lambda: simulate_rows(MODEL, begin, tool, durations, once)
