"""
What four kinds of motion tell of K and P, in the same time and under the same limits.

    python -m benchmarks.excitation

prints the table of docs/exciting.md: expected standard errors of the truth in percent, for random
waypoints, our multisine (as it is, and scaled up until a limit is met), a motion designed for the
smallest condition number, and one designed by `bellows excite`.

    python -m benchmarks.excitation --fits 100

fits so many recordings of that motion with noise, a few seconds each, and prints how the
estimates scatter, and which standard errors the fits state, in times of what was expected. The
scatter of N draws is known to 1 / sqrt(2 N) only; beside linear estimates of the very same noise,
which scatter as is expected, it is known far better.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bellows_ros.core.excitation import motion_design as excitation
from bellows_ros.core.excitation.arm_limits import ArmLimits, limits_from
from bellows_ros.core.excitation.commissioning import everyday
from bellows_ros.core.excitation.fisher import motion_information, standard_errors, Tracking
from bellows_ros.core.excitation.motion_design import (
    all_ratios,
    cups_near,
    design,
    MotionObjective,
)
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.minimum import Root
from bellows_ros.core.identification.motion_equations import Segment
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.identification.segments import (
    in_motion,
    Measured,
    measured_segments,
    PoseNoise,
)
from bellows_ros.core.model.cup_package import Cup, cup_of, model_tuple, Package, package_of
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.synthetic.motion import Motion
from bellows_ros.core.synthetic.recipe import read_recipe
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.excite import tracking_from
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 20.0
STRUCTURE = STRUCTURES['axisymmetric']


class Conditioned(MotionObjective):
    """The same search for the smallest condition number of the information."""

    def _criterion(self, M: Array) -> tuple[float, Array]:
        """Return the negative mean logarithm of the condition number, and its slope."""
        values, vectors = np.linalg.eigh(M)
        least, most = vectors[:, :, :1], vectors[:, :, -1:]
        slope = (least @ np.swapaxes(least, 1, 2) / values[:, :1, None]
                 - most @ np.swapaxes(most, 1, 2) / values[:, -1:, None])
        return -float(np.mean(np.log(values[:, -1] / values[:, 0]))), slope / len(M)


def motions(
    limits: ArmLimits, cup: Cup, package: Package, tracking: Tracking
) -> Iterator[tuple[str, Motion]]:
    """Yield names and motions."""
    models = [model_tuple(each, package, 9.81) for each in cups_near(cup)]
    yield 'random waypoints', everyday(limits, models, None, SECONDS, 1)
    ours: Any = read_recipe(
        safe_yaml.load(ROOT / 'bags' / 'identification.yaml'), package.com).motion
    ours = replace(ours, duration=SECONDS)
    yield 'multisine', ours
    for _ in range(8):
        ratios = all_ratios(ours, limits, models, None)
        ours = replace(ours, amplitude=ours.amplitude * 0.999 / max(ratios.values()))
    yield 'multisine, scaled up', ours
    plain = excitation.MotionObjective
    excitation.MotionObjective = Conditioned  # type: ignore[misc]
    try:
        yield 'condition number', designed(limits, cup, package, tracking)
    finally:
        excitation.MotionObjective = plain  # type: ignore[misc]
    yield 'determinant', designed(limits, cup, package, tracking)


def designed(limits: ArmLimits, cup: Cup, package: Package, tracking: Tracking) -> Motion:
    """Return what `bellows excite` designs."""
    return design(cup, package, 9.81, None, STRUCTURE, limits, tracking, SECONDS, 0,
                  lambda what, part: None).motion


def at_times(motion: Motion, period: float, margin: float) -> Trajectory:
    """Return a motion at equal steps (s), without a margin (s) at both ends."""
    count = int((SECONDS - 2.0 * margin) / period)
    stamps = np.round((1.0 + margin + np.arange(count) * period) * NS_PER_S)
    return motion.trajectory(stamps.astype(np.int64), NS_PER_S)


class Fits(NamedTuple):
    """
    Errors of estimates (N, n) over their expected standard errors, one row for each recording.

    Of fits, of linear estimates of the same noise, and what the fits state.
    """

    off: Array
    linear: Array
    stated: Array


def fits(
    cup: Cup, package: Package, tracking: Tracking, motion: Motion, count: int, seed: int
) -> Fits:
    """Fit recordings of a motion; the linear estimates are as uncertain as is expected."""
    rng = np.random.default_rng(seed)
    tool = at_times(motion, tracking.tool_period, 0.0)
    at = at_times(motion, tracking.package_period, 0.1)
    body = simulate(cup, package, at)
    expected = standard_errors(motion_information(cup, package, 9.81, at, tracking, STRUCTURE))
    density = np.sqrt(tracking.tool_period / tracking.package_period)
    noises = (PoseNoise(np.repeat(tracking.package, 3)),
              PoseNoise(density * np.repeat(tracking.tool, 3)))

    def noisy(poses: Trajectory, noise: Noise) -> Trajectory:
        shift, turn = (size * rng.standard_normal((len(poses), 3)) for size in noise)
        return Trajectory(poses.stamps_ns, poses.position + shift, poses.rotation @ exp_so3(turn))

    def segment(tool: Trajectory, package_poses: Trajectory, smoothed: bool = True) -> Segment:
        return Segment(Measured(tool, package_poses, package, 9.81, *noises[::-1]), smoothed)

    none = np.zeros((len(body), 12))
    smooth, true = (segment(at, body, each).equations(cup, none, {}) for each in (True, False))
    root = Root(smooth, noises, none + 1.0)
    basis = np.kron(np.eye(2), [unit[np.triu_indices(6)] for unit in STRUCTURE.basis]).T
    J, J_true = (root.whitened(each.jacobian @ basis * expected) for each in (smooth, true))
    estimate = np.linalg.solve(J.T @ J_true, J.T)
    off, linear, stated = [], [], []
    start, truth = replace(cup, stiffness=1.2 * cup.stiffness), STRUCTURE.parameters(
        cup.stiffness, cup.damping)
    for _ in range(count):
        measured = noisy(tool, tracking.tool), noisy(body, tracking.package)
        fit = prediction_error(
            measured_segments(*measured, package, 9.81), STRUCTURE, start)
        off.append((STRUCTURE.parameters(fit.stiffness, fit.damping) - truth) / expected)
        stated.append(np.sqrt(np.diag(fit.covariance)) / expected)
        own, noise, white = segment(in_motion(measured[0]), measured[1]), none, none[0]
        for _ in range(3):  # about the likeliest motion, as a fit does
            errors = own.errors(cup, noise, {}, smooth.package, smooth.tool)
            white = root.innovations(errors)
            noise = root.noise(white)[0]
        linear.append(estimate @ white)
    return Fits(np.array(off), np.array(linear), np.array(stated))


def print_fits(found: Fits) -> None:
    """Print the second table; by pairs the scatter is that of fits less that of linear ones."""
    count = len(found.off)
    rms = np.sqrt(np.mean(found.off ** 2))
    print(f'{count} fits: root mean square {rms:.3f} of what was expected, known to '
          f'{100.0 / np.sqrt(2.0 * count):.0f} % for one entry')
    print('| entry | mean | scatter | scatter by pairs | known to | stated, median | lowest | '
          'highest |')
    print('|---' * 8 + '|')
    for label, off, linear, own in zip(
            STRUCTURE.labels, found.off.T, found.linear.T, found.stated.T, strict=True):
        more = off ** 2 - linear ** 2
        pairs = np.sqrt(1.0 + more.mean())
        columns = (off.mean(), off.std(ddof=1), pairs,
                   0.5 * more.std() / np.sqrt(count) / pairs, np.median(own), own.min(), own.max())
        print(f'| {label} | ' + ' | '.join(f'{value:.3f}' for value in columns) + ' |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--fits', type=int, default=0, help='of so many recordings')
    parser.add_argument('--seed', type=int, default=0, help='of their noise')
    arguments = parser.parse_args()
    given = read_parameters(ROOT / 'bags' / 'cup.yaml')
    values: dict[str, Any] = resolve(given, PACKAGE_PARAMETERS)
    limits, block = limits_from(safe_yaml.load(ROOT / 'config' / 'limits_example.yaml'), 1.5)
    tracking, cup, package = tracking_from(block), cup_of(values), package_of(values)
    if arguments.fits:
        motion = designed(limits, cup, package, tracking)
        print_fits(fits(cup, package, tracking, motion, arguments.fits, arguments.seed))
        return
    truth: Array = STRUCTURE.parameters(cup.stiffness, cup.damping)
    print('| motion | ' + ' | '.join(STRUCTURE.labels) + ' | condition number |')
    print('|---' * (len(truth) + 2) + '|')
    for name, motion in motions(limits, cup, package, tracking):
        M = motion_information(
            cup, package, 9.81, motion.at_rate(1.0 / tracking.package_period), tracking, STRUCTURE)
        errors = 100.0 * standard_errors(M) / truth
        condition = np.linalg.cond(M * np.outer(truth, truth))
        print(f'| {name} | ' + ' | '.join(f'{e:.2g}' for e in errors) + f' | {condition:.2g} |',
              flush=True)


if __name__ == '__main__':
    main()
