"""
Output is written whole or not at all, also if the process is killed at any moment.

    python -m test.files.test_atomic NAME PATH

has an output written again and again until the writer is killed, several times; it prints a dot
after each, and goes on when it reads one.
"""

from contextlib import contextmanager
import errno
from itertools import cycle
import json
import os
from pathlib import Path
import re
import resource
import shutil
import signal
import subprocess
import sys
import time

from bellows_ros.errors import BellowsError
from bellows_ros.exits import stopped_by_signals
from bellows_ros.files.atomic import PREFIX, require_target, whole, write_bytes, write_text
from bellows_ros.files.bags import as_messages, write_bag
from bellows_ros.files.results import write_json
import numpy as np
from numpy.testing import assert_array_equal
import pytest


def test_a_new_file_has_the_permissions_of_any_and_a_replaced_one_keeps_them(tmp_path):
    write_bytes(tmp_path / 'a', b'x')
    (tmp_path / 'b').write_bytes(b'x')
    assert (tmp_path / 'a').stat().st_mode == (tmp_path / 'b').stat().st_mode
    (tmp_path / 'a').chmod(0o640)
    (tmp_path / 'link').symlink_to('a')
    write_text(tmp_path / 'link', 'new')
    assert (tmp_path / 'link').is_symlink()
    assert (tmp_path / 'a').read_text() == 'new'
    assert (tmp_path / 'a').stat().st_mode & 0o777 == 0o640


def test_what_cannot_be_written_is_refused(tmp_path):
    for path in (tmp_path / 'none' / 'a', tmp_path, '/dev/null', 'a\0b', tmp_path / ('x' * 300)):
        named = f"Output '{path}".replace('\0', '\\x00')[:80]
        with pytest.raises(BellowsError, match=re.escape(named)):
            write_text(path, 'x')
    assert os.listdir(tmp_path) == []
    (tmp_path / 'file').write_text('x')
    with pytest.raises(BellowsError, match='no folder'):
        require_target(tmp_path / 'file', is_folder=True)


def test_a_folder_appears_when_it_is_complete(tmp_path):
    for content in ('x', 'y'):
        with whole(tmp_path / 'bag', is_folder=True) as folder:
            folder.mkdir()
            (folder / 'file').write_text(content)
            assert (tmp_path / 'bag').exists() == (content == 'y')
    for failure in (RuntimeError, BellowsError):
        with pytest.raises(failure), whole(tmp_path / 'bag', is_folder=True) as folder:
            if failure is RuntimeError:
                folder.mkdir()
                raise RuntimeError('half way')  # in the other case nobody makes the folder
    assert (tmp_path / 'bag' / 'file').read_text() == 'y'
    assert os.listdir(tmp_path) == ['bag']


RNG = np.random.default_rng(0)
RESULT = {
    'method': 'least_squares', 'structure': 'axisymmetric',
    'stiffness': RNG.normal(size=(6, 6)) * 1e4, 'damping': RNG.normal(size=(6, 6)),
    'stiffness_std': RNG.normal(size=(6, 6)) ** 2, 'damping_std': np.full((6, 6), np.nan),
    'samples_used': np.int64(7051), 'samples_rejected': 99, 'condition_number': np.float64(np.inf),
    'more': {'bags': ('a', 'ü\u2028"'), 'refused': {'nan': [1, 2]},
             'ok': np.bool_(True), 'none': None}}


def test_every_digit_survives_a_round_trip(tmp_path):
    write_json(tmp_path / 'fit.json', RESULT)
    result = json.loads((tmp_path / 'fit.json').read_text())
    assert list(result) == list(RESULT)
    for key in ('stiffness', 'damping', 'stiffness_std'):
        assert_array_equal(np.array(result[key]), RESULT[key])
    assert result['samples_used'] == 7051 and isinstance(result['samples_used'], int)
    assert result['more'] == {
        'bags': ['a', 'ü\u2028"'], 'refused': {'nan': [1, 2]}, 'ok': True, 'none': None}
    assert result['condition_number'] is None  # what is not known
    assert result['damping_std'] == [[None] * 6] * 6


POSE = 'geometry_msgs/msg/PoseStamped'
STAMPS = 10**18 + 10**7 * np.arange(400)
VALUES = np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], (len(STAMPS), 1))


def result(path, number):
    """Write JSON."""
    write_json(path, {'number': number, 'values': VALUES[:200]})


def recording(storage, zstd):
    """Return a function that writes a recording."""
    def write(path, number):
        recorded = as_messages('/pose', POSE, STAMPS, VALUES + number)
        write_bag(path, [recorded], storage, zstd, replace=True)

    return write


def carelessly(path, number):
    """Write carelessly for some milliseconds: a control whose partial files kills must find."""
    with path.open('wb', buffering=0) as file:
        for _ in range(5000):
            file.write(bytes([number]) * 100)


WRITERS = {
    'fit.json': result, 'mcap': recording('mcap', False),
    'sqlite3': recording('sqlite3', True), 'careless': carelessly}


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
    with subprocess.Popen([sys.executable, '-m', __name__, name, str(tmp_path / name)],
                          cwd=Path(__file__).parents[2], stdin=-1, stdout=-1) as process:
        for _ in range(KILLS):
            assert process.stdout.read(1) == b'.'
            torn += content(tmp_path / name) not in whole
            assert all(each.name == name or each.name.startswith(PREFIX)
                       for each in tmp_path.iterdir())
            process.stdin.write(b'.')
            process.stdin.flush()
    assert process.returncode == 0 and (torn > 0) == (name == 'careless')


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


CALLS = ['os.fsync', 'os.rename', 'os.replace', 'shutil.rmtree']
"""Calls that write and replace a folder, in their order."""


@pytest.mark.parametrize('fault', ['error', 'signal before', 'signal after'])
@pytest.mark.parametrize('call', CALLS)
def test_a_fault_at_any_call_leaves_the_old_folder_or_the_new_one(
        call, fault, tmp_path, monkeypatch, handlers):
    """And nothing beside it; the first attempt to clear the temporary folder fails too."""
    contents, module = both(tmp_path, 'mcap'), {'os': os, 'shutil': shutil}[call.split('.')[0]]
    name = call.split('.')[1]
    real, calls = getattr(module, name), list[object]()

    def faulty(*arguments, **options):
        if tmp_path / 'mcap' in arguments or len(arguments) == 1:  # not within rosbags
            calls.append(arguments)
        is_first = calls == [arguments]
        if is_first and fault == 'error':
            raise OSError(errno.EIO, 'Input/output error')
        if is_first and fault == 'signal before':
            signal.raise_signal(signal.SIGTERM)
        real(*arguments, **options)
        if is_first and fault == 'signal after':
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(module, name, faulty)
    raised = BellowsError if fault == 'error' else KeyboardInterrupt
    with pytest.raises(raised), stopped_by_signals():
        WRITERS['mcap'](tmp_path / 'mcap', 0)
        if fault == 'error' and call == 'shutil.rmtree':  # passed over: the output is whole
            raise BellowsError
    is_new = call == 'shutil.rmtree' or (call, fault) == ('os.replace', 'signal after')
    assert calls and content(tmp_path / 'mcap') == contents[0 if is_new else 1]
    assert os.listdir(tmp_path) == ['mcap']


def test_a_folder_that_cannot_be_renamed_back_is_kept_and_named(tmp_path, monkeypatch):
    old, rename, replace = both(tmp_path, 'mcap')[1], os.rename, os.replace
    with monkeypatch.context() as broken:
        broken.setattr(os, 'rename', lambda source, target: rename(
            source, target if source == tmp_path / 'mcap' else tmp_path / 'no' / 'where'))
        broken.setattr(os, 'replace', lambda source, target: replace(
            source, target / 'no' if target == tmp_path / 'mcap' else target))
        with pytest.raises(BellowsError, match='nor be restored') as raised:
            WRITERS['mcap'](tmp_path / 'mcap', 0)
    kept, = tmp_path.glob(f'{PREFIX}*/{PREFIX}*')
    assert str(kept) in str(raised.value) and content(kept) == old


def main():
    """Kill a writer of both contents in turn at several moments, and let each be judged."""
    name, path = sys.argv[1:]
    for k in range(KILLS):
        begun, begin = os.pipe()
        if (writer := os.fork()) == 0:
            for number in cycle((0, 1)):
                WRITERS[name](Path(path), number)
                if number:
                    os.write(begin, b'.')
        os.close(begin)
        os.read(begun, 1)  # both were written once
        time.sleep(1e-3 * k)  # the moment is the point, nothing is awaited
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        os.close(begun)
        print('.', end='', flush=True)
        sys.stdin.buffer.read(1)


if __name__ == '__main__':
    main()
