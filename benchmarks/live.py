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

from .processes import same_package, TIMEOUT

RATE_HZ = 1000
END_TIMEOUT = 10.0

NODES: Mapping[str, tuple[str, ...]] = {
    'bare node': ('benchmarks.probe', 'echo'),
    'predictor': (
        'bellows_ros.nodes.command', 'predictor', '--ros-args', '-p', 'package.mass:=2.17', '-p',
        'package.inertia:=[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]', '-p',
        'package.com:=[0.0, 0.0, -0.03]')}


def run(short: bool) -> dict[str, list[float]]:
    """Return latencies and processor time per pose of each round (s)."""
    rounds, seconds = (1, 1.0) if short else (3, 7.0)
    results: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for name in NODES:
                found = measured(name, seconds, Path(folder))
                p50, p99 = np.percentile(found['latency'], [50.0, 99.0]).tolist()
                per_pose = found['processor_seconds'] / max(found['answered'], 1)
                for what, value in (('p50', p50), ('p99', p99), ('processor', per_pose)):
                    results.setdefault(f'{name}, {RATE_HZ} Hz, {what}', []).append(value)
    return results


def measured(name: str, seconds: float, folder: Path) -> dict[str, Any]:
    """Return the figures of one node, measured by the probe."""
    environment = {
        **same_package(), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(folder),
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)}
    with process(NODES[name], environment, folder / f'{name}.log') as pid:
        probe = subprocess.run(
            [sys.executable, '-P', '-m', 'benchmarks.probe', str(RATE_HZ), str(seconds), str(pid)],
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
