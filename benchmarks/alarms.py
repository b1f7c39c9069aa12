"""
Alarms of simulated cells, counted: false ones an hour, and how soon faults are named.

`--hours` counts false alarms in each ordinary condition, and prints the mean normalised squared
error of the state (12 where the covariance is right); `--faults` lets so many faults of each kind
happen in one condition, and prints how many causes are right, and after how many seconds half and
90 % of them are named; beside it, after how many the likelihood-ratio test finds them that knows
time and size of each fault, with the same threshold. `--drops` lets packages fall, seen
at 30 and at 10 Hz until 0.55 m below. `--slips` lets so many packages slip by 3 to 10 mm, at once
and within 0.25 s, and prints how many first alarms are right, and the errors in each half second
since, relative to the 2 s before.
"""

import argparse
from collections import Counter
import math

from bellows_ros.core.observer.alarms import MARGIN, ONSET_NS
from bellows_ros.core.observer.measurement import (
    corrected_pose,
    innovation,
    Measurement,
    when_exposed,
)
import numpy as np

from test.core.observer.cases import error_of  # noqa: I100, I201
from test.core.observer.cell import Cell, CONDITIONS, errors_around_slips, EXACT  # noqa: I201

SECONDS = 60.0
"""Length of a run without a fault."""
EXACTLY = {**EXACT, 'payload__estimate': False}
"""With white noise and exact numbers nothing else is uncertain."""
NAMED = {'turn': 'slip', 'drop': 'lost', 'peel': 'lost'}
"""The cause of an alarm by the kind of the fault, where it has another name."""
FROM_START = ('wear', 'payload', 'mass')
KINDS = ('slip', 'turn', 'leak', 'camera', *FROM_START, 'cup')


def false_alarms(
    name: str, runs: int, estimate: bool, seed: int = 0
) -> tuple[Counter[str], float]:
    """Return the causes of false alarms in so many runs, and the mean normalised squared error."""
    causes, errors = Counter[str](), []
    for number in range(seed, seed + runs):
        cell = Cell(number, SECONDS, CONDITIONS[name], payload__estimate=estimate)

        def after(k: int, cell: Cell = cell) -> None:
            if k % 125 == 0 and k > 250:
                e = error_of(cell.made, cell.body[k])
                errors.append(e @ np.linalg.solve(cell.made.estimate.covariance[:12, :12], e))

        causes.update(cause for cause, _ in cell.run(after))
    return causes, float(np.mean(errors))


def delays(
    kind: str, runs: int, name: str, seconds: float = 5.0, rate_hz: float = 125 / 4, first: int = 0
) -> tuple[float, list[float]]:
    """Return the part of faults whose cause is right, and how long (s) each took, in order."""
    at, more = 0.0 if kind in FROM_START else 3.0, EXACTLY if name == 'white' else {}
    right, after = 0, []
    for seed in range(first, first + runs):
        cup = {'lost': seed % 4} if kind == 'cup' else {}
        cell = Cell(seed, at + seconds, CONDITIONS[name], kind, at, rate_hz, **cup, **more)
        cause, delay = (cell.run() or [('', np.inf)])[0]
        if kind == 'mass':  # only the damping tells it from wear: the alarm says both
            right += {cause, *(alarm.second for alarm in cell.made.alarms[:1])} == {
                'wear', 'payload'}
        else:
            right += cause == (f'cup {seed % 4}' if cup else NAMED.get(kind, kind))
        after.append(delay)
    return right / runs, sorted(after)


def innovations(cell: Cell) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return stamps (ns) and innovations of a run, and what whitens them."""
    stamps, ys, whiteners = [], [], []

    def before(seen: Measurement) -> None:
        stamp_ns, position, q, noise = seen
        known, marker = cell.made.estimate, cell.made.sensor.marker
        body, theta, model = known.body, known.theta, cell.made.model
        com = model[1][1]
        position, q, noise = corrected_pose(position, q, noise, marker, theta, com)
        exposed = when_exposed(model, known.tool, body, theta)
        y, _, whitener, *_ = innovation(
            exposed, theta, known.covariance, position, q, noise, marker[2])
        stamps.append(stamp_ns)
        ys.append(y)
        whiteners.append(whitener)

    cell.run(before=before)
    return stamps, np.array(ys), np.array(whiteners)


def passages(d2: np.ndarray, threshold: float, seed: int) -> np.ndarray:
    """
    Return after how many innovations a log-likelihood ratio passes a threshold, in 100 draws.

    Each adds half the square d2 of its whitened mean, with d2 as variance; -1 if none is enough.
    """
    gains = 0.5 * d2 + np.sqrt(d2) * np.random.default_rng(seed).normal(size=(100, len(d2)))
    found = np.cumsum(gains, axis=1) >= threshold
    return np.where(found.any(axis=1), found.argmax(axis=1), -1)


def least_delays(
    kind: str, runs: int, name: str, seconds: float = 5.0, rate_hz: float = 125 / 4, first: int = 0
) -> list[float]:
    """
    Return how long (s) the test takes that knows time and size of each fault, in order.

    The means of its innovations are the differences of two runs with the same noise. Without a
    fault their log-likelihood ratio ever reaches log A in one of A onsets at most; here it has the
    threshold of the alarms.
    """
    at, more = 0.0 if kind in FROM_START else 3.0, EXACTLY if name == 'white' else {}
    threshold, delays = math.log(3.6e12 / ONSET_NS) + MARGIN, []
    for seed in range(first, first + runs):
        cup = {'lost': seed % 4} if kind == 'cup' else {}
        (stamps, y1, _), (_, y0, W) = (innovations(Cell(
            seed, at + seconds, CONDITIONS[name], kind, begins, rate_hz, size,
            alarm__false_per_hour=0.0, **cup, **more))
            for begins, size in ((at, 1.0), (at + seconds + 1.0, 0.0)))
        d2 = np.square(np.einsum('kij,kj->ki', W, y1 - y0)).sum(axis=1)
        after = np.append((np.array(stamps) - 1_000_000_000) * 1e-9 - at, np.inf)
        delays += after[passages(d2, threshold, seed)].tolist()
    return sorted(delays)


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
    given = parser.parse_args()
    runs = round(given.hours * 3600.0 / SECONDS)
    for name in (given.condition,) if given.condition else CONDITIONS:
        for estimate in (False, True) if runs else ():
            causes, nees = false_alarms(name, runs, estimate, given.seed)
            print(f'| {name} | {"on" if estimate else "off"} | {runs * SECONDS / 3600:.2g} | '
                  f'{causes.total()} {dict(causes)} | {nees:.1f} |', flush=True)
    name = given.condition or 'white'
    for kind in ((given.kind,) if given.kind else KINDS) if given.faults else ():
        right, after = delays(kind, given.faults, name, first=given.seed)
        least = least_delays(kind, given.faults, name, first=given.seed)
        halves, most = ([each[int(part * len(each))] for each in (after, least)]
                        for part in (0.5, 0.9))
        print(f'| {name} | {kind} | {100 * right:.0f} % | {halves[0]:.2f} | {most[0]:.2f} | '
              f'{halves[1]:.2f} | {most[1]:.2f} | {most[0] / most[1]:.2f} |', flush=True)
    for kind, ends in (('drop', 0.0), ('peel', 0.15)) if given.drops else ():
        for rate_hz, within in ((125 / 4, 0.3), (125 / 12, 0.6)):
            right, after = delays(kind, given.drops, name, 1.5, rate_hz)
            noticed = np.mean([s - ends <= within for s in after])
            print(f'| {name} | {kind} | {rate_hz:.0f} Hz | {100 * noticed:.1f} % within '
                  f'{within} s of its end | slowest {after[-1]:.2f} s after its beginning | '
                  f'{100 * right:.0f} % right |', flush=True)
    for lasts in (0.0, 0.25) if given.slips else ():
        right, errors = errors_around_slips(
            range(given.seed, given.seed + given.slips), CONDITIONS[name], lasts,
            **EXACT if name == 'white' else {})
        before = np.sqrt(np.mean(np.square(errors[4:8]), axis=0))
        print(f'| {name} | slip in {lasts} s | {right} of {given.slips} right | before: '
              f'{1e3 * before[0]:.2f} mm, {1e3 * before[1]:.1f} mrad | times of that: '
              + ', '.join(f'{a:.2f} and {b:.2f}' for a, b in errors[8:] / before), flush=True)


if __name__ == '__main__':
    main()
