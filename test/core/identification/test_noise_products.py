"""What noise adds to least squares, against fits of many noisy recordings of one motion."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.reduction import noise_products
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.core.synthetic.motion import sample_stamps
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import simulated

ROUND = STRUCTURES['axisymmetric']
L0 = simulated.CUP.length
TRUTH = ROUND.parameters(simulated.CUP.stiffness, simulated.CUP.damping)


def fitted(noise, seed, structure=ROUND):
    """Return the fit of a recording with so much noise (m, rad) on both bodies, and its noise."""
    recording = simulated.record(simulated.shake(), tool=noise, package=noise, seed=seed)
    samples = samples_of(recording)
    products = noise_products(samples, recording.noise, L0, structure)
    fit = simulated.least_squares([samples], L0, structure, [recording.noise])
    return fit, samples, products


@pytest.mark.parametrize('noise', [(1e-4, 5e-4), (3e-4, 1e-3)])
def test_the_bias_is_taken_out_and_intervals_hold_the_truth(noise):
    fits = [fitted(noise, seed)[0] for seed in range(12)]
    error = np.array([ROUND.parameters(f.stiffness, f.damping) for f in fits]) - TRUTH
    with_bias = error + np.array([f.bias for f in fits])
    std = np.sqrt([np.diag(f.covariance) for f in fits])
    # P z is hardly identifiable here; the mean of 12 is known to a third of a spread
    known = np.arange(8) != 5
    off = np.abs(np.mean(error, axis=0))
    assert np.all(off < 1.2 * np.std(error, axis=0, ddof=1) + 2e-4 * TRUTH, where=known)
    assert np.mean((np.abs(error) < 1.96 * std)[:, known]) > 0.85
    shrunk = [0, 4, 6]  # K x, P x, P rx
    assert np.all(off[shrunk] < 0.4 * np.abs(np.mean(with_bias, axis=0))[shrunk])
    assert np.mean((np.abs(with_bias) < 1.96 * std)[:, shrunk]) < 0.5


def test_compensated_are_the_normal_equations_without_what_noise_adds():
    """Hold the parameters and, for clusters of their own size, the spread to the equations."""
    fit, samples, products = fitted((1e-4, 5e-4), 1)
    whitening = np.linalg.cholesky(fit.weight).T
    rows = simulated.whitened_rows(samples, L0, ROUND, whitening)
    stacked = rows.reshape(-1, rows.shape[-1])
    added = np.einsum('ki,ipjq,kj->pq', whitening, products, whitening)
    normal = stacked.T @ stacked - added
    x = np.linalg.solve(normal[:-1, :-1], normal[:-1, -1])
    assert_allclose(ROUND.parameters(fit.stiffness, fit.damping), x, rtol=1e-6)
    plain = simulated.least_squares([samples], L0, ROUND)
    ratio = np.sqrt(np.diag(fit.covariance) / np.diag(plain.covariance))
    # what is taken off was noise, which had seemed to tell something
    assert np.all((ratio > 0.7) & (ratio < 3.0))


POSITION, ROTATION = 1e-4, 5e-4
DURATION = 40.0


def still(name, rate_hz, draw):
    """Return noisy poses of a body that does not move."""
    stamps = sample_stamps(rate_hz, DURATION, 0)
    return PoseStream(
        name, 'world', stamps, POSITION * draw.standard_normal((len(stamps), 3)),
        exp_so3(ROTATION * draw.standard_normal((len(stamps), 3))))


@pytest.mark.parametrize('tool_rate_hz', [120.0, 125.0, 300.0])
def test_noise_of_a_tool_at_the_stamps_of_the_package(tool_rate_hz):
    draw = np.random.default_rng(3)
    recording = prepare(
        still('tool', tool_rate_hz, draw), still('package', 120.0, draw), PrepareSettings())
    noise = recording.noise
    for found, weights, body in (
            (noise.tool, noise.tool_weights, recording.tool),
            (noise.package, noise.package_weights, recording.package)):
        assert_allclose(found, (POSITION, ROTATION), rtol=0.05)
        value, slope = np.linalg.norm(weights[:2], axis=1)
        # a few hundred independent windows, of three axes
        assert_allclose(np.std(body.position), POSITION * value, rtol=0.06)
        assert_allclose(np.std(body.twist[:, :3]), POSITION * slope, rtol=0.06)
        assert_allclose(np.std(body.twist[:, 3:]), ROTATION * slope, rtol=0.06)
