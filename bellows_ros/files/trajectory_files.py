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
from collections.abc import Mapping, Sequence
from contextlib import suppress
import csv
from decimal import Decimal
from io import StringIO
from itertools import islice
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
"""Accepted settings of an export; those of the length units are in m."""
POSE = [f'Position {axis}' for axis in 'XYZ'] + [f'Rotation {axis}' for axis in 'XYZW']
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
    """Return whether a file begins like an export of Motive; false if unreadable."""
    with suppress(OSError), open(path, 'rb') as file:
        return file.read(200).lstrip(b'\xef\xbb\xbf"').startswith(b'Format Version')
    return False


def read_motive(path: File) -> list[TrackedBody]:
    """
    Return the rigid bodies of an export of Motive, in its world, with stamps from 1 s on.

    Parameters
    ----------
    path : path
        CSV file exported with header, global coordinates and quaternions; marker quality is
        optional.

    Raises
    ------
    BellowsError
        If the file is not an export of Motive, or was exported with other options.

    """
    try:
        rows = csv.reader(StringIO(read_text(path, MAX_FILE_BYTES)))
        settings, heads = next(rows, []), dict[str, list[str]]()
        for row in islice(rows, 12):
            heads['Axis' if row[:1] == ['Frame'] else ''.join(row[1:2]) or 'Quantity'] = row
            if 'Axis' in heads:
                break
        found = _columns(*(heads[name] for name in ('Type', 'Name', 'Quantity', 'Axis')))
        needed = sorted({1}.union(*(pose + markers for pose, markers, _ in found.values())))
        values = array('d', (
            float(cells[i] or 'nan') for cells in rows if any(cells) for i in needed))
    except (csv.Error, LookupError, ValueError) as error:
        raise BellowsError(
            f"'{path}' is no CSV export of Motive with rigid bodies and their header "
            f"({shown(str(error), 80)}). Export it again, with 'Header Information' on.") from None
    scale = _unit(path, settings)
    table = dict(zip(needed, np.array(values).reshape(-1, len(needed)).T, strict=True))
    if not len(table[1]) or not np.all(np.abs(table[1]) < 1e9):  # column 1 is the time, s
        raise BellowsError(f"'{path}' has no frames, or frames without a time in s.")
    stamps, bodies = np.rint((1.0 + table[1]) * NS_PER_S).astype(np.int64), []
    for name, (pose, markers, least) in found.items():
        poses = np.column_stack([table[i] for i in pose]) * [*3 * [scale], *4 * [1.0]]
        present = np.isfinite(poses).all(axis=1)
        visible = np.sum([table[i] >= least for i in markers], axis=0)
        few = present & (len(markers) >= MIN_MARKERS) & (visible < MIN_MARKERS)
        left_out = {'not tracked': int(np.sum(~present)), 'too few markers': int(np.sum(few))}
        bodies.append(TrackedBody(name, stamps[present & ~few], poses[present & ~few], {
            reason: count for reason, count in left_out.items() if count}))
    return bodies


def _columns(*heads: Sequence[str]) -> dict[str, tuple[list[int], list[int], float]]:
    """Return the columns of each body's pose and markers, and the least value of a visible one."""
    columns = list(zip(*heads, strict=True))
    names = dict.fromkeys(name for kind, name, *_ in columns if kind == 'Rigid Body')
    if not names:
        raise ValueError('there are no rigid bodies')
    found = dict[tuple[str, str, str], list[int]]()
    for number, (kind, owner, quantity, axis) in enumerate(columns):
        # The name of a marker (BODY:Marker1, BODY_1) begins with the name of its body.
        body = owner if kind == 'Rigid Body' else max(
            (n for n in names if owner.startswith((f'{n}:', f'{n}_'))), key=len, default='')
        found.setdefault((kind, body, f'{quantity} {axis}'.strip()), []).append(number)
    qualities = {name: found.get(('Rigid Body Marker', name, 'Marker Quality')) for name in names}
    return {name: (
        [found['Rigid Body', name, column][0] for column in POSE],
        qualities[name] or found.get(('Marker', name, 'Position X'), []),
        MIN_QUALITY if qualities[name] else -np.inf) for name in names}


def _unit(path: File, row: Sequence[str]) -> float:
    """Return the unit of length, m; raise for settings that are not accepted."""
    about = dict(zip(row, row[1:], strict=False))  # by name, as a take's name may have commas
    for name, accepted in SETTINGS.items():
        value = about.get(name, '' if name == 'Length Units' else next(iter(accepted)))
        if value not in accepted:
            raise BellowsError(
                f"'{path}' has {name} '{value}'; expected {' or '.join(accepted)}. Export it "
                'again with this setting.')
    return SETTINGS['Length Units'][about['Length Units']]
