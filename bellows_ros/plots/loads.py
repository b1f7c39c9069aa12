"""Pictures of the cup's load: load against deflection, and the residuals of a fit."""

from typing import Any

from bellows_ros.core.signals.residuals import MILLI_UNITS
from bellows_ros.workflows.plot import Loads
import numpy as np

from .panels import BELOW_HEAD, broken, legend, Line, MILLI, picture, six, six_pairs

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
        rms = np.sqrt(np.nanmean(residual**2, axis=0))
        parts = 100.0 * rms / np.maximum(np.nanstd(load, axis=0), 1e-12)
        six_pairs(
            figure, colours, [Line('', 'measured', 1.8, loads.seconds, load)], residual,
            [f'unexplained RMS {own:.2g} {unit}, {part:.2g} % of the load'
             for own, unit, part in zip(rms, UNITS, parts, strict=True)], UNITS, '{}',
            -0.155, **BELOW_HEAD, hspace=0.24, wspace=0.26)
    return figure
