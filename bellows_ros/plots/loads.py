"""Pictures of the cup's load: load against deflection, and the residuals of a fit."""

from typing import Any

from bellows_ros.core.residuals import MILLI_UNITS
from bellows_ros.workflows.plot import Loads
import numpy as np

from .panels import (
    arrange_pair,
    BELOW_HEAD,
    broken,
    draw_strip,
    legend,
    MILLI,
    pairs,
    picture,
    six,
)

MOST_POINTS = 4000
UNITS = ('N',) * 3 + ('N m',) * 3


def deflection_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the load that the motion needs against the deflection, and the cup's stiffness.

    Parameters
    ----------
    loads : Loads
        What is drawn.
    note : str
        Which recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    usable = np.flatnonzero(loads.valid)
    shown = usable[:: max(1, len(usable) // MOST_POINTS)]
    with picture('Load on the cup against its deflection', note, theme) as (figure, colours):
        legend(figure, (('needed by the motion', colours.measured, 4.0),
                        ('stiffness of the cup', colours.predicted, 1.4)))
        for axis, panel in enumerate(six(figure, UNITS)):
            x, y = loads.deflection[shown, axis], loads.load[shown, axis]
            panel.plot(MILLI * x, y, '.', color=colours.measured, markersize=2.8, alpha=0.8,
                       markeredgewidth=0.0)
            ends = np.array([x.min(), x.max()])
            panel.plot(MILLI * ends, loads.stiffness[axis] * ends, color=colours.predicted,
                       linewidth=1.3)
            panel.set_xlabel(f'deflection ({MILLI_UNITS[axis]})', labelpad=1.0)
    return figure


def residual_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the load that the motion needs, and below it the part unexplained by the cup.

    Parameters
    ----------
    loads : Loads
        What is drawn.
    note : str
        Which recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    load, residual = (broken(x, loads.valid) for x in (loads.load, loads.residual))
    with picture('Load on the cup, and the unexplained part', note, theme) as (figure, colours):
        legend(figure, (('needed by the motion', colours.measured, 2.4),
                        ('unexplained', colours.error, 1.0)))
        panels = pairs(figure, **BELOW_HEAD, hspace=0.24, wspace=0.26)
        for axis, (upper, lower) in enumerate(panels):
            upper.plot(loads.seconds, load[:, axis], color=colours.measured, linewidth=1.8)
            draw_strip(lower, loads.seconds, residual[:, axis], colours)
            rms = float(np.sqrt(np.nanmean(residual[:, axis] ** 2)))
            part = rms / max(float(np.nanstd(load[:, axis])), 1e-12)
            unit = UNITS[axis]
            upper.set_title(f'unexplained RMS {rms:.2g} {unit}, {100 * part:.2g} % of the load',
                            loc='right', fontsize=8.5, color=colours.quiet, pad=4.0)
            arrange_pair((upper, lower), axis, loads.seconds, unit, unit, colours)
            for panel in (upper, lower):
                panel.yaxis.set_label_coords(-0.155, 0.5)
    return figure
