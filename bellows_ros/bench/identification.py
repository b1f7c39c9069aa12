"""
How well each method of identification finds a known cup.

    python -m bellows_ros.bench.identification --runs 8

Recordings are simulated with noise on tool and package, many for each noise, and every method fits
each of them. The table says by how much the parameters are off on average (bias), how they spread,
how often the told 95 % interval holds the truth, and with an exact tool how much wider the spread
is than the Cramer-Rao bound.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.noise import Noise, noise_of
from bellows_ros.core.identification.prediction.measured import Measured, measured_stretches
from bellows_ros.core.identification.prediction.objective import Objective, Stretch
from bellows_ros.core.identification.prediction.parametrisation import Parametrisation
from bellows_ros.core.identification.prediction.prediction_error import prediction_error
from bellows_ros.core.identification.regression.least_squares import least_squares, Samples
from bellows_ros.core.identification.regression.noise_products import noise_products
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.lie import exp_so3
from bellows_ros.core.model import Cup, Package
from bellows_ros.core.savgol import savgol, weights
from bellows_ros.core.simulation import simulate
from bellows_ros.core.synthetic.motion import motion_from
from bellows_ros.core.synthetic.settings import Settings
from bellows_ros.core.trajectory import Trajectory
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RATE_HZ = 360.0
GRAVITY = 9.81
HALF_WINDOW, ORDER = 30, 6
PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), np.array([0.0, 0.0, -0.03]))
STRUCTURE = structure_named('axisymmetric')
NOISES = ((0.0, 0.0), (5e-5, 2e-4), (1e-4, 5e-4), (3e-4, 1e-3), (1e-3, 1e-3))
MOTION = {
    'kind': 'multi_sine', 'rest_duration': 1.0, 'ramp_duration': 1.0,
    'multi_sine': {
        'position': {
            axis: {'amplitude': [0.02, 0.01, 0.003], 'frequency': [0.4 + i / 50, 1.3, 3 - i / 9]}
            for i, axis in enumerate('xyz')
        },
        'rotation': {
            axis: {'amplitude': [0.08, 0.04, 0.01], 'frequency': [0.5 + i / 40, 1.4, 2.9 - i / 7]}
            for i, axis in enumerate('xyz')
        },
    },
}  # fmt: skip

Poses = tuple[Trajectory, Trajectory]


def recorded(seed: int, duration: float, noise: Noise, tool_noise: Noise) -> Poses:
    """Return noisy poses of tool and package of one simulated recording."""
    rng = np.random.default_rng(seed)
    motion = motion_from(Settings({**MOTION, 'duration': duration}), rng)
    stamps = np.round(np.arange(int(duration * RATE_HZ)) / RATE_HZ * 1e9).astype(np.int64)
    tool = motion.trajectory(stamps, 0)
    body = simulate(Cup.thesis(), PLATE, tool, gravity=GRAVITY)
    return _noisy(tool, tool_noise, rng), _noisy(body, noise, rng)


def _noisy(poses: Trajectory, noise: Noise, rng: np.random.Generator) -> Trajectory:
    """Return poses with white noise."""
    shape = poses.position.shape
    return Trajectory(
        poses.stamps_ns,
        poses.position + noise.position * rng.standard_normal(shape),
        poses.rotation @ exp_so3(noise.rotation * rng.standard_normal(shape)),
    )


def by_least_squares(poses: Poses) -> Fit:
    """Fit accelerations."""
    tool, package = (savgol(part, HALF_WINDOW, ORDER) for part in poses)
    samples = Samples(tool, package, PLATE, GRAVITY, (2 * HALF_WINDOW + 1) / RATE_HZ)
    through = weights(HALF_WINDOW, ORDER, RATE_HZ)
    noise = FilterNoise(noise_of(poses[0]), noise_of(poses[1]), through, through)
    length = Cup.thesis().length
    products = noise_products(samples, noise, length, STRUCTURE)
    return least_squares([samples], length, STRUCTURE, products)


def by_prediction_error(poses: Poses) -> Fit:
    """Fit poses, with the tool's noise as what it is."""
    return _predicted(measured_stretches(*poses, PLATE, GRAVITY), poses)


def with_a_smoothed_tool(poses: Poses) -> Fit:
    """Fit poses, with the tool smoothed and then taken as exact."""
    smooth = savgol(poses[0], HALF_WINDOW, ORDER)
    stretches = []
    for part in measured_stretches(*poses, PLATE, GRAVITY):
        stamps = part.package.stamps_ns
        there = (stamps >= smooth.stamps_ns[0]) & (stamps <= smooth.stamps_ns[-1])
        stretches.append(
            replace(
                part, tool=smooth, tool_noise=Noise(0.0, 0.0),
                package=part.package.select(there), counted=part.counted[there],
            )
        )  # fmt: skip
    return _predicted(stretches, poses)


def _predicted(stretches: list[Measured], poses: Poses) -> Fit:
    """Return the fit of the prediction error from that of least squares."""
    start = by_least_squares(poses)
    length = Cup.thesis().length
    cup = Cup(start.stiffness, start.damping, length)
    return prediction_error(stretches, length, STRUCTURE, cup)


METHODS: dict[str, Callable[[Poses], Fit]] = {
    'least squares': by_least_squares,
    'tool smoothed': with_a_smoothed_tool,
    'innovations': by_prediction_error,
}


def ratios(fit: Fit) -> tuple[Array, Array]:
    """Return the parameters and their standard errors over the truth."""
    truth = STRUCTURE.parameters(Cup.thesis().stiffness, Cup.thesis().damping)
    found = STRUCTURE.parameters(fit.stiffness, fit.damping)
    return found / truth, np.sqrt(np.diag(fit.covariance)) / truth


def cramer_rao(seed: int, duration: float, noise: Noise) -> Array:
    """Return the least relative errors of any unbiased method with an exact tool."""
    silent = Noise(0.0, 0.0)
    truth = Cup.thesis()
    chart = Parametrisation(STRUCTURE, np.diag(truth.stiffness), np.diag(truth.damping))
    stretches = [
        Stretch(replace(part, package_noise=noise), truth)
        for part in measured_stretches(
            *recorded(seed, duration, silent, silent), PLATE, GRAVITY)
    ]  # fmt: skip
    objective = Objective(stretches, truth.length, chart, 0)
    theta = np.zeros(objective.size)
    theta[:chart.size] = chart.numbers(truth.stiffness, truth.damping)
    J = objective.jacobian(theta)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:chart.size])


def rows(
    noise: tuple[float, float], runs: int, duration: float, exact_tool: bool, methods: list[str]
) -> list[str]:
    """Return the lines of the table for one noise."""
    of_package = Noise(*noise)
    of_tool = Noise(0.0, 0.0) if exact_tool else of_package
    results: dict[str, list[tuple[Array, Array]]] = {name: [] for name in methods}
    for seed in range(runs):
        poses = recorded(seed, duration, of_package, of_tool)
        for name in methods:
            results[name].append(ratios(METHODS[name](poses)))
    what = f'{noise[0] * 1e3:g} mm, {noise[1] * 1e3:g} mrad'
    lines = []
    for name in methods:
        x, std = (np.array(part) for part in zip(*results[name], strict=True))
        inside = np.mean(np.abs(x - 1.0) < 1.96 * std, axis=0)
        lines.append(_line([what, name, 'bias %', *(f'{b:.2f}' for b in 100 * (x.mean(0) - 1))]))
        spread = 100 * x.std(axis=0, ddof=1) if runs > 1 else np.zeros(x.shape[1])
        lines.append(_line(['', '', 'spread %', *(f'{s:.2f}' for s in spread)]))
        lines.append(_line(['', '', 'covered %', *(f'{100 * c:.0f}' for c in inside)]))
        if exact_tool and runs > 1:
            bounds = [cramer_rao(seed, duration, of_package) for seed in range(runs)]
            over = np.std((x - 1.0) / bounds, axis=0, ddof=1)
            lines.append(_line(['', '', 'spread / bound', *(f'{r:.2f}' for r in over)]))
    return lines


def _line(cells: list[str]) -> str:
    return '| ' + ' | '.join(cells) + ' |'


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=8, help='recordings for each noise')
    parser.add_argument('--duration', type=float, default=30.0, help='of a recording, s')
    parser.add_argument('--exact-tool', action='store_true', help='noise on the package only')
    parser.add_argument('--methods', nargs='+', choices=METHODS, default=list(METHODS))
    parser.add_argument('--noise', nargs=2, type=float, metavar=('M', 'RAD'), help='only this')
    arguments = parser.parse_args()
    header = ['noise', 'method', '', *STRUCTURE.labels]
    print(_line(header))
    print(_line(['---'] * len(header)))
    noises = [tuple(arguments.noise)] if arguments.noise else NOISES
    for noise in noises:
        for line in rows(
            noise, arguments.runs, arguments.duration, arguments.exact_tool, arguments.methods
        ):
            print(line, flush=True)


if __name__ == '__main__':
    main()
