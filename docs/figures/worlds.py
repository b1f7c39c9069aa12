"""Draw the two worlds of a laboratory: a robot's base, and motion capture, and what is between."""

from pathlib import Path
import sys
from typing import Any

from bellows_ros.plots.style import drawing, Theme

sys.path.insert(0, str(Path(__file__).parent))
from sketch import draw_box, draw_cup, draw_frame, Frame  # noqa: E402

LENGTH, DEPTH = 0.0481, 0.040  # m


def worlds(theme: Theme) -> Any:
    """Return the figure: base, tool, cup, package and camera, and the transforms between them."""
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(8.6, 4.0))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_aspect('equal')
        axes.set_axis_off()
        axes.set_xlim(-0.17, 0.31)
        axes.set_ylim(-0.16, 0.064)
        tool = Frame((0.06, 0.0), 0.12)
        lip = tool.moved(-0.004, -LENGTH - 0.004, -0.30)
        package = lip.moved(0.0, -DEPTH)
        base, mocap = Frame((-0.12, -0.125), 0.0), Frame((0.265, 0.0), 0.35)
        draw_box(axes, tool, (-0.018, 0.018), (0.0, 0.055), theme.grid, theme.quiet)
        draw_cup(axes, tool, lip, theme.measured, theme.quiet)
        draw_box(axes, package, (-0.055, 0.055), (-0.035, 0.04), theme.grid, theme.quiet)
        for frame, name in ((tool, 'E'), (package, 'B'), (base, 'base'), (mocap, 'mocap')):
            draw_frame(axes, frame, name, 0.026, theme,
                       (0.1, -0.9) if frame is mocap else (-0.9, -0.3))
        for first, last, words, at in (
            (base, tool, 'tool_pose: the driver', (-0.06, -0.045)),
            (mocap, package, 'package_pose: the cameras', (0.175, -0.008)),
            (base, mocap, 'recording.package_world', (0.21, -0.145)),
        ):
            bend = 0.42 if last is mocap else 0.0
            axes.annotate(
                '', xy=last.origin, xytext=first.origin, zorder=1,
                arrowprops={'arrowstyle': '-|>', 'color': theme.quiet, 'linewidth': 1.1,
                            'linestyle': '--', 'shrinkA': 14, 'shrinkB': 14,
                            'connectionstyle': f'arc3,rad={bend}'})
            axes.text(*at, words, ha='center', color=theme.quiet, fontsize=10.5)
    return figure


FIGURES = {'worlds.svg': worlds}
