"""Identification and replay of a long recording, against a loop that only reads."""

from collections.abc import Callable, Mapping
from pathlib import Path
import tempfile
import time
from typing import Any

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.workflows.simulate import simulate_recording

from .timing import figures, in_process

RATE = 360.0
DURATION = {False: 600.0, True: 3.0}
"""Of the recording, s: of a full run, and of a short one."""

FIT_DURATION = 20.0
"""Of the recording for the fit by output error, s."""

SETTINGS: Mapping[str, Any] = {
    'topics.tool_pose': '/tool_arm/pose',
    'topics.tool_twist': '/tool_arm/twist',
    'topics.package_pose': '/package/pose',
    'package.mass': 1.8,
    'package.inertia': (0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0),
    'package.com': (0.0, 0.0, -0.03),
    'recording.package_frame': 'com',
}

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
    cup = Cup.thesis()
    return {
        **SETTINGS,
        'cup.length': cup.length,
        'cup.stiffness': tuple(cup.stiffness.ravel().tolist()),
        'cup.damping': tuple(cup.damping.ravel().tolist()),
    }


def run(short: bool) -> dict[str, Any]:
    """Return seconds, bytes and ratios."""
    duration, rounds = DURATION[short], 1 if short else 3
    with tempfile.TemporaryDirectory() as folder:
        bag, fit_bag = Path(folder) / 'long', Path(folder) / 'fit'
        make_recording(bag, duration)
        make_recording(fit_bag, min(duration, FIT_DURATION))
        found = _in_turn(str(bag), str(fit_bag), rounds)
    found['output_error_recorded'] = min(duration, FIT_DURATION)
    found['recording'] = {'seconds': duration, 'rate_hz': RATE, 'messages': found['messages']}
    return found


def motion(duration: float, seed: int = 1) -> dict[str, Any]:
    """Return the content of a motion file: all axes at once, noise, a twist."""
    return {
        'kind': 'multi_sine', 'duration': duration, 'rest_duration': 1.0, 'ramp_duration': 1.0,
        'seed': seed,
        'multi_sine': {
            'position': {
                axis: {'amplitude': [0.05, 0.01, 0.003], 'frequency': [0.3 + shift, 1.1, 3.1]}
                for axis, shift in (('x', 0.0), ('y', 0.07), ('z', 0.03))
            },
            'rotation': {
                axis: {'amplitude': [0.10, 0.04], 'frequency': [0.4 + shift, 1.5 - shift]}
                for axis, shift in (('x', 0.0), ('y', 0.05), ('z', 0.11))
            },
        },
        'tool': {
            'rate_hz': RATE, 'noise': {'position': 2e-5, 'rotation': 5e-5},
            'twist': {'publish': True, 'frame': 'world'},
        },
        'package': {
            'rate_hz': RATE, 'frame': 'com', 'noise': {'position': 1e-4, 'rotation': 5e-4},
        },
        'storage': 'mcap',
    }


def make_recording(bag: Path, duration: float, seed: int = 1) -> None:
    """Simulate a recording, with its parameter file beside it."""
    simulate_recording(parameters(), motion(duration, seed), bag)
    write_parameters(f'{bag}.yaml', parameters())


def _in_turn(bag: str, fit_bag: str, rounds: int) -> dict[str, Any]:
    """Return times, peaks and how fast the predictions of a replay are."""
    works: Mapping[str, Callable[[], dict[str, Any]]] = {
        'plain_loop': lambda: in_process(PLAIN_LOOP, bag),
        'least_squares': lambda: in_process(IDENTIFY, bag, 'least_squares'),
        'replay': lambda: _replay(bag),
        'output_error': lambda: in_process(IDENTIFY, fit_bag, 'output_error'),
    }
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
        'replay_factor': figures([run['factor'] for run in runs['replay']]),
    }


def _replay(bag: str) -> dict[str, Any]:
    """Return the time of the whole command, from the start of the interpreter to its end."""
    start = time.perf_counter()
    found = in_process(REPLAY, bag, f'{bag}.json')
    return {**found, 'seconds': time.perf_counter() - start}
