"""A toss from the side and from above: the throw, the flight with ghost boxes, and the ellipse."""

from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.landing import ellipse
from bellows_ros.core.lie import quaternion_to_rotation
import numpy as np

from .style import drawing, THEMES

SIZE = (11.0, 7.2)
GHOSTS = 6
EDGES = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7),
         (6, 7))
"""Of a box whose corners count in binary."""


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
        For paper or for the dark.

    Returns
    -------
    matplotlib.figure.Figure

    """
    colours = THEMES[theme]
    path, box = result.path(), result.case.release.box
    tool = result.case.tool
    held = result.held.states[result.held.times <= result.toss.release_time]
    spread = 1e3 * np.sqrt(np.diag(result.covariance))
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=SIZE)
        figure.text(0.07, 0.955, title, fontsize=13.5, fontweight='bold')
        figure.text(0.07, 0.928, _note(result, spread), color=colours.quiet)
        reach = np.vstack([tool.position, path[:, :3]])
        spans = np.ptp(reach, axis=0) + 0.3
        grid = figure.add_gridspec(
            2, 2, width_ratios=(3.0, 1.0), height_ratios=(spans[2], spans[1]), left=0.07,
            right=0.985, top=0.89, bottom=0.075, hspace=0.12, wspace=0.14)
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
                for line in _edges(path[k], box):
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


def _note(result: Any, spread: Array) -> str:
    """Return time and place in words."""
    found = result.toss
    return (
        f'valve {result.case.switched:.3f} s, lets go {found.release_time:.3f} s, lands '
        f'{found.landing_time:.3f} s at x {found.landing[0][0]:.3f} m, y '
        f'{found.landing[0][1]:.3f} m ± {spread[0]:.1f}, {spread[1]:.1f} mm')


def _edges(row: Array, box: Any) -> Array:
    """Return the edges (12, 2, 3) of the box of a state."""
    half, centre = np.array(box[0]), np.array(box[1])
    signs = np.array([[(k >> axis & 1) * 2 - 1 for axis in range(3)] for k in range(8)])
    corners = row[:3] + (centre + signs * half) @ quaternion_to_rotation(row[3:7]).T
    return np.asarray(corners[np.array(EDGES)])


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
