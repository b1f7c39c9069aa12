"""
Errors of the live prediction with a force-torque sensor, a camera, both, or the tool alone.

    python -m benchmarks.wrench --seeds 10

The cell is `test/core/observer/wrench_run.py`: a sensor simulated by Newton and Euler on point
masses, with the noise, drift and delay of an ATI Gamma or of a UR e-series; a package gripped 10
mm off its centre, its mass 10 % off and K 5 %; a gripper 2 % off, 1 % of gain errors
by axis and 1 % of hysteresis. The camera has 30 Hz and white noise of 2 mm and 10 mrad. Errors of
B are RMS in 8 s of pick-and-place motions, without the first 0.1 s. The second table counts losses
and slips of 5 mm within 10 ms, with their delays, and false alarms before. The last has errors and
alarms in the cycles with contact of `benchmarks.cycles`, with wrenches of 100 Hz, the
noise of a UR e-series, which the parameters do not state, and 1 % of gain errors.
"""

import argparse
from collections import Counter
from typing import Any

from benchmarks.cycles import cell_of, CYCLES, Follower, PHASES, WORSE
import numpy as np
from scipy.spatial.transform import Rotation

from test.core.observer.wrench_run import (  # noqa: I100, I201
    predict,
    SENSORS,
    simulated,
    STEP_NS,
)

BEGIN = 0.1
"""Time from which errors count, s."""
WEIGHED = 3.0
"""Time of the error of the mass, s."""
ONSET = 6.0
"""Time at which a fault begins, s."""


def row(sensor: str, seeds: range) -> str:
    """Return the errors of a sensor in a table."""
    rms, masses, first = [], [], round(BEGIN * 1e9 / STEP_NS)
    for seed in seeds:
        run, mass = simulated(seed, sensor, True), []

        def note(k: int, live: Any, reading: Any, mass: list[Any] = mass, run: Any = run) -> Any:
            if k == round(WEIGHED * 1e9 / STEP_NS):
                payload = live.payload
                mass += [payload.mass - run.mass, payload.mass_std]
            return reading

        each = [predict(run, seed, camera, wrench, note if wrench and not camera else None)[1]
                for camera, wrench in ((False, False), (True, False), (False, True), (True, True))]
        rms.append([1e3 * np.sqrt(np.mean(e[first:]**2)) for e in each])
        masses.append(np.divide(mass, run.mass))
    table, m = np.array(rms), np.array(masses)
    means = ' | '.join(f'{x:.2f} mm' for x in np.sqrt(np.mean(table**2, axis=0)))
    return (f'| {sensor} | {means} '
            f'| {np.max(table[:, 3] / table[:, 1]):.2f} | {100 * np.abs(m[:, 0]).max():.1f} % '
            f'| {np.abs(m[:, 0] / m[:, 1]).max():.1f} |')


def faults(sensor: str, fault: str, seeds: range) -> str:
    """Return counts and delays of alarms of a sensor in a table."""
    delays, others = [], 0
    for seed in seeds:
        run = simulated(seed, sensor, True, 6.5, fault, ONSET)
        alarms = [(alarm.kind, (alarm.stamp_ns - int(run.stamps[0])) * 1e-9 - ONSET)
                  for alarm in predict(run, seed)[0].alarms]
        late = [delay for cause, delay in alarms if cause == fault and delay > 0.0]
        delays += [1e3 * (late[0] + run.parameters['wrench.delay'])] if late else []
        others += sum(delay < 0.0 for _, delay in alarms)
    slowest = f'{np.median(delays):.0f} ms | {np.max(delays):.0f} ms' if delays else '- | -'
    return f'| {sensor} | {fault} | {len(delays)} of {len(seeds)} | {slowest} | {others} |'


class Feeler(Follower):
    """A follower of cycles with contact, with a sensor at the tool tip."""

    noise = np.repeat(SENSORS['UR']['noise'], 3)

    def _follow(self, cycle: Any, package: dict[str, Any]) -> None:
        """Follow a cycle; wrenches come with its twists."""
        rng, on_twist, count = np.random.default_rng(self.number), self.live.on_twist, iter(
            range(len(cycle.times)))
        gain = 1.0 + 0.01 * rng.choice([-1.0, 1.0], 6)

        def with_wrench(stamp_ns: int, *twist: Any) -> Any:
            if (k := next(count)) > 0:
                before = self.begin + round(1e9 * cycle.times[k - 1])
                back = Rotation.from_quat(cycle.tool[k - 1, 3:7]).inv()
                force, moment = cycle.load[k - 1].reshape(2, 3)
                arm = cycle.truth[k - 1, :3] - cycle.tool[k - 1, :3]
                moment = back.apply(moment + np.cross(arm, force))
                shown = -gain * np.r_[back.apply(force), moment] + self.noise * rng.normal(size=6)
                self.live.on_wrench(before, 'tool0', tuple(shown[:3]), tuple(shown[3:]))
            return on_twist(stamp_ns, *twist)

        self.live.on_twist = with_wrench  # type: ignore[method-assign]
        super()._follow(cycle, package)
        self.live.on_twist = on_twist  # type: ignore[method-assign]


def with_contact(seeds: range) -> None:
    """Print errors and alarms in pick-and-place cycles with contact."""
    print('\n| phase | tool only | wrench | camera | both | both above camera |')
    print('|---|---|---|---|---|---|')
    squares: Any = np.zeros((len(seeds), len(PHASES), 4))
    causes, hours = [Counter[str]() for _ in range(4)], 0.0
    for squares_of, seed in zip(squares, seeds, strict=True):
        cell = cell_of(seed, 'memory')
        cycles = [cell.cycle() for _ in range(CYCLES)]
        for n, (kind, camera) in enumerate((
                (Follower, False), (Feeler, False), (Follower, True), (Feeler, True))):
            by = kind(cycles, 'memory', True, camera, True)
            rows: Any = np.array(by.rows)
            causes[n].update(alarm.kind for _, _, alarm in by.alarms)
            squares_of[:, n] = [np.mean(np.sum(rows[rows[:, 0] == k, 1:4]**2, axis=1))
                                for k in range(len(PHASES))]
        hours += 1e-9 * (by.begin - 1_000_000_000_000) / 3600.0
    above = (squares[:, :, 3] > WORSE**2 * squares[:, :, 2]).sum(axis=0)
    for phase, each, count in zip(
            PHASES, 1e3 * np.sqrt(squares.mean(axis=0)), above, strict=True):
        print(f'| {phase} | ' + ' | '.join(f'{x:.2f} mm' for x in each)
              + f' | in {count} of {len(seeds)} |')
    print(f'| alarms in {hours:.2f} h | ' + ' | '.join(
        f'{each.total()} {dict(each) or ""}' for each in causes) + ' |', flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--seeds', type=int, default=10, help='number of seeds')
    parser.add_argument('--seed', type=int, default=0, help='the first seed')
    parser.add_argument('--only', choices=['errors', 'faults', 'contact'])
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.seeds)
    if options.only in (None, 'errors'):
        print('| sensor | tool only | camera | wrench | both | largest both / camera '
              '| mass at 3 s, wrench: largest error | in std |')
        print('|---|---|---|---|---|---|---|---|')
        for sensor in SENSORS:
            print(row(sensor, seeds), flush=True)
    if options.only in (None, 'faults'):
        print('\n| sensor | fault | named | delay, median | largest | alarms before |')
        print('|---|---|---|---|---|---|')
        for sensor in SENSORS:
            for fault in ('lost', 'slip'):
                print(faults(sensor, fault, seeds), flush=True)
    if options.only in (None, 'contact'):
        with_contact(seeds)


if __name__ == '__main__':
    main()
