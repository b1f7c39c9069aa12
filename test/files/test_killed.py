"""A process that is killed at any moment leaves whole outputs, or none."""

from contextlib import contextmanager
from pathlib import Path
import resource
import signal
import subprocess
import sys
import time

from bellows_ros.errors import BellowsError
from bellows_ros.files.atomic import PREFIX
import pytest

from . import killed_writers
from .killed_writers import WRITERS

KILLS = 6  # of each kind


def content(path):
    """Return all files of an output by name, or None where there is none."""
    if path.is_dir():
        return {file.name: file.read_bytes() for file in path.iterdir()}
    return {path.name: path.read_bytes()} if path.exists() else None


def both(folder, name):
    """Return both contents of an output."""
    found = []
    for number in (0, 1):
        WRITERS[name](folder / name, number)
        found.append(content(folder / name))
    return found


@pytest.mark.parametrize('name', WRITERS)
def test_a_killed_writer_leaves_no_partial_file(name, tmp_path):
    """And one that writes carelessly does, so that partial files are found."""
    whole, torn = [*both(tmp_path, name), None], 0
    for k in range(KILLS):
        with subprocess.Popen([sys.executable, '-m', killed_writers.__name__, name, str(
                tmp_path / name)], cwd=Path(__file__).parents[2], stdout=-1) as process:
            assert process.stdout.read(1) == b'.'
            time.sleep(1e-3 * k)  # the moment is the point, nothing is awaited
            process.kill()
        torn += content(tmp_path / name) not in whole
        assert all(each.name == name or each.name.startswith(PREFIX)
                   for each in tmp_path.iterdir())
    assert (torn > 0) == (name == 'careless')


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
    contents = both(tmp_path, name)
    for size in (0, 100, max(map(len, contents[1].values())) - 1):
        place = tmp_path / f'{size}'
        place.mkdir()
        if is_replaced:
            WRITERS[name](place / name, 0)
        with pytest.raises(BellowsError, match='cannot be written'), room_for(size):
            WRITERS[name](place / name, 1)
        assert content(place / name) == (contents[0] if is_replaced else None)
        assert [path.name for path in place.iterdir()] == [name] * is_replaced
