"""How well the law of release predicts measured drops of masses that it has not seen."""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).parents[2]))

from bellows_ros.core.parameters.checks import resolve  # noqa: E402
from bellows_ros.core.parameters.conversion import release_factor  # noqa: E402
from bellows_ros.core.toss.release_fit import fit_release, release_parameters  # noqa: E402
import numpy as np  # noqa: E402

from test.core import drops  # noqa: E402, I100, I201


def main() -> None:
    """Print a row for each mass left out."""
    if not drops.SHARED.exists():
        print(f'The measured drops are not here: {drops.SHARED.name}.')
        return
    data, by_mass = drops.real_drops()
    for left_out, own in by_mass.items():
        others = [drop for mass in by_mass if mass != left_out for drop in by_mass[mass]]
        found = fit_release(others, (0.0,) * 8)
        off = drops.misses(data, own, found.law)
        values = resolve({**release_parameters(found), 'package.mass': left_out})
        errors, std = drops.at_the_end(data, own, np.array(found.law), release_factor(values))
        position, velocity = np.sqrt(np.mean(off[:, :2]**2, axis=0))
        print(f'| {left_out:.3f} kg | {1e3 * position:.2f} mm | {1e3 * velocity:.1f} mm/s | '
              f'{1e3 * off[:, 2].mean():.1f} ms | {1e3 * off[:, 3].mean():.0f} mm/s | '
              f'{1e3 * errors[:, 1].mean():.0f} ± {1e3 * std[0, 1]:.0f} mm/s, '
              f'{100.0 * np.mean(np.abs(errors) < 1.96 * std):.0f} % |')


if __name__ == '__main__':
    main()
