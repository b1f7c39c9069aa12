"""
How well output error finds a cup with the sensors that people have.

    python -m benchmarks.sensors --runs 24

Every recording is of another motion, simulated; the search starts from K and P twice too large.
Of every cell the table says by how much the parameters are off on average (bias) and how they
spread, over the Cramer-Rao bound (the information along the true motion, whatever the path of the
tool), which part of the 95 % intervals holds the truth, the mean Mahalanobis distance of all
parameters over their number, and how many fits converged. Only numbers whose bound is below 20 %
are judged.
"""

import argparse
import time

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.output_error import output_error
from bellows_ros.core.identification.search import BodyNoise, Measured, Search, Segment
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic.motion import motion_from
from benchmarks.identification import GRAVITY, MOTION, PLATE
import numpy as np

Pair = tuple[float, float]
ROBOT: Pair = (2e-5, 5e-5)
CELLS: dict[str, tuple[float, Pair, float, Pair]] = {
    **{f'robot, {rate} Hz camera, {mm:g} mm': (500.0, ROBOT, rate, (mm * 1e-3, mm * 5e-3))
       for rate, mm in ((30, 0.1), (30, 1.0), (30, 3.0), (10, 1.0), (60, 1.0))},
    **{f'motion capture, {mm:g} mm': (360.0, (mm * 1e-3, rad), 360.0, (mm * 1e-3, rad))
       for mm, rad in ((0.1, 5e-4), (0.3, 1e-3), (1.0, 3e-3), (2.0, 5e-3))},
}
"""Rate (Hz) and noise (m, rad) of the tool, then of the package."""

JUDGED = 0.2


def recorded(
    seed: int, cell: tuple[float, Pair, float, Pair], duration: float, noise: float = 1.0
) -> Measured:
    """Return a simulated recording, the noise of its poses times a factor."""
    rng = np.random.default_rng(seed)
    motion = motion_from(Settings({**MOTION, 'duration': duration + 0.5}), rng)
    tool = motion.at_rate(1000.0, 0)
    body = simulate(Cup.thesis(), PLATE, tool, gravity=GRAVITY)

    def seen(poses: Trajectory, rate: float, size: Pair) -> Trajectory:
        stamps = np.rint(np.arange(int(duration * rate)) * 1e9 / rate).astype(np.int64)
        there, draw = resample(poses, stamps), noise * rng.standard_normal((len(stamps), 6))
        return Trajectory(stamps, there.position + size[0] * draw[:, :3],
                          there.rotation @ exp_so3(size[1] * draw[:, 3:]))

    tool_hz, tool_noise, package_hz, package_noise = cell
    return Measured(
        seen(tool, tool_hz, tool_noise), seen(body, package_hz, package_noise), PLATE, GRAVITY,
        BodyNoise(np.repeat(tool_noise, 3)), BodyNoise(np.repeat(package_noise, 3)))


def line(
    name: str, cell: tuple[float, Pair, float, Pair], runs: int, duration: float, form: str
) -> str:
    """Return the line of a cell."""
    structure, cup = structure_named(form), Cup.thesis()
    truth = structure.parameters(cup.stiffness, cup.damping)
    sizes = structure.sizes(cup.stiffness, cup.damping)
    start = Cup(2.0 * cup.stiffness, 2.0 * cup.damping, cup.length)
    rows: list[tuple[Array, Array, Array, float]] = []
    converged, began = 0, time.process_time()
    for seed in range(runs):
        fit = output_error([recorded(seed, cell, duration)], structure, start)
        search = Search([Segment(recorded(seed, cell, duration, 0.0))], structure, cup, {})
        parts, _, _ = search.system(search.start, 0.0)
        information = parts[0].jacobian.T @ parts[0].jacobian
        bound = np.sqrt(np.diag(np.linalg.inv(information))) * search.units / sizes
        error, std = (fit.parameters - truth) / sizes, np.sqrt(np.diag(fit.covariance)) / sizes
        known = np.isfinite(std)
        left = error[known]
        covariance = fit.covariance[np.ix_(known, known)] / np.outer(sizes[known], sizes[known])
        rows.append((error, std, bound, float(
            left @ np.linalg.solve(covariance, left)) / max(known.sum(), 1)))
        converged += fit.converged
    error, std, bound = (np.array([row[i] for row in rows]) for i in range(3))
    judged = bound.mean(axis=0) < JUDGED
    rms = np.sqrt(np.mean((error / bound) ** 2, axis=0))[judged]
    bias = (error.mean(axis=0) / bound.mean(axis=0))[judged]
    covered = 100.0 * np.mean((np.abs(error) < 1.96 * std)[:, judged])
    return (f'| {name}, {form} | {np.sqrt(np.mean(rms**2)):.2f} ({rms.max():.2f}) | '
            f'{np.sqrt(np.mean(bias**2)):.2f} ({np.abs(bias).max():.2f}) | {covered:.0f} | '
            f'{np.mean([row[3] for row in rows]):.2f} | {judged.sum()} of {len(truth)} | '
            f'{converged} of {runs} | {(time.process_time() - began) / runs:.1f} |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=24, help='recordings in each cell')
    parser.add_argument('--duration', type=float, default=30.0, help='of a recording, s')
    parser.add_argument('--structure', default='axisymmetric')
    parser.add_argument('--cells', nargs='+', choices=CELLS, default=list(CELLS))
    arguments = parser.parse_args()
    print('| sensors | rms / bound (worst) | bias / bound (worst) | covered % | Mahalanobis | '
          'judged | converged | CPU s |\n|---|---|---|---|---|---|---|---|')
    for name in arguments.cells:
        print(line(name, CELLS[name], arguments.runs, arguments.duration, arguments.structure),
              flush=True)


if __name__ == '__main__':
    main()
