"""Pictures of a predicted plan, and of the safety factor over time."""

import math
from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.holding import Margin, MODES
from bellows_ros.workflows.plan import Curves, PlanReport
from bellows_ros.workflows.replay import Margins

from .panels import head, LEFT, SIZE
from .style import drawing, Theme, THEMES

WIDE = (9.4, 4.2)  # inches
SIGMAS = 2.0
"""Width of the bands, standard deviations to each side."""

LARGEST_SHOWN = 4.0
"""Safety factors are drawn up to so many times the least."""

DEGREES = 180.0 / math.pi
STYLES = ('-', '--', ':')


def plan_figure(report: PlanReport, note: str, theme: str = 'light') -> Any:
    """
    Draw tool and package along a plan, with bands of two standard deviations.

    Parameters
    ----------
    report : PlanReport
        With curves.
    note : str
        Which plan and cup.
    theme : {'light', 'dark'}
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours, curves = THEMES[theme], report.curves
    assert curves is not None  # noqa: S101 (whoever draws has asked for them)
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=SIZE)
        head(figure, 'What the plan does to the package',
             f'{note}; bands: two standard deviations', colours)
        panels = figure.subplots(
            3, 2, sharex=True, gridspec_kw={
                'left': LEFT, 'right': 0.985, 'top': 0.87, 'bottom': 0.075, 'hspace': 0.28,
                'wspace': 0.2})
        _draw_path(panels[0, 0], curves, colours)
        _draw_offset(panels[1, 0], curves, colours)
        _draw(panels[2, 0], curves, [3], DEGREES, [colours.predicted], ['bending'])
        _draw_factors(panels[0, 1], report, curves, colours)
        three = [colours.predicted, colours.error, colours.measured]
        _draw(panels[1, 1], curves, [6, 7, 8], 1.0, three, 'xyz')
        _draw(panels[2, 1], curves, [9, 10, 11], 1.0, three, 'xyz')
        titles = (('position of tool and package (m)', 'safety factor of the grip'),
                  ('package seen from the tool tip (mm)', 'force at the lip (N)'),
                  ('bending of the cup (degrees)', 'moment at the lip (N m)'))
        for row, names in zip(panels, titles, strict=True):
            for panel, name in zip(row, names, strict=True):
                panel.set_title(name, loc='left', fontsize=9.5, pad=4.0)
                panel.axvline(report.duration, color=colours.quiet, linewidth=0.8, linestyle=':')
                panel.tick_params(length=2.5, width=0.6)
                panel.set_xlim(0.0, curves.seconds[-1])
        for panel in panels[2]:
            panel.set_xlabel('time (s); dotted: end of the plan')
    return figure


def _draw(
    panel: Any, curves: Curves, columns: list[int], factor: float, colours: list[str],
    names: Any,
) -> None:
    """Draw some columns of the curves with their bands."""
    for column, colour, name in zip(columns, colours, names, strict=True):
        _draw_band(panel, curves.seconds, factor * curves.values[:, column],
                   factor * curves.std[:, column], colour, name)
    if len(columns) > 1:
        _legend(panel)


def _draw_band(
    panel: Any, seconds: Array, value: Array, std: Array, colour: str, name: str
) -> None:
    """Draw a line with its band."""
    panel.fill_between(seconds, value - SIGMAS * std, value + SIGMAS * std, color=colour,
                       alpha=0.25, linewidth=0.0)
    panel.plot(seconds, value, color=colour, linewidth=1.2, label=name)


def _legend(panel: Any) -> None:
    """Name the lines, over what is drawn."""
    legend = panel.legend(fontsize=8, ncols=3, loc='upper right', handlelength=1.4, frameon=True,
                          facecolor=panel.get_facecolor(), edgecolor='none', framealpha=0.85)
    legend.set_zorder(5)


def _draw_path(panel: Any, curves: Curves, colours: Theme) -> None:
    """Draw the positions of tool and package in the world, from where they begin."""
    for axis, style in enumerate(STYLES):
        for values, colour, width, name in (
            (curves.tool[:, axis], colours.measured, 2.6, 'tool'),
            (curves.values[:, axis], colours.predicted, 1.0, 'package'),
        ):
            panel.plot(curves.seconds, values, style, color=colour, linewidth=width,
                       label=f'{name} {"xyz"[axis]}')
    panel.legend(fontsize=7, ncols=3, loc='best', handlelength=2.0)


def _draw_offset(panel: Any, curves: Curves, colours: Theme) -> None:
    """Draw where the package is from the tool tip, less where it hangs at the beginning."""
    offset = curves.values[:, :3] - curves.tool
    three = (colours.predicted, colours.error, colours.measured)
    for axis, colour in enumerate(three):
        _draw_band(panel, curves.seconds, 1e3 * (offset[:, axis] - offset[0, axis]),
                   1e3 * curves.std[:, axis], colour, 'xyz'[axis])
    _legend(panel)


def _draw_factors(panel: Any, report: PlanReport, curves: Curves, colours: Theme) -> None:
    """Draw the safety factors along a plan."""
    if not report.prediction.grip_known:
        panel.text(0.5, 0.5, 'not known: set cup.lip_radius and vacuum.holding', ha='center',
                   transform=panel.transAxes, color=colours.quiet)
        return
    _draw_margins(panel, Margins(
        curves.seconds, curves.values[:, 4:6], curves.std[:, 4:6],
        Margin(*report.prediction.smallest_safety), report.least), colours)


def margin_figure(margins: Margins, note: str, theme: str = 'light') -> Any:
    """
    Draw how firmly a grip holds over time, with bands of two standard deviations.

    Parameters
    ----------
    margins : Margins
        What is drawn.
    note : str
        Which recording and cup.
    theme : {'light', 'dark'}
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours = THEMES[theme]
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=WIDE)
        figure.text(LEFT, 0.93, 'How firmly the grip holds', fontsize=13.5, fontweight='bold')
        figure.text(LEFT, 0.875, f'{note}; bands: two standard deviations', color=colours.quiet)
        panel = figure.add_axes((LEFT, 0.13, 0.985 - LEFT, 0.7))
        _draw_margins(panel, margins, colours)
        panel.set_xlim(margins.seconds[0], margins.seconds[-1])
        panel.set_xlabel('time (s)')
        panel.set_ylabel('safety factor of the grip')
    return figure


def _draw_margins(panel: Any, margins: Margins, colours: Theme) -> None:
    """Draw safety factors, the smallest, what is needed, and where the cup lets go."""
    for column, colour, name in zip(
            range(2), (colours.predicted, colours.error), MODES, strict=True):
        _draw_band(panel, margins.seconds, margins.factors[:, column], margins.std[:, column],
                   colour, name)
    factor, mode, time = margins.smallest
    panel.plot([time], [factor], 'o', markersize=4.0, color=colours.text,
               label=f'{factor:.3g} ({mode}, {time:.3g} s)')
    _legend(panel)
    panel.axhline(margins.least, color=colours.text, linewidth=0.8, linestyle='--')
    panel.axhspan(0.0, 1.0, color=colours.predicted, alpha=0.12, linewidth=0.0)
    for height, words, place in ((margins.least, 'safety.least', 'bottom'),
                                 (0.5, 'lets go', 'center')):
        panel.text(0.99, height, words, fontsize=7.5, va=place, ha='right',
                   transform=panel.get_yaxis_transform(), color=colours.quiet)
    panel.set_ylim(0.0, max(LARGEST_SHOWN * margins.least, 1.5 * factor))
