"""Draw the frames of the model, at rest and deflected, and how a cup resists bending."""

from pathlib import Path
import sys
from typing import Any

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.kernels import cup_wrench
from bellows_ros.plots.style import drawing, Theme, THEMES, write_figure
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from sketch import draw_box, draw_cup, draw_frame, Frame  # noqa: E402

IMAGES = Path(__file__).resolve().parents[1] / 'images'
LENGTH, DEPTH = 0.0481, 0.040  # m
PLATE = (-0.062, 0.062), (-0.040, 0.040)


def frames(theme: Theme) -> Any:
    """Return the figure with the frames: nominal on the left, deflected on the right, world A."""
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(8.6, 4.8))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_aspect('equal')
        axes.set_axis_off()
        axes.set_xlim(-0.09, 0.33)
        axes.set_ylim(-0.172, 0.062)
        nominal = Frame((0.0, 0.0), 0.0)
        _held(axes, nominal, nominal.moved(0.0, -LENGTH), theme)
        tool = Frame((0.215, 0.0), 0.12)
        lip = tool.moved(-0.004, -LENGTH - 0.004, -0.35)
        _held(axes, tool, lip, theme)
        _measures(axes, nominal, theme)
        _middle(axes, tool, lip, theme)
        draw_frame(axes, Frame((0.108, -0.146), 0.0), 'A', 0.026, theme, (-0.5, 0.2))
        for x, words in ((0.0, 'nominal: under vacuum, no load'), (0.215, 'deflected')):
            axes.text(x, -0.163, words, ha='center', color=theme.quiet, fontsize=10.5)
    return figure


def _held(axes: Any, tool: Frame, lip: Frame, theme: Theme) -> None:
    """Draw tool tip, cup and package with E, S and B."""
    draw_box(axes, tool, (-0.018, 0.018), (0.0, 0.055), theme.grid, theme.quiet)
    draw_cup(axes, tool, lip, theme.measured, theme.quiet)
    centre = lip.moved(0.0, -DEPTH)
    draw_box(axes, centre, *PLATE, theme.grid, theme.quiet)
    draw_frame(axes, tool, 'E', 0.026, theme, (-0.95, 0.25))
    draw_frame(axes, lip, 'S', 0.028, theme, (-1.15, 0.25))
    draw_frame(axes, centre, 'B', 0.024, theme, (-0.55, -0.2))


def _measures(axes: Any, nominal: Frame, theme: Theme) -> None:
    """Write the lengths beside the cup at rest."""
    spans = ((0.0, -LENGTH, r'$l_0$'), (-LENGTH, -LENGTH - DEPTH, r'$-\mathrm{com}_z$'))
    for top, bottom, words in spans:
        x = 0.072
        axes.annotate('', xy=(x, top), xytext=(x, bottom),
                      arrowprops={'arrowstyle': '<->', 'color': theme.quiet, 'linewidth': 0.9,
                                  'shrinkA': 0, 'shrinkB': 0})
        axes.text(x + 0.004, 0.5 * (top + bottom), words, va='center', fontsize=11)
        for height in (top, bottom):
            axes.plot([0.03, x + 0.004], [height, height], color=theme.quiet, linewidth=0.5,
                      linestyle=':', zorder=1)


def _middle(axes: Any, tool: Frame, lip: Frame, theme: Theme) -> None:
    """Show S1 and S2, which meet in the middle of the cup while it is not deflected."""
    first, second = lip.moved(0.0, LENGTH / 2), tool.moved(0.0, -LENGTH / 2)
    ends = ((first, lip, r'$S_1$', theme.predicted, (0.050, -0.012)),
            (second, tool, r'$S_2$', theme.error, (0.050, 0.012)))
    for middle, end, name, colour, shift in ends:
        axes.plot(*np.array([middle.origin, end.origin]).T, color=colour, linewidth=1.6,
                  linestyle='--', zorder=9)
        axes.plot(*middle.origin, 's', color=colour, markersize=6, zorder=10)
        place = np.asarray(middle.origin) + shift
        axes.annotate(
            name, xy=middle.origin, xytext=place, color=colour, fontsize=12, va='center',
            arrowprops={'arrowstyle': '-', 'color': colour, 'linewidth': 0.8}, zorder=11,
        )


def bending(theme: Theme) -> Any:
    """Return the figure with the restoring moment against the angle of bending."""
    angles = np.deg2rad(np.linspace(0.0, 110.0, 221))
    moments = [_moment(float(angle)) for angle in angles]
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(6.4, 3.0), layout='constrained')
        axes = figure.add_subplot()
        linear = Cup.thesis().stiffness[3, 3] * angles
        axes.plot(np.rad2deg(angles), linear, color=theme.measured, linewidth=3.0)
        axes.plot(np.rad2deg(angles), moments, color=theme.predicted, linewidth=1.6)
        axes.axvspan(0.0, 20.0, color=theme.grid, alpha=0.6, linewidth=0)
        axes.axhline(0.0, color=theme.quiet, linewidth=0.6)
        axes.set_ylim(-1.4, 4.2)
        axes.set_xlim(0.0, 110.0)
        axes.set_xticks(range(0, 111, 15))
        axes.set_xlabel('bending (degrees)')
        axes.set_ylabel('restoring moment (N m)')
        axes.text(10.0, 3.75, 'real cups', ha='center', color=theme.quiet)
        axes.text(47.0, 3.75, 'a linear spring', color=theme.quiet, ha='right')
        axes.text(64.0, 1.65, 'the model', color=theme.predicted)
    return figure


def _moment(angle: float) -> float:
    """Return the moment about x with which the thesis' cup resists bending, N m."""
    cup = Cup.thesis()
    R = exp_so3(np.array([angle, 0.0, 0.0]))
    # S1 and S2 stay together, so that there is no force and the moment is the same anywhere.
    half = np.array([0.0, 0.0, -cup.length / 2.0])
    still: Any = (0.0, 0.0, 0.0)
    at: Any = tuple((half + R @ half).tolist()), tuple(R.ravel().tolist())
    return -cup_wrench(cup.as_tuple, *at, still, still)[1][0]


def main() -> None:
    """Write the pictures."""
    for name, draw in (('frames', frames), ('bending', bending)):
        write_figure(IMAGES / f'{name}.svg', draw(THEMES['light']))


if __name__ == '__main__':
    main()
