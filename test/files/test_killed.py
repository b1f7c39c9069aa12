"""A process that is killed at any moment leaves whole outputs, or none."""

import json
import os
from pathlib import Path
import subprocess
import sys
import time

from bellows_ros.files.bags import read_streams
import numpy as np
import pytest

from . import killed_writers
from .killed_writers import HIDDEN, WRITERS

ROOT = Path(__file__).parents[2]
ROWS = 4000
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


def test_every_kind_of_output_was_killed(killed):
    assert set(killed) == set(WRITERS)


def trajectory(path, offset):
    """Write a trajectory for the command to convert."""
    t = 1.7e9 + 0.01 * np.arange(ROWS)
    rows = np.column_stack([t, offset + 0.0 * t, np.zeros((ROWS, 5)), np.ones(ROWS)])
    np.savetxt(path, rows, fmt='%.9f')
    return path


def hidden(folder):
    """Return the names in a folder that nobody takes for outputs."""
    return {name for name in os.listdir(folder) if name.startswith(HIDDEN)}


def kill_while_it_writes(process, folder, after):
    """Kill a process some time (s) after it has begun to write."""
    before, deadline = hidden(folder), time.monotonic() + 60.0
    while process.poll() is None and hidden(folder) <= before and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(after)
    process.kill()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_command_is_killed_while_it_writes(tmp_path, storage):
    out, rng = tmp_path / 'recording', np.random.default_rng(8)
    sources = [trajectory(tmp_path / f'{k}.tum', k) for k in (0, 1)]
    for k in range(3):
        process = subprocess.Popen(
            [sys.executable, '-m', 'bellows_ros.cli', 'convert', str(sources[k % 2]),
             '--topic', '/p', '--storage', storage, '--out', str(out), '--force'],
            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if k:  # the first one lives
            kill_while_it_writes(process, tmp_path, rng.uniform(0.0, 0.03))
        process.wait(60)
        stream = read_streams(out, {'p': '/p'})['p']
        assert len(stream) == ROWS
        assert set(stream.position[:, 0]) in ({0.0}, {1.0})
    assert set(os.listdir(tmp_path)) - hidden(tmp_path) == {'0.tum', '1.tum', out.name}
