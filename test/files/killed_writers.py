"""
Write an output again and again until the process is killed.

    python -m test.files.killed_writers NAME PATH

Prints a dot when both contents were written once.
"""

from itertools import cycle
from pathlib import Path
import sys

from bellows_ros.files.bags import as_messages, write_bag
from bellows_ros.files.results import write_json
import numpy as np

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


def main():
    """Write both contents in turn."""
    name, path = sys.argv[1:]
    for number in (0, 1):
        WRITERS[name](Path(path), number)
    print('.', end='', flush=True)
    for number in cycle((0, 1)):
        WRITERS[name](Path(path), number)


if __name__ == '__main__':
    main()
