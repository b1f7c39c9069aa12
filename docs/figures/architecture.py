"""Draw the rooms of the package, and which way imports go."""

from pathlib import Path
from typing import Any

from bellows_ros.plots.style import drawing, Theme, THEMES, write_figure

IMAGES = Path(__file__).resolve().parents[1] / 'images'

# Room: left, bottom, width, height, what is in it.
ROOMS = {
    'nodes': (0.3, 5.95, 2.5, 1.15, 'predictor, identifier;\nonly these know ROS'),
    'demo': (3.1, 5.95, 1.5, 1.15, 'make demo'),
    'cli': (4.9, 5.95, 4.7, 1.15, 'the command bellows'),
    'report': (7.7, 4.3, 1.9, 1.15, 'pages on a fit'),
    'plots': (4.9, 4.3, 2.4, 1.15, 'pictures; only this\nknows matplotlib'),
    'workflows': (0.3, 2.95, 9.3, 0.85,
                  'identify, replay, simulate, info, plan, toss: files in, core, files out'),
    'files': (0.3, 1.55, 9.3, 0.85, 'bags, parameter files, results: read with suspicion, written '
              'whole or not at all'),
    'core': (0.3, 0.25, 9.3, 0.85, 'model, integrator, filter, preparation, identification, live '
             'prediction: numbers only'),
}
# Arrows (x, y, x, y) from a room into one below, or beside.
IMPORTS = ((1.5, 5.95, 1.5, 3.8), (3.85, 5.95, 3.85, 3.8), (6.1, 5.95, 6.1, 5.45),
           (8.65, 5.95, 8.65, 5.45), (7.7, 4.87, 7.3, 4.87), (6.1, 4.3, 6.1, 3.8),
           (8.65, 4.3, 8.65, 3.8), (4.95, 2.95, 4.95, 2.4), (4.95, 1.55, 4.95, 1.1))


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
        for x, y, to_x, to_y in IMPORTS:
            axes.annotate('', xy=(to_x, to_y), xytext=(x, y),
                          arrowprops={'arrowstyle': '-|>', 'color': theme.text, 'linewidth': 1.3,
                                      'shrinkA': 1, 'shrinkB': 1})
    return figure


def main() -> None:
    """Write the picture."""
    write_figure(IMAGES / 'architecture.svg', draw(THEMES['light']))


if __name__ == '__main__':
    main()
