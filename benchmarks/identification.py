"""
How well each method of identification finds a known cup.

    python -m benchmarks.identification --runs 8

Recordings are simulated with noise on tool and package, many for each noise, and every method fits
each of them. The table says by how much the parameters are off on average (bias) and how they
spread, the same in standard errors, which are right where it is near 0 and 1, how much wider the
spread is than the Cramer-Rao bound, how often a parameter was identifiable, and how often the 95 %
interval held the truth then.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.minimum import Search
from bellows_ros.core.identification.motion_equations import Segment
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.identification.segments import (
    measured_segments,
    PoseNoise,
    SMALLEST,
)
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.recording.recording import FilterNoise, Noise, noise_of
from bellows_ros.core.signals.savgol import savgol, weights
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic.motion import motion_from
import numpy as np
from scipy.signal import lfilter

RATE_HZ = 360.0
GRAVITY = 9.81
HALF_WINDOW, ORDER = 30, 6
PLATE = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), np.array([0.0, 0.0, -0.03]))
STRUCTURE = structure_named('axisymmetric')
TALL = np.array([1.0, 1.0, 3.0, 1.0, 1.0, 1.0])
KINDS = ('white', '26 ms', '140 ms', 'anisotropic', 'heavy-tailed')
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
}

Poses = tuple[Trajectory, Trajectory]


def recorded(
    seed: int, duration: float, noise: Noise, tool_noise: Noise, kind: str = 'white',
    cup: Cup | None = None,
) -> Poses:
    """Return noisy poses of tool and package of one simulated recording."""
    rng = np.random.default_rng(seed)
    motion = motion_from(Settings({**MOTION, 'duration': duration}), rng)
    stamps = np.round(np.arange(int(duration * RATE_HZ)) / RATE_HZ * 1e9).astype(np.int64)
    tool = motion.trajectory(stamps, 0)
    body = simulate(cup or Cup.thesis(), PLATE, tool, gravity=GRAVITY)
    return _noisy(tool, tool_noise, rng, kind), _noisy(body, noise, rng, kind)


def _noisy(poses: Trajectory, noise: Noise, rng: np.random.Generator, kind: str) -> Trajectory:
    """Return poses with noise of a kind."""
    draw = _drawn(kind, len(poses), rng)
    return Trajectory(
        poses.stamps_ns,
        poses.position + noise.position * draw[:, :3],
        poses.rotation @ exp_so3(noise.rotation * draw[:, 3:]),
    )


def _drawn(kind: str, count: int, rng: np.random.Generator) -> Array:
    """Return noise (N, 6) with a variance of one, but along z where that is larger."""
    if kind == 'heavy-tailed':
        return rng.standard_t(3, (count, 6)) / np.sqrt(3.0)
    draw = rng.standard_normal((count, 6))
    if kind == 'anisotropic':
        draw *= TALL
    if kind.endswith('ms'):
        kept = np.exp(-1e3 / RATE_HZ / float(kind.split()[0]))
        draw[1:] *= np.sqrt(1.0 - kept**2)
        draw = lfilter([1.0], [1.0, -kept], draw, axis=0)
    return np.asarray(draw)


def by_least_squares(poses: Poses) -> Fit:
    """Fit accelerations."""
    tool, package = (savgol(part, HALF_WINDOW, ORDER) for part in poses)
    samples = Samples(tool, package, PLATE, GRAVITY, (2 * HALF_WINDOW + 1) / RATE_HZ)
    through = weights(HALF_WINDOW, ORDER, RATE_HZ)
    noise = FilterNoise(noise_of(poses[0]), noise_of(poses[1]), through, through)
    length = Cup.thesis().length
    return least_squares([statistics(samples, length, STRUCTURE, noise)])


def by_prediction_error(poses: Poses) -> Fit:
    """Fit poses, with the tool's noise as what it is."""
    start = by_least_squares(poses)
    cup = Cup(start.stiffness, start.damping, Cup.thesis().length)
    return prediction_error(measured_segments(*poses, PLATE, GRAVITY), STRUCTURE, cup)


METHODS: dict[str, Callable[[Poses], Fit]] = {
    'least squares': by_least_squares,
    'prediction error': by_prediction_error,
}


def ratios(fit: Fit) -> tuple[Array, Array]:
    """Return the parameters and their standard errors over the truth."""
    truth = STRUCTURE.parameters(Cup.thesis().stiffness, Cup.thesis().damping)
    found = STRUCTURE.parameters(fit.stiffness, fit.damping)
    return found / truth, np.sqrt(np.diag(fit.covariance)) / truth


def cramer_rao(
    seed: int, duration: float, noise: Noise, tool_noise: Noise, kind: str = 'white',
    cup: Cup | None = None, structure: Structure = STRUCTURE,
) -> Array:
    """
    Return the least covariance of any unbiased method, whatever the motions of both bodies are.

    It is the inverse of the information in the equations of motion about the true motion, with
    the true cup and noise. Noise that is not normal tells more than this.
    """
    cup, silent = cup or Cup.thesis(), Noise(0.0, 0.0)
    (segment,) = measured_segments(
        *recorded(seed, duration, silent, silent, cup=cup), PLATE, GRAVITY)
    kept = float(np.exp(-1e3 / RATE_HZ / float(kind.split()[0]))) if kind.endswith('ms') else 0.0
    own, of_tool = (
        PoseNoise.of(np.maximum(np.repeat(each, 3) * (TALL if kind == 'anisotropic' else 1.0),
                                SMALLEST), kept) for each in (noise, tool_noise))
    search = Search(
        [Segment(replace(segment, package_noise=own, tool_noise=of_tool))], structure, cup, ())
    search.kept = kept, kept
    (part,) = search.whitened(search.equations(search.start))
    information = part.jacobian.T @ part.jacobian
    return np.asarray(np.linalg.inv(information) * np.outer(search.units, search.units))


def rows(
    noise: tuple[float, float], runs: int, duration: float, exact_tool: bool, methods: list[str],
    kind: str,
) -> list[str]:
    """Return the lines of the table for one noise."""
    of_package = Noise(*noise)
    of_tool = Noise(0.0, 0.0) if exact_tool else of_package
    results: dict[str, list[tuple[Array, Array]]] = {name: [] for name in methods}
    for seed in range(runs):
        poses = recorded(seed, duration, of_package, of_tool, kind)
        for name in methods:
            results[name].append(ratios(METHODS[name](poses)))
    truth = STRUCTURE.parameters(Cup.thesis().stiffness, Cup.thesis().damping)
    bounds = [
        np.sqrt(np.diag(cramer_rao(seed, duration, of_package, of_tool, kind))) / truth
        for seed in range(runs)] if runs > 1 and any(noise) else []
    what = f'{noise[0] * 1e3:g} mm, {noise[1] * 1e3:g} mrad, {kind}'
    lines = []
    for name in methods:
        x, std = (np.array(part) for part in zip(*results[name], strict=True))
        known = np.isfinite(std)
        z = np.ma.array((x - 1.0) / std, mask=~known)
        table = {'bias %': 100.0 * (x.mean(axis=0) - 1.0)}
        if runs > 1:
            table['spread %'] = 100.0 * x.std(axis=0, ddof=1)
            table['errors/std: mean'] = z.mean(axis=0)
            table['errors/std: spread'] = z.std(axis=0, ddof=1)
        if bounds:
            table['spread / bound'] = np.std((x - 1.0) / bounds, axis=0, ddof=1)
        table['identifiable %'] = 100.0 * known.mean(axis=0)
        table['covered %'] = 100.0 * (abs(z) < 1.96).mean(axis=0)
        for label, numbers in table.items():
            lines.append(_line([what, name, label, *(
                '-' if n is np.ma.masked else f'{n:.2f}' for n in numbers)]))
            what = name = ''
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
    parser.add_argument('--kind', choices=KINDS, default='white', help='of the noise')
    arguments = parser.parse_args()
    header = ['noise', 'method', '', *STRUCTURE.labels]
    print(_line(header))
    print(_line(['---'] * len(header)))
    noises = [tuple(arguments.noise)] if arguments.noise else NOISES
    for noise in noises:
        for line in rows(
            noise, arguments.runs, arguments.duration, arguments.exact_tool, arguments.methods,
            arguments.kind,
        ):
            print(line, flush=True)


if __name__ == '__main__':
    main()
