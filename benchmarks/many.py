"""
Many recordings: time and memory of each, and one K to the last digit from any number of workers.

    python -m benchmarks.many [COUNT [SECONDS]]

By default 200 recordings of 26 s: about an hour on two cores. The recordings are simulated in a
temporary folder. They are fitted by two processes and by a Dask cluster of two workers, one of
which is killed during the search.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from bellows_ros.core.identification.estimate import evaluated, measured_courses
from bellows_ros.core.identification.pool import Held
from bellows_ros.core.identification.quantities import given_std
from bellows_ros.core.identification.segments import measured_segments, segments_of
from bellows_ros.core.identification.unknowns import Problem
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import one_cup_of
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.recordings import load as load_recording
from bellows_ros.workflows.simulate import simulate_recording

from .offline import parameters, PEAK, ROOT
from .tables import MEBI
from .timing import in_process

COUNT = 200
"""Number of recordings."""

SECONDS = 26.0
"""Duration of each recording, s."""

COUNTS = (1, 12, 48)
"""Numbers of recordings in one problem."""

RATES = {'tool': {'rate_hz': 125.0}, 'package': {'rate_hz': 125.0}}
"""Rates of the recorded poses, Hz."""

LIMIT_S = 7200.0
"""Longest time of one fit, s."""

FIT = PEAK + """
import contextlib, json, os, resource, signal, sys, time
from bellows_ros.core import configure_process
configure_process()
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
folder, count, address, killed = sys.argv[1:]
marks = {}

def own():
    for process in filter(str.isdigit, os.listdir('/proc')):
        with contextlib.suppress(OSError), open(f'/proc/{process}/stat') as file, open(
                f'/proc/{process}/cmdline') as line:
            if int(file.read().rpartition(')')[2].split()[1]) == os.getpid() and (
                    'spawn_main' in line.read()):
                return int(process)

def progress(what, part=0.0):
    marks.setdefault(what.split()[0], time.perf_counter())
    if killed and what.startswith('step 3') and 'killed' not in marks:
        marks['killed'] = own() if killed == 'own' else int(killed)
        os.kill(marks['killed'], signal.SIGKILL)

values = {**read_parameters(f'{folder}/parameters.yaml'), 'fit.method': 'output_error',
          'bags': [f'{folder}/{number}' for number in range(int(count))]}
start = time.perf_counter()
result = identify(values, progress, dask=address) if address else identify(
    values, progress, jobs=2)
end = time.perf_counter()
print(json.dumps({
    'peak': peak(), 'worker': 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
    'seconds': end - start, 'processor': sum(os.times()[:4]),
    'reading': marks['fitting'] - start,
    'steps': len(result.fit.iterations), 'killed': 'killed' in marks,
    'search': marks['testing'] - marks['fitting'],
    'K': [number.hex() for number in result.fit.parameters.tolist()],
    'std': [number.hex() for number in result.fit.covariance.diagonal().tolist()]}))
"""


def make(folder: Path, count: int, seconds: float) -> None:
    """Simulate recordings, and write their parameters."""
    motion = load(ROOT / 'bags' / 'identification.yaml') | {'duration': seconds}
    motion = {**motion, **{body: {**motion[body], **rate} for body, rate in RATES.items()}}
    for number in range(count):
        simulate_recording(parameters(), {**motion, 'seed': number}, folder / str(number))
    write_parameters(folder / 'parameters.yaml', parameters())


def scaling(folder: Path, counts: Sequence[int]) -> list[dict[str, float]]:
    """Return time and memory of one step, for each recording, by the number of recordings."""
    values = resolve(parameters())
    parts = [segments_of(measured_segments(load_recording(folder / str(number), values), number))
             for number in range(max(counts))]
    rows = []
    for count in counts:
        problem = Problem.of(
            [segment for own in parts[:count] for segment in own],
            structure_named('axisymmetric'), one_cup_of(values), given_std(values))
        courses = measured_courses(problem)
        used = min(_processor(problem, courses) for _ in range(2))
        rows.append({'recordings': count, 'seconds': used / count,
                     'unknowns': len(problem.index(0))})
    return rows


def _processor(problem: Problem, courses: Held) -> float:
    """Return the processor time of a step, s."""
    begin = time.process_time()
    evaluated(problem, problem.start, courses)
    return time.process_time() - begin


def fits(folder: Path, count: int) -> dict[str, dict[str, Any]]:
    """Return K, time and peak memory of the client, by route."""
    import distributed

    start: Callable[..., Any] = distributed.LocalCluster

    def by(address: str = '', killed: str = '') -> dict[str, Any]:
        print(f'fitting {count} recordings', file=sys.stderr, flush=True)
        return in_process(FIT, str(folder), str(count), address, killed, timeout=LIMIT_S)

    routes = {'two processes': by(), 'two processes, one killed': by(killed='own')}
    with start(
            n_workers=2, threads_per_worker=1, host='127.0.0.1', scheduler_port=0,
            dashboard_address=None, local_directory=folder / 'dask') as cluster:
        worker = next(iter(cluster.workers.values()))
        routes['two Dask workers, one killed'] = by(cluster.scheduler_address, str(worker.pid))
    return routes


def run(count: int, seconds: float, counts: Sequence[int] = COUNTS) -> dict[str, Any]:
    """Return the figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make(folder, max(count, *counts), seconds)
        return {'scaling': scaling(folder, counts), 'fits': fits(folder, count)}


def main() -> None:
    """Print the figures."""
    count, seconds = int((sys.argv + [''])[1] or COUNT), float((sys.argv + ['', ''])[2] or SECONDS)
    found = run(count, seconds)
    for row in found['scaling']:
        print(f'{row["recordings"]:3} recordings: {row["seconds"]:.3f} s with '
              f'{row["unknowns"]} unknowns each')
    for name, fit in found['fits'].items():
        print(f'{name}: {fit["seconds"]:.0f} s, {fit["reading"]:.0f} s of these for reading and '
              f'{fit["search"]:.0f} s for {fit["steps"]} steps and the errors; processor '
              f'{fit["processor"]:.0f} s; client {fit["peak"] / MEBI:.0f} MiB, largest process '
              f'{fit["worker"] / MEBI:.0f} MiB')
        print('  K, P:', *(f'{float.fromhex(number):.17g}' for number in fit['K']))


if __name__ == '__main__':
    main()
