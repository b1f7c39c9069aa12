"""Memory of a replay: it grows no faster than the recording's arrays."""

import json
import subprocess
import sys

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.simulate import simulate_recording
import pytest
import yaml

REPLAY = """
import json, sys, tracemalloc
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.replay import replay
known, *bags = sys.argv[1:]
known, peaks = read_parameters(known), []
for number, bag in enumerate([bags[0], *bags]):
    if number:
        tracemalloc.start()
    poses = replay(bag, known).live.counts['poses']
    peaks.append((poses, tracemalloc.get_traced_memory()[1]))
    tracemalloc.stop()
print(json.dumps(peaks[1:]))
"""

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: simulating this takes minutes')


@pytest.fixture(scope='module')
def bags(root, tmp_path_factory):
    """Return recordings of 5 and 10 s."""
    folder = tmp_path_factory.mktemp('memory')
    motion = yaml.safe_load((root / 'bags/identification.yaml').read_text())
    del motion['package']['outliers'], motion['package']['dropouts']
    made = []
    for seconds in (5.0, 10.0):
        made.append(str(folder / f'{seconds:g}'))
        known = read_parameters(root / 'bags/cup.yaml')
        simulate_recording(known, {**motion, 'duration': seconds}, made[-1])
    return made


def test_replay_keeps_numbers_and_no_objects(root, bags):
    done = subprocess.run(
        [sys.executable, '-c', REPLAY, str(root / 'bags/cup.yaml'), *bags], cwd=root,
        capture_output=True, text=True, check=True)
    (few, small), (many, large) = json.loads(done.stdout)
    # A pose, its twist and its prediction are 27 numbers, 0.2 kB; as tuples of Python's floats
    # they would be ten times that. What is read, prepared and simulated takes some 1.8 kB.
    assert large - small < 2000 * (many - few)
