"""
Errors of the live prediction with a force-torque sensor, a camera, both, or the tool alone.

    python -m benchmarks.wrench --seeds 10

The cell is `test/core/observer/wrench_run.py`: a sensor simulated by Newton and Euler on point
masses, with the noise, drift and delay of an ATI Gamma or of a UR e-series; a package gripped 10
mm off its centre, its mass 10 % off and K 5 %; with `errors` a gripper 2 % off, 1 % of gain errors
by axis and 1 % of hysteresis. The camera has 30 Hz and white noise of 2 mm and 10 mrad. Errors of
B are RMS in 8 s of pick-and-place motions, without the first 0.1 s. The second table counts losses
and slips of 5 mm within 10 ms, with their delays, and false alarms before.
"""

import argparse
from typing import Any

import numpy as np

from test.core.observer.wrench_run import predict, SENSORS, simulated, STEP_NS  # noqa: I100, I201

BEGIN, WEIGHED, ONSET = 0.1, 3.0, 6.0
"""Times from which errors count, of the mass, and at which a fault begins, s."""


def row(sensor: str, errors: bool, count: int) -> str:
    """Return the errors of a sensor in a table."""
    rms, masses, first = [], [], round(BEGIN * 1e9 / STEP_NS)
    for seed in range(count):
        run, mass = simulated(seed, sensor, errors), []

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
    return (f'| {sensor} | {"yes" if errors else "no"} | {means} '
            f'| {np.max(table[:, 3] / table[:, 1]):.2f} | {100 * np.abs(m[:, 0]).max():.1f} % '
            f'| {np.abs(m[:, 0] / m[:, 1]).max():.1f} |')


def faults(sensor: str, fault: str, count: int) -> str:
    """Return counts and delays of alarms of a sensor in a table."""
    delays, others = [], 0
    for seed in range(count):
        run = simulated(seed, sensor, True, 6.5, fault, ONSET)
        alarms = [(alarm.cause, (alarm.stamp_ns - int(run.stamps[0])) * 1e-9 - ONSET)
                  for alarm in predict(run, seed)[0].alarms]
        late = [delay for cause, delay in alarms if cause == fault and delay > 0.0]
        delays += [1e3 * (late[0] + run.parameters['wrench.delay'])] if late else []
        others += sum(delay < 0.0 for _, delay in alarms)
    slowest = f'{np.median(delays):.0f} ms | {np.max(delays):.0f} ms' if delays else '- | -'
    return f'| {sensor} | {fault} | {len(delays)} of {count} | {slowest} | {others} |'


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--only', choices=['errors', 'faults'])
    options = parser.parse_args()
    if options.only != 'faults':
        print('| sensor | errors | tool only | camera | wrench | both | largest both / camera '
              '| mass at 3 s, wrench: largest error | in std |')
        print('|---|---|---|---|---|---|---|---|---|')
        for sensor in SENSORS:
            for errors in (False, True):
                print(row(sensor, errors, options.seeds), flush=True)
    if options.only != 'errors':
        print('\n| sensor | fault | named | delay, median | largest | alarms before |')
        print('|---|---|---|---|---|---|')
        for sensor in SENSORS:
            for fault in ('lost', 'slip'):
                print(faults(sensor, fault, options.seeds), flush=True)


if __name__ == '__main__':
    main()
