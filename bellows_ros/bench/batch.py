"""Many recordings on one and on two cores, and what a recording costs beside its own work."""

from pathlib import Path
import tempfile
from typing import Any

from bellows_ros.errors import BellowsError

from .offline import make_recording
from .timing import in_process

COUNT = {False: 24, True: 4}
DURATION = {False: 30.0, True: 5.0}

MANY = """
import json, sys, time
from bellows_ros.bench.offline import parameters
from bellows_ros.workflows.batch import identify_many, summarise_bag
if __name__ == '__main__':
    jobs, bags = int(sys.argv[1]), sys.argv[2:]
    from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
    summarise_bag(0, bags[0], resolve(parameters(), PACKAGE_PARAMETERS))
    start = time.perf_counter()
    identify_many({**parameters(), 'bags': bags}, jobs)
    print(json.dumps({'seconds': time.perf_counter() - start}))
"""


def run(short: bool) -> dict[str, Any]:
    """Return the seconds of one and two processes, with and without real work."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bags = [folder / str(number) for number in range(COUNT[short])]
        for seed, bag in enumerate(bags, 1):
            make_recording(bag, DURATION[short], seed)
        paths = [str(bag) for bag in bags]
        missing = [str(folder / f'none{number}') for number in range(10 * COUNT[short])]
        try:
            one, two = (in_process(MANY, jobs, *paths)['seconds'] for jobs in ('1', '2'))
            idle = in_process(MANY, '2', paths[0], *missing)['seconds']
        except BellowsError as error:
            return {'missing': str(error)[-200:]}
    return {
        'recordings': COUNT[short],
        'recorded_seconds_each': DURATION[short],
        'seconds_one_job': one,
        'seconds_two_jobs': two,
        'speedup': one / two,
        'overhead_per_recording': idle / len(missing),
    }
