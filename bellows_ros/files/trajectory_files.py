"""
Trajectories as text: TUM and EuRoC (read and written), and KITTI (read).

TUM has a pose per line, `time x y z qx qy qz qw`, in s and m, with blanks between; evo and many
SLAM tools take it. EuRoC has commas, ns, and the quaternion's w first. KITTI has the upper three
rows of a pose's matrix in a line, and the times (s) in another file.
"""

from array import array
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, File, read_text
import numpy as np

LARGEST_FILE = 2**31
LATEST_NS = 9 * 10**18
"""Later stamps do not fit into 64 bits."""

Lines = list[tuple[int, list[str]]]
"""Numbers and cells of the lines of a file."""

NO_ROTATION = 0.01
"""R^T R of a KITTI pose may differ from I by this much; R is then made a rotation."""


def read_trajectory(path: File) -> tuple[Stamps, Array]:
    """Read a EuRoC file, which ends in .csv, or a KITTI or TUM file; see `read_tum`."""
    if Path(path).suffix.lower() == '.csv':
        return read_euroc(path)
    lines = _lines(path, None)
    return read_kitti(path) if len(lines[0][1]) == 12 else read_tum(path)


def read_kitti(path: File) -> tuple[Stamps, Array]:
    """
    Read the poses of a KITTI file, and their times (s) from a file beside it.

    That is named NAME_times.txt, or times.txt. See `read_tum` for what is returned.
    """
    file = Path(path)
    lines = _lines(path, None, 12, 12)
    beside = [file.with_name(f'{file.stem}_times.txt'), file.with_name('times.txt')]
    times = next((each for each in beside if each.is_file()), None)
    if times is None:
        raise BellowsError(
            f"'{path}' is of KITTI, without times. Put them into '{beside[0]}', one (s) per line.")
    stamps = _stamps(times, _lines(times, None), 's')
    if len(stamps) != len(lines):
        raise BellowsError(
            f"'{path}' has {len(lines)} poses, and '{times}' {len(stamps)} times; expected one "
            'for each.')
    rows = numbers(path, lines, range(12)).reshape(-1, 3, 4)
    R, unit = rows[:, :, :3], np.eye(3)
    off = np.abs(np.einsum('nji,njk->nik', R, R) - unit).max(axis=(1, 2))
    bad = np.flatnonzero(~(off < NO_ROTATION) | ~(np.linalg.det(R) > 0.0))
    if len(bad):
        raise BellowsError(
            f"'{path}', line {lines[bad[0]][0]}: the first three columns are no rotation, by "
            f'{off[bad[0]]:.2g}. A KITTI line has the rows of [R t], row by row.')
    u, _, v = np.linalg.svd(R)
    return stamps, np.hstack([rows[:, :, 3], rotation_to_quaternion(u @ v)])


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
        With the line, if it is no such file.

    """
    lines = _lines(path, None, 8, 8)
    return _stamps(path, lines, 's'), numbers(path, lines, range(1, 8))


def read_euroc(path: File) -> tuple[Stamps, Array]:
    """Read the poses of a EuRoC ground-truth or estimate file; see `read_tum`."""
    lines = _lines(path, ',', 8)
    return _stamps(path, lines, 'ns'), numbers(path, lines, (1, 2, 3, 5, 6, 7, 4))


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
        If it cannot be written.

    """
    lines = [
        f'{stamp // NS_PER_S}.{stamp % NS_PER_S:09d} ' + ' '.join(f'{x:.9g}' for x in row)
        for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True)
    ]
    head = '# time x y z qx qy qz qw (s, m)'
    atomic.write_text(path, '\n'.join([head, *lines]) + '\n')


def write_euroc(path: File, stamps_ns: Stamps, values: Array) -> None:
    """
    Write a EuRoC file with velocities, whole or not at all.

    Parameters
    ----------
    path : path
        Text file.
    stamps_ns : int array (N,)
        Times, ns.
    values : array (N, 13)
        Position (m), quaternion (x, y, z, w), linear and angular velocity (m/s, rad/s).

    Raises
    ------
    BellowsError
        If it cannot be written.

    """
    order = [0, 1, 2, 6, 3, 4, 5, *range(7, 13)]
    lines = [f'{stamp},' + ','.join(f'{x:.9g}' for x in row) for stamp, row in zip(
        stamps_ns.tolist(), values[:, order].tolist(), strict=True)]
    head = '#time (ns),x,y,z (m),qw,qx,qy,qz,vx,vy,vz (m/s),wx,wy,wz (rad/s)'
    atomic.write_text(path, '\n'.join([head, *lines]) + '\n')


def write_urscript(
    path: File, seconds: Array, position: Array, rotation_vector: Array, frame: str
) -> None:
    """
    Write a program for a Universal Robots arm that moves the tool through evenly timed poses.

    It moves to the first of them slowly, after a confirmation at the teach pendant.

    Parameters
    ----------
    path : path
        Text file.
    seconds : array (N,)
        Times in equal steps.
    position, rotation_vector : array (N, 3)
        Of the tool tip in a frame, m and rad.
    frame : str
        Name of that frame.

    Raises
    ------
    BellowsError
        If it cannot be written.

    """
    step = float(seconds[1] - seconds[0])
    lines = [
        'def bellows_motion():',
        f'  # poses of the tool tip in {frame!r}; set where that is in the base of the arm,',
        '  # and the tool tip (TCP) in the installation',
        '  world = p[0, 0, 0, 0, 0, 0]',
        '  def to(pose):',
        f'    servoj(get_inverse_kin(pose_trans(world, pose)), t={step:g}, '
        'lookahead_time=0.03, gain=2000)',
        '  end']
    poses = ['p[' + ', '.join(f'{x:.6f}' for x in row) + ']'
             for row in np.hstack([position, rotation_vector]).tolist()]
    lines += ['  popup("The arm moves to the start of the motion. Continue if world is set and '
              'the way is free.", title="bellows_motion", blocking=True)',
              f'  movej(get_inverse_kin(pose_trans(world, {poses[0]})), a=0.3, v=0.2)',
              *(f'  to({pose})' for pose in poses), '  stopj(2.0)', 'end']
    atomic.write_text(path, '\n'.join(lines) + '\n')


def _lines(path: File, separator: str | None, fewest: int = 1, most: int = 10**6) -> Lines:
    """Return the numbers and cells of the lines that are no comments."""
    lines = [
        (number, [cell.strip() for cell in line.split(separator)])
        for number, line in enumerate(read_text(path, LARGEST_FILE).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    if not lines:
        raise BellowsError(f"'{path}' has no poses.")
    for number, cells in lines:
        if not fewest <= len(cells) <= most:
            wanted = f'{"" if fewest == most else "at least "}{fewest} numbers'
            raise _unlike(path, number, f'{wanted}, got {len(cells)}')
    return lines


def _unlike(path: File, number: int, what: str) -> BellowsError:
    """Return the error for a line that does not hold what it must."""
    return BellowsError(
        f"'{path}', line {number}: expected {what}. A TUM line is 'time x y z qx qy qz qw'; "
        "a EuRoC line is 'time_ns, x, y, z, qw, qx, qy, qz, ...'.")


def _stamps(path: File, lines: Lines, unit: str) -> Stamps:
    """Return the times at the beginning of lines, in s or ns; none goes through a float."""
    factor = {'s': NS_PER_S, 'ns': 1}[unit]
    stamps = []
    for number, (cell, *_) in lines:
        try:
            time = Decimal(cell)
            known = 0 <= time < LATEST_NS // factor and (factor > 1 or time % 1 == 0)
        except ArithmeticError:
            known = False
        if not known:
            raise _unlike(path, number, f"a time in {unit}, got '{cell[:40]}'")
        stamps.append(int(time * factor))
    return np.array(stamps, dtype=np.int64)


def numbers(path: File, lines: Iterable[tuple[int, list[str]]], columns: Sequence[int]) -> Array:
    """Return some columns (N, columns) of lines, each with its number."""
    values = array('d')
    for number, cells in lines:
        try:
            values.extend([float(cells[i]) for i in columns])
        except ValueError as error:
            raise BellowsError(f"'{path}', line {number}: {error}.") from None
    return np.array(values).reshape(-1, len(columns))
