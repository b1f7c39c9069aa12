"""Pictures of a fit: intervals of K and P, spectra of its recordings, the way to the minimum."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from bellows_ros.core.signals.residuals import AXES, Spectrum
import numpy as np

from .panels import name_panel, picture, row

HIGH = 3.4  # inches
WIDE = 3.0
"""Ratio of values from which an axis is logarithmic."""


def interval_figure(
    intervals: Sequence[tuple[str, float, float]], note: str, theme: str = 'light'
) -> Any:
    """
    Draw the intervals of K beside those of P; dashed where a parameter is not identifiable.

    Parameters
    ----------
    intervals : sequence of (label, centre, half)
        Name of each parameter, which begins with its matrix, and middle and half length of its
        interval, percent; half is not finite where nothing is known.
    note : str
        What they are parts of.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    size = (9.4, 1.5 + 0.1 * len(intervals))
    with picture('95 % intervals', note, theme, size) as (figure, colours):
        for panel, matrix in zip(row(figure, 2, 0.17, 0.45), 'KP', strict=True):
            own = [each for each in intervals if each[0].startswith(matrix)]
            for height, (_, centre, half) in enumerate(own):
                if math.isfinite(half):
                    panel.errorbar(centre, height, xerr=half, fmt='o', markersize=4.0, capsize=3.0,
                                   color=colours.predicted, ecolor=colours.text)
                else:
                    panel.axhline(height, color=colours.predicted, linestyle='--')
            panel.set_yticks(range(len(own)), [
                f'{label}, ±{half:.2g} %' if math.isfinite(half) else f'{label}, not identifiable'
                for label, _, half in own])
            panel.set_ylim(len(own) - 0.5, -0.5)
            panel.set_xlabel('% of the entry')
    return figure


def excitation_figure(twist: Spectrum, note: str, theme: str = 'light') -> Any:
    """
    Draw the spectra of the twist of the lip in the tool.

    Parameters
    ----------
    twist : Spectrum
        Of six channels, m/s and rad/s.
    note : str
        Which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    with picture('Spectra of the twist of the lip in the tool', note, theme, (9.4, HIGH)) as (
            figure, colours):
        for first, panel, name in zip(
                (0, 3), row(figure, 2), ('shift (m²/s²/Hz)', 'rotation (rad²/s²/Hz)'),
                strict=True):
            for axis, colour in enumerate(colours.three, first):
                panel.loglog(twist.frequency[1:], twist.density[1:, axis], color=colour,
                             linewidth=1.2, label=AXES[axis])
            panel.minorticks_off()
            panel.margins(x=0.0)
            panel.set_xlabel('frequency (Hz)')
            panel.legend(fontsize=8, ncols=3, loc='best')
            name_panel(panel, name)
    return figure


def iteration_figure(
    iterations: Sequence[Mapping[str, Any]], note: str, theme: str = 'light'
) -> Any:
    """
    Draw how the minimum was found: chi squared, and the diagonals of K and P, over the steps.

    Parameters
    ----------
    iterations : sequence of mapping
        Each with 'chi2', 'stiffness' (6, 6) and 'damping' (6, 6).
    note : str
        How many steps.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    number = np.arange(1, len(iterations) + 1)
    chi2 = np.array([float(step['chi2']) for step in iterations])
    with picture('The way to the minimum', note, theme, (9.4, HIGH)) as (figure, colours):
        cost, *panels = row(figure, 3)
        cost.plot(number, chi2, color=colours.predicted)
        if chi2.max() > WIDE * chi2.min() > 0.0:
            cost.set_yscale('log')
            cost.minorticks_off()
        name_panel(cost, 'chi² per degree of freedom')
        lines = [(colour, style) for style in ('-', '--') for colour in colours.three]
        for panel, key in zip(panels, ('stiffness', 'damping'), strict=True):
            found = np.array([np.diag(np.array(step[key], float)) for step in iterations])
            last = np.where(found[-1] != 0.0, found[-1], 1.0)
            for axis, (colour, style) in enumerate(lines):
                panel.plot(number, found[:, axis] / last[axis], style, color=colour,
                           label=AXES[axis])
            panel.legend(fontsize=8, ncols=2, loc='best')
            name_panel(panel, f'{key}, diagonal over its last value')
        for panel in (cost, *panels):
            panel.set_xlabel('step')
            panel.xaxis.get_major_locator().set_params(integer=True)
    return figure
