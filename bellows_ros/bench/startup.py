"""How long commands and the predictor take to start, with a warm and with a cold cache."""

import subprocess
import sys
import tempfile
import time
from typing import Any

from .timing import figures, in_process, same_package

HELP = 'from bellows_ros.cli import main; import sys; sys.argv = ["bellows", "--help"]; main()'

# From the start of the interpreter to the first prediction that could be made.
READY = """
import json, sys, time
from bellows_ros.bench.step_case import CUP, PACKAGE
if sys.argv[1] == 'ros':
    import bellows_ros.nodes.predictor_node
    import rclpy
    rclpy.init()
from bellows_ros.core.live import warm_up
warm_up(CUP, PACKAGE, 9.81, 'world')
print(json.dumps({'done': time.monotonic()}))
"""


def run(short: bool) -> dict[str, Any]:
    """Return seconds: of starts with nothing compiled, and of some after each of them."""
    kind = 'ros' if _has_ros() else 'core'
    helped, cold, warm = [], [], []
    for _ in range(1 if short else 3):
        with tempfile.TemporaryDirectory() as folder:
            cache = {'NUMBA_CACHE_DIR': folder}
            cold.append(_ready(kind, cache))
            for _ in range(3):
                warm.append(_ready(kind, cache))
                helped.append(_help())
    return {
        'help': figures(helped),
        'predictor_warm': figures(warm),
        'predictor_cold': figures(cold),
        'with_ros': kind == 'ros',
    }


def _help() -> float:
    """Return the time of `bellows --help`."""
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, '-P', '-c', HELP], env=same_package(), check=True, capture_output=True
    )
    return time.perf_counter() - start


def _ready(kind: str, environment: dict[str, str]) -> float:
    """Return the time until the predictor's code could predict."""
    start = time.monotonic()
    return float(in_process(READY, kind, environment=environment)['done']) - start


def _has_ros() -> bool:
    """Tell whether the nodes can run here."""
    code = 'import json\ntry:\n import rclpy\nexcept ImportError:\n print(0)\nelse:\n print(1)'
    return bool(in_process(code))
