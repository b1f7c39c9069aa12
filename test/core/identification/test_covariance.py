"""Standard errors of the output error: against the bound, and against the scatter of fits."""

from dataclasses import replace

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.identification.fitting import output_error
from bellows_ros.core.identification.result import inverted, with_unidentifiable
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.equilibrium import moved_by, static_equilibrium
from bellows_ros.core.model.simulation import simulate, simulate_rows, state_row, tool_rows
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import BodyNoise
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import lfilter

from ...cell.cup import GRAVITY, PLATE, random_cup
from ...cell.motion import Shake
from ...cell.sensors import with_errors

TRUTH = Cup.thesis()
AXISYMMETRIC = STRUCTURES['axisymmetric']
STD = np.repeat([1e-4, 5e-4], 3)
RATE_HZ, DURATION = 100.0, 10.0


def noise_of_kind(kind):
    """Return the noise that both bodies have, as a preparation estimates it."""
    tall = np.array([1.0, 1.0, 3.0 if kind == 'anisotropic' else 1.0, 1.0, 1.0, 1.0])
    kept = float(np.exp(-1e3 / RATE_HZ / float(kind.split()[0]))) if kind.endswith('ms') else 0.0
    return BodyNoise(tall * STD, kept)


def drawn(kind, count, rng):
    """Return errors (N, 6) of such poses."""
    white, noise = rng.standard_normal((count, 6)), noise_of_kind(kind)
    if kind == 'heavy-tailed':
        white = rng.standard_t(3, (count, 6)) / np.sqrt(3.0)
    white[1:] *= np.sqrt(1.0 - noise.correlation**2)
    return noise.std * lfilter([1.0], [1.0, -noise.correlation], white, axis=0)


def recorded(seed, tool_noise, package_noise, duration=12.0, rate_hz=RATE_HZ, cup=TRUTH):
    """Return a recording with white noise."""
    tool, rng = Shake(seed).trajectory(duration, rate_hz), np.random.default_rng((seed, 8))
    body = simulate(cup, PLATE, tool, gravity=GRAVITY)
    stds = [np.repeat(np.maximum(own, [2e-7, 2e-6]), 3) for own in (tool_noise, package_noise)]
    poses = [with_errors(own, np.repeat(size, 3) * rng.standard_normal((len(own), 6)))
             for own, size in zip((tool, body), (tool_noise, package_noise), strict=True)]
    return Segment(*poses, PLATE, GRAVITY, *map(BodyNoise, stds))


def deviations(kind, seeds, duration=DURATION):
    """Return the errors of fits (runs, 8) in standard errors."""
    motion = Shake(3).trajectory(duration, RATE_HZ)
    body = simulate(TRUTH, PLATE, motion, gravity=GRAVITY)
    true = AXISYMMETRIC.parameters(TRUTH.stiffness, TRUTH.damping)
    found = []
    for seed in seeds:
        rng = np.random.default_rng((seed, 7))
        seen = [with_errors(own, drawn(kind, len(own), rng)) for own in (motion, body)]
        own = Segment(*seen, PLATE, GRAVITY, *[noise_of_kind(kind)] * 2)
        fit = output_error([own], AXISYMMETRIC, TRUTH)
        std = np.sqrt(np.diag(fit.covariance))
        found.append((AXISYMMETRIC.parameters(fit.stiffness, fit.damping) - true) / std)
    return np.array(found)


@pytest.mark.parametrize(('kind', 'runs'), [
    ('26 ms', 3), *(
        pytest.param(kind, 24, marks=pytest.mark.stress)
        for kind in ('white', '26 ms', '140 ms', 'anisotropic', 'heavy-tailed'))])
def test_intervals_hold_the_truth(kind, runs):
    z = deviations(kind, range(runs))
    inside = np.mean(np.abs(z) < 1.96)
    # of 95 % nominally; errors of one fit are hardly correlated
    assert inside > 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / z.size)
    assert np.sqrt(np.mean(z**2)) > 0.6  # and they are not simply wide


def test_noise_of_a_tool_at_rest_is_no_information():
    """Its noise shakes the simulated package, too; the sag alone shows K z."""
    moving = Shake(3).trajectory(DURATION, RATE_HZ)
    tool = replace(moving, twist=np.zeros((len(moving), 6)), **{name: np.repeat(
        getattr(moving, name)[:1], len(moving), axis=0) for name in ('position', 'rotation')})
    rng, noise = np.random.default_rng(6), BodyNoise(STD)
    body = simulate(TRUTH, PLATE, tool, gravity=GRAVITY)
    seen = [with_errors(own, drawn('white', len(own), rng)) for own in (tool, body)]
    fit = output_error([Segment(*seen, PLATE, GRAVITY, noise, noise)], AXISYMMETRIC, TRUTH)
    assert np.flatnonzero(np.isfinite(np.diag(fit.covariance))).tolist() == [1]


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: 40 simulations take a minute')
def test_with_an_exact_tool_it_is_the_cramer_rao_bound():
    """The bound is that of a free simulation, by central differences."""
    noise, rate_hz = (3e-4, 1e-3), 250.0
    fit = output_error([recorded(1, (0.0, 0.0), noise, rate_hz=rate_hz)], AXISYMMETRIC, TRUTH)
    rows = tool_rows(Shake(1).trajectory(12.0, rate_hz))
    start = static_equilibrium(
        model_tuple(TRUTH, PLATE, GRAVITY), state_row(rows[0, :3], rows[0, 3:7], np.zeros(6)))
    steps = np.full(len(rows) - 1, 2)

    def poses(x):
        """Return positions and rotations, by K, P and what the start is off by."""
        cup = Cup(*AXISYMMETRIC.matrices(x[:8]), TRUTH.length)
        states = simulate_rows(
            model_tuple(cup, PLATE, GRAVITY), moved_by(start, x[8:]), rows,
            np.full(len(steps), 1.0 / rate_hz), steps)
        return states[:, :3], quaternion_to_rotation(states[:, 3:7])

    x = np.append(AXISYMMETRIC.parameters(TRUTH.stiffness, TRUTH.damping), np.zeros(12))
    J = []
    for step in np.diag(np.append(1e-4 * x[:8], np.full(12, 1e-6))):
        (o, R), (o_less, R_less) = poses(x + step), poses(x - step)
        changes = np.hstack([o - o_less, log_so3(np.swapaxes(R_less, 1, 2) @ R)])
        J.append((changes / (2.0 * step.sum() * np.repeat(noise, 3))).ravel())
    J = np.transpose(J)
    unit = np.linalg.norm(J, axis=0)
    bound = (np.sqrt(np.diag(np.linalg.inv((J / unit).T @ (J / unit)))) / unit)[:8]
    ratio = np.sqrt(np.diag(fit.covariance)) / bound
    # of 12 seconds a scatter is known to 20 %
    assert np.all((ratio > 0.7) & (ratio < 1.6))
    assert 0.85 < np.median(ratio) < 1.25


@pytest.mark.stress
def test_full_matrices_from_a_diagonal_start():
    structure, shares = STRUCTURES['full'], []
    for seed in range(8):
        short = seed == 2
        cup = random_cup(np.random.default_rng(40 + seed))
        noise = (0.0, 0.0) if seed == 1 else ((1e-4, 5e-4), (3e-4, 1e-3))[seed % 2]
        own = recorded(
            seed, noise, noise, 12.0 if short else 30.0, 200.0 if short else 360.0, cup)
        start = Cup(0.7 * np.diag(np.diag(cup.stiffness)), 1.5 * np.diag(np.diag(cup.damping)),
                    cup.length)
        fit = output_error([own], structure, start)
        assert fit.converged and fit.usable
        away = np.linalg.norm(fit.stiffness - cup.stiffness) / np.linalg.norm(cup.stiffness)
        assert away < 0.03  # one standard deviation is 0.015 where K is known worst, with seed 3
        off = structure.parameters(fit.stiffness - cup.stiffness, fit.damping - cup.damping)
        known = np.isfinite(np.diag(fit.covariance))
        z = np.abs(off[known]) / np.sqrt(np.diag(fit.covariance)[known])
        assert np.all(z < 5.0)
        shares += [np.mean(z < 1.96)] * any(noise)
    assert np.mean(shares) > 0.9


@pytest.mark.parametrize(('rows', 'known'), [
    ([[1.0, 0.0, 0.0], [1e-4, 1e-4, 0.0], [0.0, 0.0, 2e4]], [True, True, True]),
    ([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]], [False, False, True]),
    ([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0]], [True, True, False])])
def test_a_covariance_is_the_inverse_where_all_is_known(rows, known):
    """A known sum does not determine its terms, and nothing about one determines none."""
    information = np.transpose(rows) @ rows
    size = np.sqrt(np.diag(information))
    inverse, mask, _ = inverted(information, np.where(size > 0.0, size, np.inf))
    assert mask.tolist() == known
    chosen = np.ix_(mask, mask)
    assert_allclose(inverse[chosen], np.linalg.inv(information[chosen]), rtol=1e-6, atol=1e-12)
    covariance = with_unidentifiable(inverse, ~mask)
    assert np.isinf(np.diag(covariance)).tolist() == (~mask).tolist()
    assert not np.any(covariance[~mask][:, mask])
