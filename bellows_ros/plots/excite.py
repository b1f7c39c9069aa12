"""Picture of a designed motion: its axes, their spectra, and the limits it uses."""

from typing import Any

from bellows_ros.core.geometry.arrays import Array
import numpy as np

from .panels import BELOW_HEAD, name_panel, picture

PARTS = ((slice(0, 3), 1e3, 'mm'), (slice(3, 6), 180.0 / np.pi, 'degrees'))


def excite_figure(design: Any, note: str, theme: str = 'light') -> Any:
    """
    Draw a motion, its spectrum, and how much of each limit it uses.

    Parameters
    ----------
    design : bellows_ros.core.excitation.motion_design.Design
        The motion.
    note : str
        For which cup and arm.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    motion = design.motion
    t = np.arange(0.0, motion.duration, 0.01)
    u: Array = motion.displacement(t)[0]
    lines = np.abs(motion.coefficients)
    hertz = np.arange(1, len(lines) + 1) / motion.period
    with picture('Motion for identifying stiffness and damping', note, theme) as (figure, colours):
        grid = figure.add_gridspec(3, 2, **BELOW_HEAD, hspace=0.42, wspace=0.2)
        for row, (part, factor, unit) in enumerate(PARTS):
            of_time, of_frequency = (figure.add_subplot(grid[row, i]) for i in (0, 1))
            for i, colour in enumerate(colours.three):
                axis = part.start + i
                name = ('', 'r')[row] + 'xyz'[i]
                of_time.plot(t, factor * u[:, axis], color=colour, linewidth=0.7, label=name)
                of_frequency.semilogy(
                    hertz, factor * lines[:, axis], color=colour, linewidth=0.8, label=name)
            name_panel(of_time, f'{("shift", "turn")[row]} of the tool ({unit})')
            name_panel(of_frequency, f'amplitude of each line ({unit})')
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
        name_panel(panel, 'largest part of each limit (%)')
    return figure
