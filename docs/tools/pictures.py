"""
Draw the pictures that no command on a page draws: `make pictures`.

docs/images/overview.svg has tool arm, cup and package from the side, with their frames: x points
right and z up; a frame is an angle and an origin in this plane, its y points into the page.

docs/images/drops.svg has the real drops of each mass by the law fitted to the four other masses;
the rows of the table in docs/evidence.md are printed.
"""

from dataclasses import dataclass
from pathlib import Path
import sys
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from bellows_ros.core.toss.release_fit import fit_release  # noqa: E402
import matplotlib  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from test.core import drops  # noqa: E402, I100, I201

IMAGES = Path(__file__).resolve().parents[1] / 'images'
GREY, SOLID, RUBBER, PREDICTED = '#57606a', '#d8dee4', '#8c959f', '#0b62c4'
AXES = {'x': '#d1443c', 'z': '#3f6fd8', 'origin': '#2e8b57'}


@dataclass(frozen=True)
class Frame:
    """A frame in the page: origin (x, z) in m, and its rotation to the left, rad."""

    origin: tuple[float, float]
    angle: float

    def at(self, x: float, z: float) -> NDArray[np.float64]:
        """Return the point with these coordinates in this frame."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray(self.origin) + np.array([c * x - s * z, s * x + c * z])

    def moved(self, x: float, z: float, rotation: float = 0.0) -> 'Frame':
        """Return the frame at these coordinates in this frame, rotated relative to it."""
        origin = self.at(x, z)
        return Frame((float(origin[0]), float(origin[1])), self.angle + rotation)


WORLD = Frame((0.0, 0.0), 0.0)
TOOL = Frame((0.150, 0.190), 0.16)
LIP = TOOL.moved(-0.007, -0.046, -0.24)
CENTRE = LIP.moved(0.0, -0.040)


def draw_frame(axes: Any, frame: Frame, name: str, length: float, name_at: Any) -> None:
    """Draw x in red and z in blue, the origin in green, and the name of a frame."""
    for label, ends in (('x', (1.0, 0.0)), ('z', (0.0, 1.0))):
        tip = frame.at(*np.multiply(ends, length))
        axes.annotate('', xy=tip, xytext=frame.origin, arrowprops={
            'arrowstyle': '-|>', 'color': AXES[label], 'linewidth': 1.8, 'shrinkA': 0,
            'shrinkB': 0})
        axes.text(*frame.at(*np.multiply(ends, 1.22 * length)), label, color=AXES[label],
                  ha='center', va='center', fontsize=8.5)
    axes.plot(*frame.origin, 'o', color=AXES['origin'], markersize=5.0)
    axes.text(*frame.at(*np.multiply(name_at, length)), name, ha='center', va='center',
              fontsize=12, fontweight='bold')


def outline_of_cup() -> NDArray[np.float64]:
    """Return the closed outline (N, 2) of the bellows between tool tip and lip."""
    s = np.linspace(0.0, 1.0, 241)
    start, end = np.asarray(TOOL.origin), np.asarray(LIP.origin)
    reach, t = float(np.linalg.norm(end - start)), s[:, None]
    rates = [-reach * (frame.at(0.0, 1.0) - frame.origin) for frame in (TOOL, LIP)]
    spine = ((2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * rates[0]
             + (3 * t**2 - 2 * t**3) * end + (t**3 - t**2) * rates[1])
    tangent = np.gradient(spine, s, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = 0.020 * np.where(
        s > 0.94, 0.92 + 2.6 * (s - 0.94), 0.72 + 0.20 * np.cos(5.0 * np.pi * (s - 1.0)))
    side = radius[:, None] * normal
    return np.concatenate([spine + side, (spine - side)[::-1]])


def draw_box(axes: Any, frame: Frame, x: tuple[float, float], z: tuple[float, float]) -> None:
    """Draw a rectangle given by its extent in a frame."""
    corners = [frame.at(a, b) for a, b in ((x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1]))]
    axes.fill(*np.array(corners).T, facecolor=SOLID, edgecolor=GREY, linewidth=1.2)


def draw_overview() -> None:
    """Draw tool arm, cup and package with their frames."""
    figure = Figure(figsize=(8.6, 4.1), facecolor='white')
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(aspect='equal', xlim=(-0.045, 0.555), ylim=(-0.028, 0.258))
    axes.set_axis_off()
    draw_box(axes, TOOL, (-0.020, 0.020), (0.012, 0.075))
    draw_box(axes, TOOL, (-0.011, 0.011), (0.0, 0.012))
    axes.fill(*outline_of_cup().T, facecolor=RUBBER, edgecolor=GREY, linewidth=1.2)
    draw_box(axes, CENTRE, (-0.075, 0.075), (-0.040, 0.040))
    draw_frame(axes, WORLD, 'A', 0.042, (-0.3, 0.3))
    draw_frame(axes, TOOL, 'E', 0.034, (-0.62, 0.12))
    draw_frame(axes, LIP, 'S', 0.026, (-1.35, 0.42))
    draw_frame(axes, CENTRE, 'B', 0.026, (-0.55, -0.15))
    for start, height, colour, head, text in (
            (TOOL.at(0.024, 0.044), 0.225, 'black', 'tool arm, tip E',
             'pose: from the robot driver'),
            (TOOL.at(0.022, -0.024), 0.160, 'black', 'bellows suction cup, lip S',
             'stiffness K, damping P: identified once,\nfrom recordings'),
            (CENTRE.at(0.078, 0.004), 0.078, PREDICTED, 'package, centre of mass B',
             'pose, twist, load of the cup: predicted')):
        axes.annotate('', xy=start, xytext=(0.300, height), arrowprops={
            'arrowstyle': '-', 'color': GREY, 'linewidth': 0.8})
        axes.text(0.306, height, head, color=colour, fontsize=12, fontweight='bold', va='center')
        axes.text(0.306, height - 0.013, text, color=GREY, fontsize=10.5, va='top')
    axes.text(0.306, -0.004, 'A: world, z up', color=GREY, fontsize=10.5, va='center')
    figure.savefig(IMAGES / 'overview.svg', metadata={'Date': None})


def draw_drops() -> None:
    """Print a row and draw the heights for each mass left out."""
    if not drops.SHARED.exists():
        print(f'The measured drops are not here: {drops.SHARED.name}.')
        return
    figure = Figure(figsize=(8.6, 3.2), facecolor='white', layout='constrained')
    panels = figure.subplots(1, 5, sharey=True)
    data, by_mass = drops.real_drops()
    for axes, (mass, own) in zip(panels, by_mass.items(), strict=True):
        law = fit_release([drop for other, each in by_mass.items() if other != mass
                           for drop in each]).law
        misses = drops.misses(data, own, law)
        position, velocity = np.sqrt(np.mean(misses[:, :2]**2, axis=0))
        print(f'| {mass:.3f} kg | {1e3 * position:.2f} mm | {1e3 * velocity:.1f} mm/s | '
              f'{1e3 * misses[:, 2].mean():.1f} ms |')
        for drop in own:
            height = data['package_z_m'][drops.index_of(data, drop)]
            axes.plot(1e3 * data['time_s'], 1e3 * (height - height[:5].mean()), color='#8c959f')
        height = drops.filtered(own[0], law, 0.0)[0]
        axes.plot(1e3 * data['time_s'], 1e3 * (height - height[:5].mean()), '--', color='#0b62c4')
        axes.set_title(f'{mass:.2f} kg: {1e3 * position:.2f} mm', fontsize=10)
        axes.set_xlabel('after the valve, ms')
    panels[0].set_ylabel('height, mm')
    panels[0].plot([], [], color='#8c959f', label='measured')
    panels[0].plot([], [], '--', color='#0b62c4', label='predicted')
    panels[0].legend(frameon=False)
    figure.savefig(IMAGES / 'drops.svg', metadata={'Date': None})


if __name__ == '__main__':
    matplotlib.rcParams['svg.hashsalt'] = 'bellows_ros'
    draw_overview()
    draw_drops()
