"""
Accuracy of output error with common sensors.

    python -m benchmarks.sensors --runs 24

Each recording is a simulation of another motion; the search starts from twice the true K and P.
For each cell the table lists the bias of the parameters and their spread over the Cramer-Rao bound
(from the information along the true motion, for any path of the tool), the coverage of the 95 %
intervals, the mean Mahalanobis distance per parameter, the largest error of K in standard errors,
the fraction of identifiable parameters, and the number of converged fits. Only parameters with a
bound below 20 % are counted.
"""

import argparse
from collections.abc import Mapping, Sequence
import time
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.fitting import output_error
from bellows_ros.core.identification.residuals import evaluated
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.identification.unknowns import Problem, weak_prior
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.recording.recording import BodyNoise
from bellows_ros.core.sensors.body import poses_of
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic.motion import motion_from
import numpy as np

GRAVITY = 9.81
PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), np.array([0.0, 0.0, -0.03]))
MOTION = {
    'kind': 'multi_sine', 'rest_duration': 1.0, 'ramp_duration': 1.0,
    'multi_sine': {
        'position': {
            axis: {'amplitude': [0.02, 0.01, 0.003], 'frequency': [0.4 + i / 50, 1.3, 3 - i / 9]}
            for i, axis in enumerate('xyz')},
        'rotation': {
            axis: {'amplitude': [0.08, 0.04, 0.01], 'frequency': [0.5 + i / 40, 1.4, 2.9 - i / 7]}
            for i, axis in enumerate('xyz')}}}

JUDGED = 0.2


class Cell(NamedTuple):
    """
    Sensors.

    Rate (Hz) and noise (m, rad) of tool and package, and whether the package has a world, a clock
    and a marker of its own.
    """

    tool_hz: float
    tool: tuple[float, float]
    package_hz: float
    package: tuple[float, float]
    apart: bool = False


ROBOT, CAPTURE = (2e-5, 5e-5), (3e-4, 1e-3)
CELLS: dict[str, Cell] = {
    'robot, 30 Hz camera, 0.1 mm': Cell(500.0, ROBOT, 30.0, (1e-4, 5e-4)),
    'robot, 30 Hz camera, 1 mm': Cell(500.0, ROBOT, 30.0, (1e-3, 5e-3)),
    'robot, 30 Hz camera, 1 mm, apart': Cell(500.0, ROBOT, 30.0, (1e-3, 5e-3), True),
    'motion capture, 0.3 mm': Cell(360.0, CAPTURE, 360.0, CAPTURE)}

APART = {'time_offset': (8e-3,), 'package_world': (4e-3, -3e-3, 5e-3, 0.01, -0.015, 0.02),
         'package_marker': (0.004, 0.003, -0.005, 0.02, 0.03, -0.02)}
"""Errors of the first guesses: clock (s), world and marker (m, rad)."""


def sensed(
    poses: Trajectory, rate: float, std: Array, duration: float, rng: np.random.Generator,
    noise: float,
) -> tuple[Trajectory, BodyNoise]:
    """Return poses at a rate with noise std (6,) times a factor, and the std."""
    stamps = np.rint(np.arange(int(duration * rate)) * 1e9 / rate).astype(np.int64)
    true, e = resample(poses, stamps), noise * std * rng.standard_normal((len(stamps), 6))
    return Trajectory(stamps, true.position + e[:, :3],
                      true.rotation @ exp_so3(e[:, 3:])), BodyNoise(std, 0.0)


def recorded(seed: int, cell: Cell, duration: float, noise: float = 1.0) -> list[Segment]:
    """Return a simulated recording; `noise` is a factor of the noise."""
    rng = np.random.default_rng(seed)
    motion = motion_from(Settings({**MOTION, 'duration': duration + 0.5}), rng)
    tool = motion.at_rate(1000.0, 0)
    body = simulate(Cup.thesis(), PLATE, tool, gravity=GRAVITY)
    (tool, tool_noise), (body, package_noise) = (
        sensed(poses, rate, np.repeat(size, 3), duration, rng, noise)
        for poses, rate, size in ((tool, cell.tool_hz, cell.tool),
                                  (body, cell.package_hz, cell.package)))
    if cell.apart:
        wrong = {name: np.array(value) for name, value in APART.items()}
        late = round(float(wrong.pop('time_offset')[0]) * 1e9)
        body = poses_of(body, wrong, np.zeros(3))
        body = Trajectory(body.stamps_ns - late, body.position, body.rotation)
    return [Segment(tool, body, PLATE, GRAVITY, tool_noise, package_noise)]


class Trial(NamedTuple):
    """A fit: errors, standard errors and bounds over sizes, Mahalanobis, converged, CPU s."""

    error: Array
    std: Array
    bound: Array
    mahalanobis: float
    converged: bool
    seconds: float


def bound_of(
    cup: Cup, structure: Structure, segment: Segment, free: Mapping[str, Array]
) -> Array:
    """Return the Cramer-Rao bound (n,) of the parameters and of all else that is free."""
    problem = Problem.of([segment], structure, cup, free)
    H = evaluated(problem, problem.start, segment, segment.first).information.sum(axis=0)
    C, slopes = np.linalg.inv(H + np.diag(problem.weights)), np.diag(problem.units)
    slopes[:problem.shared, :problem.shared] = problem.slopes(problem.start)
    return np.sqrt(np.diag(slopes @ C @ slopes.T))


def trial(cell: Cell, seed: int, duration: float, form: str) -> Trial:
    """Return the fit to a simulated recording of a cell, with its errors and bounds."""
    structure, cup, began = structure_named(form), Cup.thesis(), time.process_time()
    truth = structure.parameters(cup.stiffness, cup.damping)
    sizes = structure.sizes(cup.stiffness, cup.damping)
    start = Cup(2.0 * cup.stiffness, 2.0 * cup.damping, cup.length)
    free = weak_prior(APART) if cell.apart else {}
    fit = output_error(recorded(seed, cell, duration), structure, start, free=free)
    seconds = time.process_time() - began
    (true,) = recorded(seed, cell._replace(apart=False), duration, 0.0)
    bound = bound_of(cup, structure, true, free)[:len(sizes)] / sizes
    error, std = (fit.parameters - truth) / sizes, np.sqrt(np.diag(fit.covariance)) / sizes
    finite = np.isfinite(std)
    x = error[finite]
    covariance = fit.covariance[np.ix_(finite, finite)] / np.outer(sizes[finite], sizes[finite])
    return Trial(error, std, bound, float(
        x @ np.linalg.solve(covariance, x)) / max(finite.sum(), 1), fit.converged, seconds)


def line(name: str, trials: Sequence[Trial]) -> str:
    """Return the line of a cell."""
    error, std, bound = (np.array([each[i] for each in trials]) for i in range(3))
    judged = bound.mean(axis=0) < JUDGED
    rms = np.sqrt(np.mean((error / bound) ** 2, axis=0))[judged]
    bias = (error.mean(axis=0) / bound.mean(axis=0))[judged]
    z = (np.abs(error) / std)[:, judged]
    given_error = np.isfinite(std[:, judged])
    off = z[:, np.flatnonzero(judged) < error.shape[1] // 2].max(initial=0.0)
    return (f'| {name} | {np.sqrt(np.mean(rms**2)):.2f} ({rms.max():.2f}) | '
            f'{np.sqrt(np.mean(bias**2)):.2f} ({np.abs(bias).max():.2f}) | '
            f'{100.0 * np.mean(z[given_error] < 1.96):.0f} | '
            f'{np.mean([each.mahalanobis for each in trials]):.2f} | {off:.1f} | '
            f'{judged.sum()} of {error.shape[1]}, {100.0 * given_error.mean():.0f} % | '
            f'{sum(each.converged for each in trials)} of {len(trials)} | '
            f'{np.mean([each.seconds for each in trials]):.1f} |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=24, help='recordings in each cell')
    parser.add_argument('--duration', type=float, default=30.0, help='of a recording, s')
    parser.add_argument('--structure', default='axisymmetric')
    parser.add_argument('--cells', nargs='+', choices=CELLS, default=list(CELLS))
    arguments = parser.parse_args()
    print('| sensors | rms / bound (worst) | bias / bound (worst) | covered % | Mahalanobis | '
          'largest error of K (std. errors) | with a bound below 20 %, identifiable | '
          'converged | CPU s |\n|---|---|---|---|---|---|---|---|---|')
    for name in arguments.cells:
        print(line(f'{name}, {arguments.structure}', [
            trial(CELLS[name], seed, arguments.duration, arguments.structure)
            for seed in range(arguments.runs)]), flush=True)


if __name__ == '__main__':
    main()
