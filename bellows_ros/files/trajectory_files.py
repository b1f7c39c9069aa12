"""
Trajectories as text: TUM (read and written) and EuRoC (read).

TUM has a pose per line, `time x y z qx qy qz qw`, in s and m, with blanks between; evo and many
SLAM tools take it. EuRoC has commas, ns, and the quaternion's w first.
"""

import os
from pathlib import Path

from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic
import numpy as np
from numpy.typing import NDArray

LARGEST_FILE = 2**31
NS_PER_S = 10**9

Stamps = NDArray[np.int64]
Array = NDArray[np.float64]


def read_tum(path: str | os.PathLike[str]) -> tuple[Stamps, Array]:
    """
    Read a TUM file.

    Returns
    -------
    stamps_ns : int array (N,)
    values : array (N, 7)
        Position (m) and quaternion (x, y, z, w).

    Raises
    ------
    BellowsError
        With the line, if it is no such file.

    """
    stamps, rows = [], []
    for number, cells in _lines(path, None):
        _require(path, number, len(cells) == 8, f'8 numbers, got {len(cells)}')
        stamps.append(_seconds_to_ns(path, number, cells[0]))
        rows.append(_floats(path, number, cells[1:]))
    return _arrays(path, stamps, rows)


def read_euroc(path: str | os.PathLike[str]) -> tuple[Stamps, Array]:
    """Read the poses of a EuRoC ground-truth or estimate file; see `read_tum`."""
    stamps, rows = [], []
    for number, cells in _lines(path, ','):
        _require(path, number, len(cells) >= 8, f'at least 8 numbers, got {len(cells)}')
        stamps.append(_whole(path, number, cells[0]))
        x, y, z, qw, qx, qy, qz = _floats(path, number, cells[1:8])
        rows.append([x, y, z, qx, qy, qz, qw])
    return _arrays(path, stamps, rows)


def write_tum(path: str | os.PathLike[str], stamps_ns: Stamps, values: Array) -> None:
    """
    Write a TUM file, whole or not at all.

    Parameters
    ----------
    path : path
        Text file.
    stamps_ns : int array (N,)
        Times, ns; all nine decimals of the seconds are written.
    values : array (N, 7)
        Position (m) and quaternion (x, y, z, w).

    Raises
    ------
    BellowsError
        If it cannot be written.

    """
    lines = [
        f'{stamp // NS_PER_S}.{stamp % NS_PER_S:09d} ' + ' '.join(f'{x:.9g}' for x in row)
        for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True)
    ]
    head = '# time x y z qx qy qz qw (s, m)'
    atomic.write_text(path, '\n'.join([head, *lines]) + '\n')


def _lines(path: str | os.PathLike[str], separator: str | None) -> list[tuple[int, list[str]]]:
    """Return the numbers and cells of the lines that are no comments."""
    file = Path(path)
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise BellowsError(f"'{path}' is larger than {LARGEST_FILE} bytes. Give a part of it.")
        text = file.read_text(encoding='utf-8')
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise BellowsError(f"'{path}' is no text file.") from None
    return [
        (number, [cell.strip() for cell in line.split(separator)])
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith('#')
    ]


def _require(path: str | os.PathLike[str], number: int, good: bool, what: str) -> None:
    """Refuse a line that is not as it must be."""
    if not good:
        raise BellowsError(
            f"'{path}', line {number}: expected {what}. A TUM line is 'time x y z qx qy qz qw'; "
            "a EuRoC line is 'time_ns, x, y, z, qw, qx, qy, qz, ...'."
        )


def _floats(path: str | os.PathLike[str], number: int, cells: list[str]) -> list[float]:
    """Return the numbers of a line."""
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        raise BellowsError(f"'{path}', line {number}: {error}.") from None


def _whole(path: str | os.PathLike[str], number: int, cell: str) -> int:
    """Return a time in ns."""
    _require(path, number, cell.isdigit(), f"a time in ns, got '{cell[:40]}'")
    return int(cell)


def _seconds_to_ns(path: str | os.PathLike[str], number: int, cell: str) -> int:
    """Return a time in ns, without going through a float where the text is decimal."""
    whole, _, rest = cell.partition('.')
    if whole.isdigit() and (rest.isdigit() or not rest):
        return int(whole) * NS_PER_S + int(rest[:9].ljust(9, '0'))
    (seconds,) = _floats(path, number, [cell])
    _require(path, number, 0.0 <= seconds < 9e9, f"a time in s, got '{cell[:40]}'")
    return round(seconds * NS_PER_S)


def _arrays(
    path: str | os.PathLike[str], stamps: list[int], rows: list[list[float]]
) -> tuple[Stamps, Array]:
    """Return stamps and values as arrays."""
    if not rows:
        raise BellowsError(f"'{path}' has no poses.")
    return np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64)
