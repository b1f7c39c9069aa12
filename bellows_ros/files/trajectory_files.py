"""
Poses of bodies in text: TUM files, and exports of Motive (CSV, formats 1.2 to 1.25).

TUM has a pose per line, `time x y z qx qy qz qw`, in s and m, separated by blanks. An export of
Motive has a row of settings, alternately name and value; rows for Type, Name and quantity; the row
of axes, which begins with Frame and Time; then a row per frame. A pose is omitted if its cells are
blank, or if fewer markers of its body are visible than a rigid body needs. A marker is visible if
its quality is at least `MIN_QUALITY`; in an export without qualities, if its measured position is
not blank.
"""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from datetime import datetime, UTC
from decimal import Decimal
from io import StringIO
from itertools import islice, pairwise, zip_longest
import os
import re
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import File, read_text
import numpy as np

MAX_FILE_BYTES = 2**31
MIN_MARKERS = 3
"""Number of points that determine the pose of a rigid body."""
SETTINGS: Mapping[str, Mapping[str, float]] = {
    'Rotation Type': {'Quaternion': 1.0}, 'Coordinate Space': {'Global': 1.0},
    'Length Units': {'Meters': 1.0, 'Centimeters': 0.01, 'Millimeters': 0.001, 'Inches': 0.0254}}
"""Accepted settings of an export, with the length of each unit, m."""
HEADS = {'Type': "the row 'Type'", 'Name': "the row 'Name'",
         'quantity': 'a row with the quantity of each column',
         'axis': "the row of axes, which begins with 'Frame'"}
"""Rows of the header, in words."""
MAX_HEAD_ROWS = 12
OLDEST_FORMAT = 1.2
POSE = [f'position {axis}' for axis in 'xyz'] + [f'rotation {axis}' for axis in 'xyzw']
MIN_QUALITY = 0.99
"""Smallest quality of a visible marker (appendix H)."""


class TrackedBody(NamedTuple):
    """Stamps (ns) and poses (N, 7) of a body, and the number of other rows by reason."""

    name: str
    stamps_ns: Stamps
    values: Array
    left_out: dict[str, int]


def read_tum(path: File) -> tuple[Stamps, Array]:
    """
    Return stamps (ns) and poses (N, 7), position (m) and quaternion xyzw, of a TUM file.

    Raises
    ------
    BellowsError
        With the line, if the file is not a TUM file.

    """
    stamps, values = list[int](), array('d')
    for number, line in enumerate(read_text(path, MAX_FILE_BYTES).splitlines(), 1):
        if not (cells := line.partition('#')[0].split()):
            continue
        try:
            stamps.append(int(Decimal(cells[0]) * NS_PER_S))  # floats of s lose ns
            values.extend(map(float, cells[1:]))
            if len(cells) != 8 or not 0 <= stamps[-1] < 2**63:
                raise ValueError
        except (ArithmeticError, ValueError):
            raise BellowsError(
                f"'{path}', line {number}: expected 8 numbers, 'time x y z qx qy qz qw' in s and "
                f"m, got '{shown(line, 80)}'.") from None
    if not stamps:
        raise BellowsError(f"'{path}' has no poses.")
    return np.array(stamps, dtype=np.int64), np.array(values).reshape(-1, 7)


def is_motive(path: File) -> bool:
    """Return whether a file begins like an export of Motive; false if unreadable, or a pipe."""
    if not os.path.isfile(path):
        return False
    with suppress(OSError), open(path, 'rb') as file:
        return file.read(200).lstrip(b'\xef\xbb\xbf"').startswith(b'Format Version')
    return False


def read_motive(path: File) -> list[TrackedBody]:
    """
    Return the rigid bodies of an export of Motive, in its world, with stamps of its clock.

    The stamps are UTC if the clock was; in an export without a time of its start they are from
    1 s on.

    Parameters
    ----------
    path : path
        CSV file exported with header, global coordinates and quaternions; marker quality is
        optional.

    Raises
    ------
    BellowsError
        With the line, if the file is not an export of Motive, or was exported with other options.

    """
    rows = csv.reader(StringIO(read_text(path, MAX_FILE_BYTES)))
    try:
        settings = next(rows, [])
        scale, start_ns = _unit(path, settings), _start_ns(settings)
        found, time = _columns(_heads(rows))
        needed = sorted({time}.union(*(pose + markers for pose, markers, _ in found.values())))
        values = array('d')
        for row in filter(any, rows):
            values.extend(_numbers(row, needed))
    except (csv.Error, ValueError) as error:
        raise BellowsError(
            f"'{path}' is no CSV export of Motive with rigid bodies and their header, line "
            f"{rows.line_num}: {shown(str(error), 200)}. Export it again, with 'Header "
            "Information' on.") from None
    table = dict(zip(needed, np.array(values).reshape(-1, len(needed)).T, strict=True))
    if not len(table[time]) or not np.all(np.abs(table[time]) < 1e9):  # s
        raise BellowsError(f"'{path}' has no frames, or frames without a time in s.")
    stamps = start_ns + np.rint(table[time] * NS_PER_S).astype(np.int64)
    bodies = []
    for name, (pose, markers, least) in found.items():
        poses = np.column_stack([table[i] for i in pose]) * [*3 * [scale], *4 * [1.0]]
        present = np.isfinite(poses).all(axis=1)
        visible = np.sum([table[i] >= least for i in markers], axis=0)
        few = present & (len(markers) >= MIN_MARKERS) & (visible < MIN_MARKERS)
        left_out = {'not tracked': int(np.sum(~present)), 'too few markers': int(np.sum(few))}
        bodies.append(TrackedBody(name, stamps[present & ~few], poses[present & ~few], {
            reason: count for reason, count in left_out.items() if count}))
    return bodies


def _start_ns(settings: Sequence[str]) -> int:
    """Return the start of a take, ns of its clock; 1 s if it is not given."""
    text = dict(pairwise(settings)).get('Capture Start Time', '').replace('.M.', 'M')
    for form in ('%Y-%m-%d %I.%M.%S.%f %p', '%Y-%m-%d %H.%M.%S.%f'):
        with suppress(ValueError):
            start = datetime.strptime(text, form).replace(tzinfo=UTC)
            return round(start.timestamp() * 1e3) * 1_000_000
    return NS_PER_S


def _heads(rows: Iterator[list[str]]) -> list[tuple[str, ...]]:
    """Return type, name, quantity and axis of each column; all but the name in lower case."""
    heads = dict[str, list[str]]()
    for row in islice(rows, MAX_HEAD_ROWS):
        heads['axis' if row[:1] == ['Frame'] else ''.join(row[1:2]) or 'quantity'] = row
        if 'axis' in heads:
            break
    for name, words in HEADS.items():
        if name not in heads:
            raise ValueError(f'expected {words} before the frames')
    kinds, names, quantities, axes = (heads[name] for name in HEADS)
    return [(kind.lower(), name, quantity.lower(), axis.lower())
            for kind, name, quantity, axis in zip_longest(
                kinds, names, quantities, axes, fillvalue='')]


def _numbers(row: Sequence[str], needed: Sequence[int]) -> Iterator[float]:
    """Yield the needed cells of a frame, nan for blank ones."""
    for column in needed:
        if column >= len(row):
            raise ValueError(f'expected {needed[-1] + 1} cells, got {len(row)}')
        try:
            yield float(row[column] or 'nan')
        except ValueError:
            raise ValueError(
                f"expected a number in column {column + 1}, got '{row[column]}'") from None


def _columns(
    heads: Sequence[tuple[str, ...]]
) -> tuple[dict[str, tuple[list[int], list[int], float]], int]:
    """
    Return the columns of each body, and of the time.

    Of each body the columns of its pose, the columns of its markers, and the least value of a
    visible marker are returned.
    """
    names = dict.fromkeys(name for kind, name, *_ in heads if kind == 'rigid body')
    if not names:
        raise ValueError("expected columns of the type 'Rigid Body'")
    found = dict[tuple[str, str, str], list[int]]()
    for number, (kind, owner, quantity, axis) in enumerate(heads):
        # The name of a marker (BODY:Marker1, BODY_1) begins with the name of its body.
        body = owner if kind == 'rigid body' else max(
            (n for n in names if owner.startswith((f'{n}:', f'{n}_'))), key=len, default='')
        found.setdefault((kind, body, f'{quantity} {axis}'.strip()), []).append(number)
    bodies = dict[str, tuple[list[int], list[int], float]]()
    for name in names:
        pose = [found.get(('rigid body', name, column), []) for column in POSE]
        if any(len(columns) > 1 for columns in pose):
            raise ValueError(f"expected one rigid body '{name}', got several (rename one)")
        if [] in pose:
            raise ValueError(f"expected the column '{POSE[pose.index([])]}' of '{name}'")
        qualities = found.get(('rigid body marker', name, 'marker quality'))
        bodies[name] = (
            [columns[0] for columns in pose],
            qualities or found.get(('marker', name, 'position x'), []),
            MIN_QUALITY if qualities else -np.inf)
    times = [number for number, (*_, axis) in enumerate(heads) if axis.startswith('time (')]
    return bodies, times[0] if times else 1


def _unit(path: File, row: Sequence[str]) -> float:
    """Return the unit of length, m; raise for settings that are not accepted."""
    about = dict(pairwise(row))  # by name, as a take's name may have commas
    if not re.fullmatch(r'\d+\.\d+', version := about.get('Format Version', '')):
        raise ValueError("expected 'Format Version' and its number, separated by a comma")
    if float(version) < OLDEST_FORMAT:
        raise BellowsError(f"'{path}' has Format Version {version}; expected {OLDEST_FORMAT} to "
                           '1.25. Export the take again with a newer Motive.')
    for name, accepted in SETTINGS.items():
        value = about.get(name, '' if name == 'Length Units' else next(iter(accepted)))
        if value not in accepted:
            raise BellowsError(
                f"'{path}' has {name} '{value}'; expected {' or '.join(accepted)}. Export it "
                'again with this setting.')
    return SETTINGS['Length Units'][about['Length Units']]
