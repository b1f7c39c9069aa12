"""Code that is measured in an interpreter of its own."""

from collections.abc import Mapping
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from bellows_ros.errors import BellowsError

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT = 600.0

HEAD = """
import json, sys, time
def done(**figures):
    with open('/proc/self/status') as status:  # not ru_maxrss, which starts at the parent's
        peak = next(int(line.split()[1]) / 1024 for line in status if line.startswith('VmHWM'))
    print(json.dumps({'done': time.monotonic(), 'processor': time.process_time(), 'peak': peak}
                     | figures))
"""

READY = """
import bellows_ros.nodes.predictor_node
import rclpy
rclpy.init()
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.nodes.pipeline import compile_all
compile_all(resolve({'package.mass': 2.17, 'package.com': [0.0, 0.0, -0.03],
                     'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]}))
done()
"""
"""The predictor, from the start of the interpreter to the first possible prediction."""

IMPORTS = """
import numba, numpy, rclpy
done()
"""


def in_process(
    code: str, *arguments: str, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """
    Run code in an interpreter and return the figures by `done`: s, s and MiB.

    Raises
    ------
    BellowsError
        If it fails.

    """
    done = subprocess.run(
        [sys.executable, '-P', '-c', HEAD + code, *arguments],
        env={**same_package(), **(environment or {})},
        capture_output=True, text=True, timeout=TIMEOUT, check=False)
    if done.returncode:
        raise BellowsError(f'A measurement failed: {done.stderr.strip()[-800:]}')
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def same_package() -> dict[str, str]:
    """
    Return an environment with this copy of the package, and with the ROS of the shell.

    It keeps Python's bytecode as in a user's environment: a start without takes 1 s longer.
    """
    paths = [str(ROOT), os.environ.get('PYTHONPATH', '')]
    passed = {key: value for key, value in os.environ.items() if key != 'PYTHONDONTWRITEBYTECODE'}
    return {**passed, 'PYTHONPATH': os.pathsep.join(filter(None, paths))}
