"""The node predictor between processes, against a bare node that sends every pose back."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import Any

from bellows_ros.errors import BellowsError
import numpy as np

from .timing import same_package, TIMEOUT

RATES = {False: (125, 500, 1000), True: (125,)}
SECONDS = {False: 7.0, True: 1.0}
ROUNDS = {False: 3, True: 1}
END_TIMEOUT = 10.0

BARE = 'bare'
"""Node that sends every pose back, with the executor of this package's commands."""

RAW = 'bare, bytes'
"""Node that sends every pose back as bytes, with that executor."""

WITHOUT_TWISTS = 'predictor without twists'

PARAMETERS = (
    '-p', 'package.mass:=2.17', '-p', 'package.inertia:=[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]',
    '-p', 'package.com:=[0.0, 0.0, -0.03]')
NODES: Mapping[str, tuple[str, ...]] = {
    BARE: ('benchmarks.echo',), RAW: ('benchmarks.echo', '--raw'),
    WITHOUT_TWISTS: ('bellows_ros.nodes.command', 'predictor', '--ros-args', *PARAMETERS),
    'predictor': ('bellows_ros.nodes.command', 'predictor', '--ros-args', *PARAMETERS)}


def run(short: bool) -> dict[str, Any]:
    """Return latencies (s), processor time per pose (s) and memory (bytes)."""
    results: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for rate in RATES[short]:
            parts: dict[str, list[dict[str, Any]]] = {name: [] for name in NODES}
            for _ in range(ROUNDS[short]):
                for name, runs in parts.items():
                    runs.append(measured(name, rate, SECONDS[short], Path(folder)))
            results += [{'node': name, 'rate_hz': rate, **_medians(runs)}
                        for name, runs in parts.items()]
    return {'runs': results}


def measured(name: str, rate: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Return the figures of one node, measured by the probe."""
    environment = {
        **same_package(), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(folder),
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)}
    with process(NODES[name], environment, folder / f'{name}.log') as pid:
        probe = subprocess.run(
            [sys.executable, '-P', '-m', 'benchmarks.probe', str(rate), str(seconds), str(pid),
             *(['poses'] if name == WITHOUT_TWISTS else [])],
            env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    if probe.returncode:
        log = (folder / f'{name}.log').read_text(errors='replace')[-400:]
        raise BellowsError(f'Measuring {name} failed: {probe.stderr.strip()[-400:]} {log}')
    result: dict[str, Any] = json.loads(probe.stdout.splitlines()[-1])
    return result


@contextmanager
def process(
    module: tuple[str, ...], environment: Mapping[str, str], log: Path
) -> Iterator[int]:
    """Run a node and yield its process id."""
    with log.open('wb') as output:
        running = subprocess.Popen(
            [sys.executable, '-P', '-m', *module], env=dict(environment),
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield running.pid
    finally:
        running.send_signal(signal.SIGINT)
        try:
            running.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


def _medians(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Return medians over runs of percentiles, processor time and memory, and lost messages."""
    percentiles = np.array([np.percentile(run['latency'], [50.0, 99.0, 99.9]) for run in runs])
    p50, p99, p999 = np.median(percentiles, axis=0).tolist()
    per_pose = [run['processor_seconds'] / max(run['answered'], 1) for run in runs]
    return {
        'p50': p50, 'p99': p99, 'p99.9': p999, 'processor_per_pose': float(np.median(per_pose)),
        'memory': float(np.median([run['memory'] for run in runs])),
        'sent': sum(run['sent'] for run in runs),
        'lost': sum(run['sent'] - run['answered'] for run in runs)}
