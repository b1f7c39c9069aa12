"""Six panels, one per axis: the layout of most pictures."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.residuals import AXES, MILLI_UNITS
import numpy as np

from .style import drawing, Theme, THEMES

SIZE = (9.4, 6.9)  # inches
LEFT = 0.095  # of the panels, in parts of the width
BELOW_HEAD: Mapping[str, float] = MappingProxyType(
    {'left': LEFT, 'right': 0.985, 'top': 0.87, 'bottom': 0.075})
"""Edges of the panels of a figure of `SIZE`."""

HEAD, FOOT = 0.9, 0.52  # inches above and below the panels

TITLE, NOTE = 0.31, 0.52  # inches from the top
MILLI = 1e3


@contextmanager
def picture(
    title: str, note: str, theme: str, size: tuple[float, float] = SIZE, dpi: float | None = None
) -> Iterator[tuple[Any, Theme]]:
    """
    Provide a figure with title and conditions above the panels, and the colours of its theme.

    Raises
    ------
    BellowsError
        Without matplotlib.

    """
    colours = THEMES[theme]
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=size, dpi=dpi, label=title)
        figure.text(LEFT, 1.0 - TITLE / size[1], title, fontsize=13.5, fontweight='bold')
        figure.text(LEFT, 1.0 - NOTE / size[1], note, color=colours.quiet)
        yield figure, colours


def six(figure: Any, units: Sequence[str] = MILLI_UNITS) -> list[Any]:
    """Return six panels: x, y, z on the left, rx, ry, rz beside, each with its unit."""
    panels = list(figure.subplots(
        3, 2, gridspec_kw={**BELOW_HEAD, 'hspace': 0.28, 'wspace': 0.26}).T.ravel())
    for axis, panel in enumerate(panels):
        panel.set_ylabel(f'{AXES[axis]}  ({units[axis]})')
        panel.yaxis.set_label_coords(-0.145, 0.5)
        panel.tick_params(length=2.5, width=0.6)
    return panels


def row(
    figure: Any, count: int = 1, left: float = LEFT, between: float = 0.2
) -> list[Any]:
    """Return panels side by side below the head."""
    height = figure.get_figheight()
    panels = figure.subplots(1, count, squeeze=False, gridspec_kw={
        'left': left, 'right': 0.985, 'top': 1.0 - HEAD / height, 'bottom': FOOT / height,
        'wspace': between})
    return list(panels[0])


class Line(NamedTuple):
    """Six coordinates (N, 6) over x (N,), in a colour of the theme: see `six_lines`."""

    name: str
    colour: str
    width: float
    x: Array
    values: Array


def six_lines(
    title: str, note: str, theme: str, lines: Sequence[Line], abscissa: str,
    units: Sequence[str] = MILLI_UNITS, log: bool = False,
) -> Any:
    """
    Draw lines into six panels, one per axis.

    Parameters
    ----------
    title, note : str
        What is shown, and under which conditions.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.
    lines : sequence of Line
        Drawn in this order, in their units. A line without a name is not in the legend.
    abscissa : str
        Label, with its unit.
    units : sequence of str
        Of each axis.
    log : bool
        Whether both scales are logarithmic.

    Returns
    -------
    matplotlib.figure.Figure

    """
    with picture(title, note, theme) as (figure, colours):
        legend(figure, [(line.name, getattr(colours, line.colour), line.width)
                        for line in lines if line.name])
        for axis, panel in enumerate(six(figure, units)):
            for _, colour, width, x, values in lines:
                panel.plot(x, values[:, axis], color=getattr(colours, colour), linewidth=width)
            if log:
                panel.set(xscale='log', yscale='log')
                panel.minorticks_off()
            else:
                panel.xaxis.get_major_locator().set_params(integer=True)
            panel.margins(x=0.0)
            label_abscissa(panel, axis, abscissa)
    return figure


def name_panel(panel: Any, title: str) -> None:
    """Write what a panel shows above it."""
    panel.set_title(title, loc='left', fontsize=9.5, pad=4.0)
    panel.tick_params(length=2.5, width=0.6)


def legend(figure: Any, entries: Sequence[tuple[str, str, float]]) -> None:
    """Write a legend at the top right: (label, colour, line width) each."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=colour, linewidth=width, label=label)
             for label, colour, width in entries]
    figure.legend(
        handles=lines, loc='upper right', bbox_to_anchor=(0.992, 0.985), ncols=len(lines),
        fontsize=9.5, handlelength=1.8, columnspacing=1.6,
    )


def label_abscissa(panel: Any, axis: int, label: str) -> None:
    """Label the abscissa of one of six panels: only the lowest of a column shows it."""
    if axis % 3 == 2:
        panel.set_xlabel(label)
    else:
        panel.tick_params(labelbottom=False)


def pairs(figure: Any, **place: float) -> list[tuple[Any, Any]]:
    """Return six panels as `six` has them, each with a low strip below it, at a place."""
    outer = figure.add_gridspec(3, 2, **place)
    found = []
    for axis in range(6):
        inner = outer[axis % 3, axis // 3].subgridspec(
            2, 1, height_ratios=(3.2, 1.0), hspace=0.1)
        found.append((figure.add_subplot(inner[0]), figure.add_subplot(inner[1])))
    return found


def draw_strip(panel: Any, seconds: Array, values: Array, theme: Theme) -> None:
    """Draw a difference about zero, to a scale of its own."""
    panel.axhline(0.0, color=theme.quiet, linewidth=0.6)
    panel.plot(seconds, values, color=theme.error, linewidth=0.6)
    reach = 1.15 * max(float(np.nanmax(np.abs(values))), 1e-3)
    panel.set_ylim(-reach, reach)


def arrange_pair(
    pair: tuple[Any, Any], axis: int, seconds: Array, unit: str, below: str, theme: Theme
) -> None:
    """Put ticks, labels and limits to a panel of an axis and the strip below it."""
    from matplotlib.ticker import MaxNLocator

    upper, lower = pair
    for panel in pair:
        panel.set_xlim(seconds[0], seconds[-1])
        panel.tick_params(length=2.5, width=0.6)
        panel.xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10], integer=True))
    upper.tick_params(labelbottom=False)
    upper.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
    lower.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True, steps=[1, 2, 3, 5, 10]))
    lower.tick_params(axis='y', labelsize=7.5)
    upper.set_ylabel(f'{AXES[axis]}  ({unit})')
    lower.set_ylabel(below, color=theme.error, fontsize=8.5)
    for panel in pair:
        panel.yaxis.set_label_coords(-0.125, 0.5)
    label_abscissa(lower, axis, 'time (s)')


def broken(values: Array, valid: Mask) -> Array:
    """Return values with NaN where invalid, so that lines are interrupted."""
    shape = (len(values),) + (1,) * (values.ndim - 1)
    result: Array = np.where(valid.reshape(shape), values, np.nan)
    return result
