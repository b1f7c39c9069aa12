"""Comparison of the fits to single recordings."""

from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.workflows.compare import compared
import numpy as np
import pytest

DIAGONAL, ROUND = STRUCTURES['diagonal'], STRUCTURES['axisymmetric']
X = np.array([6417.0, 11530.0, 3.868, 1.123, 66.06, 22.35, 0.05458, 0.09736])


def fit(x, relative=0.01, structure=ROUND):
    """Return estimates with independent standard errors, fractions of the values."""
    return structure, x, np.diag((relative * x) ** 2)


@pytest.mark.parametrize('count', [2, 5])
def test_one_cup_is_taken_for_several_in_one_of_a_hundred(count):
    rng = np.random.default_rng(count)
    alarms = [compared(['fit'] * count, [
        (ROUND, X * (1.0 + 0.01 * rng.standard_normal(8)), np.diag((0.01 * X) ** 2))
        for _ in range(count)]).differs for _ in range(2000)]
    assert 0.004 < np.mean(alarms) < 0.017  # three standard deviations about 1 %


@pytest.mark.parametrize('entry', range(8))
def test_the_differing_entry_is_named_with_its_size(entry):
    other = X * np.where(np.arange(8) == entry, 1.2, 1.0)
    found = compared(['A', 'B', 'C'], [fit(X), fit(other), fit(X)])
    z = 0.2 / np.hypot(1.2 * 0.01, 0.01 / np.sqrt(2.0))
    assert found.z[1, entry] == pytest.approx(z, rel=1e-6)
    assert f'{ROUND.labels[entry]} of B differs by +20 %, z {z:+.1f}' in found.verdict


def test_a_small_significant_difference_hardly_matters():
    found = compared(['A', 'B'], [fit(X, 1e-4), fit(1.01 * X, 1e-4)])
    assert found.differs and 'hardly matters' in found.verdict


def test_entries_that_one_structure_ties_have_equal_values():
    wide = DIAGONAL.parameters(*ROUND.matrices(X))
    found = compared(['A', 'B'], [fit(X), fit(wide, 0.01, DIAGONAL)])
    assert found.structure is DIAGONAL and np.allclose(found.z, 0.0, atol=1e-9)
    wide[1] *= 1.2
    assert compared(['A', 'B'], [fit(X), fit(wide, 0.01, DIAGONAL)]).differs


def test_unidentifiable_entries_are_not_compared():
    blind = fit(np.where(np.arange(8) == 3, 0.0, X))
    blind[2][3, 3] = blind[2][5, 5] = np.inf
    found = compared(['A', 'B'], [blind, fit(X)])
    assert not found.differs and np.isnan(found.z[:, [3, 5]]).all()
    nothing = ROUND, X, np.diag(np.full(8, np.inf))
    assert 'cannot be compared' in compared(['A', 'B'], [nothing] * 2).verdict
