"""
A short form of the benchmarks: ratios of processor times within one run, against wide bounds.

    python -m benchmarks.quick

It takes less than a minute on an idle machine, and fails where a figure exceeds its bound, about
twice the usual value.
"""

from collections.abc import Callable
from pathlib import Path
import sys
import tempfile
from typing import Any

from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.simulate import simulate_recording

from .processes import IMPORTS, in_process, READY, ROOT

DURATION = 60.0
"""Duration of the recording, s."""

BOUNDS = {
    'least squares with verdict / rosbags reading': 6.0, 'bellows replay / rosbags reading': 10.0,
    'memory of least squares (MiB)': 300.0, 'memory of bellows replay (MiB)': 420.0,
    'predictor ready / its imports of numba, numpy and rclpy': 4.2,
    'predictor ready, nothing compiled / compiled before': 80.0,
    'memory of the predictor when ready (MiB)': 250.0}
"""Greatest ratios: twice the measured values, or slightly above them for memory."""

READ = """
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores
used = time.process_time()
with AnyReader([Path(sys.argv[1])], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
    for connection, _, data in reader.messages():
        reader.deserialize(data, connection.msgtype)
done(processor=time.process_time() - used)
"""

IDENTIFY = """
from bellows_ros.core import configure_process
configure_process()
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
bag, = sys.argv[1:]
used = time.process_time()
identify({**read_parameters(bag + '.yaml'), 'bags': [bag], 'fit.method': 'least_squares'})
done(processor=time.process_time() - used)
"""

REPLAY = """
from bellows_ros.cli import main
bag, = sys.argv[1:]
if main(['replay', bag, '--params', bag + '.yaml', '--json', bag + '.json']):
    sys.exit('bellows replay failed')
done()
"""


def make_recording(bag: Path) -> None:
    """Simulate a recording, with its parameter file beside it."""
    parameters = {**read_parameters(ROOT / 'bags' / 'package.yaml'),
                  **read_parameters(ROOT / 'config' / 'cup_thesis.yaml')}
    motion = load(ROOT / 'bags' / 'identification.yaml')
    simulate_recording(parameters, {**motion, 'duration': DURATION}, bag)
    write_parameters(f'{bag}.yaml', parameters)


def run() -> dict[str, float]:
    """Return the figures by the names of `BOUNDS`."""
    with tempfile.TemporaryDirectory() as folder:
        bag, cache = Path(folder) / 'bag', {'NUMBA_CACHE_DIR': f'{folder}/cache'}
        make_recording(bag)
        cold = in_process(READY, environment=cache)
        ready = _best(lambda: in_process(READY, environment=cache))
        imports = _best(lambda: in_process(IMPORTS))
        reading, fit, replay = (
            _best(lambda code=code: in_process(code, str(bag)))  # type: ignore[misc]
            for code in (READ, IDENTIFY, REPLAY))
    return dict(zip(BOUNDS, (
        fit['processor'] / reading['processor'], replay['processor'] / reading['processor'],
        fit['peak'], replay['peak'], ready['processor'] / imports['processor'],
        cold['processor'] / ready['processor'], ready['peak']), strict=True))


def _best(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the run of two with less processor time; the first may compile."""
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
