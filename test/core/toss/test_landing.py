"""How sure a landing is against Monte Carlo, and aiming against a scan of all times."""

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live.landing import landing as landing_live
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import release_factor, release_of, uncertain_of
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss import landing
from bellows_ros.core.toss.landing import TossProblem
from bellows_ros.core.toss.release import HeldMotion, toss
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from .. import tosses

MODEL = model_tuple(tosses.CUP, tosses.PACKAGE, 9.81)
VALUES = resolve({
    **tosses.values(), 'package.mass_std': 0.005, 'package.com_std': (5e-4, 5e-4, 5e-4)})


@pytest.fixture(scope='module')
def case():
    """Return the throw, released in the middle."""
    held = HeldMotion(MODEL, tosses.GRIP, tosses.plan())
    return TossProblem(
        held, release_of(VALUES), 0.5, uncertain_of(VALUES), release_factor(VALUES))


@pytest.mark.parametrize(('count', 'inside', 'within'), [
    (200, 0.06, 0.15),  # four deviations of what chance does to so many
    pytest.param(1000, 0.02, 0.03, marks=pytest.mark.stress),
])
def test_linear_against_monte_carlo_and_the_ellipse_is_true(case, count, inside, within):
    """Of 1,000 tosses standard deviations within 3 %, and 93 to 97 % in the ellipse."""
    if not COMPILED:
        pytest.skip('a thousand interpreted tosses take too long; see numba')
    nominal = toss(case.held, case.release, case.switched)
    covariance = landing.contributions_to(case, nominal).covariance
    drawn = landing.draw(case, nominal, count)
    assert drawn.failed == 0
    assert abs(landing.coverage(covariance, drawn.errors) - 0.95) <= inside
    linear, counted = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(drawn.covariance))
    assert linear[2] < 1e-12  # on the floor
    np.testing.assert_allclose(linear[[0, 1, 3, 4, 5]], counted[[0, 1, 3, 4, 5]], rtol=within)


def test_law_counts_in_the_node_as_in_a_plan(case):
    """Compare one-sided differences from the valve on with central ones of the whole toss."""
    steady = Trajectory(
        np.arange(1001) * 1_000_000, np.outer(np.arange(1001) * 1e-3, [0.4, 0.0, 0.0]) + [0, 0, 2],
        np.broadcast_to(np.eye(3), (1001, 3, 3)), np.tile([0.4, 0.0, 0, 0, 0, 0], (1001, 1)))
    held = HeldMotion(MODEL, tosses.GRIP, steady)
    case, k = case._replace(held=held), np.searchsorted(held.times, case.switched)
    thrown = toss(held, case.release, case.switched)
    _, expected = landing.contributions_to(case, thrown).of('release.')
    now = Prediction(1, *row_state(held.states[k]), ZERO, ZERO, row_state(held.tools[k]))
    found = landing_live(VALUES, MODEL, tosses.GRIP, now, np.zeros((12, 12)))
    np.testing.assert_allclose(found.body[0], thrown.landing[0], atol=1e-5)
    assert found.stamp_ns == pytest.approx(1e9 * (thrown.landing_time - case.switched), abs=1e4)
    std = np.sqrt(np.diag(expected)).clip(1e-4)  # m, rad
    np.testing.assert_allclose(
        (found.covariance - expected) / np.outer(std, std), 0.0, atol=5e-3)


@pytest.mark.parametrize(('target', 'turned'), [
    ((1.3, 0.1), False), ((1.75, 0.15), True),
    pytest.param((1.3, 0.1), True, marks=pytest.mark.stress),
    pytest.param((1.75, 0.15), False, marks=pytest.mark.stress)])
def test_aims_as_near_as_a_scan_of_all_times(case, target, turned):
    """Within 0.1 ms of the best of steps of 10 us."""
    held = case.held
    wanted = quaternion_to_rotation(np.array(
        toss(held, case.release, 0.45).landing[1])) if turned else None
    reach = np.linalg.norm(np.abs(tosses.CENTRE) + tosses.HALF)

    def distance(switched):
        found = toss(held, case.release, switched)
        off = np.hypot(*np.subtract(found.landing[0][:2], target))
        if wanted is None:
            return off
        R = quaternion_to_rotation(np.array(found.landing[1]))
        cosine = 0.5 * (np.trace(wanted.T @ R) - 1.0)
        return np.hypot(off, reach * np.arccos(np.clip(cosine, -1.0, 1.0)))

    every = 1e-4 if COMPILED else 2e-2
    rough = np.arange(0.0, tosses.DURATION, every)
    best = rough[np.argmin([distance(t) for t in rough])]
    fine = np.arange(max(0.0, best - every), best + every, 1e-5 if COMPILED else 1e-3)
    best = fine[np.argmin([distance(t) for t in fine])]
    found = landing.aim(held, case.release, target, wanted)
    assert abs(found.switched - best) <= (1e-4 if COMPILED else 1e-3)
    assert found.distance == pytest.approx(
        np.hypot(*np.subtract(toss(held, case.release, found.switched).landing[0][:2], target)),
        abs=1e-6)


def test_aim_without_a_landing_is_an_error(case):
    """The floor is above the package all the time."""
    with pytest.raises(BellowsError):
        landing.aim(case.held, case.release._replace(height=5.0), (1.0, 0.0))


def test_what_cannot_be_tossed_is_counted(case):
    """A valve that may not open in time fails now and then, and the rest counts."""
    nominal = toss(case.held, case.release, case.switched)
    loose = case._replace(factor=release_factor(VALUES.replaced({'release.delay_std': 0.4})))
    drawn = landing.draw(loose, nominal, 12, seed=1)
    assert 0 < drawn.failed < 12
    assert len(drawn.errors) == 12 - drawn.failed


def test_a_mass_beyond_the_drops_makes_the_law_of_release_less_certain():
    """Not within their range, twice as far in the logarithm twice as much more."""
    values = resolve({**tosses.values(), 'release.opening': 0.02, 'release.closing': 20.0,
                      'release.closing_std': 0.5})
    inside, near, far = (
        np.diag(release_factor(values.replaced({'release.mass_range': (0.1, heaviest)})))
        for heaviest in (2.0, 1.8 / 1.1, 1.8 / 1.21))
    np.testing.assert_allclose(inside, np.diag(release_factor(values)))
    np.testing.assert_allclose(far - inside, 2.0 * (near - inside), rtol=1e-9)
    assert (near[:2] > 1.15 * inside[:2]).all() and inside[4] == 0.5


def test_the_second_order_of_the_law_is_exact_for_a_quadratic(case, monkeypatch):
    """Compare with the moments of landings that are quadratic along the axes of the law."""
    rng = np.random.default_rng(5)
    sizes, axes = np.linalg.eigh(case.factor @ case.factor.T)
    kept = sizes > 1e-12 * sizes[-1]
    units = axes[:, kept] / np.sqrt(sizes[kept])  # z = units^T change is standard normal
    a, b = rng.standard_normal((2, 6, units.shape[1]))
    monkeypatch.setattr(landing, 'release_with', lambda release, by: by)
    monkeypatch.setattr(landing, 'toss', lambda held, by, switched: units.T @ by)
    monkeypatch.setattr(TossProblem, 'error', lambda self, z, nominal: a @ z + b @ z**2)
    monkeypatch.setattr(TossProblem, 'error_with', lambda self, *models: np.zeros(6))
    covariance = landing.contributions_to(case, None).covariance
    sums = b.sum(axis=1)
    np.testing.assert_allclose(covariance, a @ a.T + 2.0 * b @ b.T + np.outer(sums, sums),
                               rtol=1e-6)
