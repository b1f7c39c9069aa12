"""
Counts over simulated cells: false alarms per hour, and delays until faults are named.

`--hours` counts false alarms in each ordinary condition, and prints the mean normalised squared
error of the state (12 for a correct covariance, less with the allowance for model errors: the
cells have none). `--faults` simulates this number of faults of each kind in one condition, and
prints the number of right causes, and the delays (s) until half and 90 % of the faults are named.
For comparison it prints the delays of two likelihood-ratio tests with known time and size of the
fault, at the threshold for one false alarm per hour: one with known direction, one averaged over
all directions. `--drops` simulates falling packages, measured at 30 and at 10 Hz until 0.55 m
below, and counts from the start of the detachment. `--slips` simulates this number of slips of 3
to 10 mm, at once and within 0.25 s, and prints the number of right first alarms, and the errors in
each half second after the slip, relative to the 2 s before.
"""

import argparse
from collections import Counter
import math
from typing import Any

from bellows_ros.core.model.equilibrium import pose_error
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import measurement as sensor
from bellows_ros.core.observer.hypotheses import ONSET_NS
from bellows_ros.core.observer.pose_sensor import Measurement
import numpy as np
from scipy.special import logsumexp

from test.core.observer.cases import error_of  # noqa: I100, I201
from test.core.observer.cell import Cell, CONDITIONS, errors_around_slips, EXACT  # noqa: I201

SECONDS = 600.0
"""Length of a run without a fault: some false alarms take minutes to build up."""
EXACTLY = {**EXACT, 'payload__estimate': False}
"""Options of a cell whose only uncertainty is white noise."""
NAMED = {'turn': 'slip', 'soften': 'leak', 'drop': 'lost', 'peel': 'lost'}
"""Cause of the alarm by kind of fault, where the names differ."""
FROM_START = ('wear', 'payload', 'mass')
DIMENSIONS = {'slip': 2, 'payload': 2, 'camera': 3}
"""Dimensions of the space of a fault's directions: a camera is shifted and turned."""
DRAWS = 25
"""Number of noise draws per fault."""
DIRECTIONS = 1000
"""Number of directions in an average."""
THRESHOLD = math.log(3.6e12 / ONSET_NS)
"""Threshold of the log likelihood ratio for one false alarm per hour."""
KINDS = ('slip', 'turn', 'leak', 'soften', 'camera', *FROM_START, 'cup')


def false_alarms(
    name: str, runs: int, estimate: bool, seed: int = 0
) -> tuple[Counter[str], float]:
    """Return the causes of false alarms in all runs, and the mean normalised squared error."""
    causes, errors = Counter[str](), []
    for number in range(seed, seed + runs):
        cell = Cell(number, SECONDS, CONDITIONS[name], payload__estimate=estimate)

        def after(k: int, cell: Cell = cell) -> None:
            if k % 125 == 0 and k > 250:
                e = error_of(cell.made.body, cell.body[k])
                errors.append(e @ np.linalg.solve(cell.made.estimate.covariance[:12, :12], e))

        causes.update(cause for cause, _ in cell.run(after))
    return causes, float(np.mean(errors))


def fault_case(
    kind: str, name: str, seed: int, seconds: float
) -> tuple[float, float, dict[str, Any]]:
    """Return the start of a fault (s), the end of the run (s), and the options of its cell."""
    start = 0.0 if kind in FROM_START else 3.0
    lost = {'lost': seed % 4} if kind == 'cup' else {}
    return start, start + seconds, {**lost, **(EXACTLY if name == 'white' else {})}


def delays(
    kind: str, runs: int, name: str, seconds: float = 5.0, rate_hz: float = 125 / 4, first: int = 0
) -> tuple[float, list[float]]:
    """Return the fraction of right causes, and the delay (s) of each fault, sorted."""
    right, after = 0, []
    for seed in range(first, first + runs):
        at, end, options = fault_case(kind, name, seed, seconds)
        cell = Cell(seed, end, CONDITIONS[name], kind, at, rate_hz, **options)
        cause, delay = (cell.run() or [('', np.inf)])[0]
        if kind == 'mass':  # only the damping tells it from wear: the alarm says both
            right += {cause, *(alarm.second for alarm in cell.made.alarms[:1])} == {
                'wear', 'payload'}
        else:
            right += cause == (f'cup {seed % 4}' if kind == 'cup' else NAMED.get(kind, kind))
        after.append(delay)
    return right / runs, sorted(after)


def innovations(cell: Cell) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return stamps (ns), innovations and whitening matrices of a run."""
    stamps, ys, whiteners = [], [], []

    def before(measurement: Measurement) -> None:
        stamp_ns, position, q, noise, _ = measurement
        estimate, marker = cell.made.estimate, cell.made.sensor.marker
        body, theta, model = estimate.body, estimate.theta, cell.made.model
        com = model[1][1]
        if not noise.any():
            noise = np.diag(np.square(np.repeat(marker[3][1:3], 3)))
        position, q, noise = sensor.corrected_pose(position, q, noise, marker, theta, com)
        exposed = sensor.at_exposure(model, estimate.tool, body, theta)
        whitened, _, whitener, *_ = sensor.innovation_of(
            exposed, theta, estimate.covariance, np.ravel(pose_error(exposed, position, q)), noise,
            marker, estimate.memory[ekf.JITTER])
        stamps.append(stamp_ns)
        ys.append(np.linalg.solve(whitener, whitened))
        whiteners.append(whitener)

    cell.run(before=before)
    return stamps, np.array(ys), np.array(whiteners)


def passages(M: np.ndarray, x: np.ndarray, others: np.ndarray, seed: int) -> np.ndarray:
    """
    Return the index of the innovation where a likelihood ratio passes the threshold, per draw.

    A fault x (c,) gives whitened innovations of mean M x, with M (k, 6, c). The likelihood ratio
    is averaged over the equally likely faults `others` (n, c); -1 without a passage.
    """
    measurement = M @ x + np.random.default_rng(seed).normal(size=(DRAWS, *M.shape[:2]))
    scores = np.cumsum(np.einsum('kic,nki->nkc', M, measurement), axis=1) @ others.T
    squares = np.cumsum(np.square(M @ others.T).sum(axis=1), axis=0)
    passed = logsumexp(scores - 0.5 * squares, axis=2) >= THRESHOLD + math.log(len(others))
    return np.where(passed.any(axis=1), passed.argmax(axis=1), -1)


def directed(
    kind: str, numbers: np.ndarray, seed: int
) -> tuple[np.ndarray, list[Any], np.ndarray]:
    """Return a fault by its columns (c,), the numbers of each, and faults as likely (n, c)."""
    if kind not in DIMENSIONS:
        return np.ones(1), [None], np.ones((1, 1))
    lengths = np.linalg.norm(numbers.reshape(-1, 3), axis=1).repeat(3)
    others = np.random.default_rng(seed).normal(size=(DIRECTIONS, len(numbers) // 3, 3))
    others[:, :, DIMENSIONS[kind]:] = 0.0
    others /= np.linalg.norm(others, axis=2, keepdims=True)
    return numbers / lengths, list(np.diag(lengths)), others.reshape(DIRECTIONS, -1)


def least_delays(
    kind: str, runs: int, name: str, seconds: float = 5.0, rate_hz: float = 125 / 4, first: int = 0
) -> list[list[float]]:
    """
    Return the sorted delays (s) of tests with known time and size of the fault.

    The first test knows the direction of the fault, too; the second averages over all directions.
    The mean innovations per unit of the fault are differences of two runs with the same noise.
    Without a fault a likelihood ratio reaches A in at most one of A onsets; the threshold is that
    of the alarms.
    """
    delays: list[list[float]] = [[], []]
    for seed in range(first, first + runs):
        at, end, options = fault_case(kind, name, seed, seconds)
        options = {'alarm__false_per_hour': 0.0, **options}
        sound = Cell(seed, end, CONDITIONS[name], kind, end + 1.0, rate_hz, 0.0, **options)
        x, columns, others = directed(kind, sound.numbers, seed)
        stamps, y0, W = innovations(sound)
        M = np.stack([
            np.einsum('kij,kj->ki', W, innovations(Cell(
                seed, end, CONDITIONS[name], kind, at, rate_hz, numbers=each, **options)
            )[1] - y0) for each in columns], axis=2)
        after = np.append((np.array(stamps) - 1_000_000_000) * 1e-9 - at, np.inf)
        for passed, those in zip(delays, (x[None], others), strict=True):
            passed += after[passages(M, x, those, seed)].tolist()
    return [sorted(each) for each in delays]


def main() -> None:
    """Count, and print each line as soon as it is known."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.alarms', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--hours', type=float, default=0.0, help='in each condition')
    parser.add_argument('--faults', type=int, default=0, help='of each kind')
    parser.add_argument('--drops', type=int, default=0, help='at once and peeling off, each')
    parser.add_argument('--slips', type=int, default=0, help='at once and slow, each')
    parser.add_argument('--kind', choices=KINDS, help='of faults; default: all')
    parser.add_argument('--condition', choices=CONDITIONS, help='default: white for faults, all')
    parser.add_argument('--seed', type=int, default=0, help='of the first run')
    arguments = parser.parse_args()
    runs = round(arguments.hours * 3600.0 / SECONDS)
    for name in (arguments.condition,) if arguments.condition else CONDITIONS:
        for estimate in (False, True) if runs else ():
            causes, nees = false_alarms(name, runs, estimate, arguments.seed)
            print(f'| {name} | {"on" if estimate else "off"} | {runs * SECONDS / 3600:.2g} | '
                  f'{causes.total()} {dict(causes)} | {nees:.1f} |', flush=True)
    name = arguments.condition or 'white'
    for kind in ((arguments.kind,) if arguments.kind else KINDS) if arguments.faults else ():
        right, after = delays(kind, arguments.faults, name, first=arguments.seed)
        least = least_delays(kind, arguments.faults, name, first=arguments.seed)
        most = ' | '.join(f'{each[int(0.9 * len(each))]:.2f}' for each in (after, *least))
        print(f'| {name} | {kind} | {100 * right:.0f} % | {after[len(after) // 2]:.2f} | {most} |',
              flush=True)
    for kind in ('drop', 'peel') if arguments.drops else ():
        for rate_hz, within in ((125 / 4, 0.3), (125 / 12, 0.3)):
            right, after = delays(
                kind, arguments.drops, name, 1.5, rate_hz, arguments.seed)
            noticed = np.mean([s <= within for s in after])
            print(f'| {name} | {kind} | {rate_hz:.0f} Hz | {noticed:.1%} within {within} s | '
                  f'slowest {after[-1]:.2f} s | {100 * right:.0f} % right |', flush=True)
    for lasts in (0.0, 0.25) if arguments.slips else ():
        right, errors = errors_around_slips(
            range(arguments.seed, arguments.seed + arguments.slips), CONDITIONS[name], lasts,
            **EXACT if name == 'white' else {})
        before = np.sqrt(np.mean(np.square(errors[4:8]), axis=0))
        print(f'| {name} | slip in {lasts} s | {right} of {arguments.slips} right | before: '
              f'{1e3 * before[0]:.2f} mm, {np.degrees(before[1]):.2f} deg | times of that: '
              + ', '.join(f'{a:.2f} and {b:.2f}' for a, b in errors[8:] / before), flush=True)


if __name__ == '__main__':
    main()
