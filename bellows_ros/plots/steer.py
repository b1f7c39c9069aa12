"""Picture of motions with and without swing: tilt of the package over time."""

from collections.abc import Mapping
from typing import Any, Protocol

from bellows_ros.core.arrays import Array
import numpy as np

from .panels import head, LEFT, SIZE
from .style import drawing, THEMES

AFTER = 1.0
"""The picture goes on for so long (s) after the last motion has ended."""


class HasTilt(Protocol):
    """A motion; see `workflows.steer.Motion`."""

    @property
    def tool(self) -> Any:
        """Trajectory of E."""
        ...

    @property
    def tilt(self) -> Array:
        """Turn of the package from where it is wanted (N,), rad."""
        ...

    @property
    def seconds(self) -> Array:
        """Times (N,), s."""
        ...


def steer_figure(motions: Mapping[str, HasTilt], note: str, theme: str = 'light') -> Any:
    """
    Draw the tilt of the package, and the way and tilt of the tool, of several motions.

    Parameters
    ----------
    motions : mapping of str to HasTilt
        By name; the first is the one that is recommended.
    note : str
        Which plan and cup.
    theme : {'light', 'dark'}
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours = THEMES[theme]
    lines = (colours.predicted, colours.measured, colours.error)
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=SIZE)
        head(figure, 'The same way, with and without swing',
             f'{note}; dotted: the motion of the tool ends', colours)
        panels = figure.subplots(
            3, 1, sharex=True, gridspec_kw={
                'left': LEFT, 'right': 0.985, 'top': 0.87, 'bottom': 0.075, 'hspace': 0.28,
                'height_ratios': [2.0, 1.0, 1.0]})
        for (name, motion), colour in zip(motions.items(), lines, strict=False):
            tool, end = motion.tool, float(motion.tool.seconds[-1])
            way = np.linalg.norm(tool.position - tool.position[0], axis=1)
            z = np.clip(tool.rotation[:, :, 2] @ tool.rotation[0, :, 2], -1.0, 1.0)
            curves = (np.degrees(motion.tilt), way, np.degrees(np.arccos(z)))
            for panel, values in zip(panels, curves, strict=True):
                seconds = motion.seconds if values is curves[0] else tool.seconds
                panel.plot(seconds, values, color=colour, linewidth=1.4, label=name)
                panel.axvline(end, color=colour, linewidth=0.8, linestyle=':')
        for panel, title in zip(panels, (
                'tilt of the package from where it is wanted (degrees)',
                'way of the tool (m)', 'tilt of the tool (degrees)'), strict=True):
            panel.set_title(title, loc='left', fontsize=9.5, pad=4.0)
            panel.tick_params(length=2.5, width=0.6)
        longest = max(float(motion.tool.seconds[-1]) for motion in motions.values())
        panels[0].set_xlim(0.0, longest + AFTER)
        panels[0].legend(fontsize=9, loc='upper right', frameon=False)
        panels[-1].set_xlabel('time (s)')
    return figure
