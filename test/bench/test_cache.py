"""The cache of compiled code: shared by processes that start at once, and not needed."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from bellows_ros.core import jit
import pytest

pytestmark = [
    pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed'),
    pytest.mark.timeout(600),
]

PACKAGE = Path(jit.__file__).parents[1]
SCRIPT = """
import json
from bellows_ros.bench.step_case import CUP, MODEL, PACKAGE, shaken_tool, start
from bellows_ros.core.integrator import advance
from bellows_ros.core.simulation import row_state
tool = shaken_tool(3, 100.0)
print(json.dumps(advance(MODEL, start(), row_state(tool[0]), row_state(tool[1]), 0.01, 2)))
print(json.dumps(sum(advance.stats.cache_hits.values())))
"""


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package, never compiled."""
    shutil.copytree(PACKAGE, tmp_path / 'bellows_ros',
                    ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path


def started(path, **environment):
    """Start the script on a copy of the package."""
    env = {**os.environ, 'PYTHONPATH': str(path), 'PYTHONDONTWRITEBYTECODE': '1', **environment}
    env.pop('NUMBA_CACHE_DIR', None) if 'NUMBA_CACHE_DIR' not in environment else None
    return subprocess.Popen(
        [sys.executable, '-P', '-c', SCRIPT], cwd=path, env=env, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def ended(process):
    """Return what a process has computed, and how many kernels came from the cache."""
    out, err = process.communicate(timeout=110)
    assert process.returncode == 0, err
    state, hits = map(json.loads, out.splitlines())
    return state, hits


def test_processes_that_start_at_once_share_the_cache(copy):
    first, second = [ended(p) for p in [started(copy), started(copy)]]
    assert first[0] == second[0]
    assert list((copy / 'bellows_ros/core/__pycache__').glob('*.nbi'))
    state, hits = ended(started(copy))
    assert state == first[0]
    assert hits == 1


def test_package_that_cannot_be_written_is_cached_for_the_user(copy):
    (copy / 'bellows_ros/core/__pycache__').write_text('in the way, for root too')
    user = copy / 'user'
    home = {'XDG_CACHE_HOME': str(user), 'HOME': str(user)}
    state, _ = ended(started(copy, **home))
    assert list(user.rglob('*.nbi'))
    again, hits = ended(started(copy, **home))
    assert again == state
    assert hits == 1


def test_runs_where_nothing_can_be_written(copy):
    (copy / 'bellows_ros/core/__pycache__').write_text('in the way, for root too')
    blocked = copy / 'no folder'
    blocked.write_text('')
    state, hits = ended(started(copy, XDG_CACHE_HOME=str(blocked), HOME=str(blocked)))
    assert len(state) == 4
    assert hits == 0


def damaged(path, number):
    """Spoil a file in one of several ways."""
    if number == 0:
        path.write_bytes(b'')
    elif number == 1:
        path.write_bytes(path.read_bytes()[:60])
    else:
        path.write_bytes(b'\x93NUMPY' * 100)


ONE_KERNEL = """
import json
from bellows_ros.core.kernels import strain
R = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
print(json.dumps([strain((1.0, 2.0, 3.0), R), sum(strain.stats.cache_hits.values())]))
"""


@pytest.mark.parametrize('pattern', ['*.nbi', '*.nbc'])
def test_damaged_cache_is_said_and_made_anew(copy, pattern):
    folder = copy / 'bellows_ros/core/__pycache__'
    ended_with(copy, ONE_KERNEL)
    files = sorted(folder.glob(pattern))
    assert len(files) == 3  # with what it calls
    for number, path in enumerate(files):
        damaged(path, number)
    (strain, hits), err = ended_with(copy, ONE_KERNEL)
    assert strain == [[3.0, 1.0, 6.0], [0.0, 0.0, 2.0]] and hits == 0
    assert f'Compiled code in {folder} cannot be used' in err
    assert ended_with(copy, ONE_KERNEL) == ([strain, 1], '')


TWO_KINDS = """
import json
from bellows_ros.core.tuples import add
print(json.dumps([add((1, 2, 3), (4, 5, 6)), add((0.5, 2.0, 3.0), (4.0, 5.0, 6.0))]))
"""


def test_code_for_other_arguments_is_not_used(copy):
    """Two processes that start at once can leave one's code under the name of the other's."""
    first = ended_with(copy, TWO_KINDS)
    one, two = sorted((copy / 'bellows_ros/core/__pycache__').glob('tuples.add-*.nbc'))
    both = one.read_bytes(), two.read_bytes()
    two.write_bytes(both[0])
    one.write_bytes(both[1])
    out, err = ended_with(copy, TWO_KINDS)
    assert out == [[5, 7, 9], [4.5, 7.0, 9.0]]
    assert first == (out, '') and 'cannot be used (ValueError)' in err


def ended_with(path, script):
    """Run a script on a copy of the package and return what it prints, and its errors."""
    env = {**os.environ, 'PYTHONPATH': str(path), 'PYTHONDONTWRITEBYTECODE': '1'}
    env.pop('NUMBA_CACHE_DIR', None)
    done = subprocess.run(
        [sys.executable, '-P', '-c', script], cwd=path, env=env, text=True, capture_output=True,
        timeout=110, check=True)
    return json.loads(done.stdout), done.stderr
