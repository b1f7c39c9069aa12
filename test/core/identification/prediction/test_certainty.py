"""What is told of the certainty: against the Cramer-Rao bound, and where nothing is known."""

from bellows_ros.core.identification.prediction.certainty import certainty
from bellows_ros.core.identification.prediction.objective import Objective, Stretch
from bellows_ros.core.identification.prediction.parametrisation import Parametrisation
from bellows_ros.core.identification.prediction.prediction_error import prediction_error
from bellows_ros.core.identification.structure import STRUCTURES
from bellows_ros.core.jit import COMPILED
from bellows_ros.core.model import Cup
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..recordings import Shake, stretches

TRUTH = Cup.thesis()
AXISYMMETRIC = STRUCTURES['axisymmetric']

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: simulated replicas take minutes interpreted')


def at_the_truth(recordings):
    """Return an objective and the free numbers of the true cup, with starts from rest."""
    chart = Parametrisation(AXISYMMETRIC, np.diag(TRUTH.stiffness), np.diag(TRUTH.damping))
    objective = Objective([Stretch(r, TRUTH) for r in recordings], TRUTH.length, chart, 0)
    theta = np.zeros(objective.size)
    theta[:chart.size] = chart.numbers(TRUTH.stiffness, TRUTH.damping)
    return objective, theta


def test_with_an_exact_tool_it_is_the_cramer_rao_bound():
    objective, theta = at_the_truth(stretches(1, package_noise=(3e-4, 1e-3)))
    sure = certainty(objective, theta)
    J = objective.jacobian(theta)  # of a simulation that sees no noise: exact
    bound = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:8]
    told = np.sqrt(np.diag(sure.covariance))[:8]
    # 16 replicas know a spread to 18 %, and it is never told smaller than in theory
    assert np.all(told > 0.99 * bound)
    assert np.all(told < 1.7 * bound)
    assert np.median(told / bound) < 1.25
    # the mean of 16 scores is zero to a quarter of their spread, here to 4 times that
    assert np.all(np.abs(sure.pull[:8]) < told)
    assert_allclose(sure.chi2, 1.0, atol=0.05)
    assert sure.unknown.shape == (len(theta), 0)


def test_noise_of_the_tool_is_no_information():
    """The noise shakes the package, too: what is apparent must be taken off."""
    exact, theta = at_the_truth(stretches(3, 8.0))
    noisy, _ = at_the_truth(stretches(3, 8.0, tool_noise=(1e-4, 5e-4)))
    told = [np.sqrt(np.diag(certainty(o, theta).covariance))[:8] for o in (exact, noisy)]
    assert np.all(told[1] > told[0])
    J = noisy.jacobian(theta)
    apparent = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:8]
    assert told[1][5] > 1.1 * apparent[5]  # the axial damping


class Push(Shake):
    """A motion along z alone."""

    def __init__(self, seed):
        super().__init__(seed)
        self.a = self.a * np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])


def test_what_is_not_excited_is_infinitely_uncertain():
    recordings = stretches(7, 6.0, tool_noise=(5e-5, 2e-4), rate_hz=125.0, motion=Push)
    fit = prediction_error(recordings, TRUTH.length, AXISYMMETRIC, TRUTH)
    std = np.diag(fit.stiffness_std), np.diag(fit.damping_std)
    assert np.isfinite(std[0][2])
    assert np.isinf(std[0][5])
    assert np.isinf(std[1][5])
    assert not np.isnan(fit.covariance).any()
    told = np.isfinite(np.diag(fit.covariance))
    assert told[fit.labels.index('K z')]
    assert not told[fit.labels.index('K rz')]
    assert np.linalg.eigvalsh(fit.stiffness)[0] > 0.0
