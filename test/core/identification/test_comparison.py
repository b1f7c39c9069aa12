"""Comparison of fits against Wald's test by hand."""

from bellows_ros.core.identification.comparison import Estimates, same_cup
from bellows_ros.core.model.structure import STRUCTURES
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import chi2

DIAGONAL, ROUND = STRUCTURES['diagonal'], STRUCTURES['axisymmetric']

X = np.array([6417.0, 11530.0, 3.868, 1.123, 66.06, 22.35, 0.05458, 0.09736])


def fit(x, relative=0.01, structure=ROUND):
    """Return estimates with independent standard errors, fractions of the values."""
    size = X if structure is ROUND else x
    return Estimates(structure, x, np.diag((relative * size) ** 2))


def scattered(seed, count=2, relative=0.01):
    """Return fits of one cup, scattered by their errors."""
    rng = np.random.default_rng(seed)
    return [fit(X * (1.0 + relative * rng.standard_normal(8)), relative) for _ in range(count)]


def test_probabilities_of_one_cup_are_uniform():
    found = [same_cup(scattered(seed, 3)) for seed in range(300)]
    for p in ([f.probability for f in found], [f.probability_stiffness for f in found],
              [f.probability_damping for f in found]):
        # 300 draws: a tenth of them below 0.1, with a spread of 0.017
        assert abs(np.mean(np.array(p) < 0.1) - 0.1) < 0.06
        assert abs(np.mean(p) - 0.5) < 0.06


@pytest.mark.parametrize(('change', 'matrices'), [(0, ['K']), (6, ['P']), ((1, 5), ['K', 'P'])])
def test_the_differing_entry_is_named(change, matrices):
    """Return codes and numbers of a significant, material difference."""
    fits = scattered(2)
    other = np.array(fits[1].values)
    other[np.ravel(change)] *= 1.2
    found = same_cup([fits[0], fit(other)])
    assert found.code == 'other_cups' and found.numbers['matrices'] == matrices
    assert found.probability < 1e-6 and found.differs
    assert found.numbers['label'] in {ROUND.labels[i] for i in np.ravel(change)}
    assert_allclose(abs(found.numbers['difference']), 0.09, atol=0.03)


def test_small_significant_differences_are_immaterial():
    """Tell 1 % with errors of 0.01 % from a difference that matters."""
    found = same_cup([fit(X, 1e-4), fit(X * 1.01, 1e-4)])
    assert found.probability < 1e-6 and found.code == 'nearly_one_cup'


def test_two_fits_are_tested_by_the_variance_of_their_difference():
    """Compute Wald's chi^2 by hand, with a correlated covariance."""
    rng = np.random.default_rng(4)
    A, B = (M @ M.T * np.outer(X, X) * 1e-4 for M in rng.standard_normal((2, 8, 8)))
    other = X * (1.0 + 0.01 * rng.standard_normal(8))
    found = same_cup([Estimates(ROUND, X, A), Estimates(ROUND, other, B)])
    d = other - X
    assert_allclose(found.probability, chi2.sf(d @ np.linalg.solve(A + B, d), 8), rtol=1e-6)


def test_structures_may_differ():
    """Compare in the richer structure; entries that one fit ties have no difference there."""
    matrices = ROUND.matrices(X)
    wide = DIAGONAL.parameters(*matrices)
    other = np.array(wide)
    other[1] *= 1.1
    found = same_cup([fit(X), fit(other, 0.01, DIAGONAL)])
    assert found.structure is DIAGONAL
    assert_allclose(found.std[0, :2], 0.01 * X[0])
    anti = (other[1] - other[0]) / np.hypot(*(0.01 * other[:2]))
    assert found.probability < chi2.sf(anti**2, 12) < 1e-3 and found.code == 'other_cups'
    assert same_cup([fit(X), fit(wide, 0.01, DIAGONAL)]).probability > 0.999


def test_unidentifiable_parameters_are_not_compared():
    """Ignore the value of an entry with an infinite error."""
    blind = fit(np.where(np.arange(8) == 3, 0.0, X))
    for i in (ROUND.labels.index('K rz'), ROUND.labels.index('P z')):
        blind.covariance[i, i] = np.inf
    found = same_cup([blind, fit(X)])
    assert found.probability == 1.0
    assert np.all(np.abs(found.deviations) < 1e-9)
    nothing = [Estimates(ROUND, each.values, np.diag(np.full(8, np.inf))) for each in scattered(3)]
    found = same_cup(nothing)
    assert found.code == 'not_comparable' and not found.differs and np.isfinite(found.mean).all()
