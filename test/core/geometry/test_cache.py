"""The cache of compiled code: shared by processes that start at once, and not needed."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from bellows_ros.core.geometry import jit
import pytest

pytestmark = [
    pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed'),
    pytest.mark.timeout(600),
]

PACKAGE = Path(jit.__file__).parents[2]
ONE_KERNEL = """
import json
from bellows_ros.core.model.kernels import strain
R = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
print(json.dumps([strain((1.0, 2.0, 3.0), R), sum(strain.stats.cache_hits.values())]))
"""
NO_COMPILER = "import sys; assert 'numba.np.arrayobj' not in sys.modules"
STRAIN = [[3.0, 1.0, 6.0], [0.0, 0.0, 2.0]]


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package, never compiled."""
    shutil.copytree(PACKAGE, tmp_path / 'bellows_ros',
                    ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path


def started(path, script=ONE_KERNEL, **environment):
    """Start a script on a copy of the package."""
    env = {name: value for name, value in os.environ.items() if name != 'NUMBA_CACHE_DIR'}
    env |= {'PYTHONPATH': str(path), 'PYTHONDONTWRITEBYTECODE': '1', **environment}
    return subprocess.Popen(
        [sys.executable, '-P', '-c', script], cwd=path, env=env, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def blocked_caches(copy):
    """Put files where the folders of the package's caches would be."""
    for room in ('geometry', 'model'):
        (copy / f'bellows_ros/core/{room}/__pycache__').write_text('in the way, for root too')


def ended(process):
    """Return what a process has printed, and its errors."""
    out, err = process.communicate(timeout=110)
    assert process.returncode == 0, err
    return json.loads(out), err


def test_processes_that_start_at_once_share_the_cache(copy):
    first, second = [ended(p) for p in [started(copy), started(copy)]]
    assert first[0][0] == second[0][0] == STRAIN
    assert list((copy / 'bellows_ros/core/model/__pycache__').glob('*.nbi'))
    assert ended(started(copy, ONE_KERNEL + NO_COMPILER)) == ([STRAIN, 1], '')


def test_package_that_cannot_be_written_is_cached_for_the_user(copy):
    blocked_caches(copy)
    user = copy / 'user'
    home = {'XDG_CACHE_HOME': str(user), 'HOME': str(user)}
    assert ended(started(copy, **home))[0] == [STRAIN, 0]
    assert list(user.rglob('*.nbi'))
    assert ended(started(copy, **home))[0] == [STRAIN, 1]


def test_runs_where_nothing_can_be_written(copy):
    blocked_caches(copy)
    blocked = copy / 'no folder'
    blocked.write_text('')
    home = {'XDG_CACHE_HOME': str(blocked), 'HOME': str(blocked)}
    assert ended(started(copy, **home))[0] == [STRAIN, 0]


def damaged(path, number):
    """Spoil a file in one of several ways."""
    if number == 0:
        path.write_bytes(b'')
    elif number == 1:
        path.write_bytes(path.read_bytes()[:60])
    else:
        path.write_bytes(b'\x93NUMPY' * 100)


def test_damaged_cache_is_said_and_made_anew(copy):
    folder = copy / 'bellows_ros/core'
    ended(started(copy))
    files = sorted(folder.rglob('*.nbi'))
    assert len(files) == 3  # with what it calls
    for number, path in enumerate(files):
        damaged(path, number)
    out, err = ended(started(copy))
    assert out == [STRAIN, 0]
    assert f'Compiled code in {folder}/model/__pycache__ cannot be used' in err
    assert ended(started(copy)) == ([STRAIN, 1], '')


TWO_KINDS = """
import json
from bellows_ros.core.geometry.tuples import add
print(json.dumps([add((1, 2, 3), (4, 5, 6)), add((0.5, 2.0, 3.0), (4.0, 5.0, 6.0))]))
"""


def test_code_for_other_arguments_is_not_used(copy):
    """Two processes that start at once can leave one's code under the name of the other's."""
    first = ended(started(copy, TWO_KINDS))
    one, two = sorted((copy / 'bellows_ros/core/geometry/__pycache__').glob('tuples.add-*.nbc'))
    both = one.read_bytes(), two.read_bytes()
    two.write_bytes(both[0])
    one.write_bytes(both[1])
    out, err = ended(started(copy, TWO_KINDS))
    assert out == [[5, 7, 9], [4.5, 7.0, 9.0]]
    assert first == (out, '') and 'cannot be used (ValueError)' in err
