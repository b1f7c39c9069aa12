"""Draw the picture at the top of the README: what is known, and what is predicted."""

from pathlib import Path
import sys
from typing import Any

from bellows_ros.plots.style import drawing, Theme

sys.path.insert(0, str(Path(__file__).parent))
from sketch import draw_box, draw_cup, draw_frame, Frame  # noqa: E402

WORLD = Frame((0.0, 0.0), 0.0)
TOOL = Frame((0.150, 0.190), 0.16)
LIP = TOOL.moved(-0.007, -0.046, -0.24)
CENTRE = LIP.moved(0.0, -0.040)
PLATE = (-0.075, 0.075), (-0.040, 0.040)


def draw(theme: Theme) -> Any:
    """Return the figure."""
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(8.6, 4.1))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_aspect('equal')
        axes.set_axis_off()
        axes.set_xlim(-0.045, 0.555)
        axes.set_ylim(-0.028, 0.258)
        _draw_things(axes, theme)
        _draw_frames(axes, theme)
        _write(axes, theme)
    return figure


def _draw_things(axes: Any, theme: Theme) -> None:
    """Draw tool arm, cup and package."""
    solid = theme.grid
    draw_box(axes, TOOL, (-0.020, 0.020), (0.012, 0.075), solid, theme.quiet)
    draw_box(axes, TOOL, (-0.011, 0.011), (0.0, 0.012), solid, theme.quiet)
    draw_cup(axes, TOOL, LIP, theme.measured, theme.quiet)
    draw_box(axes, CENTRE, *PLATE, solid, theme.quiet)


def _draw_frames(axes: Any, theme: Theme) -> None:
    """Draw A, E, S and B."""
    draw_frame(axes, WORLD, 'A', 0.042, theme, (-0.3, 0.3))
    draw_frame(axes, TOOL, 'E', 0.034, theme, (-0.62, 0.12))
    draw_frame(axes, LIP, 'S', 0.026, theme, (-1.35, 0.42))
    draw_frame(axes, CENTRE, 'B', 0.026, theme, (-0.55, -0.15))


def _write(axes: Any, theme: Theme) -> None:
    """Say beside it what each thing is, and what is known of it."""
    notes = (
        (TOOL.at(0.024, 0.044), 0.225, theme.text, 'tool arm, tip E',
         'pose and twist: from the robot driver'),
        (TOOL.at(0.022, -0.024), 0.160, theme.text, 'bellows suction cup, lip S',
         'stiffness K, damping P: identified once,\nfrom recordings'),
        (CENTRE.at(0.078, 0.004), 0.078, theme.predicted, 'package, centre of mass B',
         'pose and twist, and what the cup carries:\npredicted, live'),
    )
    for start, height, colour, head, text in notes:
        axes.annotate(
            '', xy=start, xytext=(0.300, height),
            arrowprops={'arrowstyle': '-', 'color': theme.quiet, 'linewidth': 0.8, 'shrinkB': 0},
        )
        axes.text(0.306, height, head, color=colour, fontsize=12, fontweight='bold', va='center')
        axes.text(0.306, height - 0.013, text, color=theme.quiet, fontsize=10.5, va='top',
                  linespacing=1.35)
    axes.text(0.306, -0.004, 'A: world, z up', color=theme.quiet, fontsize=10.5, va='center')


FIGURES = {'overview.svg': draw}
