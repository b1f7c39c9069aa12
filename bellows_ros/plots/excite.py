"""Picture of a designed motion: its axes, their spectra, and the limits it uses."""

from typing import Any

from bellows_ros.core.arrays import Array
import numpy as np

from .panels import head, LEFT, SIZE
from .style import drawing, THEMES

PARTS = ((slice(0, 3), 1e3, 'mm'), (slice(3, 6), 180.0 / np.pi, 'degrees'))


def excite_figure(design: Any, note: str, theme: str = 'light') -> Any:
    """
    Draw a motion, its spectrum, and what part of each limit it takes.

    Parameters
    ----------
    design : bellows_ros.core.excitation.Design
        The motion.
    note : str
        For which cup and arm.
    theme : {'light', 'dark'}
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours, motion = THEMES[theme], design.motion
    t = np.arange(0.0, motion.duration, 0.01)
    u: Array = motion.displacement(t)[0]
    lines = np.abs(motion.coefficients)
    hertz = np.arange(1, len(lines) + 1) / motion.period
    three = (colours.predicted, colours.error, colours.measured)
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=SIZE)
        head(figure, 'Motion for identifying stiffness and damping', note, colours)
        grid = figure.add_gridspec(
            3, 2, left=LEFT, right=0.985, top=0.87, bottom=0.075, hspace=0.42, wspace=0.2)
        for row, (part, factor, unit) in enumerate(PARTS):
            of_time, of_frequency = (figure.add_subplot(grid[row, i]) for i in (0, 1))
            for i, colour in enumerate(three):
                axis = part.start + i
                name = ('', 'r')[row] + 'xyz'[i]
                of_time.plot(t, factor * u[:, axis], color=colour, linewidth=0.7, label=name)
                of_frequency.semilogy(
                    hertz, factor * lines[:, axis], color=colour, linewidth=0.8, label=name)
            of_time.set_title(f'{("shift", "turn")[row]} of the tool ({unit})', loc='left',
                              fontsize=9.5)
            of_frequency.set_title(f'amplitude of each line ({unit})', loc='left', fontsize=9.5)
            of_frequency.legend(fontsize=8, ncols=3, loc='upper right')
            of_time.set_xlabel('time (s)')
            of_frequency.set_xlabel('frequency (Hz)')
        panel = figure.add_subplot(grid[2, :])
        names = list(design.ratios)
        panel.bar(range(len(names)), [100.0 * design.ratios[name] for name in names],
                  color=colours.measured, width=0.6)
        panel.axhline(100.0, color=colours.text, linewidth=0.8, linestyle='--')
        panel.set_xticks(range(len(names)), [name.replace(' ', '\n') for name in names],
                         fontsize=7)
        panel.set_title('largest part of each limit (%)', loc='left', fontsize=9.5)
    return figure
