"""A toss from the side and from above: the throw, the flight with ghost boxes, and the ellipse."""

from typing import Any

from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.toss.landing import ellipse
from bellows_ros.core.toss.release import flight_path
import numpy as np

from .panels import BELOW_HEAD, picture
from .shapes import box_corners, BOX_EDGES

SIZE = (11.0, 7.2)
GHOSTS, PATH_POINTS = 6, 60


def toss_figure(result: Any, title: str, theme: str = 'light') -> Any:
    """
    Draw a toss.

    Parameters
    ----------
    result : workflows.toss.TossResult
        What is drawn.
    title : str
        Over the picture.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    found, tool = result.toss, result.case.tool
    path = flight_path(result.case.model, found, PATH_POINTS)
    half, middle = map(np.array, result.case.release.box)
    held = result.held.states[result.held.times <= found.release_time]
    spread = 1e3 * np.sqrt(np.diag(result.covariance))
    x, y, _ = found.landing[0]
    note = (f'valve {result.case.switched:.3f} s, lets go {found.release_time:.3f} s, lands '
            f'{found.landing_time:.3f} s at x {x:.3f} m, y {y:.3f} m ± {spread[0]:.1f}, '
            f'{spread[1]:.1f} mm')
    with picture(title, note, theme, SIZE) as (figure, colours):
        reach = np.vstack([tool.position, path[:, :3]])
        spans = np.ptp(reach, axis=0) + 0.3
        grid = figure.add_gridspec(
            2, 2, **BELOW_HEAD, width_ratios=(3.0, 1.0), height_ratios=(spans[2], spans[1]),
            hspace=0.12, wspace=0.14)
        side = figure.add_subplot(grid[0, 0])
        above = figure.add_subplot(grid[1, 0], sharex=side)
        close = figure.add_subplot(grid[1, 1])
        for panel, (i, j) in ((side, (0, 2)), (above, (0, 1))):
            panel.plot(tool.position[:, i], tool.position[:, j], color=colours.measured,
                       linewidth=3.0, label='tool')
            panel.plot(held[:, i], held[:, j], color=colours.quiet, linewidth=1.2,
                       label='package, held')
            panel.plot(path[:, i], path[:, j], color=colours.predicted, linewidth=1.2,
                       label='package, flying')
            for k in np.linspace(0, len(path) - 1, GHOSTS).astype(int):
                last = k == len(path) - 1
                R = quaternion_to_rotation(path[k, 3:7])
                corners = box_corners(path[k, :3] + R @ middle, R, 2.0 * half)
                for line in corners[BOX_EDGES]:
                    panel.plot(line[:, i], line[:, j], color=colours.predicted,
                               linewidth=0.9 if last else 0.6, alpha=1.0 if last else 0.35)
            panel.set_aspect('equal', adjustable='box')
        side.axhline(result.case.release.height, color=colours.text, linewidth=1.0)
        side.set_ylabel('z (m), from the side')
        above.set_ylabel('y (m), from above')
        above.set_xlabel('x (m)')
        _draw_landing(above, close, result, colours)
        handles, labels = above.get_legend_handles_labels()
        figure.legend(handles, labels, loc='upper right', bbox_to_anchor=(0.99, 0.985), ncols=3)
    return figure


def _draw_landing(above: Any, close: Any, result: Any, colours: Any) -> None:
    """Draw ellipse, drawn landings and target from above, and the ellipse once more closely."""
    centre = np.array(result.toss.landing[0][:2])
    ring = ellipse(result.covariance, 121)
    for panel, about, scale in ((above, centre, 1.0), (close, np.zeros(2), 1e3)):
        panel.plot(*(scale * ring + about).T, color=colours.error, linewidth=1.4,
                   label='95 % ellipse')
        if result.drawn is not None:
            panel.plot(*(scale * result.drawn.figures[:, :2] + about).T, '.', markersize=2.0,
                       color=colours.error, alpha=0.5, label='drawn tosses')
    if result.target is not None:
        above.plot(*result.target, '+', color=colours.text, markersize=10, label='target')
    close.set_aspect('equal', adjustable='datalim')
    close.set_title('where B lands (mm)', fontsize=10)
    close.set_xlabel('x')
    close.set_ylabel('y')
