"""A process that is killed at any moment leaves whole outputs, or none."""

from contextlib import contextmanager
import json
from pathlib import Path
import resource
import signal
import subprocess
import sys

from bellows_ros.errors import BellowsError
import pytest

from . import killed_writers
from .killed_writers import content, whole, WRITERS

ROOT = Path(__file__).parents[2]
KILLS = 6  # of each kind

pytestmark = pytest.mark.timeout(400)


@pytest.fixture(scope='module')
def killed(tmp_path_factory):
    """Kill writers of every kind, and provide what they left."""
    folder = str(tmp_path_factory.mktemp('k'))
    done = subprocess.run(
        [sys.executable, '-m', killed_writers.__name__, folder, str(KILLS)],
        cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_killed_runs_leave_no_partial_file(killed):
    careful = {name: found for name, found in killed.items() if name != 'careless'}
    for name, found in careful.items():
        whole = found.get('old', 0) + found.get('new', 0)
        assert whole + found.get('nothing', 0) == KILLS, (name, found)
        assert found['in the way'] == 0
    # The kills have come before, during and after the writing.
    total = {key: sum(found.get(key, 0) for found in careful.values())
             for key in ('old', 'new', 'nothing', 'hidden')}
    assert all(count >= 3 for count in total.values()), total


def test_the_kill_test_detects_a_non_atomic_write(killed):
    assert killed['careless'].get('torn', 0) >= 1, killed['careless']


@contextmanager
def room_for(size):
    """Let no file grow beyond a size, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize('is_replaced', [False, True])
@pytest.mark.parametrize('name', [name for name in WRITERS if name != 'careless'])
def test_a_full_disk_leaves_the_old_output_or_none(name, is_replaced, tmp_path):
    contents, _ = whole(tmp_path, name)
    for size in (0, 100, max(map(len, contents[1].values())) - 1):
        place = tmp_path / f'{size}'
        place.mkdir()
        if is_replaced:
            WRITERS[name](place / name, 0)
        with pytest.raises(BellowsError, match='cannot be written'), room_for(size):
            WRITERS[name](place / name, 1)
        assert content(place / name) == (contents[0] if is_replaced else None)
        assert [path.name for path in place.iterdir()] == [name] * is_replaced
