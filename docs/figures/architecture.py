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
    'bench': (4.9, 4.55, 2.0, 0.85, 'measures speed'),
    'report': (7.2, 4.55, 2.4, 0.85, 'pages on a fit'),
    'workflows': (0.3, 2.85, 6.6, 1.15,
                  'identify, replay, simulate, info:\nfiles in, core, files out'),
    'plots': (7.2, 2.85, 2.4, 1.15, 'pictures; only this\nknows matplotlib'),
    'files': (0.3, 1.55, 9.3, 0.85, 'bags, parameter files, results: read with suspicion, written '
              'whole or not at all'),
    'core': (0.3, 0.25, 9.3, 0.85, 'model, integrator, filter, preparation, identification, live '
             'prediction: numbers only'),
}  # fmt: skip
# Arrows (x, from, to), each straight down from a room into one below.
IMPORTS = ((1.5, 5.95, 4.0), (3.85, 5.95, 4.0), (5.9, 5.95, 5.4), (8.4, 5.95, 5.4),
           (5.9, 4.55, 4.0), (8.4, 4.55, 4.0), (3.6, 2.85, 2.4), (8.4, 2.85, 2.4),
           (4.95, 1.55, 1.1))  # fmt: skip


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
                      va='top')  # fmt: skip
            axes.text(left + 0.18, bottom + height - 0.52, words, fontsize=9.5, va='top',
                      color=theme.quiet, linespacing=1.3)  # fmt: skip
        for x, start, end in IMPORTS:
            axes.annotate('', xy=(x, end), xytext=(x, start),
                          arrowprops={'arrowstyle': '-|>', 'color': theme.text, 'linewidth': 1.3,
                                      'shrinkA': 1, 'shrinkB': 1})  # fmt: skip
    return figure


def main() -> None:
    """Write the picture."""
    write_figure(IMAGES / 'architecture.svg', draw(THEMES['light']))


if __name__ == '__main__':
    main()
