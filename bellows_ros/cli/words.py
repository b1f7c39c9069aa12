"""Results in words and tables, as the commands print them."""

from collections.abc import Mapping, Sequence
import math
import shutil
from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.residuals import AXES
from bellows_ros.core.structure import structure_named

STIFFNESS_UNITS = ('N/m',) * 3 + ('N m/rad',) * 3
DAMPING_UNITS = ('N s/m',) * 3 + ('N m s/rad',) * 3
MILLI = 1e3
GUTTER, INDENTED = 2, 2
SHOWN = 5


def cup_table(fit: Any) -> list[str]:
    """Return K and P with standard errors, a line per direction; with couplings all entries."""
    structure = structure_named(fit.structure)
    rows = [('axis', 'stiffness K', 'damping P')]
    for axes in structure.tied_axes:
        i = axes[0]
        rows.append(
            (
                ', '.join(AXES[axis] for axis in axes),
                f'{with_error(fit.stiffness[i, i], fit.stiffness_std[i, i])} {STIFFNESS_UNITS[i]}',
                f'{with_error(fit.damping[i, i], fit.damping_std[i, i])} {DAMPING_UNITS[i]}',
            )
        )
    lines = aligned(rows)
    if structure.couples:
        lines += ['', 'K in N/m, N and N m/rad:', *_matrix(fit.stiffness)]
        lines += ['', 'P in N s/m, N s and N m s/rad:', *_matrix(fit.damping)]
    return lines


def _matrix(matrix: Array) -> list[str]:
    """Return a 6x6 matrix, a line per row."""
    return ['  ' + ' '.join(f'{x:11.4g}' for x in row) for row in matrix]


def with_error(value: float, error: float) -> str:
    """
    Return a value to the decimal place of its standard error's second figure, and the error.

    An infinite error is said: the value is meaningless.
    """
    if math.isinf(error):
        return f'{value:.3g} (not identifiable)'
    if not (math.isfinite(error) and error > 0.0 and math.isfinite(value)):
        return f'{value:.5g}'
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f'{value:.{decimals}f} ± {error:.{decimals}f}'


def aligned(rows: Sequence[Sequence[str]], right: bool = False) -> list[str]:
    """
    Return rows as lines with columns below each other; all but the first right-aligned.

    On a terminal that is too narrow, columns follow in blocks, each with the first one again.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for block in _blocks(widths, shutil.get_terminal_size((0, 0)).columns - INDENTED):
        for row in rows:
            cells = [
                row[i].rjust(widths[i]) if right and i else row[i].ljust(widths[i])
                for i in (0, *block)
            ]
            lines.append('  '.join(cells).rstrip())
    return lines


def _blocks(widths: Sequence[int], room: int) -> list[list[int]]:
    """Return the columns beside the first in blocks that fit; in one where no width is known."""
    blocks, used = [list[int]()], widths[0]
    for number, width in enumerate(widths[1:], 1):
        if blocks[-1] and 0 < room < used + GUTTER + width:
            blocks.append([])
            used = widths[0]
        blocks[-1].append(number)
        used += GUTTER + width
    return blocks


def short(value: float) -> str:
    """Return a positive number in at most six characters."""
    if value >= 1e3:
        return f'{value:.0f}'
    return f'{value:.3g}' if value >= 0.01 else f'{value:.4f}'


def percent(ratio: float, decimals: int = 2) -> str:
    """Return a ratio in percent, or a dash where nothing moved."""
    return f'{100.0 * ratio:.{decimals}f} %' if math.isfinite(ratio) else '-'


def listed(items: Sequence[str]) -> str:
    """Return items as in a sentence; of many the first ones and how many more."""
    if len(items) > SHOWN:
        return f'{", ".join(items[:SHOWN])} and {len(items) - SHOWN} more'
    return ' and '.join(filter(None, [', '.join(items[:-1]), items[-1]]))


def sample_lines(fit: Any, reports: Sequence[Any]) -> list[str]:
    """
    Return how many samples were used, and what was wrong with the others.

    Parameters
    ----------
    fit : bellows_ros.core.identification.result.Fit
        The fit.
    reports : sequence of mapping
        What became of each recording, as in the JSON file.

    """
    lines = [f'{fit.samples_used} samples used, {fit.samples_rejected} rejected.']
    streams = [report[name] for report in reports for name in ('tool_pose', 'package_pose')]
    return lines + [f'  {stream["topic"]}: {line}' for stream in streams
                    if (line := stream_line(stream))]


def stream_line(stream: Mapping[str, Any]) -> str:
    """Return what was wrong with the poses of a topic, or nothing."""
    gaps, outliers, touched = (
        stream[name] for name in ('gaps', 'outliers', 'filtered_samples_left_out'))
    lost = sum(gap['duration_s'] for gap in gaps)
    found = [
        *(many(len(indices), f'message {reason.replace("_", " ")}', f'messages {reason}')
          for reason, indices in stream['refused'].items() if indices),
        *([many(outliers, 'outlier', 'outliers')] if outliers else []),
        *([f'{many(len(gaps), "gap", "gaps")} of {lost:.2g} s together'] if gaps else []),
    ]
    left_out = f'; {touched} filtered samples touch these' if touched else ''
    return ', '.join(found) + left_out if found else ''


def many(count: int, one: str, several: str) -> str:
    """Return a count with its noun."""
    return f'{count} {one if count == 1 else several}'


def count_lines(counts: Mapping[str, int]) -> list[str]:
    """Return what came in and went out, and a line for all that was left out on the way."""
    known = ('poses', 'twists', 'predictions', 'twists estimated')
    poses, twists, predictions, estimated = (counts.get(name, 0) for name in known)
    line = (f'{many(poses, "pose", "poses")} and {many(twists, "twist", "twists")} in, '
            f'{many(predictions, "prediction", "predictions")} out')
    line += f'; {many(estimated, "twist", "twists")} estimated from poses.' if estimated else '.'
    return [line, *(f'  {name}: {count}' for name, count in counts.items() if name not in known)]
