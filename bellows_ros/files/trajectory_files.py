"""
Trajectories as text: TUM files, motions with velocities, programs, and exports of Motive.

TUM has a pose per line, `time x y z qx qy qz qw`, in s and m, separated by blanks; evo and many
SLAM tools read it.

The tracked poses of rigid bodies are read from Motive's CSV exports (formats 1.2 to 1.25). A pose
is omitted if its cells are blank, or if fewer markers of its body are visible than a rigid body
needs. A marker is visible if its quality is at least 0.99 (appendix H); in an export without
qualities, if its measured position is not blank. (The positions of a 'Rigid Body Marker' are
expected positions, which are always present.) The layout is: a row of settings, alternately name
and value; a blank row; rows for Type, Name, ID, since format 1.25 Parent, and quantity; the row of
axes, which begins with Frame and Time (Seconds) and, if the take has one, TimeCode; then a row per
frame. The rows of the head identify the columns in any order.
"""

from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass
from datetime import datetime, UTC
from decimal import Decimal
from io import StringIO
from pathlib import Path
import re
from typing import Any

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, File, read_text
import numpy as np

MAX_FILE_BYTES = 2**31

TUM_COLUMNS = 8
"""Number of columns of a TUM file."""

NumberedRows = list[tuple[int, list[str]]]
"""Numbers and cells of the lines of a file."""


def read_tum(path: File) -> tuple[Stamps, Array]:
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
        With the line, if the file is not a TUM file.

    """
    lines = _lines(path)
    return _stamps(path, lines), numbers(path, lines, range(1, TUM_COLUMNS))


def write_tum(path: File, stamps_ns: Stamps, values: Array) -> None:
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
        If the file cannot be written.

    """
    _write(path, '# time x y z qx qy qz qw (s, m)', '%d.%09d' + 7 * ' %.9g',
           *divmod(stamps_ns, NS_PER_S), *values.T)


def _write(path: File, head: str, form: str, *columns: Array | Stamps) -> None:
    """Write a text file of a head and a line for each row of the columns."""
    rows = zip(*(column.tolist() for column in columns), strict=True)
    atomic.write_text(path, '\n'.join([head, *map(form.__mod__, rows)]) + '\n')


def _lines(path: File) -> NumberedRows:
    """Return the numbers and cells of the lines without comments."""
    lines = [
        (number, line.split())
        for number, line in enumerate(read_text(path, MAX_FILE_BYTES).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith('#')]
    if not lines:
        raise BellowsError(f"'{path}' has no poses.")
    for number, cells in lines:
        if len(cells) != TUM_COLUMNS:
            raise _line_error(path, number, f'{TUM_COLUMNS} numbers, got {len(cells)}')
    return lines


def _line_error(path: File, number: int, what: str) -> BellowsError:
    """Return the error for a faulty line."""
    return BellowsError(
        f"'{path}', line {number}: expected {what}. A TUM line is 'time x y z qx qy qz qw'.")


def _stamps(path: File, lines: NumberedRows) -> Stamps:
    """Return the times (s) at the beginning of lines in ns, without conversion to float."""
    stamps = []
    for number, (cell, *_) in lines:
        try:
            time = Decimal(cell)
            valid = 0 <= time < 9 * 10**18 // NS_PER_S  # 64-bit ns
        except ArithmeticError:
            valid = False
        if not valid:
            raise _line_error(path, number, f"a time in s, got '{cell[:40]}'")
        stamps.append(int(time * NS_PER_S))
    return np.array(stamps, dtype=np.int64)


def numbers(path: File, lines: Iterable[tuple[int, list[str]]], columns: Sequence[int]) -> Array:
    """Return the values (N, columns) in the given columns of numbered lines of a file."""
    values = array('d')
    for number, cells in lines:
        try:
            values.extend([float(cells[i]) for i in columns])
        except ValueError as error:
            raise BellowsError(f"'{path}', line {number}: {error}.") from None
    return np.array(values).reshape(-1, len(columns))


# ------------------------------------------------------------------------------------- Motive

MIN_MARKERS = 3  # for a pose of a rigid body
METRES = {'meters': 1.0, 'centimeters': 0.01, 'millimeters': 0.001, 'inches': 0.0254}  # m
# Some languages of Windows write P.M.
START_FORMS = [f'%Y-%m-%d {time}' for time in (
    '%I.%M.%S.%f %p', '%H.%M.%S.%f', '%I.%M.%S %p', '%H.%M.%S')]
SETTINGS = ('Format Version', 'Rotation Type', 'Coordinate Space', 'Length Units',
            'Capture Start Time')
POSE_COLUMNS = ('Rotation X', 'Rotation Y', 'Rotation Z', 'Rotation W',
                'Position X', 'Position Y', 'Position Z')
TIME = 1  # column

Heads = Mapping[str, Sequence[str]]
Columns = tuple[list[int], list[int], list[int]]
"""Columns of the poses of a body, of the qualities of its markers, and of their positions."""


@dataclass(frozen=True, eq=False)
class MotiveBody:
    """
    The poses of a rigid body.

    Parameters
    ----------
    name : str
    stamps_ns : int array (N,)
        Stamps of the usable poses, ns.
    values : array (N, 7)
        Position (m) and quaternion (x, y, z, w), in Motive's world.
    missing : int
        Number of frames without a pose.
    unseen : int
        Number of frames with a pose from too few markers.

    """

    name: str
    stamps_ns: Stamps
    values: Array
    missing: int
    unseen: int


def read_motive(path: File, min_markers: int = MIN_MARKERS) -> tuple[MotiveBody, ...]:
    """
    Read the rigid bodies of a Motive CSV export.

    Parameters
    ----------
    path : path
        CSV file exported with header, global coordinates and quaternions; marker quality is
        optional.
    min_markers : int
        Smallest number of visible markers of a pose, if the file states them.

    Raises
    ------
    BellowsError
        If the file is not an export of Motive, or was exported with other options.

    """
    try:
        return _bodies(Path(path), csv.reader(StringIO(read_text(path, MAX_FILE_BYTES))),
                       min_markers)
    except csv.Error as error:
        raise BellowsError(f"'{path}' is no CSV file: {error}.") from None


def is_motive(path: File) -> bool:
    """Return whether a file begins like an export of Motive; false if unreadable."""
    with suppress(OSError), Path(path).open('rb') as file:
        return file.read(200).lstrip(b'\xef\xbb\xbf"').startswith(b'Format Version')
    return False


def _bodies(path: Path, rows: Any, min_markers: int) -> tuple[MotiveBody, ...]:
    """Return the bodies from the rows of a file (`csv.reader`)."""
    about, heads = _read_head(path, rows)
    scale = METRES[about['Length Units'].lower()]
    columns = _body_columns(path, heads)
    needed = sorted({TIME}.union(*(c for of_body in columns.values() for c in of_body)))
    frames = ((rows.line_num, [(row[c] if c < len(row) else '').strip() or 'nan' for c in needed])
              for row in rows if any(row))
    table = dict(zip(needed, numbers(path, frames, range(len(needed))).T, strict=True))
    seconds = table[TIME]
    if not len(seconds) or not np.all(np.abs(seconds) < 1e9):  # s
        raise BellowsError(f"'{path}' has no frames, or frames without a time in s.")
    stamps = _start_ns(about) + np.rint(seconds * NS_PER_S).astype(np.int64)
    bodies = []
    for name, (pose_columns, qualities, positions) in columns.items():
        pose = np.column_stack([table[c] for c in pose_columns])
        present, markers = np.isfinite(pose).all(axis=1), np.full(len(pose), min_markers)
        if qualities:
            markers = np.sum([table[c] >= 0.99 for c in qualities], axis=0)  # (appendix H)
        elif len(positions) >= MIN_MARKERS:
            markers = np.sum([np.isfinite(table[c]) for c in positions], axis=0)
        enough = markers >= min_markers
        usable = present & enough
        bodies.append(MotiveBody(
            name, stamps[usable], np.hstack([scale * pose[usable, 4:], pose[usable, :4]]),
            int(np.count_nonzero(~present)), int(np.count_nonzero(present & ~enough))))
    return tuple(bodies)


def _read_head(path: Path, rows: Iterator[list[str]]) -> tuple[dict[str, str], Heads]:
    """Return the properties of the first row, and the column heads, as wide as the row of axes."""
    first = next(rows, [])
    if first and first[0].startswith('Format Version;'):
        raise BellowsError(
            f"'{path}' is separated by semicolons, as a spreadsheet saves it. Use the file that "
            'Motive exported.')
    # By name, as a take's own name or notes may contain commas.
    about = {name: first[first.index(name) + 1] for name in SETTINGS if name in first[:-1]}
    above: dict[str, list[str]] = {}
    for _, row in zip(range(12), rows, strict=False):
        if row[:1] == ['Frame'] and 'Format Version' in about:
            width = len(row)
            heads = {label: (cells + [''] * width)[:width] for label, cells in above.items()}
            lacking = [name for name in ('Type', 'Name', 'Quantity') if name not in heads]
            if lacking:
                raise BellowsError(f"'{path}' lacks the header row {lacking[0]}. Export it again.")
            _require_settings(path, about)
            return about, {**heads, 'axis': row}
        if any(row):
            above[row[1] if len(row) > 1 and row[1] else 'Quantity'] = row
    raise BellowsError(
        f"'{path}' is no CSV export of Motive with its header. Export it again, with 'Header "
        "Information' switched on.")


def _require_settings(path: Path, about: Mapping[str, str]) -> None:
    """Raise for an export without usable poses."""
    for name, wanted in (('Rotation Type', 'Quaternion'), ('Coordinate Space', 'Global')):
        if about.get(name, wanted) != wanted:
            raise BellowsError(
                f"'{path}' has {name} {about[name]}; {wanted} is needed. Export it again with "
                f'{name} set to {wanted}.')
    unit = about.get('Length Units', 'an unknown unit')
    if unit.lower() not in METRES:
        raise BellowsError(
            f"'{path}' has lengths in {unit}; expected are {', '.join(METRES)}. Export it again.")


def _start_ns(about: Mapping[str, str]) -> int:
    """Return the start of the capture, ns (its clock is taken as UTC); 1 s if not stated."""
    text = re.sub('[:,]', '.', about.get('Capture Start Time', '').strip().upper())
    text = re.sub(r'\s*([AP])\.?M\.?$', r' \1M', text)
    for form in START_FORMS:
        with suppress(ValueError):
            start = datetime.strptime(text, form).replace(tzinfo=UTC)
            return int(start.timestamp()) * NS_PER_S + 1000 * start.microsecond
    return int(NS_PER_S)


def _body_columns(path: Path, heads: Heads) -> dict[str, Columns]:
    """Return the columns of each rigid body."""
    labels = ('Type', 'Name', 'Quantity', 'axis')
    columns = list(zip(*(heads[label] for label in labels), strict=True))
    names = list(dict.fromkeys(name for kind, name, *_ in columns if kind == 'Rigid Body'))
    if not names:
        raise BellowsError(
            f"'{path}' has no rigid bodies. Export the take again with rigid bodies switched on.")
    found: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for number, (kind, owner, quantity, axis) in enumerate(columns):
        # A marker's name (BODY:Marker1, BODY_1) begins with the name of its body.
        fitting = [name for name in names if owner.startswith((f'{name}:', f'{name}_'))]
        body = owner if kind == 'Rigid Body' else max(fitting, key=len, default='')
        what = quantity if kind == 'Rigid Body Marker' else f'{quantity} {axis}'.strip()
        found[kind, body, what].append(number)
    for name in names:
        lacking = [column for column in POSE_COLUMNS if ('Rigid Body', name, column) not in found]
        if lacking:
            raise BellowsError(
                f"'{path}': rigid body '{name}' lacks the column {lacking[0]}. Export it again.")
    return {name: ([found['Rigid Body', name, column][0] for column in POSE_COLUMNS],
                   found['Rigid Body Marker', name, 'Marker Quality'],
                   found['Marker', name, 'Position X']) for name in names}
