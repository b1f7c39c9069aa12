"""Results in words and tables, as the commands print them."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from bellows_ros.core.score import AXES, Scores
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STIFFNESS_UNITS = ('N/m',) * 3 + ('N m/rad',) * 3
DAMPING_UNITS = ('N s/m',) * 3 + ('N m s/rad',) * 3
MILLI = 1e3
SHOWN = 5


def cup_table(fit: Any) -> list[str]:
    """Return K and P with standard errors, a line per direction; of a full fit all entries."""
    rows = [('axis', 'stiffness K', 'damping P')]
    for axes in _tied(fit.structure):
        i = axes[0]
        rows.append(
            (
                ', '.join(AXES[axis] for axis in axes),
                f'{with_error(fit.stiffness[i, i], fit.stiffness_std[i, i])} {STIFFNESS_UNITS[i]}',
                f'{with_error(fit.damping[i, i], fit.damping_std[i, i])} {DAMPING_UNITS[i]}',
            )
        )
    lines = aligned(rows)
    if fit.structure == 'full':
        lines += ['', 'K in N/m, N and N m/rad:', *_matrix(fit.stiffness)]
        lines += ['', 'P in N s/m, N s and N m s/rad:', *_matrix(fit.damping)]
    return lines


def _tied(structure: str) -> Sequence[tuple[int, ...]]:
    """Return the axes that share a number."""
    if structure == 'axisymmetric':
        return ((0, 1), (2,), (3, 4), (5,))
    return tuple((i,) for i in range(6))


def _matrix(matrix: Array) -> list[str]:
    """Return a 6x6 matrix, a line per row."""
    return ['  ' + ' '.join(f'{x:11.4g}' for x in row) for row in matrix]


def with_error(value: float, error: float) -> str:
    """
    Return a value to the decimal place of its standard error's second figure, and the error.

    An infinite error is said: the value tells nothing.
    """
    if math.isinf(error):
        return f'{value:.3g} (not told)'
    if not (math.isfinite(error) and error > 0.0 and math.isfinite(value)):
        return f'{value:.5g}'
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f'{value:.{decimals}f} ± {error:.{decimals}f}'


def aligned(rows: Sequence[Sequence[str]], right: bool = False) -> list[str]:
    """Return rows as lines with columns below each other; all but the first right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if right and number else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append('  '.join(cells).rstrip())
    return lines


def score_table(scores: Scores) -> list[str]:
    """Return RMS and largest error and NRMSE, a line per axis."""
    rows = [('axis', 'RMS error', 'largest', 'of the motion')]
    for i, name in enumerate(AXES):
        unit = 'mm' if i < 3 else 'mrad'
        rows.append(
            (
                name,
                f'{scores.rms[i] * MILLI:.3g} {unit}',
                f'{scores.largest[i] * MILLI:.3g} {unit}',
                percent(scores.nrmse[i]),
            )
        )
    return aligned(rows, right=True)


def percent(ratio: float) -> str:
    """Return a ratio in percent, or a dash where nothing moved."""
    return f'{100.0 * ratio:.2f} %' if math.isfinite(ratio) else '-'


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
    reports : sequence of bellows_ros.core.recording.preparation.Report
        One per recording.

    """
    lines = [f'{fit.samples_used} samples used, {fit.samples_rejected} rejected.']
    streams = [stream for report in reports for stream in (report.tool, report.package)]
    return lines + [f'  {stream.name}: {line}' for stream in streams
                    if (line := stream_line(stream))]  # fmt: skip


def stream_line(stream: Any) -> str:
    """Return what was wrong with the poses of a topic, or nothing."""
    gaps = stream.timing.gaps
    lost = sum(gap.duration_s for gap in gaps)
    found = [
        *(many(len(indices), f'message {reason.replace("_", " ")}', f'messages {reason}')
          for reason, indices in stream.refused.items() if indices),
        *([many(stream.marked, 'outlier', 'outliers')] if stream.marked else []),
        *([f'{many(len(gaps), "gap", "gaps")} of {lost:.2g} s together'] if gaps else []),
    ]  # fmt: skip
    touched = f'; {stream.touched} filtered samples touch these' if stream.touched else ''
    return ', '.join(found) + touched if found else ''


def many(count: int, one: str, several: str) -> str:
    """Return a count with its noun."""
    return f'{count} {one if count == 1 else several}'


def count_lines(counts: Mapping[str, int]) -> list[str]:
    """Return what came in and went out, and a line for all that was left out on the way."""
    known = ('poses', 'twists', 'predictions', 'twists estimated')
    poses, twists, predictions, estimated = (counts.get(name, 0) for name in known)
    line = (f'{many(poses, "pose", "poses")} and {many(twists, "twist", "twists")} in, '
            f'{many(predictions, "prediction", "predictions")} out')  # fmt: skip
    line += f'; {many(estimated, "twist", "twists")} estimated from poses.' if estimated else '.'
    return [line, *(f'  {name}: {count}' for name, count in counts.items() if name not in known)]
