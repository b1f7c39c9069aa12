"""Writers that are killed, and writers on a full disk: the old output, the new one, or none."""

from contextlib import contextmanager
import json
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys

from bellows_ros.errors import BellowsError

from .frame import CLEAN, Failed, REFUSED
from ..files import killed_writers
from ..files.killed_writers import content, whole, WRITERS

ROOT = Path(__file__).parents[2]
KILLS = 3  # of each kind, in each turn
CAREFUL = [name for name in WRITERS if name != 'careless']


def kills(rng, folder):
    """Kill writers of every kind while they write."""
    done = subprocess.run(
        [sys.executable, '-m', killed_writers.__name__, str(folder), str(rng.integers(10**6)),
         str(KILLS)], cwd=ROOT, capture_output=True, text=True, check=True)
    for name, found in json.loads(done.stdout).items():
        left = sum(found.get(key, 0) for key in ('old', 'new', 'nothing'))
        if name in CAREFUL and (left != KILLS or found['in the way']):
            raise Failed(f'a killed writer of {name} left {found}')
        yield from [CLEAN] * left


def disks(rng, folder):
    """Write every kind of output where files cannot grow, as on a full disk."""
    for name in CAREFUL:
        place = folder / name.replace('.', '_')
        place.mkdir()
        contents, _ = whole(place, name)
        largest = max(len(data) for data in contents[0].values()) if contents[0] else 0
        for old in (False, True):
            shutil.rmtree(place)
            place.mkdir()
            if old:
                WRITERS[name](place / name, 0)
            outcome = CLEAN
            try:
                with room_for(int(rng.integers(largest + 1))):
                    WRITERS[name](place / name, 1)
            except BellowsError as error:
                outcome = REFUSED
                if 'cannot be written' not in str(error):
                    raise Failed(f'of a full disk: {error}') from error
            expected = contents[1] if outcome == CLEAN else contents[0] if old else None
            if content(place / name) != expected:
                raise Failed(f'a full disk left something else of {name}')
            if [path.name for path in place.iterdir()] not in ([], [name]):
                raise Failed(f'a full disk left {sorted(p.name for p in place.iterdir())}')
            yield outcome


@contextmanager
def room_for(size):
    """Let no file grow beyond a size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
