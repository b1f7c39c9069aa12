"""The toss: letting go and landing against SciPy with events, the flight against its constants."""

import math

from bellows_ros.core.geometry.lie import exp_so3, log_so3, quaternion_to_rotation
from bellows_ros.core.model.cup_package import model_tuple, Package
from bellows_ros.core.model.grip import NO_LAW
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import release_of
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss.free_flight import flight
from bellows_ros.core.toss.release import HeldMotion, toss
from bellows_ros.errors import NoLandingError
import numpy as np
import pytest

from .. import tosses

MODEL = model_tuple(tosses.CUP, tosses.PACKAGE, 9.81)
RELEASE = release_of(resolve(tosses.values()))


@pytest.fixture(scope='module')
def held():
    """Return the package along the throw."""
    return HeldMotion(MODEL, tosses.GRIP, tosses.plan())


def plain(row):
    """Return a state row with the rotation's nine entries."""
    return np.concatenate([row[:3], quaternion_to_rotation(row[3:7]).ravel(), row[7:]])


def turned(rotation, state):
    """Return the angle (rad) between a rotation and that of a state."""
    return np.linalg.norm(log_so3(rotation.T @ quaternion_to_rotation(np.array(state[1]))))


@pytest.mark.parametrize('switched', [
    0.5, *(pytest.param(time, marks=pytest.mark.stress) for time in (0.25, 0.61))])
def test_release_and_landing_agree_with_an_independent_integrator(held, switched):
    """The instant to 1 us, the place to 1 um, the rotation to 10 urad."""
    found = toss(held, RELEASE, switched)
    released, landed = tosses.integrate(
        plain(held.states[0]), switched, RELEASE.law, RELEASE.height)
    assert found.release_time > switched + RELEASE.law[0]
    assert abs(found.release_time - released[0]) < 1e-6
    assert abs(found.landing_time - landed[0]) < 1e-6
    assert np.abs(found.landing[0] - landed[1]).max() < 1e-6
    assert turned(landed[2], found.landing) < 1e-5
    assert np.abs(np.concatenate(found.landing[2:]) - landed[3]).max() < 1e-5


@pytest.mark.parametrize('delay', [0.0103, 0.0107])
@pytest.mark.parametrize('fall', [0.0, 1e-4])
def test_a_sudden_end_of_the_suction_lets_go_at_its_instant(held, delay, fall):
    """The delay between the steps of the search: the delay alone, or SciPy, to 1 us."""
    law = (delay, fall, *NO_LAW[2:])
    found = toss(held, RELEASE._replace(law=law), 0.5).release_time
    expected = 0.5 + delay
    if fall:
        (expected, *_), _ = tosses.integrate(plain(held.states[0]), 0.5, law, RELEASE.height)
    assert abs(found - expected) < 1e-6


OPENS = (0.015, 0.02, 60.0, 0.02, 30.0, 1.5)
"""A cup that opens by some 20 mm under a blow-off."""


def test_a_cup_that_opens_lets_go_and_lands_where_an_independent_integrator_says(held):
    """Swinging, tilted: the instant to 10 us, the place to 20 um, the rotation to 0.3 mrad."""
    release = RELEASE._replace(law=OPENS)
    found = toss(held, release, 0.5)
    released, landed = tosses.integrate(plain(held.states[0]), 0.5, OPENS, release.height)
    assert found.release_time - 0.5 > 0.04
    assert abs(found.release_time - released[0]) < 1e-5
    assert abs(found.landing_time - landed[0]) < 5e-5
    assert np.abs(np.array(found.release[0]) - released[1]).max() < 2e-5
    assert np.abs(np.array(found.landing[0]) - landed[1]).max() < 5e-5
    assert turned(landed[2], found.landing) < 3e-4
    _, late = held.along(release._replace(law=(0.2, *OPENS[1:])), 0.5, held.times)
    before = held.times < 0.7  # the delay
    np.testing.assert_allclose(late[before], held.states[before], atol=1e-10)


def test_a_plan_that_begins_later_is_tossed_in_its_own_time(held):
    """With a first point at 0.5 s all times are 0.5 s later, and the landing is the same."""
    late = HeldMotion(MODEL, tosses.GRIP, tosses.plan(), begin=0.5)
    expected, found = toss(held, RELEASE, 0.4), toss(late, RELEASE, 0.9)
    assert found.release_time == pytest.approx(expected.release_time + 0.5, abs=1e-9)
    assert found.landing_time == pytest.approx(expected.landing_time + 0.5, abs=1e-9)
    np.testing.assert_allclose(found.landing[0], expected.landing[0], atol=1e-9)
    seconds = 0.5 + np.arange(0.0, 1.0, 0.1)
    for one, other in zip(held.along(RELEASE, 0.4, seconds - 0.5),
                          late.along(RELEASE, 0.9, seconds), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    with pytest.raises(NoLandingError, match='0.4 s.* 0.5 to 1.5 s'):
        toss(late, RELEASE, 0.4)


def test_without_a_grip_it_is_let_go_as_the_suction_ends():
    found = toss(HeldMotion(MODEL, None, tosses.plan()), RELEASE, 0.4)
    assert abs(found.release_time - 0.4 - RELEASE.law[0] - RELEASE.law[1]) < 1e-9


def test_a_grip_that_is_lost_before_is_found(held):
    """The first point with a load above the suction, and the release at the valve."""
    weak = HeldMotion(MODEL, (60.0, *tosses.GRIP[1:]), tosses.plan())
    early = weak.lost_before(1.0)
    assert toss(weak, RELEASE, early + 1e-4).release_time == pytest.approx(early + 1e-4, abs=1e-9)
    later = toss(weak, RELEASE, early - 5e-3).release_time
    assert early - 5e-3 < later <= early + 1e-3
    assert held.lost_before(1.0) is None


@pytest.mark.parametrize('rate', [(0.5, 9.0, 0.4), (8.0, -7.0, 5.0), (0.0, 0.0, 0.0)])
def test_the_flight_keeps_energy_and_angular_momentum(rate):
    """Over 2 s to 1e-10, about an unsteady axis too; the centre of mass follows the parabola."""
    R = exp_so3(np.array([0.3, 0.5, -0.2]))
    inertia = R @ np.diag([0.00438, 0.00654, 0.00984]) @ R.T
    package = Package(1.8, inertia, (0.0, 0.0, -0.03))
    start = ((0.0, 0.1, 2.0), (0.1, 0.2, 0.3, math.sqrt(0.86)), (1.0, 0.5, 2.0), rate)
    gravity = (0.0, 0.0, -9.81)
    end = flight(package.as_tuple, gravity, start, 2.0, 0.01)

    def constants(state):
        o, q, v, w = (np.array(part) for part in state)
        turn = quaternion_to_rotation(q)
        spin = 0.5 * w @ inertia @ w
        return 0.9 * v @ v + 1.8 * 9.81 * o[2] + spin, spin, turn @ inertia @ w, turn @ v

    before, after = constants(start), constants(end)
    assert after[0] == pytest.approx(before[0], rel=1e-10)
    assert after[1] == pytest.approx(before[1], rel=1e-10, abs=1e-14)
    assert np.linalg.norm(after[2] - before[2]) <= 1e-10 * np.linalg.norm(before[2])
    fallen = before[3] * 2.0 + 0.5 * np.array(gravity) * 4.0
    np.testing.assert_allclose(np.array(end[0]) - start[0], fallen, atol=1e-11)


def test_in_a_tilted_world_the_same_package_lands_on_the_same_floor(held):
    """Where gravity points elsewhere, height is measured against it."""
    Q = exp_so3(np.array([0.9, -0.4, 0.3]))
    plan = tosses.plan()
    tilted = Trajectory(
        plan.stamps_ns, plan.position @ Q.T, Q @ plan.rotation, plan.twist)
    model = model_tuple(tosses.CUP, tosses.PACKAGE, Q @ tosses.GRAVITY_VECTOR)
    expected = toss(held, RELEASE, 0.5)
    found = toss(HeldMotion(model, tosses.GRIP, tilted), RELEASE, 0.5)
    assert found.landing_time == pytest.approx(expected.landing_time, abs=1e-8)
    np.testing.assert_allclose(found.landing[0], Q @ expected.landing[0], atol=1e-7)


@pytest.mark.parametrize('switched, change, named', [
    (1.2, {}, '1.2 s.* 0 to 1 s'), (-0.1, {}, '-0.1 s.* 0 to 1 s'),
    (0.5, {'height': 2.0}, r'landing\.height is 2 m'),
    (0.5, {'law': (0.0, 1e9, *NO_LAW[2:])}, r'2\.5 s .*release\.fall')])
def test_refuses_what_is_no_toss(held, switched, change, named):
    with pytest.raises(NoLandingError, match=named):
        toss(held, RELEASE._replace(**change), switched)


def test_refuses_a_plan_that_ends_in_motion_before_it_lets_go():
    """Nothing is known of the tool after the end."""
    plan = tosses.plan()
    with pytest.raises(NoLandingError, match=r'0\.009 s .* 0\.49 s'):
        toss(HeldMotion(MODEL, tosses.GRIP, plan.select(slice(500))), RELEASE, 0.49)
