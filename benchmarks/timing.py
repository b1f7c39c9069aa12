"""Repeated, interleaved measurements: a slow phase of the machine affects all subjects alike."""

from collections.abc import Callable, Mapping, Sequence
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time
from typing import Any

from bellows_ros.errors import BellowsError

Work = Callable[[], Any]

TIMEOUT = 600.0


def interleaved(
    subjects: Mapping[str, Work], rounds: int, clock: Callable[[], float] = time.perf_counter,
    units: int = 1,
) -> dict[str, dict[str, float]]:
    """
    Time subjects in turn, several rounds, and return seconds per unit of each.

    Parameters
    ----------
    subjects : mapping of name to callable
        Called once before the first round, untimed.
    rounds : int
        Number of measurements of each subject.
    clock : callable
        Clock in s; `time.process_time` for processor time.
    units : int
        Number of units in one call.

    Returns
    -------
    dict of name to dict
        'median', 'lowest', 'highest' and 'runs'.

    """
    for work in subjects.values():
        work()
    seconds: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(rounds):
        for name, work in subjects.items():
            start = clock()
            work()
            seconds[name].append((clock() - start) / units)
    return {name: figures(values) for name, values in seconds.items()}


def figures(values: Sequence[float]) -> dict[str, float]:
    """Return the median and the range of repeated measurements."""
    return {
        'median': statistics.median(values), 'lowest': min(values), 'highest': max(values),
        'runs': len(values)}


def in_process(
    code: str, *arguments: str, environment: Mapping[str, str] | None = None,
    timeout: float = TIMEOUT,
) -> dict[str, Any]:
    """
    Run code in an interpreter of its own and return its last line, parsed as JSON.

    Raises
    ------
    BellowsError
        If it fails.

    """
    done = subprocess.run(
        [sys.executable, '-P', '-c', code, *arguments],
        env={**same_package(), **(environment or {})},
        capture_output=True, text=True, timeout=timeout, check=False)
    if done.returncode:
        raise BellowsError(f'A measurement failed: {done.stderr.strip()[-800:]}')
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def same_package() -> dict[str, str]:
    """
    Return an environment with this copy of the package, and with the ROS of the shell.

    It keeps Python's bytecode as in a user's environment: a start without takes 1 s longer.
    """
    paths = [str(Path(__file__).resolve().parents[1]), os.environ.get('PYTHONPATH', '')]
    passed = {key: value for key, value in os.environ.items() if key != 'PYTHONDONTWRITEBYTECODE'}
    return {**passed, 'PYTHONPATH': os.pathsep.join(filter(None, paths))}
