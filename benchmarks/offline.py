"""Identification and replay of a long recording, against a loop that only reads."""

from collections.abc import Callable, Mapping
from pathlib import Path
import tempfile
import time
from typing import Any

from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.simulate import simulate_recording

from .timing import figures, in_process

RATE = 360.0
DURATION = {False: 600.0, True: 3.0}
"""Duration of the recording in a full (False) and in a short run (True), s."""

FIT_DURATION = 20.0
"""Duration of the recording for the fit by output error, s."""

ROOT = Path(__file__).resolve().parents[1]

PEAK = """
def peak():  # not ru_maxrss, which a process has from the one that started it
    with open('/proc/self/status') as status:
        return next(1024 * int(line.split()[1]) for line in status if line.startswith('VmHWM'))
"""

PLAIN_LOOP = PEAK + """
import json, sys, time
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores
start, used, count = time.perf_counter(), time.process_time(), 0
with AnyReader([Path(sys.argv[1])], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
    for connection, _, data in reader.messages():
        reader.deserialize(data, connection.msgtype)
        count += 1
print(json.dumps({'seconds': time.perf_counter() - start, 'processor': time.process_time() - used,
                  'peak': peak(), 'messages': count}))
"""

IDENTIFY = PEAK + """
import json, sys, time
from bellows_ros.core import configure_process
configure_process()
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
values = {
    **read_parameters(sys.argv[1] + '.yaml'), 'bags': [sys.argv[1]], 'fit.method': sys.argv[2]}
start, used = time.perf_counter(), time.process_time()
identify(values)
print(json.dumps({'seconds': time.perf_counter() - start, 'processor': time.process_time() - used,
                  'peak': peak()}))
"""

REPLAY = PEAK + """
import json, sys, time
from bellows_ros.cli import main
bag, out = sys.argv[1:]
if main(['replay', bag, '--params', bag + '.yaml', '--json', out]):
    sys.exit('bellows replay failed')
with open(out) as file:
    print(json.dumps({'processor': time.process_time(), 'peak': peak(),
                      'factor': json.load(file)['live']['real_time_factor']}))
"""


def parameters() -> dict[str, Any]:
    """Return the parameters of the recording's package, and of its cup."""
    return {**read_parameters(ROOT / 'bags' / 'package.yaml'),
            **read_parameters(ROOT / 'config' / 'cup_thesis.yaml')}


def run(short: bool) -> dict[str, Any]:
    """Return seconds, bytes and ratios."""
    duration, rounds = DURATION[short], 1 if short else 3
    with tempfile.TemporaryDirectory() as folder:
        bag, fit_bag = Path(folder) / 'long', Path(folder) / 'fit'
        make_recording(bag, duration)
        make_recording(fit_bag, min(duration, FIT_DURATION))
        result = _in_turn(str(bag), str(fit_bag), rounds)
    result['output_error_recorded'] = min(duration, FIT_DURATION)
    result['recording'] = {'seconds': duration, 'rate_hz': RATE, 'messages': result['messages']}
    return result


def make_recording(bag: Path, duration: float, seed: int = 1) -> None:
    """Simulate a recording, with its parameter file beside it."""
    motion = load(Path(__file__).with_name('motion.yaml')) | {'duration': duration, 'seed': seed}
    simulate_recording(parameters(), motion, bag)
    write_parameters(f'{bag}.yaml', parameters())


def _in_turn(bag: str, fit_bag: str, rounds: int) -> dict[str, Any]:
    """Return times, peaks of memory, and the speed of the predictions of a replay."""
    works: Mapping[str, Callable[[], dict[str, Any]]] = {
        'plain_loop': lambda: in_process(PLAIN_LOOP, bag),
        'least_squares': lambda: in_process(IDENTIFY, bag, 'least_squares'),
        'replay': lambda: _replay(bag),
        'output_error': lambda: in_process(IDENTIFY, fit_bag, 'output_error')}
    for work in works.values():
        work()  # compiles, and fills the disk's cache
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            runs[name].append(work())
    return {
        'messages': runs['plain_loop'][0]['messages'],
        **{name: figures([run['seconds'] for run in of]) for name, of in runs.items()},
        **{f'peak_{name}': max(run['peak'] for run in of) for name, of in runs.items()},
        'replay_factor': figures([run['factor'] for run in runs['replay']])}


def _replay(bag: str) -> dict[str, Any]:
    """Return the time of the whole command, from the start of the interpreter to its end."""
    start = time.perf_counter()
    result = in_process(REPLAY, bag, f'{bag}.json')
    return {**result, 'seconds': time.perf_counter() - start}
