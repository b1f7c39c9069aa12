"""Pictures of a recording: motion on all axes, spectra, and the path in space."""

from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.lie import log_so3
from bellows_ros.core.residuals import MILLI_UNITS
from bellows_ros.workflows.plot import Motion, Spectra
import numpy as np

from .panels import broken, label_abscissa, legend, MILLI, picture, six
from .style import Theme


def motion_figure(motion: Motion, note: str, theme: str = 'light') -> Any:
    """
    Draw tool and package over time, each axis from its start.

    Parameters
    ----------
    motion : Motion
        What is drawn.
    note : str
        Which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    start = int(np.argmax(motion.valid))
    with picture('Motion in the world, from the start', note, theme) as (figure, colours):
        panels = six(figure)
        legend(figure, (('tool', colours.measured, 3.0), ('package', colours.predicted, 1.0)))
        for position, rotation, colour, width in (
            (motion.tool_position, motion.tool_rotation, colours.measured, 3.0),
            (motion.package_position, motion.package_rotation, colours.predicted, 0.9),
        ):
            turned = log_so3(rotation @ rotation[start].T)
            values = MILLI * broken(np.hstack([position - position[start], turned]), motion.valid)
            for axis, panel in enumerate(panels):
                panel.plot(motion.seconds, values[:, axis], color=colour, linewidth=width)
        unusable = motion.seconds[~motion.valid]  # marked at the foot of each panel
        for axis, panel in enumerate(panels):
            panel.plot(unusable, np.zeros_like(unusable), '|', color=colours.error,
                       markersize=7.0, transform=panel.get_xaxis_transform(), clip_on=False)
            panel.set_xlim(motion.seconds[0], motion.seconds[-1])
            label_abscissa(panel, axis, 'time (s)')
    return figure


def spectra_figure(spectra: Spectra, note: str, theme: str = 'light') -> Any:
    """
    Draw the spectra of the package's motion seen from the tool, and of a prediction's error.

    Parameters
    ----------
    spectra : Spectra
        What is drawn.
    note : str
        Which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    keep = spectra.frequency_hz > 0.0
    hertz = spectra.frequency_hz[keep]
    with picture('Spectra of the package relative to the tool', note, theme) as (figure, colours):
        shown = [('measured', spectra.measured, colours.measured, 3.0, 2.2)]
        if spectra.error is not None:
            shown.append(('predicted minus measured', spectra.error, colours.error, 1.2, 1.1))
        legend(figure, [(name, colour, width) for name, _, colour, width, _ in shown])
        for axis, panel in enumerate(six(figure, [f'{unit}/√Hz' for unit in MILLI_UNITS])):
            for _, density, colour, _, width in shown:
                panel.loglog(hertz, MILLI * density[keep, axis], color=colour, linewidth=width)
            panel.set_xlim(hertz[0], hertz[-1])
            label_abscissa(panel, axis, 'frequency (Hz)')
    return figure


def path_figure(motion: Motion, note: str, theme: str = 'light') -> Any:
    """
    Draw the paths of tool and package in space, with the axes of both now and then.

    Parameters
    ----------
    motion : Motion
        What is drawn.
    note : str
        Which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    usable = np.flatnonzero(motion.valid)
    with picture('Paths of tool tip and package', note, theme, (8.4, 8.0)) as (figure, colours):
        legend(figure, (('tool tip E', colours.measured, 3.0),
                        ('package B', colours.predicted, 1.2)))
        space = figure.add_axes((0.02, 0.04, 0.92, 0.86), projection='3d')
        _paint_space(space, colours)
        tool = broken(motion.tool_position, motion.valid)
        package = broken(motion.package_position, motion.valid)
        space.plot(*tool.T, color=colours.measured, linewidth=2.4)
        space.plot(*package.T, color=colours.predicted, linewidth=1.0)
        for i in usable[:: max(1, len(usable) // 40)]:  # some forty
            space.plot(*np.array([tool[i], package[i]]).T, color=colours.quiet, linewidth=0.6)
        space.plot(*tool[usable[0]][:, None], 'o', color=colours.text,
                   markersize=4.0)
        set_equal(space, np.vstack([tool, package]))
        for name in 'xyz':
            getattr(space, f'set_{name}label')(f'{name} (m)')
    return figure


def _paint_space(space: Any, colours: Theme) -> None:
    """Give a 3D panel the theme's colours."""
    for name in 'xyz':
        axis = getattr(space, f'{name}axis')
        axis.set_pane_color(colours.background)
        axis._axinfo['grid'].update(color=colours.grid, linewidth=0.6)
        axis.line.set_color(colours.quiet)


def set_equal(space: Any, points: Array) -> None:
    """Show all points with equal scales along x, y and z."""
    from matplotlib.ticker import MaxNLocator

    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    middle, half = 0.5 * (low + high), 0.52 * float(np.max(high - low))
    for name, centre in zip('xyz', middle, strict=True):
        getattr(space, f'set_{name}lim')(centre - half, centre + half)
        getattr(space, f'{name}axis').set_major_locator(MaxNLocator(nbins=5))
    space.set_box_aspect((1.0, 1.0, 1.0), zoom=0.93)
