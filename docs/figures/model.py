"""Draw the frames of the model, its resistance to bending, and the law beside finite elements."""

from pathlib import Path
import sys
from typing import Any

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.kernels import cup_wrench
from bellows_ros.plots.style import drawing, Theme
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from sketch import draw_box, draw_cup, draw_frame, Frame  # noqa: E402

LENGTH, DEPTH = 0.0481, 0.040  # m
PLATE = (-0.062, 0.062), (-0.040, 0.040)

AXIAL = np.array([
    [-8, 75.81], [-7, 65.16], [-6, 54.58], [-5, 44.18], [-4, 34.11], [-3, 24.51], [-2, 15.53],
    [-1, 7.32], [0, 0.0], [1, -6.38], [2, -11.79], [3, -16.28], [4, -19.93], [5, -22.81],
    [6, -25.02], [7, -26.65], [8, -27.78]])
"""Axial shift of the lip, mm, and force on the package, N, by finite elements."""

BENT = {
    0.0: np.array([[0, 0, 0, 0], [-2.483, 0.158, 5, 0.090], [-4.876, 0.623, 10, 0.172],
                   [-7.104, 1.373, 15, 0.239], [-9.110, 2.375, 20, 0.289]]),
    1.8: np.array([[0, -2.244, 0, 0], [-2.262, -2.131, 5, 0.145], [-4.447, -1.791, 10, 0.279],
                   [-6.479, -1.227, 15, 0.395], [-8.298, -0.454, 20, 0.488]])}
"""By load (kg): shift in x and z, mm, bending, degrees, and moment, N m, by finite elements."""

LAWS = {
    'K alone': ((1980.6, 6923.6, 1.2497), 0.0, (0.0, 0.0)),
    'coupling and stretch': ((1811.1, 6639.8, 0.99637), 6.8829, (-18286.0, -5.011))}
"""Laws fitted to 80 poses of the finite elements: K x, z, rx, K[x,ry], and stretch; SI units."""


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


def stretch(theme: Theme) -> Any:
    """Return the figure with force and moment of laws beside those of finite elements."""
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 3.0), layout='constrained')
        axial, bent = figure.subplots(1, 2)
        axial.plot(*AXIAL.T, 'o', color=theme.measured, markersize=4.0, label='finite elements')
        for (name, law), style in zip(LAWS.items(), ('--', '-'), strict=True):
            shifts = np.linspace(-8.0, 8.0, 65)
            axial.plot(shifts, [_wrench(law, 0.0, z, 0.0)[2] for z in shifts], style,
                       color=theme.predicted, label=name)
            for load, rows in BENT.items():
                x, z, angle, moment = rows.T
                fine = np.linspace(0.0, 20.0, 41)
                moments = [-_wrench(law, *(np.interp(at, angle, way) for way in (x, z)), at)[4]
                           for at in fine]
                bent.plot(fine, moments, style, color=theme.predicted)
                bent.plot(angle, moment, 'o', color=theme.measured, markersize=4.0)
                bent.text(20.3, moment[-1], f'{load:g} kg', va='center', color=theme.quiet)
        axial.set_xlabel('axial shift of the lip (mm)')
        axial.set_ylabel('force (N)')
        axial.legend(loc='upper right')
        bent.set_xlabel('bending (degrees)')
        bent.set_ylabel('moment (N m)')
        bent.set_xlim(0.0, 24.0)
    return figure


def _wrench(law: Any, x: float, z: float, angle: float) -> Any:
    """Return the wrench of a law for a shift (mm) and a bending (degrees) of the lip."""
    (lateral, along, about), coupling, numbers = law
    K = np.diag([lateral, lateral, along, about, about, 1.53])
    K[0, 4] = K[4, 0] = coupling
    K[1, 3] = K[3, 1] = -coupling
    cup = Cup(K, np.zeros((6, 6)), 0.048, stretch=numbers)
    R = exp_so3(np.array([0.0, np.deg2rad(angle), 0.0]))
    still: Any = (0.0, 0.0, 0.0)
    at: Any = (1e-3 * x, 0.0, 1e-3 * z - cup.length), tuple(R.ravel().tolist())
    return np.hstack(cup_wrench(cup.as_tuple, *at, still, still))


FIGURES = {'frames.svg': frames, 'bending.svg': bending, 'stretch.svg': stretch}
