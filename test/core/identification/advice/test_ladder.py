"""The ladder of structures: the right one is advised, whichever it is."""

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.ladder import effective_samples, structure_ladder
from bellows_ros.core.identification.methods import samples_of
from bellows_ros.core.identification.regression.least_squares import (
    equations,
    least_squares,
    Samples,
)
from bellows_ros.core.identification.structure import STRUCTURES
from bellows_ros.core.model import Cup
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import simulated

NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}


def ladder_of(cup, **options):
    """Return the ladder of a recording of a cup with noise."""
    recording = simulated.record(
        simulated.shake(duration=12.0), cup, rate_hz=200.0, **{**NOISE, **options})
    samples = samples_of(recording, simulated.HELD, simulated.GRAVITY)
    return samples, structure_ladder([samples], cup.length, [FilterNoise.of(recording)])


def coupled():
    """Return a cup whose directions are coupled as no round one's are."""
    K, P = simulated.CUP.stiffness.copy(), simulated.CUP.damping.copy()
    K[0, 4] = K[4, 0] = 0.35 * np.sqrt(K[0, 0] * K[4, 4])
    K[1, 5] = K[5, 1] = 0.3 * np.sqrt(K[1, 1] * K[5, 5])
    return Cup(K, P, simulated.CUP.length)


def oval():
    """Return a cup that is softer about one lateral axis than about the other."""
    K = np.diag(np.diag(simulated.CUP.stiffness) * [1.0, 1.4, 1.0, 1.3, 1.0, 1.0])
    return Cup(K, simulated.CUP.damping, simulated.CUP.length)


@pytest.mark.parametrize(('cup', 'name'), [
    (simulated.CUP, 'axisymmetric'), (oval(), 'diagonal'), (coupled(), 'full')])
def test_the_structure_of_the_truth_is_advised(cup, name):
    _, ladder = ladder_of(cup)
    assert ladder.advised == name
    assert ladder.advice[0].startswith(f'Take fit.structure: {name}. ')
    assert [rung.parameters for rung in ladder.rungs] == [8, 12, 42]
    right = next(rung for rung in ladder.rungs if rung.structure == name)
    assert right.held_out < 0.03
    for rung in ladder.rungs[:[r.structure for r in ladder.rungs].index(name)]:
        assert rung.held_out > 2.0 * right.held_out  # too simple is far worse
        assert rung.aic > 10.0 and rung.bic > 10.0


def test_criteria_are_those_of_the_formulas():
    """Compute AIC and BIC anew from the residuals of fits with the weight of the richest."""
    samples, ladder = ladder_of(simulated.CUP)
    aic, bic = [], []
    rich = least_squares([samples], simulated.CUP.length, STRUCTURES['full'])
    for rung in ladder.rungs:
        structure = STRUCTURES[rung.structure]
        L, c, _ = equations(samples, simulated.CUP.length, structure)
        full_L, _, _ = equations(samples, simulated.CUP.length, STRUCTURES['full'])
        x = STRUCTURES['full'].parameters(rich.stiffness, rich.damping)
        residual = c - full_L @ x
        W = np.linalg.inv(residual.T @ residual / len(residual))
        root = np.linalg.cholesky(W).T
        A, b = (root @ L).reshape(-1, L.shape[2]), (c @ root.T).ravel()
        size = np.linalg.norm(A, axis=0)
        left = b - A / size @ np.linalg.lstsq(A / size, b, rcond=None)[0]
        deviance = ladder.effective_samples / len(residual) * float(left @ left)
        aic.append(deviance + 2 * L.shape[2])
        bic.append(deviance + np.log(ladder.effective_samples) * L.shape[2])
    assert_allclose([rung.aic for rung in ladder.rungs], np.array(aic) - min(aic), atol=1e-3)
    assert_allclose([rung.bic for rung in ladder.rungs], np.array(bic) - min(bic), atol=1e-3)


@pytest.mark.parametrize('a', [0.0, 0.6, 0.9])
def test_effective_samples_of_an_autoregression(a):
    """Compare with (1 - a^2) / (1 + a^2) N of a first-order autoregression."""
    rng = np.random.default_rng(8)
    count = 20000
    white = rng.standard_normal((count, 6))
    values = np.empty_like(white)
    values[0] = white[0]
    for k in range(1, count):
        values[k] = a * values[k - 1] + white[k]
    valid = np.ones(count, dtype=bool)
    expected = count * (1 - a**2) / (1 + a**2)
    assert_allclose(effective_samples([(values, valid)], 100), expected, rtol=0.05)
    valid[rng.integers(0, count, 2000)] = False  # samples missing here and there change nothing
    part = np.count_nonzero(valid) / count
    assert_allclose(effective_samples([(values, valid)], 100), expected * part, rtol=0.05)


def test_exact_recordings_are_no_trouble():
    _, ladder = ladder_of(simulated.CUP, tool=(0.0, 0.0), package=(0.0, 0.0))
    assert ladder.advised == 'axisymmetric'
    assert all(rung.held_out < 2e-3 for rung in ladder.rungs)


def test_gaps_are_left_out_and_without_noises_nothing_is_corrected():
    recording = simulated.record(simulated.shake(duration=12.0), rate_hz=120.0)
    samples = samples_of(recording, simulated.HELD, simulated.GRAVITY)
    valid = np.ones(len(samples.tool), dtype=bool)
    valid[300:330] = False
    tool = Trajectory(*[getattr(samples.tool, name) for name in (
        'stamps_ns', 'position', 'rotation', 'twist', 'acceleration')], valid)
    gappy = Samples(tool, samples.package, samples.held, samples.gravity, samples.window)
    ladder = structure_ladder([gappy], simulated.CUP.length)
    assert ladder.samples == len(samples.tool) - 30
    assert ladder.advised == 'axisymmetric'


def test_a_motion_that_tells_little_leaves_the_simple_structure():
    """Refuse what cannot be fitted, with the reason, and advise what can."""
    recording = simulated.record(simulated.shake(axes=(0, 2), duration=8.0), **NOISE)
    samples = samples_of(recording, simulated.HELD, simulated.GRAVITY)
    ladder = structure_ladder([samples], simulated.CUP.length, [FilterNoise.of(recording)])
    assert ladder.advised == 'axisymmetric'
    full = ladder.rungs[-1]
    assert not full.usable
    assert any(sentence.startswith('full ') for sentence in ladder.advice)


def test_mistakes_are_named():
    recording = simulated.record(simulated.shake(duration=4.0))
    samples = samples_of(recording, simulated.HELD, simulated.GRAVITY)
    with pytest.raises(BellowsError, match='No structure can be fitted'):
        structure_ladder([Samples(
            samples.tool.select(slice(0, 1)), samples.package.select(slice(0, 1)), samples.held,
            samples.gravity, samples.window)], simulated.CUP.length)
    with pytest.raises(BellowsError, match='as many noises'):
        structure_ladder([samples, samples], simulated.CUP.length, [FilterNoise.of(recording)])
