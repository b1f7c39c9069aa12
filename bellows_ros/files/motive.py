"""
Motive's CSV exports (format 1.2x): poses of rigid bodies, with what was not tracked left out.

A pose is left out where its cells are blank, and where fewer markers of its body are seen than a
rigid body needs; a marker is seen where its quality is at least 0.99 (appendix H).
"""

from collections.abc import Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass
from datetime import datetime, UTC
import os
from pathlib import Path

from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

SEEN_QUALITY = 0.99  # appendix H
FEWEST_MARKERS = 3  # of a rigid body, for a pose
UNITS = {'Meters': 1.0, 'Centimeters': 0.01, 'Millimeters': 0.001}  # m
TIME_FORMATS = ('%Y-%m-%d %I.%M.%S.%f %p', '%Y-%m-%d %H.%M.%S.%f')
LARGEST_FILE = 2**31
HEAD_ROWS = 12  # in which the table must begin
POSE = ('Rotation X', 'Rotation Y', 'Rotation Z', 'Rotation W', 'Position X', 'Position Y',
        'Position Z')  # fmt: skip
NS_PER_S = 1e9

Array = NDArray[np.float64]
Heads = Mapping[str, Sequence[str]]


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
    stamps_ns: NDArray[np.int64]
    values: Array
    missing: int
    unseen: int


def read_motive(
    path: str | os.PathLike[str], fewest_markers: int = FEWEST_MARKERS
) -> tuple[MotiveBody, ...]:
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
    rows = _rows(Path(path))
    about, heads, start = _head(Path(path), rows)
    table = _numbers(Path(path), rows[start:], len(heads['axis']))
    scale = _scale(Path(path), about)
    stamps = _start_ns(about) + np.rint(table[:, 1] * NS_PER_S).astype(np.int64)
    names = dict.fromkeys(name for kind, name in zip(heads['Type'], heads['Name'], strict=True)
                          if kind == 'Rigid Body')  # fmt: skip
    if not names:
        raise BellowsError(
            f"'{path}' has no rigid bodies. Export the take again with rigid bodies switched on."
        )
    return tuple(
        _body(Path(path), name, heads, table, stamps, scale, fewest_markers) for name in names
    )


def is_motive(path: str | os.PathLike[str]) -> bool:
    """Tell whether a file begins as Motive's exports do."""
    with Path(path).open('rb') as file:
        return file.read(200).lstrip(b'\xef\xbb\xbf').startswith(b'Format Version')


def _rows(path: Path) -> list[list[str]]:
    """Return the cells of a file."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise BellowsError(f"'{path}' is larger than {LARGEST_FILE} bytes. Export a part.")
        with path.open(encoding='utf-8-sig', newline='') as file:
            return list(csv.reader(file))
    except OSError as error:
        raise BellowsError(f"'{path}' cannot be read: {error.strerror}.") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise BellowsError(f"'{path}' is no CSV file: {error}.") from None


def _head(path: Path, rows: list[list[str]]) -> tuple[dict[str, str], Heads, int]:
    """Return what the file says about itself, its column heads, and where the numbers begin."""
    first = rows[0] if rows else []
    about = dict(zip(first[::2], first[1::2], strict=False))
    found = [i for i, row in enumerate(rows[:HEAD_ROWS]) if row[:1] == ['Frame']]
    if 'Format Version' not in about or not found:
        raise BellowsError(
            f"'{path}' is no CSV export of Motive with its header. Export it again, with 'Header "
            "Information' switched on."
        )
    width = len(rows[found[0]])
    heads: dict[str, Sequence[str]] = {'axis': rows[found[0]]}
    for row in rows[1:found[0]]:
        if len(row) > 1:
            label = row[1] or 'Quantity'
            heads[label] = row + [''] * (width - len(row))
    lacking = [name for name in ('Type', 'Name', 'Quantity') if name not in heads]
    if lacking:
        raise BellowsError(f"'{path}' lacks the header row {lacking[0]}. Export it again.")
    _require_settings(path, about)
    return about, heads, found[0] + 1


def _require_settings(path: Path, about: Mapping[str, str]) -> None:
    """Refuse what was exported in another way than poses can be taken from."""
    for name, wanted in (('Rotation Type', 'Quaternion'), ('Coordinate Space', 'Global')):
        if about.get(name, wanted) != wanted:
            raise BellowsError(
                f"'{path}' has {name} {about[name]}; {wanted} is needed. Export it again."
            )


def _scale(path: Path, about: Mapping[str, str]) -> float:
    """Return the file's unit of length, m."""
    unit = about.get('Length Units', 'Meters')
    if unit not in UNITS:
        raise BellowsError(f"'{path}' has lengths in {unit}; known are {', '.join(UNITS)}.")
    return UNITS[unit]


def _start_ns(about: Mapping[str, str]) -> int:
    """Return when the take began, ns; one second after 1970 where the file does not say."""
    text = about.get('Capture Start Time', '')
    for form in TIME_FORMATS:
        try:
            start = datetime.strptime(text, form).replace(tzinfo=UTC)
        except ValueError:
            continue
        return round(start.timestamp() * 1e3) * 1_000_000
    return int(NS_PER_S)


def _numbers(path: Path, rows: list[list[str]], width: int) -> Array:
    """Return the table (N, width); blank cells are NaN."""
    kept = [row for row in rows if row]
    table = np.full((len(kept), width), np.nan)
    for number, row in enumerate(kept):
        try:
            cells = [float(cell) if cell.strip() else np.nan for cell in row[:width]]
        except ValueError as error:
            raise BellowsError(f"'{path}', row {number + 1} of the table: {error}.") from None
        table[number, :len(cells)] = cells
    if not len(table) or not np.all(np.isfinite(table[:, 1])):
        raise BellowsError(f"'{path}' has no frames, or frames without a time.")
    return table


def _body(
    path: Path, name: str, heads: Heads, table: Array, stamps: NDArray[np.int64], scale: float,
    fewest_markers: int,
) -> MotiveBody:  # fmt: skip
    """Return the usable poses of a body."""
    columns = {f'{quantity} {axis}'.strip(): number
               for number, (kind, owner, quantity, axis) in enumerate(_columns(heads))
               if kind == 'Rigid Body' and owner == name}  # fmt: skip
    lacking = [column for column in POSE if column not in columns]
    if lacking:
        raise BellowsError(
            f"'{path}': rigid body '{name}' lacks the column {lacking[0]}. Export it again."
        )
    pose = table[:, [columns[column] for column in POSE]]
    there = np.isfinite(pose).all(axis=1)
    seen = _markers_seen(name, heads, table)
    enough = np.ones(len(table), dtype=bool) if seen is None else seen >= fewest_markers
    kept = there & enough
    values = np.hstack([scale * pose[kept, 4:], pose[kept, :4]])
    return MotiveBody(
        name, stamps[kept], values, int(np.count_nonzero(~there)),
        int(np.count_nonzero(there & ~enough)),
    )  # fmt: skip


def _columns(heads: Heads) -> Iterator[tuple[str, str, str, str]]:
    """Yield type, name, quantity and axis of each column."""
    return zip(heads['Type'], heads['Name'], heads['Quantity'], heads['axis'], strict=True)


def _markers_seen(name: str, heads: Heads, table: Array) -> NDArray[np.int64] | None:
    """Return how many markers of a body are seen in each frame; None where it is not said."""
    quality = [number for number, (kind, owner, quantity, _) in enumerate(_columns(heads))
               if kind == 'Rigid Body Marker' and quantity == 'Marker Quality'
               and owner.startswith((f'{name}:', f'{name}_'))]  # fmt: skip
    if not quality:
        return None
    seen: NDArray[np.int64] = np.count_nonzero(table[:, quality] >= SEEN_QUALITY, axis=1)
    return seen
