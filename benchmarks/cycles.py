"""
Count alarms and errors in pick-and-place cycles of cells that the package's formulas do not have.

    python -m benchmarks.cycles --hours 1        # ordinary work with three cameras
    python -m benchmarks.cycles --faults 30      # so many faults of each kind

Cells are those of `test/core/observer/contact_cell.py`. Each has its own errors and twelve cycles
of different packages. `--seed` is the seed of the first cell.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bellows_ros import LivePredictor
from bellows_ros.core.model.equilibrium import pose_error
from bellows_ros.core.observer.alarms import ONSET_NS
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import hyp0f1
from scipy.stats import ncx2, norm

from test.core.observer import contact_cell  # noqa: I100, I201
from test.core.observer.contact_cell import ContactCell, DAMPING, LENGTH, STIFFNESS, WRONG

START_NS = 1_000_000_000_000
CYCLES = 12
"""Number of cycles of one cell."""
CAMERAS: dict[str, dict[str, Any]] = {
    'memory': {}, 'white': {},
    'view': {'measured.model': 'tag', 'measured.camera': [0.5, 0.0, 1.6]}}
"""Parameters of each sensor of a `ContactCell`."""
CUP: dict[str, Any] = {
    'cup.stiffness': np.diag(STIFFNESS).ravel().tolist(), 'cup.length': LENGTH,
    'cup.damping': np.diag(DAMPING).ravel().tolist(), 'vacuum.signal': 'bool',
    'tool_noise.position': 2e-5, 'tool_noise.rotation': 5e-5}
CUP_STD = {
    'cup.stiffness_std': np.diag(WRONG['stiffness'] * STIFFNESS).ravel().tolist(),
    'cup.damping_std': np.diag(WRONG['damping'] * DAMPING).ravel().tolist()}


class Outcome(NamedTuple):
    """Alarms and errors of one cell."""

    alarms: list[tuple[int, float, Any]]
    """Cycle, seconds in the cycle, and alarm, as told first."""
    errors: np.ndarray
    """Pose errors (N, 6) of held packages, m and rad."""
    nees: np.ndarray
    """Normalised squared errors of these poses."""
    seconds: float


def followed(
    cycles: Sequence[Any], sensor: str = 'memory', stated: bool = True, has_camera: bool = True,
) -> Outcome:
    """Let one predictor follow the cycles of a cell, with package.* set at each grip."""
    packages = [{name: value for name, value in cycle.stated.items()
                 if stated or not name.endswith('_std')} for cycle in cycles]
    live = LivePredictor.from_parameters(
        CUP | CAMERAS[sensor] | (CUP_STD if stated else {}) | packages[0])
    begin, alarms, errors, nees = START_NS, list[tuple[int, float, Any]](), [], []
    for number, cycle in enumerate(cycles):
        held = int(np.searchsorted(cycle.times, cycle.at['grip'])), int(
            np.searchsorted(cycle.times, cycle.at['release']))
        seen = sorted(cycle.seen, key=lambda each: each[1]) if has_camera else []
        for k, t in enumerate(cycle.times.tolist()):
            stamp_ns = begin + round(1e9 * t)
            if k == held[0]:
                live.set_parameters(packages[number])
            if k % 5 == 0:
                live.on_vacuum(held[0] <= k < held[1], stamp_ns)
            while seen and seen[0][1] <= t:
                measured, arrival, position, q = seen.pop(0)
                live.on_measured(begin + round(1e9 * measured), 'world', position, q, None,
                                 begin + round(1e9 * arrival))
            row = cycle.tool[k].tolist()
            live.on_twist(stamp_ns, tuple(row[7:10]), tuple(row[10:]))
            live.on_pose(stamp_ns, 'world', tuple(row[:3]), tuple(row[3:7]), stamp_ns)
            for alarm in live.alarms[-3:]:
                if all(alarm.cause != other.cause or abs(alarm.stamp_ns - other.stamp_ns) > 5e9
                       for _, _, other in alarms):
                    alarms.append((number, t, alarm))
            if cycle.at['move'] < t < cycle.at['lower'] and k % 5 == 0 and live.held:
                true = cycle.truth[k].tolist()
                e = np.r_[pose_error(live.held.body, tuple(true[:3]), tuple(true[3:]))]
                errors.append(e)
                P = live.covariance(live.held.stamp_ns) if live.package.observer else None
                nees.append(np.nan if P is None else e @ np.linalg.solve(P[:6, :6], e))
        begin += round(1e9 * (cycle.times[-1] + 0.01))
    return Outcome(alarms, np.array(errors), np.array(nees), 1e-9 * (begin - START_NS))


def ordinary(sensor: str, cells: range, stated: bool) -> None:
    """Print alarms an hour, errors with and without a camera, and NEES of ordinary work."""
    causes, hours, rows, worse = Counter[str](), 0.0, [], 0
    for seed in cells:
        cell = ContactCell(seed, sensor)
        cycles = [cell.cycle() for _ in range(CYCLES)]
        both, alone = (followed(cycles, sensor, stated, camera) for camera in (True, False))
        causes.update(alarm.cause for _, _, alarm in both.alarms)
        hours += both.seconds / 3600.0
        of_cell = [np.sqrt(np.mean(np.square(run.errors[:, :3]).sum(axis=1)))
                   for run in (both, alone)]
        worse += of_cell[0] > of_cell[1]
        rows.append([*np.square(of_cell), np.nanmean(both.nees)])
    mm = 1e3 * np.sqrt(np.mean(rows, axis=0))
    print(f'| {sensor} | {"stated" if stated else "default"} | {hours:.2f} h | '
          f'{causes.total() / hours:.1f}/h {dict(causes)} | {mm[0]:.2f} mm with, {mm[1]:.2f} '
          f'without, worse in {worse} of {len(cells)} | NEES {np.mean(rows, axis=0)[2]:.1f} |',
          flush=True)


FAULTS: dict[str, list[dict[str, Any]]] = {
    'collision': [{'size': 0.3}],
    'drop': [{'at_event': 'hold', 'after': 0.15}, {'at_event': 'hold', 'after': -0.3},
             {'at_event': 'hold', 'after': 0.1, 'gradual': 0.15},
             {'at_event': 'move', 'after': 0.05}],
    'slip': [{'size': 5e-3}],
    'swap': [{'size': 1.3}],
    'latency': [{'size': 0.04, 'at_event': 'grip', 'after': 0.0}],
    'camera': [{'size': 5e-3}],
}
RIGHT = {'collision': ('', 'disturbance'), 'drop': ('lost',), 'swap': ('payload',)}
TRUE_SIZE = {'slip': 5e-3, 'swap': 0.3, 'latency': 0.04, 'camera': 5e-3}
DIRECTIONS = {'slip': 2, 'camera': 3}
"""Dimensions of the directions of faults with an ideal test."""


def faults(kind: str, seeds: range, sensor: str) -> None:
    """Print the first causes of faults in the third cycle of a cell, and z of the sizes."""
    first, z, odds, found_by = Counter[str](), [], 0.0, np.zeros(2)
    for seed in seeds:
        fault = FAULTS[kind][seed % len(FAULTS[kind])]
        cycles = _with_fault(seed, sensor, kind, fault)
        run = followed(cycles, sensor)
        found = [each for each in run.alarms if each[0] >= 2]
        first[found[0][2].cause if found else ''] += 1
        if kind in DIRECTIONS:
            sound = _with_fault(seed, sensor, kind, {**fault, 'size': 0.0})
            found_by += ideal(sound[2], cycles[2], DIRECTIONS[kind])
        for _, _, alarm in found[:1]:
            if alarm.cause not in RIGHT.get(kind, (kind,)):
                odds = max(odds, alarm.odds)
            elif kind in TRUE_SIZE:
                z.append((alarm.size - TRUE_SIZE[kind]) / alarm.std)
    right = sum(first[cause] for cause in RIGHT.get(kind, (kind,)))
    print(f'| {kind} | {sensor} | {right} of {len(seeds)} {dict(first)} | largest wrong odds '
          f'{odds:.0f} | z rms {np.sqrt(np.mean(np.square(z))):.2f} of {len(z)} |' + (
              ' ideal {:.1f}, {:.1f} with its direction |'.format(*found_by)
              if kind in DIRECTIONS else ''), flush=True)


def _with_fault(seed: int, sensor: str, kind: str, fault: Mapping[str, Any]) -> list[Any]:
    """Return two sound cycles, and one or three with a fault."""
    cell = ContactCell(seed, sensor)
    return [cell.cycle(), cell.cycle(), *(
        cell.cycle(kind, **fault) for _ in range(3 if kind in ('latency', 'swap') else 1))]


def ideal(sound: Any, faulty: Any, dimensions: int) -> tuple[float, float]:
    """
    Return the probabilities that ideal tests find a fault at the threshold of an alarm.

    The tests have the true time and size of the fault, its effect on the poses, and the true noise
    of poses and stamps. Marker, camera and centre of mass have their stated standard deviations.
    The first test averages over directions, the second has the true one. With n dimensions, the
    fault's squared distance k and r = sqrt(k) |y| for the whitened score y, the average of the
    likelihood ratio is 0F1(n / 2; r^2 / 4) exp(-k / 2).
    """
    count = sum(t < faulty.at['lower'] for t, *_ in sound.seen)
    (stamps, _, o0, q0), (_, _, o1, q1) = (
        map(np.array, zip(*cycle.seen[:count], strict=True)) for cycle in (sound, faulty))
    turn = (Rotation.from_quat(q0).inv() * Rotation.from_quat(q1)).as_rotvec()
    by_weight = faulty.stated['package.mass'] * 9.81 / STIFFNESS[3]
    speed = np.linalg.norm(np.gradient(sound.truth[:, :2], sound.times, axis=0), axis=1)
    late = 5e-3 / np.sqrt(2.0) * np.interp(stamps, sound.times, speed)
    offset, twist = np.hypot(WRONG['camera'], WRONG['marker'])
    com, memory = WRONG['com'], np.exp(-np.abs(stamps[:, None] - stamps) / 0.05)
    k = sum(np.sum(change * np.linalg.solve(noise**2 * memory + prior**2 + np.diag(jitter**2),
                                            change)) for change, noise, prior, jitter in (
        (o1 - o0, contact_cell.NOISE[0], np.hypot(offset, com), late),
        (turn, contact_cell.NOISE[3], np.hypot(twist, com * by_weight), 0.0 * late)))
    threshold = np.log(3600e9 / ONSET_NS) + 0.5 * k
    r = brentq(lambda r: np.log(hyp0f1(0.5 * dimensions, 0.25 * r * r)) - threshold, 0.0, 300.0)
    return (float(ncx2.sf(r * r / k, dimensions, k)),
            float(norm.sf(threshold / np.sqrt(k) - np.sqrt(k))))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.cycles', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--hours', type=float, default=0.0, help='of ordinary work in each row')
    parser.add_argument('--faults', type=int, default=0, help='of each kind')
    parser.add_argument('--kind', choices=FAULTS, help='of faults; default: all')
    parser.add_argument('--sensor', choices=CAMERAS, help='default: all; memory for faults')
    parser.add_argument('--seed', type=int, default=0, help='of the first cell')
    given = parser.parse_args()
    cells = range(given.seed, given.seed + max(1, round(given.hours * 3600.0 / (CYCLES * 6.0))))
    for sensor in ((given.sensor,) if given.sensor else CAMERAS) if given.hours else ():
        for stated in (False, True):
            ordinary(sensor, cells, stated)
    for kind in ((given.kind,) if given.kind else FAULTS) if given.faults else ():
        faults(kind, range(given.seed, given.seed + given.faults), given.sensor or 'memory')


if __name__ == '__main__':
    main()
