"""A picture of what a plan does to the package: path, bending, safety factors, wrench."""

import math
from typing import Any

from bellows_ros.workflows.plan import Curves, PlanReport
import numpy as np

from .panels import head, LEFT, SIZE
from .style import drawing, Theme, THEMES

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
        value, band = factor * curves.values[:, column], factor * SIGMAS * curves.std[:, column]
        panel.fill_between(curves.seconds, value - band, value + band, color=colour, alpha=0.25,
                           linewidth=0.0)
        panel.plot(curves.seconds, value, color=colour, linewidth=1.2, label=name)
    if len(columns) > 1:
        _legend(panel)


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
        value = 1e3 * (offset[:, axis] - offset[0, axis])
        band = 1e3 * SIGMAS * curves.std[:, axis]
        panel.fill_between(curves.seconds, value - band, value + band, color=colour, alpha=0.25,
                           linewidth=0.0)
        panel.plot(curves.seconds, value, color=colour, linewidth=1.2, label='xyz'[axis])
    _legend(panel)


def _draw_factors(panel: Any, report: PlanReport, curves: Curves, colours: Theme) -> None:
    """Draw the safety factors, what is needed, and where the cup lets go."""
    if not report.prediction.grip_known:
        panel.text(0.5, 0.5, 'not known: set cup.lip_radius and vacuum.holding', ha='center',
                   transform=panel.transAxes, color=colours.quiet)
        return
    _draw(panel, curves, [4, 5], 1.0, [colours.predicted, colours.error], ['peel', 'slip'])
    panel.axhline(report.least, color=colours.text, linewidth=0.8, linestyle='--')
    panel.axhspan(0.0, 1.0, color=colours.predicted, alpha=0.12, linewidth=0.0)
    panel.text(0.01, report.least, ' safety.least', fontsize=7.5, va='bottom',
               transform=panel.get_yaxis_transform(), color=colours.quiet)
    panel.text(0.01, 0.5, ' lets go', fontsize=7.5, va='center',
               transform=panel.get_yaxis_transform(), color=colours.quiet)
    lowest = float(np.min(curves.values[:, 4:6]))
    panel.set_ylim(0.0, max(LARGEST_SHOWN * report.least, 1.5 * lowest))
