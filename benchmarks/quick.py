"""
A short form of the benchmarks: ratios of processor times within one run, against wide bounds.

    python -m benchmarks.quick [--cold]

It takes less than a minute on an idle machine, and fails where a figure exceeds its bound, about
twice the usual value. With --cold it measures, in some minutes, commands with an empty cache, in
units of a rosbags loop over ten minutes of recording.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
import sys
import tempfile
from typing import Any

from .offline import IDENTIFY, make_recording, PLAIN_LOOP, REPLAY
from .startup import IMPORTS, READY, TOPICS
from .tables import MEBI
from .timing import in_process

DURATION = 60.0
"""Duration of the recording, s."""

TEN_MINUTES = 600.0
"""Duration of the recording whose reading is the unit of budgets, s."""

BOUNDS = {
    'least squares with verdict / rosbags reading': 6.0, 'bellows replay / rosbags reading': 10.0,
    'memory of least squares (MiB)': 300.0, 'memory of bellows replay (MiB)': 420.0,
    'predictor ready / its imports of numba, numpy and rclpy': 3.5,
    'predictor ready, nothing compiled / compiled before': 25.0,
    'memory of the predictor when ready (MiB)': 220.0}
"""Greatest ratios: twice the measured values, or slightly above them for memory."""


COMMAND = """
import os, sys
from bellows_ros.cli import main
code = main(sys.argv[1:])
own, children = os.times()[:2], os.times()[2:4]
print('{"processor": %f}' % (sum(own) + sum(children)))
sys.exit(code)
"""

PLANNED = ('--params', 'bags/tossing.yaml')
COLD: Mapping[str, tuple[float, tuple[str, ...]]] = {
    'predictor ready': (1.2, (READY,)), 'kernels of all its topics': (3.0, (TOPICS,)),
    'bellows plan': (2.0, ('plan', 'bags/transport.yaml', *PLANNED)),
    'bellows toss': (2.0, ('toss', 'bags/throw.yaml', *PLANNED, '--release', '2.95')),
    'bellows replay --observe': (5.0, (
        'replay', 'bags/validation', '--params', 'bags/package.yaml', '--params', 'bags/cup.yaml',
        '--observe', '/package/pose')),
    'bellows identify': (5.0, (
        'identify', 'bags/identification', '--params', 'bags/package.yaml'))}
"""Budgets of processor time with an empty cache, in rosbags loops over ten minutes."""


def run_cold(duration: float = DURATION) -> dict[str, float]:
    """Return the figures by the names of `COLD`."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        make_recording(Path(folder) / 'bag', duration)
        loop = _best(lambda: in_process(PLAIN_LOOP, f'{folder}/bag'))['processor']
        loop *= TEN_MINUTES / duration
        for number, (name, (_, arguments)) in enumerate(COLD.items()):
            code = COMMAND if arguments[1:] else arguments[0]
            done = in_process(code, *arguments, environment={
                'NUMBA_CACHE_DIR': f'{folder}/{number}'})
            found[name] = done['processor'] / loop
    return found


def run(duration: float = DURATION) -> dict[str, float]:
    """Return the figures by the names of `BOUNDS`."""
    with tempfile.TemporaryDirectory() as folder:
        bag, cache = Path(folder) / 'bag', {'NUMBA_CACHE_DIR': f'{folder}/cache'}
        make_recording(bag, duration)
        cold = in_process(READY, environment=cache)
        ready = _best(lambda: in_process(READY, environment=cache))
        imports = _best(lambda: in_process(IMPORTS))
        reading = _best(lambda: in_process(PLAIN_LOOP, str(bag)))
        fit = _best(lambda: in_process(IDENTIFY, str(bag), 'least_squares'))
        replay = _best(lambda: in_process(REPLAY, str(bag), f'{bag}.json'))
    return dict(zip(BOUNDS, (
        fit['processor'] / reading['processor'], replay['processor'] / reading['processor'],
        fit['peak'] / MEBI, replay['peak'] / MEBI, ready['processor'] / imports['processor'],
        cold['processor'] / ready['processor'], ready['peak'] / MEBI), strict=True))


def _best(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the run of two with less processor time; the first may compile."""
    return min((measure() for _ in range(2)), key=lambda results: float(results['processor']))


def main() -> int:
    """Print the figures and their bounds; return 1 where one is exceeded."""
    is_cold = '--cold' in sys.argv
    bounds = {name: bound for name, (bound, _) in COLD.items()} if is_cold else BOUNDS
    results = run_cold() if is_cold else run()
    for name, value in results.items():
        mark = '  EXCEEDED' if value > bounds[name] else ''
        print(f'{value:8.2f}  at most {bounds[name]:5g}  {name}{mark}')
    return int(any(value > bounds[name] for name, value in results.items()))


if __name__ == '__main__':
    sys.exit(main())
