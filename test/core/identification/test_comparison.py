"""Comparison of fits against hand calculation, and the cup's modes against textbook formulas."""

from bellows_ros.core.identification import comparison
from bellows_ros.core.identification.comparison import compare_fits, Fitted, modes, same_cup
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.structure import STRUCTURES
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import chi2, norm

from .simulated import without

PACKAGE = Package(2.0, np.diag([0.008, 0.009, 0.016]), np.array([0.0, 0.0, -0.03]))

K, P = np.array([6000.0, 6000, 11000, 4.0, 4.0, 1.2]), np.array([60.0, 60, 25, 0.06, 0.06, 0.1])

DIAGONAL, ROUND = STRUCTURES['diagonal'], STRUCTURES['axisymmetric']

G = 9.81


def fitted(k=K, p=P, part=0.01, structure=DIAGONAL):
    """Return a fit with standard errors that are a part of each entry."""
    cup = Cup(np.diag(k), np.diag(p), 0.048)
    x = structure.parameters(cup.stiffness, cup.damping)
    return Fitted(structure, cup, np.diag((part * x) ** 2))


def changed(values, index, factor):
    """Return values with one of them changed."""
    new = np.array(values)
    new[index] *= factor
    return new


def test_standard_errors_and_probability_of_one_change():
    """Divide by the root of both variances; take both tails of the normal distribution."""
    change = comparison.Change('K x', 'N/m', 100.0, 110.0, 3.0, 4.0)
    assert_allclose(change.standard_errors, 2.0)
    assert_allclose(change.percent, 10.0)
    assert_allclose(change.p_value, 2 * norm.cdf(-2.0))
    assert change.significant
    unknown = comparison.Change('P z', 'N s/m', 100.0, 50.0, np.inf, 1.0)
    assert unknown.standard_errors == 0.0 and not unknown.significant


def test_parameters_together_are_tested_by_chi_squared():
    """Add the squares of independent changes."""
    found = compare_fits(fitted(), fitted(changed(K, 2, 1.02), changed(P, 5, 1.03)), PACKAGE, G)
    squares = 0.02**2 / (0.01**2 * (1 + 1.02**2)) + 0.03**2 / (0.01**2 * (1 + 1.03**2))
    assert_allclose(found.p_value, chi2.sf(squares, 12), rtol=1e-6)


def test_a_softer_bending_matters():
    """Bring the change to frequency and rest pose."""
    found = compare_fits(fitted(part=1e-3), fitted(changed(K, 3, 0.8), part=1e-3), PACKAGE, G)
    assert found.matters and found.significant and found.shake_matters
    large = {effect.name for effect in found.effects if effect.matters}
    assert any('turn of the lip' in name for name in large)
    assert any('frequency' in name and 'bending' in name for name in large)


def test_a_large_change_within_its_errors_is_open():
    """Do not call it important where both fits hardly know it, but name it."""
    before, after = fitted(), fitted(p=changed(P, 2, 1.3))
    wide = [Fitted(fit.structure, fit.cup, fit.covariance + np.diag(
        np.where(np.arange(12) == 8, 100.0, 0.0))) for fit in (before, after)]
    found = compare_fits(*wide, PACKAGE, G)
    assert not found.matters
    assert any('axial' in effect.name for effect in found.open_effects)


def test_modes_that_coincide_are_matched_by_shape():
    """Find no change that matters between fits of one cup whose axial mode is a lateral one's."""
    lateral = max(m.frequency for m in modes(Cup(np.diag(K), np.diag(P), 0.048), PACKAGE, G)
                  if m.direction == 'lateral')
    k = np.array(K)
    k[2] = PACKAGE.mass * (2.0 * np.pi * lateral) ** 2
    rng = np.random.default_rng(1)
    axial_is_higher = set()
    for _ in range(4):
        draws = [(k * (1 + 2e-3 * rng.normal(size=6)), P * (1 + 2e-3 * rng.normal(size=6)))
                 for _ in range(2)]
        for draw_k, draw_p in draws:
            cup = Cup(np.diag(draw_k), np.diag(draw_p), 0.048)
            known = modes(cup, PACKAGE, G)
            axial = next(m.frequency for m in known if m.direction == 'axial')
            sideways = max(m.frequency for m in known if m.direction == 'lateral')
            axial_is_higher.add(axial > sideways)
        found = compare_fits(*(fitted(*draw, part=2e-3) for draw in draws), PACKAGE, G)
        assert not any(effect.matters for effect in found.effects)
        zeta = next(e for e in found.effects if 'damping' in e.name and 'axial' in e.name)
        assert_allclose(zeta.after / zeta.before, draws[1][1][2] / draws[0][1][2], rtol=5e-3)
        assert_allclose(zeta.before_std / zeta.before, np.hypot(2e-3, 1e-3), rtol=0.2)
    assert len(axial_is_higher) == 2  # by frequency, modes would have been taken for others


def test_structures_may_differ():
    """Compare in the richer structure; tied entries have equal errors there."""
    round_cup = fitted(structure=ROUND)
    found = compare_fits(round_cup, fitted(changed(K, 1, 1.1)), PACKAGE, G)
    assert [c.name for c in found.parameters] == list(DIAGONAL.labels)
    by_name = {c.name: c for c in found.parameters}
    assert_allclose(by_name['K y'].percent, 10.0)
    assert_allclose(by_name['K y'].before_std, 60.0)
    assert_allclose(by_name['K x'].before_std, 60.0)


def test_what_is_not_identifiable_does_not_count():
    """Leave parameters with infinite errors out of the verdict."""
    before, after = fitted(), fitted(p=changed(P, 2, 5.0))
    blind = before.covariance.copy()
    blind[8, 8] = np.inf
    found = compare_fits(Fitted(DIAGONAL, before.cup, blind), after, PACKAGE, G)
    assert not found.significant
    assert np.isinf({c.name: c for c in found.parameters}['P z'].before_std)


def test_standard_errors_of_effects_follow_from_those_of_parameters():
    """Meet the rule for powers: f ~ sqrt(k), so half the relative error; zeta ~ p / sqrt(k)."""
    found = {e.name: e for e in compare_fits(fitted(), fitted(), PACKAGE, G).effects}
    f = next(e for name, e in found.items() if 'frequency' in name and 'axial' in name)
    zeta = next(e for name, e in found.items() if 'damping' in name and 'axial' in name)
    assert_allclose(f.before_std / f.before, 0.005, rtol=1e-4)
    assert_allclose(zeta.before_std / zeta.before, np.hypot(0.01, 0.005), rtol=1e-4)
    # at rest the lip hangs m g / kz below its nominal place
    rest = found['shift of the lip at rest, hanging']
    assert_allclose(rest.before, 2.0 * G / K[2], rtol=1e-9)
    assert_allclose(rest.before_std / rest.before, 0.01, rtol=1e-4)


def test_modes_of_axial_and_torsion_are_those_of_one_mass():
    """Meet f = sqrt(k/m) / 2 pi and zeta = p / (2 sqrt(k m)), exact for these two."""
    found = {mode.direction: (mode.frequency, mode.damping) for mode in modes(
        Cup(np.diag(K), np.diag(P), 0.048), PACKAGE, G)}
    for name, k, p, m in (('axial', K[2], P[2], 2.0), ('torsion', K[5], P[5], 0.016)):
        assert_allclose(found[name][0], np.sqrt(k / m) / (2 * np.pi), rtol=1e-6)
        assert_allclose(found[name][1], p / (2 * np.sqrt(k * m)), rtol=1e-6)


def test_modes_of_bending_come_in_pairs_that_meet_a_beams_formula():
    """Find them twice where nothing tells x from y, as the 2x2 problem about the middle says."""
    plate = Package(2.0, np.diag([0.008, 0.008, 0.016]), np.array([0.0, 0.0, -0.03]))
    found = modes(Cup(np.diag(K), np.diag(P), 0.048), plate, 0.0)
    a = 0.03 + 0.024
    M = np.array([[2.0, 0.0], [0.0, 0.008]])
    stiffness = np.array([[K[0], K[0] * a], [K[0] * a, K[3] + K[0] * a**2]])
    squares = np.linalg.eigvals(np.linalg.solve(M, stiffness))
    expected = np.sort(np.sqrt(squares)) / (2 * np.pi)
    assert_allclose(sorted(m.frequency for m in found if m.direction in ('bending', 'lateral')),
                    np.repeat(expected, 2), rtol=1e-5)


def test_a_cup_that_only_bends_is_a_pendulum_with_a_spring():
    """Meet f = sqrt((k + m g a) / (I + m a^2)) / 2 pi, with a hinge in the middle of the cup."""
    stiff = Cup(np.diag([1e9, 1e9, 1e9, 4.0, 5.0, 1.2]), np.diag(P), 0.048)
    a = 0.03 + 0.024
    expected = [
        np.sqrt((k + 2.0 * G * a) / (inertia + 2.0 * a**2)) / (2 * np.pi)
        for k, inertia in ((4.0, 0.008), (5.0, 0.009))]
    found = sorted(
        mode.frequency for mode in modes(stiff, PACKAGE, G) if mode.direction == 'bending')
    assert_allclose(found, sorted(expected), rtol=1e-4)


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
