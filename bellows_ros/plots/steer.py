"""Picture of motions with and without swing: tilt of the package over time."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .panels import BELOW_HEAD, name_panel, picture

AFTER = 1.0
"""Time (s) shown after the end of the last motion."""


def steer_figure(motions: Mapping[str, Any], note: str, theme: str = 'light') -> Any:
    """
    Draw the tilt of the package, and the way and tilt of the tool, of several motions.

    Parameters
    ----------
    motions : mapping of str to workflows.steer.Motion
        By name; the first is the one that is recommended.
    note : str
        Which plan and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    note = f'{note}; dotted: the motion of the tool ends'
    with picture('The same way, with and without swing', note, theme) as (figure, colours):
        panels = figure.subplots(3, 1, sharex=True, gridspec_kw={
            **BELOW_HEAD, 'hspace': 0.28, 'height_ratios': [2.0, 1.0, 1.0]})
        lines = (colours.predicted, colours.measured, colours.error)
        for (name, motion), colour in zip(motions.items(), lines, strict=False):
            tool, end = motion.tool, float(motion.tool.seconds[-1])
            way = np.linalg.norm(tool.position - tool.position[0], axis=1)
            z = np.clip(tool.rotation[:, :, 2] @ tool.rotation[0, :, 2], -1.0, 1.0)
            curves = (np.degrees(motion.tilt), way, np.degrees(np.arccos(z)))
            for panel, values in zip(panels, curves, strict=True):
                seconds = motion.along.seconds if values is curves[0] else tool.seconds
                panel.plot(seconds, values, color=colour, linewidth=1.4, label=name)
                panel.axvline(end, color=colour, linewidth=0.8, linestyle=':')
        for panel, title in zip(panels, (
                'tilt of the package from where it is wanted (degrees)',
                'way of the tool (m)', 'tilt of the tool (degrees)'), strict=True):
            name_panel(panel, title)
        longest = max(float(motion.tool.seconds[-1]) for motion in motions.values())
        panels[0].set_xlim(0.0, longest + AFTER)
        panels[0].legend(fontsize=9, loc='upper right', frameon=False)
        panels[-1].set_xlabel('time (s)')
    return figure
