"""Draw the rooms of the package, and which way imports go."""

from collections.abc import Iterator
from pathlib import Path
import re
from typing import Any

from bellows_ros.plots.style import drawing, Theme

# Room: left, bottom, width, height, content.
ROOMS = {
    'demo': (0.3, 5.95, 1.5, 1.15, 'make demo'),
    'cli': (2.2, 5.95, 4.5, 1.15, 'the command bellows'),
    'nodes': (7.1, 5.95, 2.5, 1.15, 'predictor, identifier;\nonly these know ROS'),
    'report': (7.1, 4.3, 2.5, 1.15, 'sentences, text, pages'),
    'plots': (2.2, 4.3, 4.5, 1.15, 'pictures; only this knows matplotlib'),
    'workflows': (0.3, 2.95, 9.3, 0.85,
                  'identify, replay, simulate, info, plan, toss: files in, core, files out'),
    'files': (0.3, 1.55, 9.3, 0.85, 'bags, parameter files, results: read with suspicion, written '
              'whole or not at all'),
    'core': (0.3, 0.25, 9.3, 0.85, 'model, integrator, filter, preparation, identification, live '
             'prediction: numbers only'),
}
PACKAGE = Path(__file__).resolve().parents[2] / 'bellows_ros'


def imports() -> dict[str, set[str]]:
    """Return the rooms that each room imports, but for the sentences, which stand below."""
    found: dict[str, set[str]] = {room: set() for room in ROOMS}
    for room, targets in found.items():
        for file in (PACKAGE / room).rglob('*.py'):
            text = file.read_text()
            for target in ROOMS:
                if re.search(rf'from (?:bellows_ros|\.\.)\.?{target}(?!\.sentences)[. ]'
                             rf'|from bellows_ros import [^\n]*\b{target}\b', text):
                    targets.add(target)
        targets.discard(room)
    return found


def arrows() -> Iterator[tuple[str, str]]:
    """Yield the imports that do not follow from others, from room to room."""
    direct = imports()

    def reached(room: str) -> set[str]:
        return direct[room].union(*map(reached, direct[room]))

    for room, targets in direct.items():
        for target in sorted(targets - set().union(*map(reached, targets))):
            yield room, target


def ends(room: str, target: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the beginning and the end of an arrow between the edges of two boxes."""
    (x, y, w, h, _), (tx, ty, tw, th, _) = ROOMS[room], ROOMS[target]
    if y == ty:
        side = (x + w, tx) if tx > x else (x, tx + tw)
        return (side[0], y + 0.5 * h), (side[1], ty + 0.5 * th)
    middle = 0.5 * (max(x, tx) + min(x + w, tx + tw))
    return (middle, y), (middle, ty + th)


def draw(theme: Theme) -> Any:
    """Return the figure."""
    from matplotlib.patches import FancyBboxPatch

    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 5.6))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(0.0, 9.9)
        axes.set_ylim(0.0, 7.3)
        for name, (left, bottom, width, height, words) in ROOMS.items():
            axes.add_patch(FancyBboxPatch(
                (left + 0.06, bottom + 0.06), width - 0.12, height - 0.12,
                boxstyle='round,pad=0.06', facecolor=theme.grid, edgecolor=theme.quiet))
            axes.text(left + 0.18, bottom + height - 0.16, name, fontweight='bold', fontsize=11,
                      va='top')
            axes.text(left + 0.18, bottom + height - 0.52, words, fontsize=9.5, va='top',
                      color=theme.quiet, linespacing=1.3)
        for room, target in arrows():
            start, end = ends(room, target)
            axes.annotate('', xy=end, xytext=start,
                          arrowprops={'arrowstyle': '-|>', 'color': theme.text, 'linewidth': 1.3,
                                      'shrinkA': 1, 'shrinkB': 1})
    return figure


FIGURES = {'architecture.svg': draw}
