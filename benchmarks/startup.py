"""Startup time of the predictor with a warm and with a cold cache."""

import tempfile
import time
from typing import Any

from .offline import PEAK
from .timing import figures, in_process

# From the start of the interpreter to the first prediction that could be made.
READY = PEAK + """
import json, time
from benchmarks.step_case import CUP, PACKAGE
import bellows_ros.nodes.predictor_node
import rclpy
rclpy.init()
from bellows_ros.core.live import warm_up
warm_up(CUP, PACKAGE, 9.81, 'world')
print(json.dumps({'done': time.monotonic(), 'processor': time.process_time(), 'peak': peak()}))
"""

# Kernels of all topics, which the predictor compiles in a process of its own.
TOPICS = """
import json, time
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.nodes.pipeline import compile_topics
compile_topics(resolve(read_parameters('bags/tossing.yaml'), ()))
print(json.dumps({'processor': time.process_time()}))
"""


IMPORTS = """
import json, time
import numba, numpy, rclpy
print(json.dumps({'done': time.monotonic(), 'processor': time.process_time()}))
"""


def run(short: bool) -> dict[str, Any]:
    """Return durations (s) of starts with an empty cache, and of warm starts after each."""
    imports, cold, warm = [], [], []
    repeats = 1 if short else 3
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            cache = {'NUMBA_CACHE_DIR': folder}
            cold.append(_ready(READY, cache))
            for _ in range(repeats):
                warm.append(_ready(READY, cache))
                imports.append(_ready(IMPORTS, cache))
    return {'seconds': {
        'numba, numpy and rclpy imported': figures(imports),
        'predictor ready with ROS, compiled before': figures(warm),
        'predictor ready with ROS, nothing compiled': figures(cold)}}


def _ready(code: str, environment: dict[str, str]) -> float:
    """Return the time (s) from the start of an interpreter to the end of its code."""
    start = time.monotonic()
    return float(in_process(code, environment=environment)['done']) - start
