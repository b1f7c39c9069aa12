"""Compiled and interpreted code is one source; stored machine code is of its present state."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
import time

from bellows_ros.core.geometry import jit
from numpy.testing import assert_allclose
import pytest

pytestmark = pytest.mark.lane
compiled = pytest.mark.skipif(not jit.COMPILED, reason='numba is not installed')

PACKAGE = Path(jit.__file__).parents[2]

MOVED = """
import json
from bellows_ros.core.geometry import jit
from bellows_ros.core.model.equilibrium import moved_by
try:
    moved = jit.entry(moved_by)
    found = moved(((1., 2., 3.), (0., 0., 0., 1.), (.1, .2, 0.), (.3, 0., .5)), (.1,) * 12)
    hits = sum(moved.stats.cache_hits.values()) if jit.COMPILED else 0
    print(json.dumps([found, hits, str(jit.FOLDER)]))
except Exception as error:
    print(json.dumps(jit.damage(error)))
"""


def run(script, path=PACKAGE.parent, **environment):
    """Return what a script prints in a new interpreter, and its errors."""
    env = {name: value for name, value in os.environ.items() if name != 'NUMBA_CACHE_DIR'}
    env |= {'PYTHONPATH': str(path), 'PYTHONDONTWRITEBYTECODE': '1', **environment}
    done = subprocess.run([sys.executable, '-P', '-c', script], cwd='/', env=env, text=True,
                          capture_output=True, timeout=500)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


@pytest.fixture
def copy(tmp_path):
    """Return a folder with a copy of the package."""
    shutil.copytree(
        PACKAGE, tmp_path / 'bellows_ros', ignore=shutil.ignore_patterns('__pycache__'))
    return tmp_path


@compiled
def test_interpreted_code_gives_the_same_numbers():
    (fast, _, folder), _ = run(MOVED)
    (slow, _, none), _ = run(MOVED, NUMBA_DISABLE_JIT='1')
    assert folder != none == 'None'
    for got, wanted in zip(fast, slow, strict=True):
        assert_allclose(got, wanted, rtol=0, atol=1e-13)


@compiled
@pytest.mark.parametrize(('variable', 'root'), [
    ('XDG_CACHE_HOME', 'cache/bellows_ros'), ('NUMBA_CACHE_DIR', 'cache')])
def test_a_change_in_any_file_compiles_again_and_removes_what_is_unused_for_a_day(
    copy, variable, root
):
    cache = {variable: str(copy / 'cache')}
    (first, hits, folder), err = run(MOVED, copy, **cache)
    assert hits == 0 and err == ''
    assert run(MOVED, copy, **cache) == ([first, 1, folder], '')
    assert run(MOVED, copy, NUMBA_CACHE_DIR=folder) == ([first, 1, folder], '')  # of a parent
    tuples = copy / 'bellows_ros/core/geometry/tuples.py'
    text, line = tuples.read_text(), 'return (a[0] + b[0], a[1] + b[1], a[2] + b[2])'
    assert line in text and Path(folder).is_relative_to(copy / 'cache')
    tuples.write_text(text.replace(line, 'return (a[0] + 5 * b[0], a[1] + b[1], a[2] + b[2])'))
    (second, hits, other), _ = run(MOVED, copy, **cache)
    assert second != first and hits == 0
    assert set((copy / root).iterdir()) == {Path(folder), Path(other)}
    os.utime(folder, (0, time.time() - 90_000))
    assert run(MOVED, copy, **cache) == ([second, 1, other], '')
    assert list((copy / root).iterdir()) == [Path(other)]


@compiled
def test_damaged_code_is_removed_and_a_cache_that_cannot_be_written_is_not_needed(tmp_path):
    cache = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    (first, _, folder), _ = run(MOVED, **cache)
    for index in Path(folder).rglob('*.nbi'):
        index.write_bytes(index.read_bytes()[:20])
    advice, _ = run(MOVED, **cache)
    assert folder in advice and 'start again' in advice
    blocked = tmp_path / 'no folder'
    blocked.write_text('in the way, for root too')
    (found, hits, none), err = run(MOVED, NUMBA_CACHE_DIR=str(blocked))
    assert (found, hits, none) == (first, 0, 'None')
    assert err.count('Compiled code cannot be stored') == 1


@pytest.mark.parametrize(('fault', 'reason'), [
    ("ImportError('Numba needs NumPy 2.3 or less')", 'numba cannot be loaded (Numba needs NumPy'),
    ("OSError('libllvmlite.so: no such file')", 'numba cannot be loaded (libllvmlite.so'),
    ("ModuleNotFoundError('no numba')", 'numba is not installed')])
def test_numba_that_cannot_be_loaded_is_not_needed_and_says_why(tmp_path, fault, reason):
    (tmp_path / 'numba.py').write_text(f'raise {fault}')
    (found, hits, _), _ = run(MOVED, f'{tmp_path}{os.pathsep}{PACKAGE.parent}')
    told, _ = run("""import json
from bellows_ros.core.geometry import jit
print(json.dumps(jit.NOT_COMPILED))""", f'{tmp_path}{os.pathsep}{PACKAGE.parent}')
    assert hits == 0 and len(found) == 4 and told.startswith(reason)
