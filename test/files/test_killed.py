"""A process that is killed at any moment leaves whole outputs, or none."""

import json
from pathlib import Path
import subprocess
import sys

import pytest

from . import killed_writers

ROOT = Path(__file__).parents[2]
KILLS = 6  # of each kind

pytestmark = pytest.mark.timeout(400)


@pytest.fixture(scope='module')
def killed(tmp_path_factory):
    """Kill writers of every kind, and provide what they left; `make stress` does more."""
    folder = str(tmp_path_factory.mktemp('k'))
    done = subprocess.run(
        [sys.executable, '-m', killed_writers.__name__, folder, '7', str(KILLS)],
        cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_kills_leave_nothing_torn(killed):
    careful = {name: found for name, found in killed.items() if name != 'careless'}
    for name, found in careful.items():
        whole = found.get('old', 0) + found.get('new', 0)
        assert whole + found.get('nothing', 0) == KILLS, (name, found)
        assert found['in the way'] == 0
    # The kills have come before, during and after the writing.
    total = {key: sum(found.get(key, 0) for found in careful.values())
             for key in ('old', 'new', 'nothing', 'hidden')}
    assert all(count >= 3 for count in total.values()), total


def test_the_kills_find_what_is_written_carelessly(killed):
    assert killed['careless'].get('torn', 0) >= 1, killed['careless']
