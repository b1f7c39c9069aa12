"""
Count alarms and errors in pick-and-place cycles of cells that the package's formulas do not have.

    python -m benchmarks.cycles --hours 1        # ordinary work with each sensor
    python -m benchmarks.cycles --faults 30      # so many faults of each kind
    python -m benchmarks.cycles --honesty 40     # published covariances in so many cells

Cells are those of `test/core/observer/contact_cell.py`, and with `--sensor rig` those of an
independent simulator (`benchmarks/rig_cells.py`). Each has its own errors and twelve cycles of
different packages. Errors are RMS by phase of the cycle: with the camera, without, and of the
newest pose of the camera alone; a cell counts as worse in a phase if its error with the camera
exceeds that without by more than 5 %. Honesty is the share of true positions and rotations within
their published 50 and 95 % regions, with the smallest share of one cell, and the ratio of median
errors with and without the camera, with the largest of one cell. `--seed` is the seed of the first
cell.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from bellows_ros import LivePredictor
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.model.equilibrium import pose_error
from benchmarks import rig_cells
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import hyp0f1
from scipy.stats import chi2, ncx2, norm

from test.core.observer import contact_cell  # noqa: I100, I201
from test.core.observer.contact_cell import ContactCell, DAMPING, LENGTH, STIFFNESS, WRONG

START_NS = 1_000_000_000_000
CYCLES = 12
"""Number of cycles of one cell."""
OF_TAG = {'measured.tag_size': contact_cell.TAG, 'recording.package_world':
          ' '.join(map(str, (*contact_cell.CAMERA, 1.0, 0.0, 0.0, 0.0)))}
"""Parameters of a tag and a camera."""
CAMERAS: dict[str, dict[str, Any]] = {
    'memory': {}, 'white': {}, 'rig': {}, 'view': OF_TAG, 'corners': OF_TAG}
"""Parameters of each sensor of a `ContactCell`."""
CUP: dict[str, Any] = {
    'cup.stiffness': np.diag(STIFFNESS).ravel().tolist(), 'cup.length': LENGTH,
    'cup.damping': np.diag(DAMPING).ravel().tolist(), 'vacuum.signal': 'bool',
    'tool_noise': (2e-5, 5e-5)}
CUP_STD = {
    'cup.stiffness_std': np.diag(WRONG['stiffness'] * STIFFNESS).ravel().tolist(),
    'cup.damping_std': np.diag(WRONG['damping'] * DAMPING).ravel().tolist()}


PHASES = 'lift', 'move', 'hold', 'lower', 'touch', 'set down'
TOUCHING = 1.5e-3
"""Height above its rest from which a lowered package may touch the support, m."""
PARTS = slice(6), slice(3), slice(3, 6)
"""Entries of pose, position and rotation of an error."""
REGIONS = 0.5, 0.95
"""Probabilities of the published regions."""
WORSE = 1.05
"""Smallest ratio of errors with and without a camera of a phase that counts as worse."""


class Outcome(NamedTuple):
    """Alarms and errors of one cell."""

    alarms: list[tuple[int, float, Any]]
    """Cycle, seconds in the cycle, and alarm, as told first."""
    phases: np.ndarray
    """Index of the phase of each error (N,)."""
    errors: np.ndarray
    """Pose errors (N, 6) of held packages, m and rad."""
    of_camera: np.ndarray
    """Errors (N, 6) of the newest measured pose; NaN without one in the cycle."""
    nees: np.ndarray
    """Normalised squared errors (N, 3) of pose, position and rotation; NaN without a
    covariance."""
    seconds: float

    def by_phase(self, errors: np.ndarray) -> np.ndarray:
        """Return the mean squared errors of position and rotation in each phase (phases, 2)."""
        squares = np.square(errors).reshape(-1, 2, 3).sum(axis=2)
        return np.array([np.nanmean(squares[self.phases == k], axis=0) if (
            np.isfinite(squares[self.phases == k]).any()) else [np.nan] * 2
            for k in range(len(PHASES))])

    def of_lifted(self, values: np.ndarray) -> np.ndarray:
        """Return the entries of a package in the air (n, ...)."""
        return values[(self.phases > 0) & (self.phases < 3)]


def phases_of(cycle: Any) -> np.ndarray:
    """Return the index of the phase at each sample; -1 outside of all."""
    at, t, z = cycle.at, cycle.times, cycle.truth[:, 2]
    phase = np.searchsorted(
        [at['lift'], at['move'], at['hold'], at['lower'], at['low'], at['release']], t) - 1
    phase[phase == 4] = 5
    phase[(phase == 3) & (z < z[t > at['low']].min() + TOUCHING)] = 4
    phase[t >= at['release']] = -1
    return phase


def cup_of(sensor: str, stated: bool) -> dict[str, Any]:
    """Return the parameters of cup and camera of a kind of cell."""
    of_rig = rig_cells.cup() if sensor == 'rig' else CUP_STD
    return {**CUP, **CAMERAS[sensor],
            **{name: of_rig[name] for name in of_rig if stated or not name.endswith('_std')}}


class Follower:
    """
    One predictor that follows the cycles of a cell, with package.* set at each grip.

    Parameters
    ----------
    cycles : sequence of Cycle
    sensor : str
        Kind of the cell, of `CAMERAS`.
    stated : bool
        Whether standard deviations are stated.
    has_camera, has_switch : bool
        Whether measured poses arrive, and whether the vacuum switch notices a drop.

    """

    def __init__(
        self, cycles: Sequence[Any], sensor: str, stated: bool, has_camera: bool, has_switch: bool,
    ) -> None:
        packages = [{name: value for name, value in cycle.stated.items()
                     if stated or not name.endswith('_std')} for cycle in cycles]
        self.live = LivePredictor.from_parameters(cup_of(sensor, stated) | packages[0])
        self.has_camera, self.has_switch = has_camera, has_switch
        self.of_tag = CAMERAS[sensor] is OF_TAG
        self.alarms: list[tuple[int, float, Any]] = []
        self.rows: list[tuple[float, ...]] = []
        self.begin = START_NS
        for self.number, cycle in enumerate(cycles):
            self._follow(cycle, packages[self.number])
            self.begin += round(1e9 * (cycle.times[-1] + 0.01))

    def _follow(self, cycle: Any, package: dict[str, Any]) -> None:
        live, held = self.live, np.searchsorted(
            cycle.times, [cycle.at['grip'], cycle.at['release'] if self.has_switch
                          else cycle.at['valve'] + 0.08]).tolist()
        seen, phases = sorted(cycle.seen, key=lambda each: each[1]), phases_of(cycle)
        self.newest: Any = None
        for k, t in enumerate(cycle.times.tolist()):
            stamp_ns = self.begin + round(1e9 * t)
            if k == held[0]:
                live.set_parameters(package)
            self._switch(k, held, stamp_ns)
            while seen and seen[0][1] <= t:
                self._see(*seen.pop(0))
            row = cycle.tool[k].tolist()
            live.on_twist(stamp_ns, tuple(row[7:10]), tuple(row[10:]))
            live.on_pose(stamp_ns, 'world', tuple(row[:3]), tuple(row[3:7]), stamp_ns)
            for alarm in live.alarms[-3:]:
                if all(alarm.kind != other.kind or abs(alarm.stamp_ns - other.stamp_ns) > 5e9
                       for _, _, other in self.alarms):
                    self.alarms.append((self.number, t, alarm))
            if phases[k] >= 0 and k % 2 == 0 and live.latest:
                self._compare(int(phases[k]), cycle.truth[k], k % 10 == 0)

    def _switch(self, k: int, held: list[int], stamp_ns: int) -> None:
        """Let the switch follow the package; without it the valve alone is known."""
        if not self.has_switch:
            if k in held:
                self.live.on_valve(k == held[0], stamp_ns)
        elif k % 5 == 0:
            self.live.on_vacuum(held[0] <= k < held[1], stamp_ns)

    def _see(self, measured: float, arrival: float, position: Any, q: Any) -> None:
        """Let a measured pose arrive, s."""
        self.newest = position, q
        if self.of_tag:
            R = Rotation.from_matrix(contact_cell.DOWN)
            self.newest = (tuple(contact_cell.CAMERA + R.apply(position)),
                           tuple((R * Rotation.from_quat(q)).as_quat()))
        if self.has_camera:
            self.live.on_measured(self.begin + round(1e9 * measured), 'world', position, q, None,
                                  self.begin + round(1e9 * arrival))

    def _compare(self, phase: int, truth: np.ndarray, with_covariance: bool) -> None:
        """Keep the errors of the prediction and of the newest measured pose."""
        prediction, (*o, a, b, c, d) = self.live.latest, truth.tolist()
        assert prediction is not None
        true = tuple(o), (a, b, c, d)
        e = np.r_[pose_error(prediction.body, *true)]
        of_camera = np.r_[pose_error((*self.newest, ZERO, ZERO), *true)] if (
            self.newest) else np.full(6, np.nan)
        P = self.live.covariance(prediction.stamp_ns) if with_covariance else None
        nees = [np.nan] * 3 if P is None else [
            e[part] @ np.linalg.solve(P[part, part], e[part]) for part in PARTS]
        self.rows.append((phase, *e, *of_camera, *nees))


def followed(
    cycles: Sequence[Any], sensor: str = 'memory', stated: bool = True, has_camera: bool = True,
    has_switch: bool = True,
) -> Outcome:
    """Return alarms and errors of the cycles of a cell, see `Follower`."""
    by = Follower(cycles, sensor, stated, has_camera, has_switch)
    rows = np.array(by.rows)
    return Outcome(by.alarms, rows[:, 0].astype(int), rows[:, 1:7], rows[:, 7:13], rows[:, 13:],
                   1e-9 * (by.begin - START_NS))


def cell_of(seed: int, sensor: str) -> Any:
    """Return a cell of a kind."""
    return rig_cells.RigCell(seed) if sensor == 'rig' else ContactCell(seed, sensor)


def ordinary(sensor: str, cells: range, stated: bool) -> None:
    """Print alarms an hour and NEES of ordinary work, and errors by phase."""
    causes, hours, nees, means = Counter[str](), 0.0, [], []
    for seed in cells:
        cell = cell_of(seed, sensor)
        cycles = [cell.cycle() for _ in range(CYCLES)]
        both, alone = (followed(cycles, sensor, stated, camera) for camera in (True, False))
        causes.update(alarm.kind for _, _, alarm in both.alarms)
        hours += both.seconds / 3600.0
        nees.append(np.nanmean(both.of_lifted(both.nees[:, 0])))
        means.append([both.by_phase(both.errors), alone.by_phase(alone.errors),
                      both.by_phase(both.of_camera)])
    squares = np.array(means)  # (cells, runs, phases, 2)
    print(f'| {sensor} | {"stated" if stated else "default"} | {hours:.2f} h | '
          f'{causes.total() / hours:.1f}/h {dict(causes)} | NEES {np.mean(nees):.1f} |')
    worse = (squares[:, 0] > WORSE**2 * squares[:, 1]).sum(axis=0)
    rms = 1e3 * np.sqrt(np.nanmean(squares, axis=0))
    for k, phase in enumerate(PHASES):
        print(f'| {sensor} | {"stated" if stated else "default"} | {phase} | ' + ' | '.join(
            '{:.2f} with, {:.2f} without, {:.1f} camera alone, worse in {} of {}'.format(
                *rms[:, k, axis], worse[k, axis], len(cells)) + unit
            for axis, unit in enumerate((' (mm)', ' (mrad) |'))), flush=True)


def honesty(sensor: str, cells: range, stated: bool) -> None:
    """Print coverage of regions, and ratios of median errors, see the module."""
    shares, ratios = [], []
    for seed in cells:
        cell = cell_of(seed, sensor)
        cycles = [cell.cycle() for _ in range(CYCLES)]
        runs = [followed(cycles, sensor, stated, camera) for camera in (True, False)]
        shares.append([[coverage(run.nees[:, k]) for k in (1, 2)] for run in runs])
        with_camera, without = (medians(run) for run in runs)
        ratios.append(with_camera / without)
    name = f'| {sensor} | {"stated" if stated else "default"} |'
    mean, least = np.mean(shares, axis=0), np.min(shares, axis=0)  # (runs, parts, regions)
    for run, what in enumerate(('with', 'without')):
        print(name, f'{what} the camera |', ' | '.join(
            f'{part} {mean[run, k, 0]:.2f} in 50 %, {mean[run, k, 1]:.2f} in 95 %, '
            f'least {least[run, k, 1]:.2f}' for k, part in enumerate(('position', 'rotation'))),
            '|', flush=True)
    for phase, middle, largest in zip(
            PHASES, np.nanmedian(ratios, axis=0), np.nanmax(ratios, axis=0), strict=True):
        print(name, f'{phase} | ratio of position {middle[0]:.2f}, largest {largest[0]:.2f} | '
              f'of rotation {middle[1]:.2f}, largest {largest[1]:.2f} |', flush=True)


def coverage(nees: np.ndarray) -> list[float]:
    """Return the shares of normalised squared errors (N,) of three axes within the regions."""
    known = nees[np.isfinite(nees)]
    return [float(np.mean(known <= bound)) for bound in chi2.ppf(REGIONS, 3)]


def medians(run: Outcome) -> np.ndarray:
    """Return median errors of position and rotation in each phase (phases, 2)."""
    sizes = np.linalg.norm(run.errors.reshape(-1, 2, 3), axis=2)
    return np.array([np.median(sizes[run.phases == k], axis=0) for k in range(len(PHASES))])


FAULTS: dict[str, list[dict[str, Any]]] = {
    'collision': [{'size': 0.3}],
    'drop': [{'at_event': 'hold', 'after': 0.15}, {'at_event': 'hold', 'after': -0.3},
             {'at_event': 'hold', 'after': 0.1, 'gradual': 0.15},
             {'at_event': 'move', 'after': 0.05}, {'at_event': 'lift', 'after': 0.2}],
    'drop lowering': [{'at_event': 'lower', 'after': 0.1},
                      {'at_event': 'lower', 'after': 0.25}],
    'slip': [{'size': 5e-3}],
    'swap': [{'size': 1.3}],
    'latency': [{'size': 0.04, 'at_event': 'grip', 'after': 0.0}],
    'camera': [{'size': 5e-3}],
}
RIGHT = {'drop': ('lost',), 'drop lowering': ('lost',), 'swap': ('differs', 'deviates')}
"""Kinds of the alarms on a fault; `deviates` on the others."""
ONSET_NS = 30_000_000
"""Period of the camera, ns."""
DIRECTIONS = {'slip': 2, 'camera': 3}
"""Dimensions of the directions of faults with an ideal test."""


def faults(kind: str, seeds: range, sensor: str, has_switch: bool = True) -> None:
    """Print the first alarms on faults in the third cycle of a cell, with their delays."""
    first, found_by, delays = Counter[str](), np.zeros(2), []
    for seed in seeds:
        fault = FAULTS[kind][seed % len(FAULTS[kind])]
        cycles = _with_fault(seed, sensor, kind, fault)
        run = followed(cycles, sensor, has_switch=has_switch)
        found = [each for each in run.alarms if each[0] >= 2]
        first[found[0][2].kind if found else ''] += 1
        delays += [t - cycles[2].at['fault'] for number, t, _ in found[:1] if number == 2]
        if kind in DIRECTIONS:
            sound = _with_fault(seed, sensor, kind, {**fault, 'size': 0.0})
            found_by += ideal(sound[2], cycles[2], DIRECTIONS[kind],
                              cup_of(sensor, False)['cup.stiffness'][21])
    right = sum(first[each] for each in RIGHT.get(kind, ('deviates',)))
    switch = '' if has_switch else ' without the switch'
    print(f'| {kind}{switch} | {sensor} | {right} of {len(seeds)} {dict(first)} | '
          f'delay {np.median(delays or [np.nan]):.2f} s, largest '
          f'{max(delays, default=np.nan):.2f} s |' + (
              ' ideal {:.1f}, {:.1f} with its direction |'.format(*found_by)
              if found_by.any() else ''), flush=True)


def _with_fault(seed: int, sensor: str, kind: str, fault: Mapping[str, Any]) -> list[Any]:
    """Return two sound cycles, and one or three with a fault."""
    cell, count = cell_of(seed, sensor), 3 if kind in ('latency', 'swap') else 1
    return [cell.cycle(), cell.cycle(), *(
        cell.cycle(kind.split()[0], **fault) for _ in range(count))]


def ideal(sound: Any, faulty: Any, dimensions: int, bending: float) -> tuple[float, float]:
    """
    Return the probabilities that ideal tests find a fault at the threshold of an alarm.

    The tests have the true time and size of the fault, its effect on the poses, and the true noise
    of poses and stamps. Marker, camera and centre of mass have their stated standard deviations;
    the latter turns a package on a cup with a stiffness in bending (N m/rad).
    The first test averages over directions, the second has the true one. With n dimensions, the
    fault's squared distance k and r = sqrt(k) |y| for the whitened score y, the average of the
    likelihood ratio is 0F1(n / 2; r^2 / 4) exp(-k / 2).
    """
    count = sum(t < faulty.at['lower'] for t, *_ in sound.seen)
    (stamps, _, o0, q0), (_, _, o1, q1) = (
        map(np.array, zip(*cycle.seen[:count], strict=True)) for cycle in (sound, faulty))
    turn = (Rotation.from_quat(q0).inv() * Rotation.from_quat(q1)).as_rotvec()
    by_weight = faulty.stated['package.mass'] * 9.81 / bending
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
    parser.add_argument('--honesty', type=int, default=0, help='in so many cells of each sensor')
    parser.add_argument('--kind', choices=FAULTS, help='of faults; default: all')
    parser.add_argument('--sensor', choices=CAMERAS, help='default: all; memory for faults')
    parser.add_argument('--seed', type=int, default=0, help='of the first cell')
    given = parser.parse_args()
    cells = range(given.seed, given.seed + max(1, round(given.hours * 3600.0 / (CYCLES * 6.0))))
    for sensor in ((given.sensor,) if given.sensor else CAMERAS) if given.hours else ():
        for stated in (False, True):
            ordinary(sensor, cells, stated)
    for sensor in ((given.sensor,) if given.sensor else CAMERAS) if given.honesty else ():
        honesty(sensor, range(given.seed, given.seed + given.honesty), True)
    for kind in ((given.kind,) if given.kind else FAULTS) if given.faults else ():
        for has_switch in (True, False) if kind.startswith('drop') else (True,):
            faults(kind, range(given.seed, given.seed + given.faults), given.sensor or 'memory',
                   has_switch)


if __name__ == '__main__':
    main()
