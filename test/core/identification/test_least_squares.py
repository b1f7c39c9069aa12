"""Least squares: the truth recovered, the weights and the solver as the thesis has them."""

from dataclasses import replace

from bellows_ros.core.identification.least_squares import (
    FilteredSamples,
    lip_relative,
    needed_wrench,
    samples_of,
)
from bellows_ros.core.identification.result import definiteness_findings
from bellows_ros.core.model.cup_package import Cup, regressor
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import oracle
from ...cell.cup import random_cup, random_package, THESIS
from ...cell.motion import Shake, shake
from ...cell.sensors import least_squares, record

GRAVITY = 9.81


def exact_samples(cup, package, rng, window):
    """Return samples whose accelerations are exact to the model."""
    tool = Shake(rng.integers(1000)).trajectory(6.0, 250.0).select(slice(500, None))
    body = simulate(cup, package, tool)
    rates = [
        oracle.acceleration(
            cup, package, np.array([0, 0, -GRAVITY]),
            oracle.transform(tool.rotation[k], tool.position[k]), tool.twist[k],
            oracle.transform(body.rotation[k], body.position[k]), body.twist[k])
        for k in range(len(tool))]
    moved = Trajectory(body.stamps_ns, body.position, body.rotation, body.twist, np.array(rates))
    return FilteredSamples(tool, moved, package, GRAVITY, window)


@pytest.fixture(scope='module')
def exact():
    """Return a cup, a package, and samples of them."""
    rng = np.random.default_rng(12)
    cup, package = random_cup(rng), random_package(rng)
    return cup, package, exact_samples(cup, package, rng, 0.02)


def test_full_matrices_are_recovered_exactly_from_exact_accelerations(exact):
    cup, _, samples = exact
    fit = least_squares([samples], cup.length, STRUCTURES['full'])
    assert_allclose(fit.stiffness, cup.stiffness, rtol=0, atol=1e-8 * cup.stiffness.max())
    assert_allclose(fit.damping, cup.damping, rtol=0, atol=1e-8 * cup.damping.max())
    assert fit.usable
    assert fit.findings == ()
    assert fit.samples_used == len(samples.tool.stamps_ns)
    assert_allclose(fit.residual_rms, 0.0, atol=2e-6)  # a root of rounded squares


@pytest.fixture(scope='module')
def round_cup():
    """Return samples of an axisymmetric cup."""
    rng = np.random.default_rng(14)
    return exact_samples(Cup.thesis(), random_package(rng), rng, 0.004)


def noisy(samples, rng, rate=1.0):
    """Return samples with white noise on the accelerations only: no error in the regressor."""
    sigma = rate * np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
    rates = samples.package.acceleration
    return replace(samples, package=replace(
        samples.package, acceleration=rates + sigma * rng.standard_normal(rates.shape)))


def first(samples, count):
    """Return the first samples."""
    tool, package = (body.select(slice(count)) for body in (samples.tool, samples.package))
    return replace(samples, tool=tool, package=package)


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_equals_the_printed_solution_with_the_printed_weights(exact, name):
    cup, _, samples = exact
    structure = STRUCTURES[name]
    samples = noisy(samples, np.random.default_rng(1))
    fit = least_squares([samples], cup.length, structure)
    c = needed_wrench(samples.payload, samples.package, GRAVITY)
    beta = c - c.mean(axis=0)
    Q = beta.T @ beta / (len(c) - 1)  # (4.69), (4.70)
    if name == 'diagonal':
        Q = np.diag(np.diag(Q))
    if name == 'axisymmetric':  # (4.80): the variance of both lateral rows taken together
        pooled = [np.var(np.concatenate([c[:, i], c[:, i + 1]]), ddof=1) for i in (0, 3)]
        Q = np.diag([pooled[0], pooled[0], Q[2, 2], pooled[1], pooled[1], Q[5, 5]])
    if name == 'axisymmetric_coupled':  # the same of both planes of bending
        plane = np.cov(np.concatenate([c[:, [0, 4]], c[:, [1, 3]] * [1.0, -1.0]]).T)
        Q = np.diag([0.0, 0.0, Q[2, 2], 0.0, 0.0, Q[5, 5]])
        Q[np.ix_([0, 4], [0, 4])] = plane
        Q[np.ix_([1, 3], [1, 3])] = plane * [[1.0, -1.0], [-1.0, 1.0]]
    W = np.linalg.inv(Q)
    L = regressor(cup.length, structure.basis, *lip_relative(
        samples.tool, samples.package, samples.payload.com))
    normal = np.einsum('nip,ij,njq->pq', L, W, L)  # (4.74) as printed; fine for a small check
    x = np.linalg.solve(normal, np.einsum('nip,ij,nj->p', L, W, c))
    K, P = structure.matrices(x)
    assert_allclose(fit.stiffness, K, rtol=1e-7, atol=1e-6)
    assert_allclose(fit.damping, P, rtol=1e-7, atol=1e-7)


def test_standard_errors_are_those_of_repeated_noise(round_cup):
    rng = np.random.default_rng(5)
    structure = STRUCTURES['axisymmetric']
    fits = [least_squares([noisy(round_cup, rng)], 0.0481, structure) for _ in range(60)]
    found = np.array([structure.parameters(f.stiffness, f.damping) for f in fits])
    variances = np.array([np.diag(f.covariance) for f in fits])
    known = np.isfinite(variances)
    assert np.all(known.mean(axis=0) > 0.7)  # P z, known to 20 %, may seem unknown
    stated = np.mean(variances, axis=0, where=known)
    # a variance from 60 repetitions is known to 18 %, the mean of the stated ones to less
    assert_allclose(np.var(found, axis=0, ddof=1) / stated, 1.0, atol=0.6)


def test_noise_of_motion_capture_biases_little():
    """Without compensation of noise: K within 2 %, P within 10 % on average."""
    structure, errors = STRUCTURES['axisymmetric'], []
    truth = structure.parameters(THESIS.stiffness, THESIS.damping)
    for seed in range(8):
        fit = least_squares([samples_of(record(
            shake(), tool=(2e-5, 5e-5), package=(1e-4, 5e-4), seed=seed,
            rate_hz=360.0))], THESIS.length, structure)
        errors.append(fit.parameters / truth - 1.0)
        assert np.all(np.abs(fit.parameters - truth) < 4.0 * np.sqrt(np.diag(fit.covariance)))
    assert np.all(np.abs(np.mean(errors, axis=0)) < np.repeat([0.02, 0.1], 4))


def test_too_few_samples(exact):
    cup, _, samples = exact
    with pytest.raises(BellowsError, match=r'\b5\b.* 42\b'):
        least_squares([first(samples, 5)], cup.length, STRUCTURES['full'])


@pytest.mark.parametrize('name', ['axisymmetric', 'diagonal', 'full'])
def test_parameters_without_motion_are_not_identifiable(name):
    """Shake a cup along x only: nothing turns about z."""
    cup = THESIS
    samples = samples_of(record(shake(axes=(0,), duration=6.0)))
    structure = STRUCTURES[name]
    fit = least_squares([samples], cup.length, structure)
    unknown = {label for label, variance in zip(
        structure.labels, np.diag(fit.covariance), strict=True) if np.isinf(variance)}
    assert {'K rz', 'P rz'} <= unknown
    assert 'K z' not in unknown  # gravity loads the axis
    if name == 'axisymmetric':
        assert_allclose(fit.stiffness[0, 0], cup.stiffness[0, 0], rtol=0.05)
        assert_allclose(fit.stiffness[3, 3], cup.stiffness[3, 3], rtol=0.05)
    assert not fit.usable


def test_indefinite_matrix_is_reported_and_not_changed(exact):
    cup, _, samples = exact
    upside_down = replace(samples, gravity=-GRAVITY, package=replace(
        samples.package, acceleration=-samples.package.acceleration))
    fit = least_squares([upside_down], cup.length, STRUCTURES['full'])
    assert not fit.usable
    assert np.linalg.eigvalsh(fit.stiffness)[0] < 0.0
    first = fit.findings[0]
    assert first.code == 'indefinite' and 'not positive definite' in first.numbers['name']
    assert 'axisymmetric' in first.numbers['simpler']
    assert {each.code for each in fit.findings} <= {'indefinite', 'not_identifiable'}


def test_semidefinite_damping_is_no_fault():
    assert definiteness_findings(np.eye(6), np.zeros((6, 6)), 'full') == ()
    assert len(definiteness_findings(np.zeros((6, 6)), -np.eye(6), 'axisymmetric')) == 2
