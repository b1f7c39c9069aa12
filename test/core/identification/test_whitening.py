"""The linearised model over a step between nodes, against SciPy's exponential."""

from bellows_ros.core.identification import whitening
from bellows_ros.core.identification.problem import COARSE_FACTOR
from bellows_ros.core.model.equilibrium import PHASE_PER_STEP
import numpy as np
import pytest
from scipy.linalg import expm


@pytest.mark.parametrize('steps', [1, 3, 8, 20])
@pytest.mark.parametrize('mode', [-1.0, 1j, -0.7 + 0.7j])
def test_the_quickest_mode_of_a_step_settles(mode, steps):
    turn = np.array([[mode.real, mode.imag], [-mode.imag, mode.real]])
    M = COARSE_FACTOR * PHASE_PER_STEP * steps * np.kron(np.diag([1.0, 0.1, 0.01]), turn)
    mean, ramp = np.zeros_like(M), np.zeros_like(M)
    F = whitening._exponential(M.copy(), steps, mean, ramp)
    exact = expm(M)
    assert np.abs(np.linalg.eigvals(F)).max() < 1.0
    assert np.abs(F - exact).max() < 0.2
    assert np.abs(F - exact)[2:, 2:].max() < 1e-4
    assert mean == pytest.approx(np.linalg.solve(M, exact - np.eye(6)), abs=0.05)
    assert ramp == pytest.approx(
        np.linalg.solve(M @ M, exact - np.eye(6) - M), abs=0.05)
