"""The prediction-error method recovers the truth, from afar, through noise and outliers."""

from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys

from bellows_ros.core.identification.consistency import same_cup
from bellows_ros.core.identification.minimum import innovations
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .recordings import HEAVY, PLATE, segments
from ..cases import random_cup

TRUTH = Cup.thesis()
AXISYMMETRIC = STRUCTURES['axisymmetric']
MOVING = [0, 1, 3, 4, 5]  # the axial damping is hardly visible


def off(factors):
    """Return the true cup with its entries off by factors (12,)."""
    return Cup(
        np.diag(np.diag(TRUTH.stiffness) * factors[:6]),
        np.diag(np.diag(TRUTH.damping) * factors[6:]), TRUTH.length)


def ratios(fit, cup=TRUTH):
    """Return found over true diagonal entries of K and P."""
    return (np.diag(fit.stiffness) / np.diag(cup.stiffness),
            np.diag(fit.damping) / np.diag(cup.damping))


@pytest.mark.parametrize('tool_noise', [(0.0, 0.0), (1e-4, 5e-4)])
def test_innovations_of_the_truth_are_white_and_of_unit_variance(tool_noise):
    (recording,) = segments(11, 20.0, tool_noise=tool_noise)
    e = innovations(TRUTH, recording)
    # of N samples a variance is known to sqrt(2 / N), a correlation to 1 / sqrt(N); of the noise
    # per axis, which comes from the same samples, to 3 %
    within = 4.5 / np.sqrt(len(e))
    assert_allclose(np.mean(e**2, axis=0), 1.0, atol=1.5 * within + 0.03)
    for lag in (1, 2, 5, 20, 60):
        assert np.all(np.abs(np.mean(e[lag:] * e[:-lag], axis=0)) < within)


def test_innovations_know_of_missing_poses_and_of_a_wrong_cup():
    (recording,) = segments(13, 4.0, tool_noise=(1e-4, 5e-4))
    valid = recording.package.valid.copy()
    valid[300:350] = False
    position = recording.package.position.copy()
    position[300:350] += 0.01  # nonsense, as where a gap was bridged badly
    lost = replace(recording, package=replace(recording.package, position=position, valid=valid))
    assert 0.9 < np.mean(innovations(TRUTH, lost)**2) < 1.1
    soft = Cup(0.8 * TRUTH.stiffness, TRUTH.damping, TRUTH.length)
    assert np.mean(innovations(soft, recording)**2) > 1.5


def test_a_short_recording():
    (recording,) = segments(9, 5.0, tool_noise=(2e-5, 1e-4), rate_hz=100.0)
    fit = prediction_error([recording], AXISYMMETRIC, TRUTH)
    assert_allclose(ratios(fit)[0], 1.0, atol=0.05)
    assert 0.85 < fit.chi2 < 1.15


@pytest.fixture(scope='module')
def exact_tool():
    """Return the fit of a recording with an exact tool, from the truth."""
    recordings = segments(1, package_noise=(3e-4, 1e-3))
    return recordings, prediction_error(recordings, AXISYMMETRIC, TRUTH)


def test_exact_tool_and_noisy_package(exact_tool):
    _, fit = exact_tool
    stiffness, damping = ratios(fit)
    assert_allclose(stiffness, 1.0, atol=0.02)  # 12 s only
    assert_allclose(damping[MOVING], 1.0, atol=0.06)
    assert 0.95 < fit.chi2 < 1.05
    assert fit.warnings == ()
    assert fit.usable


@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.stress)])
def test_starts_half_off_end_at_the_same_optimum(exact_tool, seed):
    recordings, reference = exact_tool
    factors = np.random.default_rng(seed).choice([0.5, 1.5], 12)
    factors[[1, 4, 7, 10]] = factors[[0, 3, 6, 9]]
    fit = prediction_error(recordings, AXISYMMETRIC, off(factors))
    assert_allclose(np.diag(fit.stiffness), np.diag(reference.stiffness), rtol=1e-3)
    assert_allclose(np.diag(fit.damping), np.diag(reference.damping), rtol=1e-3)


def test_errors_are_of_the_size_of_their_standard_errors(exact_tool):
    _, fit = exact_tool
    for found, std, true in (
            (fit.stiffness, fit.stiffness_std, TRUTH.stiffness),
            (fit.damping, fit.damping_std, TRUTH.damping)):
        z = (np.diag(found) - np.diag(true)) / np.diag(std)
        assert np.all(np.abs(z) < 4.0)
        assert np.all(np.diag(std) > 0.0)


def test_iterations_are_reported_and_kept(exact_tool):
    recordings, reference = exact_tool
    reported = []
    fit = prediction_error(recordings, AXISYMMETRIC, TRUTH, reported.append)
    assert tuple(reported) == fit.iterations
    assert [i.number for i in reported] == list(range(len(reported)))
    assert_allclose(fit.stiffness, reference.stiffness, rtol=0, atol=0)  # and bit for bit again
    assert_allclose(fit.covariance, reference.covariance, rtol=0, atol=0)


def test_noise_on_both_bodies_with_outliers_and_dropouts():
    def damage(tool, package):
        position, valid = package.position.copy(), package.valid.copy()
        position[500] += 0.05  # an outlier that nobody has marked
        position[1500:1504] += 0.02
        valid[800:830] = False
        tool_valid = tool.valid.copy()
        tool_valid[1200:1210] = False
        return (
            Trajectory(tool.stamps_ns, tool.position, tool.rotation, valid=tool_valid),
            Trajectory(package.stamps_ns, position, package.rotation, valid=valid))

    recordings = segments(2, 16.0, tool_noise=(1e-4, 5e-4), damage=damage)
    fit = prediction_error(recordings, AXISYMMETRIC, TRUTH)
    stiffness, damping = ratios(fit)
    assert_allclose(stiffness, 1.0, atol=0.02)
    assert_allclose(damping[MOVING], 1.0, atol=0.06)
    assert fit.samples_rejected >= 30
    assert 0.9 < fit.robust_chi2 < 1.1 < fit.chi2  # the outliers are not trimmed


def test_full_matrices_from_near_by():
    cup = random_cup(np.random.default_rng(21))
    recordings = segments(3, 5.0, package_noise=(1e-5, 5e-5), cup=cup, rate_hz=100.0)
    start = Cup(0.97 * cup.stiffness, 1.03 * cup.damping, cup.length)
    fit = prediction_error(recordings, STRUCTURES['full'], start)
    assert np.linalg.norm(fit.stiffness - cup.stiffness) < 0.005 * np.linalg.norm(cup.stiffness)
    assert 0.9 < fit.chi2 < 1.1


@pytest.mark.stress
def test_full_matrices_from_their_diagonals():
    cup = random_cup(np.random.default_rng(21))
    recordings = segments(3, 12.0, package_noise=(1e-4, 5e-4), cup=cup)
    start = Cup(np.diag(np.diag(cup.stiffness)), np.diag(np.diag(cup.damping)), cup.length)
    fit = prediction_error(recordings, STRUCTURES['full'], start)
    assert np.linalg.norm(fit.stiffness - cup.stiffness) < 0.02 * np.linalg.norm(cup.stiffness)
    assert 0.95 < fit.chi2 < 1.05
    assert np.linalg.eigvalsh(fit.stiffness)[0] > 0.0
    assert np.linalg.eigvalsh(fit.damping)[0] >= 0.0


def test_time_offset_of_the_streams():
    recordings = segments(4, tool_noise=(2e-5, 1e-4), later=-0.0123, margin=0.05)
    fit = prediction_error(
        recordings, AXISYMMETRIC, TRUTH, free=('time_offset',))
    # the tool's stamps are 12.3 ms too early: its motion is found at earlier stamps
    assert_allclose(fit.delays, [-0.0123], atol=0.5e-3)
    assert_allclose(ratios(fit)[0], 1.0, atol=0.02)


def test_a_search_goes_on_from_where_it_was_stopped():
    """Start from what least squares makes of a tool that is stamped late."""
    recordings = segments(
        4, 5.0, tool_noise=(2e-5, 1e-4), package_noise=(5e-5, 2e-4), rate_hz=100.0)
    damping = TRUTH.damping.copy()
    damping[[0, 1, 2], [0, 1, 2]] = -29.0, -29.0, -140.0
    start = Cup(TRUTH.stiffness, damping, TRUTH.length)
    fit = prediction_error(recordings, AXISYMMETRIC, start)
    assert_allclose(ratios(fit)[0], 1.0, atol=0.02)
    assert_allclose(ratios(fit)[1][MOVING], 1.0, atol=0.06)
    assert np.all(np.isfinite(np.diag(fit.damping_std)))
    assert fit.chi2 < 1.1


def test_several_packages_are_one_cup_or_not():
    both = [
        *segments(5, rate_hz=100.0, tool_noise=(5e-5, 2e-4)),
        *segments(6, rate_hz=100.0, tool_noise=(5e-5, 2e-4), payload=HEAVY, recording=1)]
    joint = prediction_error(both, AXISYMMETRIC, TRUTH)
    assert_allclose(ratios(joint)[0], 1.0, atol=0.02)
    apart = [
        prediction_error([part], AXISYMMETRIC, TRUTH) for part in both]
    same = same_cup(apart, ['2.17 kg', '2.9 kg'])
    assert same.probability > 0.01
    assert 'one cup' in same.verdict
    softer = Cup(0.9 * TRUTH.stiffness, TRUTH.damping, TRUTH.length)
    other = prediction_error(
        segments(6, rate_hz=100.0, tool_noise=(5e-5, 2e-4), payload=HEAVY, cup=softer),
        AXISYMMETRIC, TRUTH)
    differ = same_cup([apart[0], other], ['2.17 kg', '2.9 kg'])
    assert differ.probability < 1e-6
    assert 'not of one cup' in differ.verdict


def test_identifiable_is_what_is_known_beside_its_own_size():
    """Noise of 0.3 mm and 1 mrad on both bodies: bending is known well, axial damping badly."""
    noise = (3e-4, 1e-3)
    fit = prediction_error(segments(4, 8.0, noise, noise, rate_hz=150.0), AXISYMMETRIC, TRUTH)
    std = dict(zip(fit.labels, np.sqrt(np.diag(fit.covariance)), strict=True))
    assert std['K rx'] < 0.003 * TRUTH.stiffness[3, 3]
    assert np.isinf(std['P z']) and np.isfinite([std['K z'], std['P x'], std['P rx']]).all()
    less = prediction_error(
        segments(4, 8.0, (2e-6, 1e-5), (2e-6, 1e-5), rate_hz=150.0), AXISYMMETRIC, TRUTH)
    error = np.sqrt(np.diag(less.covariance))[fit.labels.index('P z')]
    assert 0.0 < error < 0.5 * less.damping[2, 2]


def test_a_wrong_mass_is_noticed():
    heavier = type(PLATE)(2.0, np.diag([0.012, 0.012, 0.0173]), (0.0, 0.0, -0.05))
    recordings = segments(7, 5.0, rate_hz=100.0)
    wrong = [replace(r, payload=heavier) for r in recordings]
    fit = prediction_error(wrong, AXISYMMETRIC, TRUTH)
    assert fit.chi2 > 1.2
    assert 'does not explain' in fit.misfit
    assert 'package.mass' in fit.misfit and 'fit.time_offset' in fit.misfit


def test_nothing_to_compare_is_an_error():
    recordings = segments(8, 4.0)
    blind = [replace(r, package=replace(r.package, valid=np.array(False))) for r in recordings]
    with pytest.raises(BellowsError, match='No valid package pose'):
        prediction_error(blind, AXISYMMETRIC, TRUTH)


FULL_FIT = """
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import STRUCTURES
import numpy as np
from test.core.cases import random_cup
from test.core.identification.recordings import segments

cup = random_cup(np.random.default_rng(21))
recordings = segments(3, 5.0, (1e-4, 5e-4), (1e-4, 5e-4), cup, rate_hz=200.0)
start = Cup(0.97 * cup.stiffness, 1.03 * cup.damping, cup.length)
fit = prediction_error(recordings, STRUCTURES['full'], start)
print(*fit.stiffness.ravel(), *fit.damping.ravel(), *np.diag(fit.covariance))
"""


@pytest.mark.stress
def test_threads_of_linear_algebra_change_nothing(root: Path) -> None:
    """Ask for one and for two before NumPy starts."""
    found = []
    for count in '12':
        threads = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), count)
        done = subprocess.run([sys.executable, '-c', FULL_FIT], cwd=root, check=True, text=True,
                              capture_output=True, env={**os.environ, **threads})
        found.append(np.array(done.stdout.split(), dtype=float))
    assert_allclose(found[1][:72], found[0][:72], rtol=1e-9, atol=1e-9)
    assert_allclose(found[1][72:], found[0][72:], rtol=1e-6)
