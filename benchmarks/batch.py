"""Many recordings on one and on two cores, and what a recording costs beside its own work."""

from pathlib import Path
import tempfile
from typing import Any

from .offline import make_recording
from .timing import Figures, figures, in_process, ratio

COUNT = {False: 24, True: 2}
DURATION = {False: 30.0, True: 3.0}
SMALL_COUNT = {False: 96, True: 2}
SMALL_DURATION = 4.0
"""Of the recordings whose own work is little, s."""
ROUNDS = {False: 3, True: 1}

MANY = """
import json, sys, time
from benchmarks.offline import parameters
from bellows_ros.workflows.identify import identify, read_part
if __name__ == '__main__':
    jobs, bags = int(sys.argv[1]), sys.argv[2:]
    from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
    read_part(bags[0], resolve(parameters(), PACKAGE_PARAMETERS))
    start = time.perf_counter()
    identify({**parameters(), 'bags': bags}, jobs=jobs)
    print(json.dumps({'seconds': time.perf_counter() - start}))
"""

SMALL = """
import json, sys
from benchmarks.offline import parameters
from benchmarks.timing import interleaved
from bellows_ros.workflows.identify import identify
if __name__ == '__main__':
    rounds, bags = int(sys.argv[1]), sys.argv[2:]
    def work(jobs):
        identify({**parameters(), 'bags': bags}, jobs=jobs)
        return len(bags)
    print(json.dumps(interleaved({'one': lambda: work(1), 'two': lambda: work(2)}, rounds)))
"""


def run(short: bool) -> dict[str, Any]:
    """Return the seconds of one and two processes, and of many small recordings."""
    with tempfile.TemporaryDirectory() as name:
        one, two = _in_turn(_recordings(Path(name) / 'long', DURATION[short], COUNT[short]), short)
        small = _recordings(Path(name) / 'small', SMALL_DURATION, SMALL_COUNT[short])
        each = in_process(SMALL, str(ROUNDS[short]), *small)
    return {
        'recordings': COUNT[short],
        'recorded_seconds_each': DURATION[short],
        'one_job': one,
        'two_jobs': two,
        'speedup': ratio(one, two),
        'small': each,
        # where two processes do the work of one recording each, all else is overhead
        'overhead_per_recording': 2.0 * each['two']['median'] - each['one']['median'],
    }


def _recordings(folder: Path, duration: float, count: int) -> list[str]:
    """Return the paths of recordings that differ in their noise, for none counts twice."""
    folder.mkdir()
    bags = [folder / str(number) for number in range(count)]
    for seed, bag in enumerate(bags, 1):
        make_recording(bag, duration, seed)
    return list(map(str, bags))


def _in_turn(bags: list[str], short: bool) -> tuple[Figures, Figures]:
    """Return the times of one process and of two, which are started anew each time."""
    found: dict[str, list[float]] = {'1': [], '2': []}
    for _ in range(ROUNDS[short]):
        for jobs, seconds in found.items():
            seconds.append(in_process(MANY, jobs, *bags)['seconds'])
    return figures(found['1']), figures(found['2'])
