"""
Whether the stated errors of K and P are true: simulation-based calibration over a population.

    python -m benchmarks.calibration PATH

PATH has for each set-up SEED a recording PATH/SEED, the parameters PATH/SEED.yaml of `bellows
identify` with given quantities that are wrong by their stated errors, and PATH/SEED_truth.npz with
`kind`, `K` and `P` (6, 6); nan for an entry without a true value. For each kind of sensors the
table lists the refused set-ups, and of the accepted ones the share of true values within 1, 2 and
3 stated errors (0.68, 0.95 and 0.997 if these are true), the largest deviation, the mean deviation
of each axis, the values that are not identifiable, the median ratio of stated error to the bound
of `benchmarks.bound` (after this has run), chi², and the processor time of all. Deviations are in
stated errors, which include those of the given quantities. Results are kept by the digest of the
package's sources, so that an interrupted run continues.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from hashlib import sha256
import json
from pathlib import Path
import time
from typing import NamedTuple

import bellows_ros
from bellows_ros.core import configure_process
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
from benchmarks.bound import AXES as AXISYMMETRIC
import numpy as np

HEAD = ('| kind | | set-ups | refused | within 1, 2, 3 | largest | mean by axis | not claimed '
        '| stated / bound | chi² median, max | CPU s median, max |\n'
        '|---|---|---|---|---|---|---|---|---|---|---|')


class Outcome(NamedTuple):
    """The identification of one set-up; diagonals of K and P over the structure's free axes."""

    seed: int
    kind: str
    seconds: float
    """Processor time, s."""
    refusal: str
    """First reason of a refusal, '' for an accepted cup."""
    axes: Sequence[int] = ()
    chi2: float = np.nan
    K: tuple[float, ...] = ()
    K_std: tuple[float, ...] = ()
    K_true: tuple[float, ...] = ()
    P: tuple[float, ...] = ()
    P_std: tuple[float, ...] = ()
    P_true: tuple[float, ...] = ()

    def deviations(self, matrix: str) -> Array:
        """Return deviations by axis (6,) in stated errors; nan if tied, unclaimed or unknown."""
        value, std, true = (np.array(getattr(self, matrix + end), dtype=np.float64)
                            for end in ('', '_std', '_true'))
        deviations = np.full(6, np.nan)
        deviations[list(self.axes)] = np.where(np.isfinite(std), (value - true) / std, np.nan)
        return deviations

    def unclaimed(self, matrix: str) -> int:
        """Return the number of values that are not identifiable."""
        return int(np.sum(~np.isfinite(getattr(self, f'{matrix}_std'))))


def identified(path: Path, seed: int) -> Outcome:
    """Return the outcome of the route of `bellows identify` for one set-up."""
    configure_process()
    truth = np.load(path / f'{seed}_truth.npz')
    kind, began = str(truth['kind']), time.process_time()
    settings = {**read_parameters(path / f'{seed}.yaml'), 'bags': (str(path / str(seed)),)}
    try:
        result = identify(settings)
    except BellowsError as error:
        return Outcome(seed, kind, time.process_time() - began, str(error))
    fit, refusals = result.fit, result.refusals
    causes = [f'{each.name} ({"certain" if each.certain else "possible"})'
              for each in result.verdict.causing[:1]]
    axes = tuple(group[0] for group in structure_named(fit.structure).tied_axes)
    diagonals = {
        name: tuple(np.diag(M)[list(axes)].tolist()) for name, M in (
            ('K', fit.stiffness), ('K_std', fit.stiffness_std), ('K_true', truth['K']),
            ('P', fit.damping), ('P_std', fit.damping_std), ('P_true', truth['P']))}
    chi2 = np.nan if fit.chi2 is None else fit.chi2
    return Outcome(seed, kind, time.process_time() - began,
                   ' | '.join([*causes, *refusals]) if refusals else '', axes, chi2, **diagonals)


def kept(path: Path, folder: Path, seed: int) -> Outcome:
    """Return the outcome of a set-up, from the folder of results if it is there."""
    file = folder / f'{seed}.json'
    if not file.exists():
        partial = file.with_suffix('.part')
        partial.write_text(json.dumps(identified(path, seed)._asdict()))
        partial.rename(file)
    return Outcome(**json.loads(file.read_text()))


def over_bound(path: Path, outcome: Outcome, matrix: str) -> Array:
    """Return the ratios of stated error to the bound, of claimed values; none without a bound."""
    file = path / 'bounds' / f'{outcome.seed}.json'
    if not file.exists() or tuple(outcome.axes) != AXISYMMETRIC:
        return np.empty(0)
    std = np.array(getattr(outcome, f'{matrix}_std'))
    ratios = std / np.array(json.loads(file.read_text())[matrix])
    return ratios[np.isfinite(ratios)]


def digest_of_package() -> str:
    """Return a digest of the package's sources and tables."""
    root, digest = Path(bellows_ros.__file__).parent, sha256()
    for file in sorted(each for each in root.rglob('*') if each.suffix in ('.py', '.toml')):
        digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:8]


def outcomes_of(
    path: Path, seeds: Sequence[int], folder: Path, jobs: int
) -> Iterator[Outcome]:
    """Yield the outcomes of set-ups, each computed in one of a number of processes."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(kept, [path] * len(seeds), [folder] * len(seeds), seeds)


def row(path: Path, kind: str, matrix: str, outcomes: Sequence[Outcome]) -> str:
    """Return the row of the table for K or P of one kind."""
    accepted = [each for each in outcomes if not each.refusal]
    deviations = np.array([each.deviations(matrix) for each in accepted]).reshape(-1, 6)
    sizes = np.abs(deviations)
    judged = np.isfinite(sizes)
    count = max(int(judged.sum()), 1)
    within = ', '.join(f'{np.sum(sizes[judged] <= n) / count:.2f}' for n in (1, 2, 3))
    means = ', '.join(f'{AXES[axis]} {deviations[judged[:, axis], axis].mean():+.1f}'
                      for axis in range(6) if judged[:, axis].any())
    largest = 'none'
    if judged.any():
        place, axis = np.unravel_index(np.nanargmax(sizes), sizes.shape)
        largest = f'{deviations[place, axis]:+.1f} ({accepted[place].seed} {AXES[axis]})'
    ratios = np.concatenate([over_bound(path, each, matrix) for each in accepted] or [[]])
    ratio = f'{np.median(ratios):.2f}' if ratios.size else 'none'
    chi2 = np.array([each.chi2 for each in accepted])
    chi2_text = f'{np.nanmedian(chi2):.2f}, {np.nanmax(chi2):.2f}' if len(chi2) else 'none'
    seconds = np.array([each.seconds for each in outcomes])
    return (f'| {kind} | {matrix} | {len(outcomes)} | {len(outcomes) - len(accepted)} '
            f'| {within} of {judged.sum()} | {largest} | {means} '
            f'| {sum(each.unclaimed(matrix) for each in accepted)} '
            f'| {ratio} | {chi2_text} | {np.median(seconds):.1f}, {seconds.max():.1f} |')


def line(outcome: Outcome) -> str:
    """Return the deviations of one set-up as a line of text."""
    texts = [f'{outcome.seed} {outcome.kind}: {outcome.seconds:.1f} s, chi² {outcome.chi2:.2f}']
    for matrix in 'KP':
        numbers = outcome.deviations(matrix)[list(outcome.axes)] if outcome.axes else []
        texts.append(f'{matrix} ' + ' '.join(f'{number:+.1f}' for number in numbers))
    return ', '.join(texts) + (f', REFUSED: {outcome.refusal[:300]}' if outcome.refusal else '')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('path', type=Path, help='folder of the population')
    parser.add_argument('--jobs', type=int, default=1, help='number of processes')
    parser.add_argument('--seeds', type=int, nargs='+', help='only these set-ups')
    parser.add_argument('--kinds', nargs='+', help='only set-ups of these kinds')
    parser.add_argument('--results', type=Path, help='folder of the results')
    given = parser.parse_args()
    seeds = given.seeds or sorted(
        int(each.stem) for each in given.path.glob('*.yaml'))
    if given.kinds:
        seeds = [seed for seed in seeds
                 if str(np.load(given.path / f'{seed}_truth.npz')['kind']) in given.kinds]
    folder = given.results or given.path / 'results' / digest_of_package()
    print(f'Results are kept in {folder}', flush=True)
    outcomes = []
    for outcome in outcomes_of(given.path, seeds, folder, given.jobs):
        outcomes.append(outcome)
        print(line(outcome), flush=True)
    print(HEAD)
    for kind in sorted({each.kind for each in outcomes}):
        for matrix in 'KP':
            print(row(given.path, kind, matrix, [each for each in outcomes if each.kind == kind]))


if __name__ == '__main__':
    main()
