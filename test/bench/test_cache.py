"""The cache of compiled code: shared by processes that start at once, and not needed."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from bellows_ros.core import jit
import pytest

pytestmark = pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed')

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
