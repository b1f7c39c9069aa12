"""The node predictor between processes, against bare nodes that send every pose back."""

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

RATES = {False: (125, 500), True: (125,)}
SECONDS = {False: 7.0, True: 1.0}
LONG = 60.0
"""Of the single run at the highest rate in which nothing may be lost, s."""
ROUNDS = {False: 3, True: 1}
CYCLES = {False: 6, True: 1}
"""In the first half of each a camera corrects."""
END_TIMEOUT = 10.0

BARE = 'bare'
"""A node spun with `rclpy.spin`, ..."""
EVENTS = 'bare, events'
"""... and the same spun as the commands of this package spin theirs."""
PREDICTOR = 'predictor'
HEARD = 'predictor, twist and wrench heard'
"""Only what somebody listens to is published, beside the pose."""
CAMERA = 'predictor, corrected at 30 Hz half of the time'
"""The sender gives some answers back as measured poses."""

PARAMETERS = (
    '-p', 'package.mass:=2.17',
    '-p', 'package.inertia:=[0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0]',
    '-p', 'package.com:=[0.0, 0.0, -0.03]',
)
NODES: Mapping[str, tuple[str, ...]] = {
    BARE: ('benchmarks.echo',),
    EVENTS: ('benchmarks.echo', 'events'),
    PREDICTOR: ('bellows_ros.nodes.predictor', '--ros-args', *PARAMETERS),
    HEARD: ('bellows_ros.nodes.predictor', '--ros-args', *PARAMETERS),
    CAMERA: ('bellows_ros.nodes.predictor', '--ros-args', *PARAMETERS),
}


def run(short: bool) -> dict[str, Any]:
    """Return latencies (s), processor time per pose (s) and memory (bytes)."""
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for rate in RATES[short]:
            parts: dict[str, list[dict[str, Any]]] = {
                name: [] for name in (BARE, EVENTS, PREDICTOR, HEARD)}
            for _ in range(ROUNDS[short]):
                for name, runs in parts.items():
                    runs.append(measured(name, rate, SECONDS[short], True, Path(folder)))
            found += _figures(parts, rate, True, SECONDS[short])
        if not short:
            rate = max(RATES[short])
            parts = {
                name: [measured(name, rate, LONG, True, Path(folder))]
                for name in (BARE, PREDICTOR)
            }
            found += _figures(parts, rate, True, LONG)
    return {'runs': found}


def with_a_camera(rate: int, short: bool) -> dict[str, Any]:
    """
    Return the figures with and without a camera, and ratios of latencies.

    `p50` and `p99` are medians over the cycles of the node that has a camera: while it corrects to
    while it does not. What else a machine does changes less within a run than from run to run.
    `to_without` is the p50 of such runs to that of a node that never had a camera.
    """
    seconds = SECONDS[short]
    parts: dict[str, list[dict[str, Any]]] = {PREDICTOR: [], CAMERA: []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(ROUNDS[short]):
            for name, heard, cycles in (
                    (PREDICTOR, 'pose', 1), (CAMERA, f'camera,{seconds}', CYCLES[short])):
                parts[name].append(
                    measured(name, rate, cycles * seconds, True, Path(folder), heard))
    p50, p99 = np.median(
        [pair for run in parts[CAMERA] for pair in halves(run, seconds)], axis=0).tolist()
    without, both = ([np.median(run['latency']) for run in runs] for runs in parts.values())
    return {'runs': _figures(parts, rate, True, seconds), 'p50': p50, 'p99': p99,
            'to_without': float(np.median(np.divide(both, without)))}


def halves(run: Mapping[str, Any], cycle: float) -> list[np.ndarray]:
    """Return p50 and p99 of the latencies in the first half of each cycle to the second half."""
    latency, (number, phase) = np.array(run['latency']), np.divmod(run['stamps'], cycle)
    with_, without = phase < 0.5 * cycle, phase > 0.5 * cycle
    return [
        np.percentile(latency[(number == k) & with_], [50.0, 99.0])
        / np.percentile(latency[(number == k) & without], [50.0, 99.0])
        for k in np.unique(number[without])]


def measured(
    name: str, rate: int, seconds: float, twists: bool, folder: Path, heard: str = 'pose'
) -> dict[str, Any]:
    """Return what the probe finds of one node; `heard` as the probe has it."""
    environment = {
        **same_package(),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(folder),
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
    }
    with _process(NODES[name], environment, folder / f'{name}.log') as pid:
        sent = 'twists' if twists else 'poses'
        heard = 'all' if name == HEARD else heard
        arguments = [str(rate), str(seconds), sent, heard, str(pid)]
        probe = subprocess.run(
            [sys.executable, '-P', '-m', 'benchmarks.probe', *arguments],
            env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False,
        )
    if probe.returncode:
        log = (folder / f'{name}.log').read_text(errors='replace')[-400:]
        raise BellowsError(f'Measuring {name} failed: {probe.stderr.strip()[-400:]} {log}')
    result: dict[str, Any] = json.loads(probe.stdout.splitlines()[-1])
    return result


@contextmanager
def _process(
    module: tuple[str, ...], environment: Mapping[str, str], log: Path
) -> Iterator[int]:
    """Run a node and yield its process id."""
    with log.open('wb') as output:
        process = subprocess.Popen(
            [sys.executable, '-P', '-m', *module], env=dict(environment),
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        )
    try:
        yield process.pid
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(END_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _figures(
    parts: Mapping[str, list[dict[str, Any]]], rate: int, twists: bool, seconds: float
) -> list[dict[str, Any]]:
    """Return the figures of each node's repeated runs."""
    return [
        {
            'node': name, 'rate_hz': rate, 'twists': twists, 'seconds': seconds,
            'runs': len(runs), **_medians(runs),
        }
        for name, runs in parts.items()
    ]


def _medians(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Return the medians of each run's percentiles and processor time, and what was lost."""
    percentiles = np.array([np.percentile(run['latency'], [50.0, 99.0, 99.9]) for run in runs])
    p50, p99, p999 = np.median(percentiles, axis=0).tolist()
    per_pose = [run['processor_seconds'] / max(run['answered'], 1) for run in runs]
    return {
        'p50': p50,
        'p99': p99,
        'p99.9': p999,
        'processor_per_pose': float(np.median(per_pose)),
        'memory': max(run['memory'] for run in runs),
        'sent': sum(run['sent'] for run in runs),
        'lost': sum(run['sent'] - run['answered'] for run in runs),
    }
