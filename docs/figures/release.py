"""
Predict the real drops of each mass by the law fitted to the four other masses.

Prints the rows of the table in docs/evidence.md, and draws docs/images/drops.svg.
"""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).parents[2]))

from bellows_ros.core.toss.release_fit import fit_release  # noqa: E402
import matplotlib  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
import numpy as np  # noqa: E402

from test.core import drops  # noqa: E402, I100, I201

IMAGE = Path(__file__).resolve().parents[1] / 'images' / 'drops.svg'


def main() -> None:
    """Print a row and draw the heights for each mass left out."""
    if not drops.SHARED.exists():
        print(f'The measured drops are not here: {drops.SHARED.name}.')
        return
    matplotlib.rcParams['svg.hashsalt'] = 'bellows_ros'
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
    figure.savefig(IMAGE, metadata={'Date': None})


if __name__ == '__main__':
    main()
