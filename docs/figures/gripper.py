"""Draw a gripper of cups on a bent package: where each cup stands, and what it feels."""

from pathlib import Path
import sys
from typing import Any

from bellows_ros.plots.style import drawing, Theme

sys.path.insert(0, str(Path(__file__).parent))
from sketch import draw_box, draw_cup, draw_frame, Frame  # noqa: E402

LENGTH, DEPTH, PLACES = 0.0481, 0.040, (-0.09, 0.0, 0.09)  # m


def gripper(theme: Theme) -> Any:
    """Return the figure: tool, cups at a_i, lips, package, and the frames E and S."""
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(8.6, 4.4))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_aspect('equal')
        axes.set_axis_off()
        axes.set_xlim(-0.18, 0.18)
        axes.set_ylim(-0.145, 0.04)
        tool = Frame((0.0, 0.0), 0.0)
        lip = tool.moved(0.004, -LENGTH - 0.004, 0.14)
        package = lip.moved(0.0, -DEPTH)
        draw_box(axes, tool, (-0.115, 0.115), (0.0, 0.012), theme.grid, theme.quiet)
        for number, a in enumerate(PLACES):
            draw_cup(axes, tool.moved(a, 0.0), lip.moved(a, 0.0), theme.measured, theme.quiet)
            axes.text(
                a - 0.02, 0.018, f'cup {number}', ha='center', color=theme.quiet, fontsize=10.5)
        draw_box(axes, package, (-0.14, 0.14), (-0.03, 0.04), theme.grid, theme.quiet)
        for frame, name in ((tool, 'E'), (lip, 'S'), (package, 'B')):
            draw_frame(axes, frame, name, 0.022, theme, (-0.9, -0.3))
        axes.annotate(
            '', xy=(PLACES[2], 0.0), xytext=(0.0, 0.0), zorder=9,
            arrowprops={'arrowstyle': '-|>', 'color': theme.quiet, 'linewidth': 1.1,
                        'linestyle': '--'})
        axes.text(0.055, -0.009, 'a of cup 2', color=theme.quiet, fontsize=10.5, ha='center')
    return figure


FIGURES = {'gripper.svg': gripper}
