"""
The cup, the tool arm and the package seen from the side, drawn to scale in metres.

x points right and z up; a frame is an angle and an origin in this plane, and its y points into
the page.
"""

from dataclasses import dataclass
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.plots.style import Theme, THEMES
import numpy as np

RED, GREEN, BLUE = '#d1443c', '#2e8b57', '#3f6fd8'  # x, y, z, as everywhere
ON_DARK = {RED: '#ff7b72', GREEN: '#3fb950', BLUE: '#a5c8ff'}
CUP_RADIUS = 0.020  # m
CONVOLUTIONS = 2.5


@dataclass(frozen=True)
class Frame:
    """A frame in the page: origin (x, z) in m, and how far it is turned to the left, rad."""

    origin: tuple[float, float]
    angle: float

    @property
    def x(self) -> Array:
        """Direction of its x axis."""
        return np.array([np.cos(self.angle), np.sin(self.angle)])

    @property
    def z(self) -> Array:
        """Direction of its z axis."""
        return np.array([-np.sin(self.angle), np.cos(self.angle)])

    def at(self, x: float, z: float) -> Array:
        """Return the point with these coordinates in this frame."""
        return np.asarray(self.origin) + x * self.x + z * self.z

    def moved(self, x: float, z: float, turn: float = 0.0) -> 'Frame':
        """Return the frame at these coordinates in this frame, turned against it."""
        origin = self.at(x, z)
        return Frame((float(origin[0]), float(origin[1])), self.angle + turn)


def draw_frame(axes: Any, frame: Frame, name: str, length: float, theme: Theme,
               name_at: tuple[float, float] = (-0.35, -0.35)) -> None:
    """Draw x in red and z in blue, y as a cross that goes into the page, and the name."""
    paints = ON_DARK if theme is THEMES['dark'] else {c: c for c in ON_DARK}
    for direction, paint, label in ((frame.x, paints[RED], 'x'), (frame.z, paints[BLUE], 'z')):
        tip = np.asarray(frame.origin) + length * direction
        axes.annotate(
            '', xy=tip, xytext=frame.origin,
            arrowprops={'arrowstyle': '-|>', 'color': paint, 'linewidth': 1.8,
                        'shrinkA': 0, 'shrinkB': 0, 'mutation_scale': 11},
            zorder=8,
        )
        end = np.asarray(frame.origin) + 1.22 * length * direction
        axes.text(*end, label, color=paint, ha='center', va='center', fontsize=8.5, zorder=9)
    axes.plot(*frame.origin, 'o', color=paints[GREEN], markersize=5.0, zorder=9)
    place = frame.at(name_at[0] * length, name_at[1] * length)
    axes.text(*place, name, color=theme.text, ha='center', va='center', fontsize=12,
              fontweight='bold', zorder=9)


def outline_of_cup(top: Frame, lip: Frame) -> Array:
    """Return the closed outline (N, 2) of the bellows between two frames."""
    s = np.linspace(0.0, 1.0, 241)
    spine = _spine(top, lip, s)
    tangent = np.gradient(spine, s, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = CUP_RADIUS * (0.72 + 0.20 * np.cos(2.0 * np.pi * CONVOLUTIONS * (s - 1.0)))
    radius = np.where(s > 0.94, CUP_RADIUS * (0.92 + 2.6 * (s - 0.94)), radius)[:, None]
    sides = spine + radius * normal, spine - radius * normal
    return np.concatenate([sides[0], sides[1][::-1]])


def _spine(top: Frame, lip: Frame, s: Array) -> Array:
    """Return the points (N, 2) of a cubic that leaves and arrives along the two z axes."""
    start, end = np.asarray(top.origin), np.asarray(lip.origin)
    reach = float(np.linalg.norm(end - start))
    rate_0, rate_1 = -reach * top.z, -reach * lip.z
    t = s[:, None]
    points: Array = (
        (2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * rate_0
        + (3 * t**2 - 2 * t**3) * end + (t**3 - t**2) * rate_1
    )
    return points


def draw_cup(axes: Any, top: Frame, lip: Frame, fill: str, edge: str) -> None:
    """Draw the bellows between the tool tip and the lip."""
    outline = outline_of_cup(top, lip)
    axes.fill(*outline.T, facecolor=fill, edgecolor=edge, linewidth=1.2, zorder=4)


def draw_box(axes: Any, frame: Frame, x: tuple[float, float], z: tuple[float, float],
             fill: str, edge: str, **style: Any) -> None:
    """Draw a rectangle given by its extent in a frame."""
    corners = [frame.at(a, b) for a, b in ((x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1]))]
    style = {'linewidth': 1.2, 'zorder': 3, **style}
    axes.fill(*np.array(corners).T, facecolor=fill, edgecolor=edge, **style)
