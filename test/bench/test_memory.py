"""Memory of least squares: it grows with the recording no faster than its arrays."""

from bellows_ros.bench.offline import make_recording
from bellows_ros.bench.timing import in_process
from bellows_ros.core.jit import COMPILED
import pytest

PEAK = """
import json, sys, tracemalloc
from bellows_ros.bench.offline import parameters
from bellows_ros.workflows.identify import identify
peaks = []
for bag in [sys.argv[1], *sys.argv[1:]]:
    tracemalloc.start()
    identify({**parameters(), 'bags': [bag], 'fit.method': 'least_squares'})
    peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
print(json.dumps({'peaks': peaks[1:]}))
"""


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: simulating this takes minutes')
def test_peak_grows_as_the_recording_does(tmp_path):
    bags = [tmp_path / f'{seconds}' for seconds in (5, 10, 20)]
    for bag in bags:
        make_recording(bag, float(bag.name))
    one, two, four = in_process(PEAK, *map(str, bags))['peaks']
    assert 0 < two - one
    assert four - two < 2.2 * (two - one)
