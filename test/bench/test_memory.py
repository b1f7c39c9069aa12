"""Memory of least squares and of replay: it grows no faster than the recording's arrays."""

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

REPLAY = """
import json, sys, tracemalloc
from bellows_ros.bench.offline import parameters
from bellows_ros.workflows.replay import replay
peaks = []
for bag in [sys.argv[1], *sys.argv[1:]]:
    tracemalloc.start()
    poses = replay(bag, parameters()).counts['poses']
    peaks.append((poses, tracemalloc.get_traced_memory()[1]))
    tracemalloc.stop()
print(json.dumps(peaks[1:]))
"""

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: simulating this takes minutes')


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Return recordings of 5, 10 and 20 s."""
    folder = tmp_path_factory.mktemp('memory')
    made = [folder / f'{seconds}' for seconds in (5, 10, 20)]
    for bag in made:
        make_recording(bag, float(bag.name))
    return list(map(str, made))


def test_peak_grows_as_the_recording_does(bags):
    one, two, four = in_process(PEAK, *bags)['peaks']
    assert 0 < two - one
    assert four - two < 2.2 * (two - one)


def test_replay_keeps_numbers_and_no_objects(bags):
    (few, small), (many, large) = in_process(REPLAY, *bags[1:])
    # A pose, its twist and its prediction are 27 numbers, 0.2 kB; as tuples of Python's floats
    # they would be more than ten times that. What is read and prepared takes some 1 kB.
    assert large - small < 2000 * (many - few)
