"""Whether fits are of one cup, of made-up fits with known differences."""

from bellows_ros.core.identification.consistency import same_cup
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.model.structure import STRUCTURES
import numpy as np
import pytest

from .simulated import without

ROUND = STRUCTURES['axisymmetric']
X = np.array([6417.0, 11530.0, 3.868, 1.123, 66.06, 22.35, 0.05458, 0.09736])
NAMES = ('light (1.2 kg)', 'heavy (2.2 kg)', 'third')


def fit(x, relative=0.01):
    """Return a fit with independent standard errors, parts of the values."""
    return Fit('least_squares', 'axisymmetric', x, np.diag((relative * X) ** 2),
               100, 0, 1.0, np.eye(6), np.zeros(6))


def scattered(seed, count=2, relative=0.01):
    """Return fits of one cup, scattered by their errors."""
    rng = np.random.default_rng(seed)
    return [fit(X * (1.0 + relative * rng.standard_normal(8)), relative) for _ in range(count)]


def test_probabilities_of_one_cup_are_uniform():
    found = [same_cup(scattered(seed, 3), NAMES) for seed in range(300)]
    for p in ([f.probability for f in found], [f.probability_stiffness for f in found],
              [f.probability_damping for f in found]):
        # 300 draws: a tenth of them below 0.1, with a spread of 0.017
        assert abs(np.mean(np.array(p) < 0.1) - 0.1) < 0.06
        assert abs(np.mean(p) - 0.5) < 0.06


def test_the_same_cup_is_said_to_be_the_same():
    found = same_cup(scattered(1), NAMES[:2])
    assert found.verdict.startswith('The fits are consistent with one cup') and not found.differs
    assert 'K and P are the same for light (1.2 kg) and heavy (2.2 kg)' in found.verdict


@pytest.mark.parametrize(('change', 'words'), [
    (0, 'K is not the same'), (6, 'P is not the same'), ((1, 5), 'K and P are not the same')])
def test_what_differs_is_named(change, words):
    fits = scattered(2)
    other = ROUND.parameters(fits[1].stiffness, fits[1].damping)
    other[np.ravel(change)] *= 1.2
    found = same_cup([fits[0], fit(other)], NAMES[:2])
    assert words in found.verdict and 'may not hold over this range' in found.verdict
    assert found.probability < 1e-6 and found.differs
    label = ROUND.labels[np.ravel(change)[0]]
    assert label in found.verdict or ROUND.labels[np.ravel(change)[-1]] in found.verdict


def test_small_differences_that_are_certain_hardly_matter():
    first, second = fit(X, 1e-4), fit(X * 1.01, 1e-4)
    found = same_cup([first, second], NAMES[:2])
    assert found.probability < 1e-6 and 'hardly matters' in found.verdict


def test_what_is_not_identifiable_is_not_compared():
    """Put nonsense where nothing is known: it does not count, and no warning comes of it."""
    fits = [without(fit(np.where(np.arange(8) == 3, 0.0, X)), ['K rz', 'P z']), fit(X)]
    found = same_cup(fits, NAMES[:2])
    assert found.probability == 1.0
    assert np.all(np.abs(found.deviations) < 1e-9)
    nothing = same_cup([without(f, ROUND.labels) for f in scattered(3)], NAMES[:2])
    assert 'cannot be compared' in nothing.verdict and not nothing.differs
