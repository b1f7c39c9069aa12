"""
Motive's CSV exports (formats 1.2 to 1.25): tracked poses of rigid bodies.

A pose is left out where its cells are blank, and where fewer markers of its body are seen than a
rigid body needs. A marker is seen where its quality is at least 0.99 (appendix H); in an export
without qualities, where its measured position is not blank. (The positions of a 'Rigid Body
Marker' say nothing about that: they are where the body expects its markers, and always there.)

The layout: a row of settings, name and value in turn; a blank row; rows for Type, Name, ID, since
format 1.25 Parent, and quantity; the row of axes, which begins with Frame and Time (Seconds) and,
where the take has one, TimeCode; then a row per frame. Columns are found by these heads, so their
order does not matter.
"""

from collections.abc import Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass
from datetime import datetime, UTC
from pathlib import Path
import re
from typing import TextIO

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.trajectory_files import numbers
import numpy as np

SEEN_QUALITY = 0.99  # appendix H
FEWEST_MARKERS = 3  # of a rigid body, for a pose
UNITS = {'meters': 1.0, 'centimeters': 0.01, 'millimeters': 0.001, 'inches': 0.0254}  # m
# 2021-05-11 02.31.05.250 PM, in some languages of Windows with P.M. or without.
START = re.compile(
    r'(\d{4})-(\d\d)-(\d\d) (\d{1,2})[.:](\d\d)[.:](\d\d)(?:[.,](\d{1,6}))?\s*([AaPp]?)')
SETTINGS = ('Format Version', 'Rotation Type', 'Coordinate Space', 'Length Units',
            'Capture Start Time')
LARGEST_FILE = 2**31
LONGEST = 1e9  # s, of the time of a frame
HEAD_ROWS = 12  # in which the table must begin
POSE = ('Rotation X', 'Rotation Y', 'Rotation Z', 'Rotation W', 'Position X', 'Position Y',
        'Position Z')
TIME = 1  # column

Heads = Mapping[str, Sequence[str]]
Columns = tuple[list[int], list[int], list[int]]
"""Where the poses of a body are, the qualities of its markers, and their measured positions."""


@dataclass(frozen=True, eq=False)
class MotiveBody:
    """
    The poses of a rigid body.

    Parameters
    ----------
    name : str
    stamps_ns : int array (N,)
        Of the poses that can be used, ns.
    values : array (N, 7)
        Position (m) and quaternion (x, y, z, w), in Motive's world.
    missing : int
        Frames without a pose.
    unseen : int
        Frames with a pose made of too few markers.

    """

    name: str
    stamps_ns: Stamps
    values: Array
    missing: int
    unseen: int


def read_motive(path: File, fewest_markers: int = FEWEST_MARKERS) -> tuple[MotiveBody, ...]:
    """
    Read the rigid bodies of a Motive CSV export.

    Parameters
    ----------
    path : path
        Exported with header, global coordinates and quaternions; marker quality is used if there.
    fewest_markers : int
        A pose with fewer markers seen is left out, where the file says how many were.

    Raises
    ------
    BellowsError
        If it is no such file, or was exported in another way.

    """
    file = Path(path)
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise BellowsError(f"'{path}' is larger than {LARGEST_FILE} bytes. Export a part.")
        with file.open(encoding='utf-8-sig', newline='') as stream:
            return _bodies(file, stream, fewest_markers)
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read: {error.strerror}.") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise BellowsError(f"'{path}' is no CSV file: {error}.") from None


def is_motive(path: File) -> bool:
    """Return whether a file begins like an export of Motive."""
    with Path(path).open('rb') as file:
        return file.read(200).lstrip(b'\xef\xbb\xbf"').startswith(b'Format Version')


def _bodies(path: Path, stream: TextIO, fewest_markers: int) -> tuple[MotiveBody, ...]:
    """Return the bodies in an open file."""
    rows = csv.reader(stream)
    about, heads = _head(path, rows)
    scale = UNITS[about['Length Units'].lower()]
    columns = _body_columns(path, heads)
    needed = sorted({TIME}.union(*(c for of_body in columns.values() for c in of_body)))
    frames = ((rows.line_num, [(row[c] if c < len(row) else '').strip() or 'nan' for c in needed])
              for row in rows if any(row))
    table = dict(zip(needed, numbers(path, frames, range(len(needed))).T, strict=True))
    seconds = table[TIME]
    if not len(seconds) or not np.all(np.abs(seconds) < LONGEST):
        raise BellowsError(f"'{path}' has no frames, or frames without a time in s.")
    stamps = _start_ns(about) + np.rint(seconds * NS_PER_S).astype(np.int64)
    found = []
    for name, (pose_columns, qualities, positions) in columns.items():
        pose = np.column_stack([table[c] for c in pose_columns])
        there, enough = np.isfinite(pose).all(axis=1), np.ones(len(pose), dtype=bool)
        if qualities:
            enough = np.sum([table[c] >= SEEN_QUALITY for c in qualities], 0) >= fewest_markers
        elif len(positions) >= FEWEST_MARKERS:
            enough = np.sum([np.isfinite(table[c]) for c in positions], 0) >= fewest_markers
        kept = there & enough
        found.append(MotiveBody(
            name, stamps[kept], np.hstack([scale * pose[kept, 4:], pose[kept, :4]]),
            int(np.count_nonzero(~there)), int(np.count_nonzero(there & ~enough)),
        ))
    return tuple(found)


def _head(path: Path, rows: Iterator[list[str]]) -> tuple[dict[str, str], Heads]:
    """Return what the file says about itself, and its column heads, as wide as the row of axes."""
    first = next(rows, [])
    if first and first[0].startswith('Format Version;'):
        raise BellowsError(
            f"'{path}' has semicolons between its cells: a spreadsheet has saved it again. Take "
            'the file that Motive has written.'
        )
    # By name, as a take's own name or notes may hold commas.
    about = {name: first[first.index(name) + 1] for name in SETTINGS if name in first[:-1]}
    above: dict[str, list[str]] = {}
    for _, row in zip(range(HEAD_ROWS), rows, strict=False):
        if row[:1] == ['Frame'] and 'Format Version' in about:
            width = len(row)
            heads = {label: (cells + [''] * width)[:width] for label, cells in above.items()}
            lacking = [name for name in ('Type', 'Name', 'Quantity') if name not in heads]
            if lacking:
                raise BellowsError(
                    f"'{path}' lacks the header row {lacking[0]}. Export it again.")
            _require_settings(path, about)
            return about, {**heads, 'axis': row}
        if any(row):
            above[row[1] if len(row) > 1 and row[1] else 'Quantity'] = row
    raise BellowsError(
        f"'{path}' is no CSV export of Motive with its header. Export it again, with 'Header "
        "Information' switched on."
    )


def _require_settings(path: Path, about: Mapping[str, str]) -> None:
    """Refuse an export that poses cannot be taken from."""
    for name, wanted in (('Rotation Type', 'Quaternion'), ('Coordinate Space', 'Global')):
        if about.get(name, wanted) != wanted:
            raise BellowsError(
                f"'{path}' has {name} {about[name]}; {wanted} is needed. Export it again with "
                f'{name} set to {wanted}.'
            )
    unit = about.get('Length Units', 'an unknown unit')
    if unit.lower() not in UNITS:
        raise BellowsError(
            f"'{path}' has lengths in {unit}; expected are {', '.join(UNITS)}. Export it again.")


def _start_ns(about: Mapping[str, str]) -> int:
    """Return when the capture began, ns (its clock is taken as UTC); 1 s if not stated."""
    match = START.match(about.get('Capture Start Time', ''))
    if match is None:
        return int(NS_PER_S)
    year, month, day, hour, minute, second = map(int, match.groups()[:6])
    if match[8]:
        hour = hour % 12 + (12 if match[8] in 'Pp' else 0)
    try:
        start = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return int(NS_PER_S)
    return int(start.timestamp()) * 10**9 + int((match[7] or '0').ljust(9, '0'))


def _body_columns(path: Path, heads: Heads) -> dict[str, Columns]:
    """Return the columns of each rigid body."""
    pairs = zip(heads['Type'], heads['Name'], strict=True)
    names = list(dict.fromkeys(name for kind, name in pairs if kind == 'Rigid Body'))
    if not names:
        raise BellowsError(
            f"'{path}' has no rigid bodies. Export the take again with rigid bodies switched on."
        )
    poses: dict[str, dict[str, int]] = {name: {} for name in names}
    qualities: dict[str, list[int]] = {name: [] for name in names}
    positions: dict[str, list[int]] = {name: [] for name in names}
    for number, (kind, owner, quantity, axis) in enumerate(zip(
            heads['Type'], heads['Name'], heads['Quantity'], heads['axis'], strict=True)):
        if kind == 'Rigid Body':
            poses[owner].setdefault(f'{quantity} {axis}'.strip(), number)
            continue
        # A marker's name (BODY:Marker1, BODY_1) begins with that of its body.
        fitting = [name for name in names if owner.startswith((f'{name}:', f'{name}_'))]
        body = max(fitting, key=len, default='')
        if body and kind == 'Rigid Body Marker' and quantity == 'Marker Quality':
            qualities[body].append(number)
        elif body and kind == 'Marker' and (quantity, axis) == ('Position', 'X'):
            positions[body].append(number)
    for name, pose in poses.items():
        lacking = [column for column in POSE if column not in pose]
        if lacking:
            raise BellowsError(
                f"'{path}': rigid body '{name}' lacks the column {lacking[0]}. Export it again."
            )
    return {name: ([poses[name][column] for column in POSE], qualities[name], positions[name])
            for name in names}
