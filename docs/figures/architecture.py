"""Draw the rooms of the package, and which way imports and data go."""

from pathlib import Path
from typing import Any

from bellows_ros.plots.style import drawing, Theme, THEMES, write_figure

IMAGES = Path(__file__).resolve().parents[1] / 'images'

# Room: left, bottom, width, height, what is in it.
ROOMS = {
    'nodes': (0.3, 4.75, 3.3, 1.15, 'predictor, identifier;\nthe only ones that know ROS'),
    'cli': (4.0, 4.75, 2.6, 1.15, 'the command bellows'),
    'demo': (7.0, 4.75, 2.6, 1.15, 'make demo'),
    'workflows': (0.3, 3.05, 6.3, 1.15,
                  'identify, replay, simulate, info:\nfiles in, core, files out'),
    'plots': (7.0, 3.05, 2.6, 1.15, 'pictures; the only one\nthat knows matplotlib'),
    'files': (0.3, 1.65, 9.3, 0.85, 'bags, parameter files, results: read with suspicion, written '
              'whole or not at all'),
    'core': (0.3, 0.25, 9.3, 0.85, 'model, integrator, filter, preparation, identification, live '
             'prediction: numbers only'),
}  # fmt: skip
# Straight lines (x, from, to) from a room down into the one below, and one aside (x, y to x, y).
IMPORTS = ((1.9, 4.75, 4.2), (5.0, 4.75, 4.2), (8.3, 4.75, 4.2), (3.4, 3.05, 2.5),
           (8.3, 3.05, 2.5), (5.0, 1.65, 1.1))  # fmt: skip
ASIDE = (((6.0, 4.75), (7.3, 4.2)), ((7.3, 4.75), (6.0, 4.2)))


def draw(theme: Theme) -> Any:
    """Return the figure."""
    from matplotlib.patches import FancyBboxPatch

    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 4.7))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set_xlim(0.0, 9.9)
        axes.set_ylim(0.0, 6.1)
        for name, (left, bottom, width, height, words) in ROOMS.items():
            axes.add_patch(FancyBboxPatch(
                (left + 0.06, bottom + 0.06), width - 0.12, height - 0.12,
                boxstyle='round,pad=0.06', facecolor=theme.grid, edgecolor=theme.quiet))
            axes.text(left + 0.18, bottom + height - 0.16, name, fontweight='bold', fontsize=11,
                      va='top')  # fmt: skip
            axes.text(left + 0.18, bottom + height - 0.52, words, fontsize=9.5, va='top',
                      color=theme.quiet, linespacing=1.3)  # fmt: skip
        straight = tuple(((x, start), (x, end)) for x, start, end in IMPORTS)
        for start, end in straight + ASIDE:
            axes.annotate('', xy=end, xytext=start,
                          arrowprops={'arrowstyle': '-|>', 'color': theme.text, 'linewidth': 1.3,
                                      'shrinkA': 1, 'shrinkB': 1})  # fmt: skip
    return figure


def main() -> None:
    """Write the picture."""
    write_figure(IMAGES / 'architecture.svg', draw(THEMES['light']))


if __name__ == '__main__':
    main()
