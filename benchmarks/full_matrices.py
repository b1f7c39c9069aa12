"""
How well the prediction error finds full K and P, whatever the noise.

    python -m benchmarks.full_matrices --runs 20

Every recording is of another cup, simulated: K coupled, with an eigenvalue down to 0.4, P nearly
singular. In turn there are 0, 0.05, 0.1 and 0.3 mm of noise on tool and package. A line says by
how much K is off (Frobenius norm) and by how much any method must be (the root mean square at the
Cramer-Rao bound), the largest error in standard errors, how many of the 95 % intervals hold the
truth, chi^2 per degree of freedom and the seconds that the fit took.
"""

import argparse
import time

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.least_squares import least_squares
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.identification.segments import measured_segments
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.signals.savgol import savgol
from benchmarks.identification import (
    cramer_rao,
    GRAVITY,
    HALF_WINDOW,
    ORDER,
    PLATE,
    RATE_HZ,
    recorded,
)
import numpy as np

FULL = structure_named('full')
NOISES = ((0.0, 0.0), (5e-5, 2e-4), (1e-4, 5e-4), (3e-4, 1e-3))
STIFFNESS = np.sqrt([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])
DAMPING = np.sqrt([55.0, 55.0, 24.0, 0.06, 0.06, 0.10])
SOFTEST, LEAST_DAMPED = 0.4, 1e-3
"""Smallest eigenvalue of K, N m/rad, and of P scaled to a diagonal of ones."""


def random_cup(rng: np.random.Generator) -> Cup:
    """Return a cup whose K and P are coupled, and nearly singular."""
    K, P = (scale[:, None] * _correlated(rng) * scale for scale in (STIFFNESS, DAMPING))
    values, vectors = np.linalg.eigh(K)
    K += (SOFTEST - values[0]) * np.outer(vectors[:, 0], vectors[:, 0])
    return Cup(K, P, Cup.thesis().length)


def _correlated(rng: np.random.Generator) -> Array:
    """Return a matrix with a diagonal near one and a small eigenvalue."""
    A = np.eye(6) + 0.25 * rng.standard_normal((6, 6))
    values, vectors = np.linalg.eigh(A @ A.T)
    values[0] = LEAST_DAMPED
    matrix = (vectors * values) @ vectors.T
    size = np.sqrt(np.diag(matrix))
    return np.asarray(matrix / np.outer(size, size))


def line(seed: int, duration: float) -> str:
    """Return the line of one recording."""
    cup, noise = random_cup(np.random.default_rng(seed)), Noise(*NOISES[seed % len(NOISES)])
    poses = recorded(seed, duration, noise, noise, cup=cup)
    began = time.perf_counter()
    tool, package = (savgol(part, HALF_WINDOW, ORDER) for part in poses)
    samples = Samples(tool, package, PLATE, GRAVITY, (2 * HALF_WINDOW + 1) / RATE_HZ)
    quick = least_squares([statistics(samples, cup.length, FULL)])
    start = Cup(quick.stiffness, quick.damping, cup.length)
    fit = prediction_error(measured_segments(*poses, PLATE, GRAVITY), FULL, start)
    seconds = time.perf_counter() - began
    size = np.linalg.norm(cup.stiffness)
    away = np.linalg.norm(fit.stiffness - cup.stiffness) / size
    variances = np.diag(cramer_rao(seed, duration, noise, noise, cup=cup, structure=FULL))
    bound = np.linalg.norm(FULL.spread(np.sqrt(variances))[0]) / size
    true = FULL.parameters(cup.stiffness, cup.damping)
    known = np.isfinite(np.diag(fit.covariance))
    error = (FULL.parameters(fit.stiffness, fit.damping) - true)[known]
    z = np.abs(error) / np.sqrt(np.diag(fit.covariance)[known])
    worst = np.array(fit.labels)[known][np.argmax(z)] if known.any() else ''
    return (
        f'| {seed} | {1e3 * noise.position:g} mm | {100.0 * away:.3f} | '
        f'{100.0 * bound:.3f} | {z.max(initial=0.0):.1f} '
        f'{worst} | {100.0 * np.mean(z < 1.96):.0f} | {int(known.sum())} | {fit.chi2:.3f} | '
        f'{len(fit.iterations)} | {seconds:.1f} | {"yes" if fit.usable else "no"} |')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=20, help='recordings')
    parser.add_argument('--first', type=int, default=0, help='seed of the first')
    parser.add_argument('--duration', type=float, default=30.0, help='of a recording, s')
    arguments = parser.parse_args()
    header = 'seed noise K_off_% bound_% largest_error covered_% of chi2 steps s usable'.split()
    print(f'| {" | ".join(header)} |\n|{"---|" * len(header)}')
    for seed in range(arguments.first, arguments.first + arguments.runs):
        print(line(seed, arguments.duration), flush=True)


if __name__ == '__main__':
    main()
