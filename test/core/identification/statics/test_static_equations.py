"""Standstills in a fit: their equations against the truth, and what they add to motions."""

from dataclasses import replace

from bellows_ros.core.identification.equations import covariance_of
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.statics.static_equations import (
    joined_with_standstills,
    Length,
    static_equations,
)
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.recording.standstills import standstills_of
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import simulated

G, L0 = simulated.GRAVITY, simulated.CUP.length
ROUND = STRUCTURES['axisymmetric']
TILTS = [(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.2, 0.2, 1.0), (0.0, 0.0, 0.0)]
NOISE = {'tool': (5e-5, 2e-4), 'package': (1e-4, 5e-4)}
TRUTH = ROUND.parameters(simulated.CUP.stiffness, simulated.CUP.damping)


def resting(seed, noise=NOISE, hold=3.5):
    """Return standstills in several poses."""
    recording = simulated.record(simulated.standstills(TILTS, hold=hold), seed=seed, **noise)
    return standstills_of(recording)[0]


def moving(seed, axes=(0, 1, 2, 3, 4, 5), noise=NOISE):
    """Return the fit to a motion of some axes."""
    recording = simulated.record(simulated.shake(axes, seed=seed), seed=seed, **noise)
    return simulated.least_squares([samples_of(recording)], L0, ROUND)


def exact(parameters=8):
    """Return the true length, as if known exactly."""
    return Length(L0, 0.0, np.zeros(parameters))


def whitened(standstills, stiffness=simulated.CUP.stiffness, length_std=0.0):
    """Return A and b of b = A k, whitened, with an error of the length common to all."""
    A, b, by_length = static_equations(standstills, L0, ROUND, G, stiffness)
    root = np.linalg.cholesky(np.eye(len(b)) + length_std**2 * np.outer(by_length, by_length))
    return np.linalg.solve(root, A), np.linalg.solve(root, b)


def test_errors_of_the_equations_have_unit_variance():
    """Average over recordings: with the true K they leave what the mean poses are wrong by."""
    squares = []
    for seed in range(5):
        A, b = whitened(resting(seed))
        squares += ((b - A @ TRUTH[:4]) ** 2).tolist()
    # 150 numbers: a mean of 1 to 12 %; swinging that has not died out is counted as error, too
    assert 0.5 < np.mean(squares) < 1.25


@pytest.mark.parametrize('wrong', [0.7, 1.5])
def test_a_wrong_guess_leads_to_the_truth_in_a_few_rounds(wrong):
    standstills = resting(1, {}, hold=6.0)
    K = wrong * simulated.CUP.stiffness
    for _ in range(6):
        A, b = whitened(standstills, stiffness=K)
        k = np.linalg.lstsq(A, b, rcond=None)[0]
        K = ROUND.matrices(np.concatenate([k[:3], TRUTH[3:4], TRUTH[4:]]))[0]
    assert_allclose(k[:3], TRUTH[:3], rtol=1e-3)


def test_torsion_without_load_is_not_identifiable_by_its_noise():
    A, _ = whitened(resting(2))
    assert np.all(A[:, 3] == 0.0)
    assert np.isinf(np.diag(covariance_of(A.T @ A))).tolist() == [False, False, False, True]


def test_an_uncertain_length_makes_the_axial_stiffness_uncertain():
    """Without it the axial stretch m g / k is known; with it only its error over the stretch."""
    standstills = resting(3)
    exact, uncertain = (
        np.sqrt(np.diag(covariance_of((A := whitened(standstills, length_std=std)[0]).T @ A)))
        for std in (0.0, 1e-4))
    # All standstills are of one mass: the error of l0 is that of the stretch, which tilting by 0.3
    # hardly changes.
    segment = simulated.HELD.mass * G / TRUTH[1]
    assert_allclose(uncertain[1] / TRUTH[1], 1e-4 / segment, rtol=0.25)
    assert exact[1] < 0.1 * uncertain[1]
    assert uncertain[2] < 3.0 * exact[2]


def test_standstills_narrow_the_errors_and_do_not_shift_the_result():
    """See the stiffness of which static poses tell most come nearer, within its errors."""
    off = {'alone': [], 'joined': []}
    for seed in range(6):
        fit = moving(seed)
        joined = joined_with_standstills(
            fit, resting(10 + seed), exact(), G, simulated.CUP.stiffness)
        for name, found in (('alone', fit), ('joined', joined)):
            x = ROUND.parameters(found.stiffness, found.damping)
            off[name].append((x - TRUTH) / TRUTH)
        assert joined.standstills.count == 5 and joined.standstills.chi2 < 2.5
        assert joined.standstills.narrowed[0] < 0.85 and joined.standstills.narrowed[2] < 0.85
        assert_allclose(joined.standstills.narrowed[4:], 1.0, atol=0.02)  # at rest no damper acts
        std = np.sqrt(np.diag(joined.covariance))[:3]
        x = ROUND.parameters(joined.stiffness, joined.damping)[:3]
        assert np.all(np.abs(x - TRUTH[:3]) < 5.0 * std + 5e-3 * TRUTH[:3])
        assert joined.samples_used == fit.samples_used
    alone, joined = (np.sqrt(np.mean(np.square(off[name]), axis=0)) for name in off)
    assert joined[0] < alone[0] and joined[2] < alone[2]


def test_what_no_motion_tells_standstills_do():
    """Take the axial stiffness out of the fit to a motion: it comes from rest alone."""
    fit = simulated.without(moving(3), ['K z', 'P z'])
    assert np.isinf(fit.stiffness_std[2, 2])
    joined = joined_with_standstills(fit, resting(4), exact(), G, 1.4 * simulated.CUP.stiffness)
    assert np.isfinite(joined.stiffness_std[2, 2]) and np.isinf(joined.damping_std[2, 2])
    assert joined.standstills.narrowed[1] == 0.0
    assert abs(joined.stiffness[2, 2] / TRUTH[1] - 1.0) < 0.01
    assert joined.damping[2, 2] == fit.damping[2, 2]


def test_standstills_that_do_not_agree_count_less_and_are_warned_about():
    """Say the load was 20 % more than it was."""
    heavy = replace(simulated.HELD, mass=1.2 * simulated.HELD.mass)
    fit, heavier = moving(7), [replace(still, payload=heavy) for still in resting(8)]
    joined = joined_with_standstills(fit, heavier, exact(), G, simulated.CUP.stiffness)
    assert joined.standstills.chi2 > 100.0
    assert 'static recordings and the motion disagree' in joined.warnings[-1]
    # the motion knows its own stiffness better than 20 %
    assert abs(joined.stiffness[2, 2] / TRUTH[1] - 1.0) < 0.05


def test_a_better_mean_counts_more():
    found = resting(9)
    better = [replace(still, error=Noise(*(0.5 * e for e in still.error))) for still in found]
    first, second = (whitened(part)[0] for part in (found, better))
    assert_allclose(second[:, :3], 2.0 * first[:, :3], rtol=1e-9)


def test_none_is_a_mistake():
    with pytest.raises(BellowsError, match='at least one standstill'):
        static_equations([], L0, ROUND, G, simulated.CUP.stiffness)
