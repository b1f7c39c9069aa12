"""The scatter of a landing against its own draws, and aiming against a scan of all times."""

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live.landing import landing as landing_live
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import (
    MAX_DELAY,
    release_factor,
    release_of,
    uncertain_of,
    with_assumed_release,
)
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


@pytest.mark.skipif(not COMPILED, reason='interpreted tosses take too long; see numba')
def test_the_ellipse_holds_other_draws_and_the_budget_adds_up(case):
    """Of 600 others 95 %, the parts the whole: to three deviations of chance in 200 draws."""
    nominal = toss(case.held, case.release, case.switched)
    found, other = landing.scatter(case, nominal), landing.scatter(case, nominal, 600, seed=1)
    assert found.failed == 0
    assert abs(landing.coverage(found.covariance, other.errors) - 0.95) < 0.035
    assert found.covariance[2, 2] < 1e-20  # on the floor
    whole, (_, parts) = np.diag(found.covariance), found.of('')
    np.testing.assert_allclose(
        np.diag(parts)[[0, 1, 3, 4, 5]], whole[[0, 1, 3, 4, 5]], rtol=0.3)
    assert {'release.delay', 'release.fall', 'package.mass'} < set(found.names)
    delay = found.parts[found.names.index('release.delay')]
    later = toss(case.held, landing.release_with(case.release, np.eye(6)[0] * 5e-4), 0.5)
    np.testing.assert_allclose(
        delay[:2], np.subtract(later.landing[0], nominal.landing[0])[:2], atol=5e-5)


def test_law_counts_in_the_node_as_in_a_plan(case):
    """Compare differences from the valve on with draws of the whole toss."""
    steady = Trajectory(
        np.arange(1001) * 1_000_000, np.outer(np.arange(1001) * 1e-3, [0.4, 0.0, 0.0]) + [0, 0, 2],
        np.broadcast_to(np.eye(3), (1001, 3, 3)), np.tile([0.4, 0.0, 0, 0, 0, 0], (1001, 1)))
    held = HeldMotion(MODEL, tosses.GRIP, steady)
    k = np.searchsorted(held.times, case.switched)
    thrown = toss(held, case.release, case.switched)
    now = Prediction(1, *row_state(held.states[k]), ZERO, ZERO, row_state(held.tools[k]))
    found = landing_live(VALUES, MODEL, tosses.GRIP, now, np.zeros((12, 12)))
    np.testing.assert_allclose(found.body[0], thrown.landing[0], atol=1e-5)
    assert found.stamp_ns == pytest.approx(1e9 * (thrown.landing_time - case.switched), abs=1e4)
    drawn = landing.scatter(case._replace(
        held=held, uncertain=case.uncertain._replace(std=0.0 * case.uncertain.std)), thrown, 50)
    _, expected = drawn.of('release')
    std = np.sqrt(np.diag(expected)).clip(1e-4)  # m, rad
    np.testing.assert_allclose(
        (found.covariance - expected) / np.outer(std, std), 0.0, atol=0.05)


@pytest.mark.parametrize('target', [(1.3, 0.1), (1.75, 0.15)])
def test_aims_as_near_as_a_scan_of_all_times(case, target):
    """Within 0.2 ms of the best of steps of 0.1 ms."""
    held = case.held

    def distance(switched):
        found = toss(held, case.release, switched)
        return np.hypot(*np.subtract(found.landing[0][:2], target))

    every = 1e-4 if COMPILED else 2e-2
    rough = np.arange(0.0, tosses.DURATION, every)
    best = rough[np.argmin([distance(t) for t in rough])]
    found = landing.aim(held, case.release, target)
    assert abs(found.switched - best) <= 2.0 * every


def test_aim_without_a_landing_is_an_error(case):
    """The floor is above the package all the time."""
    with pytest.raises(BellowsError):
        landing.aim(case.held, case.release._replace(height=5.0), (1.0, 0.0))


def test_what_cannot_be_tossed_is_counted(case):
    """A valve that may not open in time fails now and then, and the rest counts."""
    nominal = toss(case.held, case.release, case.switched)
    loose = case._replace(factor=0.4 * np.eye(6)[:, :1] * np.eye(6)[0])
    drawn = landing.scatter(loose, nominal, 12, seed=1)
    assert 0 < drawn.failed < 12
    assert len(drawn.errors) == 12 - drawn.failed


@pytest.mark.parametrize(('delay', 'expected'), [(0.0, 0.5 * MAX_DELAY), (0.02, 0.02)])
def test_a_release_of_at_most_a_delay_is_anywhere_within_the_longest_delay(delay, expected):
    unknown = VALUES.replaced({
        'release.delay': delay, 'release.fall': 0.0, 'release.std': (0.0,) * 6})
    assumed = with_assumed_release(unknown)
    assert assumed.release.delay == expected
    assert release_factor(assumed)[0, 0] == pytest.approx(MAX_DELAY / 12.0**0.5)
    for known in ({'release.std': (1e-3, *(0.0,) * 5)}, {'release.fall': 0.03}):
        assert with_assumed_release(given := unknown.replaced(known)) is given


def test_a_mass_beyond_the_drops_makes_the_law_of_release_less_certain():
    """Not within their range, twice as far in the logarithm twice as much more."""
    values = resolve({**tosses.values(), 'release.opening': 0.02, 'release.closing': 20.0,
                      'release.std': (5e-4, 1e-3, 0.5, 0.0, 0.0, 0.0)})
    inside, near, far = (
        np.diag(release_factor(values.replaced({'release.mass_range': (0.1, heaviest)})))
        for heaviest in (2.0, 1.8 / 1.1, 1.8 / 1.21))
    np.testing.assert_allclose(inside, np.diag(release_factor(values)))
    np.testing.assert_allclose(far - inside, 2.0 * (near - inside), rtol=1e-9)
    assert (near[:2] > 1.15 * inside[:2]).all() and inside[2] == 0.5
