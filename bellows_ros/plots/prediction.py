"""
Measured against predicted pose of the package relative to the tool, all six axes.

The content of Figs. 4.16 and 4.17 of the thesis on one page, with what is left over below each
axis, to its own scale.
"""

from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.residuals import Comparison
import numpy as np

from .panels import arrange_pair, draw_strip, pairs
from .style import drawing, Theme, THEMES

SIZE = (11.0, 8.4)  # inches
LEFT, RIGHT, BETWEEN = 0.085, 0.985, 0.19  # parts of the width; of a column between two
MIDDLE = LEFT + (RIGHT - LEFT) * (1.0 + BETWEEN) / (2.0 + BETWEEN)
MILLI = 1e3
UNITS = ('mm',) * 3 + ('mrad',) * 3
GAP_PERIODS = 3.0
"""A line is interrupted where so many sampling periods have no sample."""

LEAST_SPAN = 2.0  # mm or mrad; an axis that hardly moves is not blown up beyond this


def prediction_figure(
    seconds: Array, comparison: Comparison, title: str, note: str, theme: str = 'light'
) -> Any:
    """
    Draw a comparison.

    Parameters
    ----------
    seconds : array (N,)
        From the recording's first stamp, s.
    comparison : Comparison
        What is drawn; each line is interrupted where its own values are missing.
    title, note : str
        What is shown, and under which conditions.
    theme : {'light', 'dark'}
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours = THEMES[theme]
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=SIZE)
        _write_head(figure, title, note, colours)
        columns = pairs(
            figure, left=LEFT, right=RIGHT, top=0.855, bottom=0.065, hspace=0.2, wspace=BETWEEN)
        for axis, panels in enumerate(columns):
            _draw_axis(panels, seconds, comparison, axis, colours)
            unit = UNITS[axis]
            arrange_pair(panels, axis, seconds, unit, f'error\n({unit})', colours)
    return figure


def _write_head(figure: Any, title: str, note: str, colours: Theme) -> None:
    """Write title, conditions and legend over all panels."""
    figure.text(LEFT, 0.955, title, fontsize=13.5, fontweight='bold')
    figure.text(LEFT, 0.93, note, color=colours.quiet)
    columns = ((LEFT, 'Position of B in tool axes'), (MIDDLE, 'Rotation of B in tool axes'))
    for x, words in columns:
        figure.text(x, 0.885, words, fontsize=10.5, fontweight='bold')
    lines = [
        _line(colours.measured, 4.0, 'measured'),
        _line(colours.predicted, 1.0, 'predicted'),
        _line(colours.error, 1.0, 'predicted minus measured'),
    ]
    figure.legend(
        handles=lines, loc='upper right', bbox_to_anchor=(0.992, 0.982), ncols=3, fontsize=9.5,
        handlelength=1.8, columnspacing=1.6,
    )


def _line(colour: str, width: float, label: str) -> Any:
    """Return an entry of the legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, linewidth=width, label=label)


def _draw_axis(
    panels: Any, seconds: Array, comparison: Comparison, axis: int, colours: Theme
) -> None:
    """Draw one coordinate and its error."""
    upper, lower = panels
    times, measured, predicted = (
        with_gaps(seconds, values)
        for values in (seconds, comparison.measured[:, axis] * MILLI,
                       comparison.predicted[:, axis] * MILLI)
    )
    upper.plot(times, measured, color=colours.measured, linewidth=3.6)
    upper.plot(times, predicted, color=colours.predicted, linewidth=0.9)
    _widen(upper)
    draw_strip(lower, times, predicted - measured, colours)
    scores, unit = comparison.scores, UNITS[axis]
    upper.set_title(
        f'error RMS {figures(scores.rms[axis] * MILLI)} {unit}, largest '
        f'{figures(scores.largest[axis] * MILLI)} {unit}, '
        f'{percent(scores.nrmse[axis])} of the motion',
        loc='right', fontsize=8.5, color=colours.quiet, pad=4.0,
    )


def figures(value: float) -> str:
    """Return a number with two figures."""
    return f'{value:#.2g}'.removesuffix('.')


def percent(ratio: float) -> str:
    """Return a ratio in percent with two figures, or a dash where nothing moved."""
    return f'{figures(100.0 * ratio)} %' if np.isfinite(ratio) else '-'


def _widen(panel: Any) -> None:
    """Show at least `LEAST_SPAN`, so that noise on an axis at rest does not look like motion."""
    low, high = panel.get_ylim()
    lack = 0.5 * max(0.0, LEAST_SPAN - (high - low))
    panel.set_ylim(low - lack, high + lack)


def with_gaps(seconds: Array, values: Array) -> Array:
    """Return values (N + G,) with a NaN in each of the G gaps, so that lines are interrupted."""
    if len(seconds) < 3:
        return values
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > GAP_PERIODS * np.median(steps)) + 1
    broken: Array = np.insert(values, gaps, np.nan)
    return broken
