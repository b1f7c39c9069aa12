"""Every command with files of another kind, on a full disk, and ended by a signal."""

from contextlib import contextmanager
from functools import partial
import json
import os
from pathlib import Path
import re
import shutil
import signal
import time

from bellows_ros.files.atomic import PREFIX
import numpy as np
import pytest

from .conftest import contents, TRANSPORT, write_yaml
from ..conftest import ROOT
from ..core.planning.test_arm import URDF
from ..files.recordings import plan_messages
from ..files.test_atomic import room_for
from ..workflows.test_fuzz import MOTIVE, of_seeds, TUM

BAGS = ROOT / 'bags'
TOSSING, PACKAGE = f'--params {BAGS}/tossing.yaml', f'--params {BAGS}/package.yaml'
CUP = f'{PACKAGE} --params {BAGS}/cup.yaml'
PICTURES = '--json new.json --plot new.png'
WRITING = {
    'info': 'info recording --json new.json --write-params new.yaml --force',
    'identify': 'identify recording --params package.yaml --out new.yaml --out-cell cell.yaml '
    f'{PICTURES} --force',
    'replay': f'replay recording {CUP} --report new.html {PICTURES}',
    'simulate': f'simulate {CUP} --motion motion.yaml --out bag --json new.json --force',
    'parameters': f'parameters {CUP} --mjcf new.xml --json new.json',
    'plan': f'plan transport.yaml {TOSSING} --out bag {PICTURES} --force',
    'toss': f'toss {BAGS}/throw.yaml {TOSSING} --release 2.95 --out bag {PICTURES} --force',
    'convert': 'convert poses.tum --out bag --json new.json --force',
    'animation': f'plan transport.yaml {TOSSING} --plot new.gif'}
"""A command line with all outputs of each command."""
KILLED = signal.SIGTERM, signal.SIGINT

of_commands = pytest.mark.parametrize('command', [
    pytest.param(name, marks=pytest.mark.stress) if name == 'animation' else name
    for name in WRITING])


@pytest.fixture
def desk(workshop, tmp_path):
    """Give a folder with inputs of every command, and outputs of before."""
    folder = shutil.copytree(workshop, tmp_path / 'desk')
    (folder / 'poses.tum').write_text(TUM)
    write_yaml(folder / 'transport.yaml', TRANSPORT)
    shutil.copytree(folder / 'recording', folder / 'bag')
    for name in ('new.json', 'new.yaml', 'cell.yaml', 'new.png', 'new.html', 'new.xml', 'new.gif'):
        (folder / name).write_text('before')
    return folder


def outputs(folder):
    """Return the contents of files by name, those of a recording together; no temporary ones."""
    assert not [path for path in folder.rglob('*') if path.name.startswith(PREFIX)]
    found = contents(folder)
    recorded = {name: found.pop(name) for name in [*found] if name.startswith('bag/')}
    return {**found, 'bag': recorded}


def without_times(data):
    """Return JSON or HTML without the durations of a replay, which differ."""
    return re.sub(rb'[0-9.e+-]+', b'0', data) if isinstance(data, bytes) else data


def require_old_or_new(folder, before, after):
    """Require each output to be as before or as after the whole command."""
    found = outputs(folder)
    assert found.keys() == before.keys()
    for name, data in found.items():
        assert data == before[name] or without_times(data) == without_times(after[name]), name


@contextmanager
def killed(number, seconds):
    """Send a signal to this process after some seconds of its processor time."""
    for each in KILLED:
        signal.signal(each, signal.default_int_handler)
    before = signal.signal(signal.SIGPROF, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@of_seeds
@of_commands
def test_a_command_that_does_not_end_leaves_each_output_old_or_new(
        command, seed, bellows, desk, handlers):
    """End it by a signal at some moment, and let no file be larger than some size."""
    rng, words = np.random.default_rng([seed, *command.encode()]), WRITING[command].split()
    kept, before = shutil.copytree(desk, desk.with_name('kept')), outputs(desk)
    assert bellows(*words, cwd=desk).returncode == 0  # compiled, and loaded
    after, seconds, codes = outputs(desk), np.inf, list[int]()

    def again():
        shutil.rmtree(desk)
        shutil.copytree(kept, desk)

    for number in (0, *KILLED):
        again()
        begin = time.process_time()
        with killed(number, rng.uniform(0.1, 0.9) * seconds if number else 0.0):
            done = bellows(*words, cwd=desk)
        seconds = min(time.process_time() - begin, seconds) if done.returncode == 0 else seconds
        if done.returncode:
            assert done.returncode == 128 + number
            assert done.stderr.endswith('every output file is whole, the old or the new one.\n')
        require_old_or_new(desk, before, after)
        codes.append(done.returncode)
    assert any(codes) or seconds < 0.1  # such a timer has steps of some milliseconds
    again()
    largest = max(len(data) for name, data in after.items() if data != before[name])
    with room_for(int(rng.integers(largest))):
        done = bellows(*words, cwd=desk)
    assert done.returncode == 2 and 'cannot be written' in done.stderr, done.stderr
    require_old_or_new(desk, before, after)


PLAN = plan_messages()
KINDS = {
    'empty': b'', 'zeros': bytes(3000), 'noise': np.random.default_rng(0).bytes(3000),
    'word': b'hello', 'list': b'[1, 2]', 'picture': b'\x89PNG\r\n\x1a\n' + bytes(99),
    'urdf': URDF.encode(), 'tum': TUM.encode(), 'motive': MOTIVE.encode(),
    'joints': json.dumps(PLAN['joints']).encode(), 'tool': json.dumps(PLAN['multi']).encode(),
    'cup': (BAGS / 'cup.yaml').read_bytes()}
"""Contents of files, each of which is wrong nearly everywhere."""
SPECIAL = {
    'folder': Path.mkdir, 'pipe': os.mkfifo, 'link to nothing': partial(os.symlink, 'nothing'),
    'link to itself': lambda path: path.symlink_to(path.name),
    'endless': lambda path: path.symlink_to('/dev/zero')}
"""What is no file."""
READING = {
    'info FILE.mcap': '', 'info FILE.txt': '', f'identify FILE.db3 {CUP}': '',
    f'replay FILE.mcap {CUP}': '', f'identify FILE.mcap {TOSSING} --release': '',
    'info recording --params FILE.yaml': 'cup',
    'parameters --params FILE.yaml --mjcf new': 'cup',
    f'simulate {CUP} --motion FILE.yaml --out new': '',
    f'simulate {CUP} --motion motion.yaml --plan FILE.json --out new': 'tool joints',
    f'plan FILE.yaml {TOSSING}': 'tool joints', f'plan FILE.tum {TOSSING}': 'tum',
    f'plan FILE.csv {TOSSING}': '', f'toss FILE.yaml {TOSSING} --release 1': 'tool joints',
    f'plan joints.yaml {TOSSING} --tool-link tool --urdf FILE.urdf': 'urdf',
    f'plan transport.yaml {TOSSING} --limits FILE.yaml': '',
    'convert FILE.csv --out new': 'tum motive',
    'convert poses.tum FILE.tum --out new': 'tum motive'}
"""Command lines with a file, and the kinds of it that are right."""


@pytest.mark.timeout(300)  # a pipe is no reason to wait for ever
@pytest.mark.parametrize('line', READING)
def test_a_file_of_another_kind_is_refused_and_named(line, bellows, desk):
    """Put every kind of file into every place of a file."""
    write_yaml(desk / 'joints.yaml', PLAN['joints'])
    file = desk / next(word for word in re.split('[ =]', line) if word.startswith('FILE'))
    for kind in (kind for kind in (*KINDS, *SPECIAL) if kind not in READING[line].split()):
        if kind in KINDS:
            file.write_bytes(KINDS[kind])
        else:
            SPECIAL[kind](file)
        before = {path.name for path in desk.rglob('*')}
        done = bellows(*line.split(), cwd=desk)
        assert (done.returncode, done.stdout) == (2, ''), (kind, done.stderr)
        assert file.name in done.stderr or 'URDF' in done.stderr, (kind, done.stderr)
        assert done.stderr.startswith('bellows: ') and len(done.stderr) < 1500
        assert 'Traceback' not in done.stderr and 'Warning' not in done.stderr
        assert {path.name for path in desk.rglob('*')} == before
        file.rmdir() if kind == 'folder' else file.unlink()
