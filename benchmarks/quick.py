"""
A short form of the benchmarks: ratios of processor times within one run, against wide bounds.

    python -m benchmarks.quick

It takes less than a minute on an idle machine, and fails where something takes twice as long or
as much memory as it should.
"""

from collections.abc import Callable
from pathlib import Path
import sys
import tempfile
from typing import Any

from .offline import IDENTIFY, make_recording, PLAIN_LOOP, REPLAY
from .startup import IMPORTS, READY
from .tables import MEBI
from .timing import in_process

DURATION = 60.0
"""Of the recording, s."""

BOUNDS = {
    'least squares with verdict / rosbags reading': 6.0, 'bellows replay / rosbags reading': 10.0,
    'memory of least squares (MiB)': 300.0, 'memory of bellows replay (MiB)': 420.0,
    'predictor ready / its imports of numba, numpy and rclpy': 3.5,
    'predictor ready, nothing compiled / compiled before': 25.0,
    'memory of the predictor when ready (MiB)': 180.0}
"""Twice what is measured, or a little above where memory is concerned."""


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
    """Return the run of two that took the processor less; the first may compile."""
    return min((measure() for _ in range(2)), key=lambda results: float(results['processor']))


def main() -> int:
    """Print the figures and their bounds; return 1 where one is exceeded."""
    results = run()
    for name, value in results.items():
        mark = '  EXCEEDED' if value > BOUNDS[name] else ''
        print(f'{value:8.2f}  at most {BOUNDS[name]:5g}  {name}{mark}')
    return int(any(value > BOUNDS[name] for name, value in results.items()))


if __name__ == '__main__':
    sys.exit(main())
