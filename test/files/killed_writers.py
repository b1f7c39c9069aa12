"""
Kill processes during their writing, and classify the remaining files.

    python -m test.files.killed_writers FOLDER KILLS

A process of its own that forks the writers: what they write is made before, so that the kills
fall into the writing. Prints for each kind of output how many kills left nothing, the old or the
new content, and anything else.
"""

from collections import Counter
import json
import os
from pathlib import Path
import shutil
import signal
import sys
import time

from bellows_ros.files.bags import as_messages, write_bag
from bellows_ros.files.results import write_json
import numpy as np

LONG = 2.0  # durations of a write in which it is killed
HIDDEN = '.bellows-'
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


def content(path):
    """Return all files of an output by name, or None where there is none."""
    if path.is_dir():
        return {file.name: file.read_bytes() for file in path.iterdir()}
    return {path.name: path.read_bytes()} if path.exists() else None


def whole(folder, name):
    """Return both contents, and the duration (s) of their writing."""
    contents = []
    seconds = 1.0
    for number in (0, 1, 0, 1):
        begin = time.monotonic()
        WRITERS[name](folder / name, number)
        seconds = min(seconds, time.monotonic() - begin)
        contents.append(content(folder / name))
    assert contents[:2] == contents[2:] and contents[0] != contents[1], name
    return contents[:2], seconds


def kill_one(path, write, after):
    """Fork a process that writes the new and the old content in turn; kill it a time (s) later."""
    begun, begin = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            write(path.parent.parent / path.name, 0)  # copies the pages a fork leaves shared
            os.write(begin, b'.')
            for number in range(1, 100_000):
                write(path, number % 2)
        finally:
            os._exit(1)
    os.close(begin)
    assert os.read(begun, 1), path  # ends at the latest with the child
    os.close(begun)
    time.sleep(after)  # the moment is the point, nothing is awaited
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status), path


def kill_many(folder, name, kills):
    """
    Kill writers of one kind of output, and count the remaining contents by kind.

    The kills are spread evenly over the writing, the first at its begin: with few of them, too,
    some come before the first output is whole and some after it.
    """
    folder.mkdir()
    contents, seconds = whole(folder, name)
    found = Counter()
    for k in range(kills):
        shutil.rmtree(folder)
        folder.mkdir()
        old = k % 2  # every other time there is nothing yet
        if old:
            WRITERS[name](folder / name, 0)
        share = k // 2 / ((kills + 1) // 2)
        kill_one(folder / name, WRITERS[name], share * LONG * seconds)
        found[judged(content(folder / name), contents, bool(old))] += 1
        left = [path.name for path in folder.iterdir() if path.name != name]
        found['hidden'] += len(left)
        found['in the way'] += sum(not entry.startswith(HIDDEN) for entry in left)
    return found


def judged(now, contents, old):
    """Return the kind of the content after a kill."""
    if now is None:
        return 'lost' if old else 'nothing'
    return ('old', 'new')[contents.index(now)] if now in contents else 'torn'


def main():
    """Kill writers of every kind."""
    folder, kills = Path(sys.argv[1]), int(sys.argv[2])
    print(json.dumps({
        name: kill_many(folder / f'of_{name}', name, kills) for name in WRITERS}))


if __name__ == '__main__':
    main()
