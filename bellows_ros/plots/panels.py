"""Six panels, one per axis, the layout of most pictures; and shapes of cup and package."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.signals.residuals import AXES, MILLI_UNITS
import numpy as np

from .style import drawing, Theme, THEMES

SIZE = (9.4, 6.9)  # inches
LEFT = 0.095  # of the panels, in parts of the width
BELOW_HEAD = {'left': LEFT, 'right': 0.985, 'top': 0.87, 'bottom': 0.075}
"""Edges of the panels of a figure of `SIZE`."""

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


def draw_series(
    panel: Any, x: Array, values: Array, colours: Sequence[str], names: Sequence[str] = '',
    std: Array | None = None, width: float = 1.2,
) -> None:
    """Draw a line for each column of values (N, M), with bands of two standard deviations."""
    for i, (value, colour) in enumerate(zip(values.T, colours, strict=False)):
        if std is not None:
            reach = 2.0 * std[:, i]
            panel.fill_between(x, value - reach, value + reach, color=colour, alpha=0.25,
                               linewidth=0.0)
        panel.plot(x, value, color=colour, linewidth=width, label=names[i] if names else None)


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
        fontsize=9.5, handlelength=1.8, columnspacing=1.6)


def label_abscissa(panel: Any, axis: int, label: str) -> None:
    """Label the abscissa of one of six panels: only the lowest of a column shows it."""
    if axis % 3 == 2:
        panel.set_xlabel(label)
    else:
        panel.tick_params(labelbottom=False)


def six_pairs(
    figure: Any, theme: Theme, lines: Sequence[Line], error: Array, titles: Sequence[str],
    units: Sequence[str], below: str, labels_at: float = -0.125, **place: float,
) -> list[tuple[Any, Any]]:
    """
    Draw six coordinates over time as `six` places them, each with its error in a strip below it.

    Parameters
    ----------
    figure, theme
        As from `picture`.
    lines : sequence of Line
        Over the same times (s), in `units`.
    error : array (N, 6)
        Drawn about zero, to a scale of its own.
    titles : sequence of str
        What is said above each coordinate.
    units : sequence of str
        Of each coordinate.
    below : str
        Label of the strips, with {} for the unit.
    labels_at : float
        Where the labels of the ordinates stand, in parts of a panel's width.
    **place
        Of the panels in the figure, and between them.

    Returns
    -------
    list of (panel, panel)

    """
    from matplotlib.ticker import MaxNLocator

    outer, seconds, pairs = figure.add_gridspec(3, 2, **place), lines[0].x, []
    for axis in range(6):
        inner = outer[axis % 3, axis // 3].subgridspec(2, 1, height_ratios=(3.2, 1.0), hspace=0.1)
        upper, lower = (figure.add_subplot(inner[i]) for i in (0, 1))
        for line in lines:
            upper.plot(seconds, line.values[:, axis], color=getattr(theme, line.colour),
                       linewidth=line.width)
        upper.set_title(titles[axis], loc='right', fontsize=8.5, color=theme.quiet, pad=4.0)
        upper.set_ylabel(f'{AXES[axis]}  ({units[axis]})')
        upper.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
        lower.axhline(0.0, color=theme.quiet, linewidth=0.6)
        lower.plot(seconds, error[:, axis], color=theme.error, linewidth=0.6)
        reach = 1.15 * max(float(np.nanmax(np.abs(error[:, axis]))), 1e-3)
        lower.set_ylim(-reach, reach)
        lower.set_ylabel(below.format(units[axis]), color=theme.error, fontsize=8.5)
        lower.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True, steps=[1, 2, 3, 5, 10]))
        for panel in (upper, lower):
            panel.set_xlim(seconds[0], seconds[-1])
            panel.tick_params(length=2.5, width=0.6)
            panel.xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10], integer=True))
            panel.yaxis.set_label_coords(labels_at, 0.5)
        upper.tick_params(labelbottom=False)
        lower.tick_params(axis='y', labelsize=7.5)
        label_abscissa(lower, axis, 'time (s)')
        pairs.append((upper, lower))
    return pairs


def broken(values: Array, valid: Mask) -> Array:
    """Return values with NaN where invalid, so that lines are interrupted."""
    shape = (len(values),) + (1,) * (values.ndim - 1)
    return np.asarray(np.where(valid.reshape(shape), values, np.nan))


RINGS, SIDES = 25, 13  # of the drawn cup; the last point of a ring is its first one again
CONVOLUTIONS = 2.5
RADIUS = 0.020  # m

BOX_EDGES = [[0, 1], [0, 2], [0, 4], [1, 3], [1, 5], [2, 3], [2, 6], [3, 7], [4, 5], [4, 6],
             [5, 7], [6, 7]]
BOX_FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
"""Of the corners of `box_corners`."""


def box_corners(centre: Array, R: Array, size: Array) -> Array:
    """Return the corners (8, 3) of a box in the world, m, counted in binary: x, y, z."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(centre + (0.5 * signs * size) @ R.T)


def bellows_rings(top_o: Array, top_R: Array, lip_o: Array, lip_R: Array) -> Array:
    """
    Return the rings of a bellows between two z axes.

    Parameters
    ----------
    top_o, lip_o : array (3,)
        Tool tip E and lip S in the world, m.
    top_R, lip_R : array (3, 3)
        Their orientations.

    Returns
    -------
    array (RINGS, SIDES, 3)
        Points in the world, m.

    """
    s = np.linspace(0.0, 1.0, RINGS)[:, None]
    reach = float(np.linalg.norm(lip_o - top_o))
    rates = -reach * top_R[:, 2], -reach * lip_R[:, 2]
    spine = ((2 * s**3 - 3 * s**2 + 1) * top_o + (s**3 - 2 * s**2 + s) * rates[0]
             + (3 * s**2 - 2 * s**3) * lip_o + (s**3 - s**2) * rates[1])
    radius = RADIUS * (0.75 + 0.2 * np.cos(2.0 * np.pi * CONVOLUTIONS * (s - 1.0)))
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)])
    return np.array([o + r * (circle @ ((1 - t) * top_R + t * lip_R).T)
                     for o, r, t in zip(spine, radius, s, strict=True)])
