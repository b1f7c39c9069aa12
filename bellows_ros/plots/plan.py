"""Pictures of a predicted plan, and of the safety factor over time."""

from collections.abc import Sequence
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.grip import MODES
from bellows_ros.workflows.plan import Curves, PlanReport
from bellows_ros.workflows.replay import Margins

from .panels import BELOW_HEAD, MILLI, name_panel, picture, row
from .style import Theme

WIDE = (9.4, 4.2)  # inches
SIGMAS = 2.0
"""Half width of the bands, standard deviations."""

LARGEST_SHOWN = 4.0
"""Safety factors are drawn up to this multiple of the required one."""

DEGREES = 180.0 / math.pi
STYLES = ('-', '--', ':')


def plan_figure(report: PlanReport, note: str, theme: str = 'light') -> Any:
    """
    Draw tool and package along a plan, with bands of two standard deviations.

    Parameters
    ----------
    report : PlanReport
        What is drawn.
    note : str
        Which plan and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    curves = report.curves
    values, std = curves.values, curves.std
    offset = values[:, :3] - curves.tool
    note = f'{note}; bands: two standard deviations'
    with picture('What the plan does to the package', note, theme) as (figure, colours):
        panels = figure.subplots(
            3, 2, sharex=True, gridspec_kw={**BELOW_HEAD, 'hspace': 0.28, 'wspace': 0.2})
        _draw_path(panels[0, 0], curves, colours)
        if report.prediction.grip_known:
            _draw_margins(panels[0, 1], Margins(
                curves.seconds, values[:, 4:6], std[:, 4:6],
                report.prediction.smallest_safety, report.least), colours)
        else:
            panels[0, 1].text(
                0.5, 0.5, 'not known: set cup.lip_radius and vacuum.holding', ha='center',
                transform=panels[0, 1].transAxes, color=colours.quiet)
        for panel, shown, sigma, names in (
            (panels[1, 0], MILLI * (offset - offset[0]), MILLI * std[:, :3], 'xyz'),
            (panels[2, 0], DEGREES * values[:, 3:4], DEGREES * std[:, 3:4], ['bending']),
            (panels[1, 1], values[:, 6:9], std[:, 6:9], 'xyz'),
            (panels[2, 1], values[:, 9:], std[:, 9:], 'xyz'),
        ):
            _draw_bands(panel, curves.seconds, shown, sigma, names, colours)
            if len(names) > 1:
                _legend(panel)
        for panel, name in zip(panels.ravel(), (
                'position of tool and package (m)', 'safety factor of the grip',
                'package seen from the tool tip (mm)', 'force at the lip (N)',
                'bending of the cup (degrees)', 'moment at the lip (N m)'), strict=True):
            name_panel(panel, name)
            panel.axvline(
                report.source.duration, color=colours.quiet, linewidth=0.8, linestyle=':')
            panel.set_xlim(0.0, curves.seconds[-1])
        for panel in panels[2]:
            panel.set_xlabel('time (s); dotted: end of the plan')
    return figure


def _draw_bands(
    panel: Any, seconds: Array, values: Array, std: Array, names: Sequence[str], colours: Theme
) -> None:
    """Draw a line with its band for each column."""
    for value, reach, name, colour in zip(
            values.T, SIGMAS * std.T, names, colours.three, strict=False):
        panel.fill_between(seconds, value - reach, value + reach, color=colour, alpha=0.25,
                           linewidth=0.0)
        panel.plot(seconds, value, color=colour, linewidth=1.2, label=name)


def _legend(panel: Any) -> None:
    """Draw the legend above the panel."""
    legend = panel.legend(fontsize=8, ncols=3, loc='upper right', handlelength=1.4, frameon=True,
                          facecolor=panel.get_facecolor(), edgecolor='none', framealpha=0.85)
    legend.set_zorder(5)


def _draw_path(panel: Any, curves: Curves, colours: Theme) -> None:
    """Draw the positions of tool and package in the world."""
    for axis, style in enumerate(STYLES):
        for values, colour, width, name in (
            (curves.tool[:, axis], colours.measured, 2.6, 'tool'),
            (curves.values[:, axis], colours.predicted, 1.0, 'package'),
        ):
            panel.plot(curves.seconds, values, style, color=colour, linewidth=width,
                       label=f'{name} {"xyz"[axis]}')
    panel.legend(fontsize=7, ncols=3, loc='best', handlelength=2.0)


def margin_figure(margins: Margins, note: str, theme: str = 'light') -> Any:
    """
    Draw the safety factors of a grip over time, with bands of two standard deviations.

    Parameters
    ----------
    margins : Margins
        What is drawn.
    note : str
        Which recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    note = f'{note}; bands: two standard deviations'
    with picture('How firmly the grip holds', note, theme, WIDE) as (figure, colours):
        panel, = row(figure)
        _draw_margins(panel, margins, colours)
        panel.set_xlim(margins.seconds[0], margins.seconds[-1])
        panel.set_xlabel('time (s)')
        panel.set_ylabel('safety factor of the grip')
    return figure


def _draw_margins(panel: Any, margins: Margins, colours: Theme) -> None:
    """Draw the safety factors, the smallest, the required one, and where the cup lets go."""
    _draw_bands(panel, margins.seconds, margins.factors, margins.std, MODES, colours)
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
