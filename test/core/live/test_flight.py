"""The live package from the valve to the floor against the toss of the whole plan."""

from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.live.flight import at_constant_velocity, Flight
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import largest_step, moved_by
from bellows_ros.core.model.simulation import row_state, tool_rows, ToolRows
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import release_factor, release_of
from bellows_ros.core.toss import release as tossing
from bellows_ros.core.toss.landing import release_with
from bellows_ros.core.toss.release import HeldMotion, toss
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from .. import tosses
from ..cases import messages

MODEL = model_tuple(tosses.CUP, tosses.PACKAGE, 9.81)
VALUES = resolve(tosses.values())
START_NS, PERIOD_NS, VALVE = 1_000_000_000, 2_000_000, 0.5


@pytest.fixture(scope='module')
def plan():
    """Return the throw at the rate of a robot driver."""
    return tosses.plan(500)


def held_at(held, seconds):
    """Return the prediction of a held package at a time."""
    i = int(np.searchsorted(held.times, seconds))
    return Prediction(
        START_NS, *row_state(held.states[i]), ZERO, ZERO, row_state(held.tools[i]))


def played(plan, flight, poses):
    """Play the throw, the valve being switched; return predictions and the states of each."""
    live = LivePredictor(tosses.CUP, tosses.PACKAGE, 9.81, 'tool')
    live.flight = flight
    live.expect_twists(True)
    _, o, q, v, w = messages(plan)
    found, states = [], []
    for k in range(poses):
        i, stamp = min(k, len(plan) - 1), START_NS + k * PERIOD_NS
        if stamp == START_NS + round(VALVE * 1e9):
            live.on_valve(False, stamp)
        twist = (v[i], w[i]) if k < len(plan) else (ZERO, ZERO)
        found += live.on_pose(stamp, 'world', o[i], q[i], stamp)
        found += live.on_twist(stamp, *twist)
        states.append(live.phase(stamp))
    return live, found, states


def test_flies_on_as_the_plan_has_it_until_it_lands(plan):
    """One prediction for each pose until landing, on the path of the toss; then the next one."""
    expected = toss(HeldMotion(MODEL, tosses.GRIP, plan), release_of(VALUES), VALVE)
    live, found, states = played(plan, Flight(VALUES), 520)
    times = {state: PERIOD_NS * 1e-9 * states.index(state) for state in states}
    assert list(times) == ['settling', 'released', 'flying', 'landed']
    assert times['flying'] == pytest.approx(expected.release_time, abs=2.1e-3)
    assert times['landed'] == pytest.approx(expected.landing_time, abs=2.1e-3)
    last = found[-1]
    left = expected.landing_time - (last.stamp_ns - START_NS) * 1e-9
    assert 0.0 <= left < 2.1e-3
    v = np.subtract(expected.landing[0], last.position) / left
    assert np.linalg.norm(v) == pytest.approx(np.linalg.norm(expected.landing[2]), rel=1e-2)
    assert last.force == (0.0, 0.0, 0.0)
    assert [p.stamp_ns for p in found] == [START_NS + k * PERIOD_NS for k in range(len(found))]
    live.on_valve(True, START_NS + 520 * PERIOD_NS)
    stamp = START_NS + 521 * PERIOD_NS
    xyzw = tuple(rotation_to_quaternion(plan.rotation[-1]).tolist())
    again = live.on_pose(stamp, 'world', tuple(plan.position[-1].tolist()), xyzw, stamp)
    again += live.on_twist(stamp, (0.0,) * 3, (0.0,) * 3)
    assert live.phase(stamp) == 'settling' and again[-1].linear == (0.0, 0.0, 0.0)


def worked_out(flight, now, std):
    """Return a landing and its covariance from one toss after the other, with NumPy."""
    release, longest = release_of(VALUES), 2.0 * largest_step(MODEL)
    axes = np.eye(len(tossing.DIFFERENCE_STEPS))

    def landing(body, release):
        return tossing.toss_along(
            (MODEL, tosses.GRIP, release, 0.0), 0.0, now.tool, body,
            (np.empty((0, 13)), np.empty(0), flight._ahead, longest))[3]

    nominal, by = landing(now.body, release), []
    for size, push in zip(tossing.DIFFERENCE_STEPS, axes, strict=True):
        found = landing(moved_by(now.body, size * push),
                        release_with(release, release_factor(VALUES) @ (size * push[12:])))
        by.append(np.concatenate(tossing.landing_error(found, nominal, MODEL[2])) / size)
    J = np.transpose(by) * np.append(std, np.ones(8))
    return np.concatenate(nominal), J @ J.T


def test_says_where_it_would_land_now_and_how_sure_that_is(plan):
    """The landing of a toss with the tool going on steadily; J Sigma J^T of state and release."""
    held = HeldMotion(MODEL, tosses.GRIP, plan)
    now = held_at(held, VALVE)
    flight = Flight(VALUES)
    std = np.repeat([1e-4, 1e-3, 2e-3, 1e-2], 3)
    found = flight.landing(MODEL, now, lambda _: np.diag(std**2))
    tool = at_constant_velocity(now, None, 0.5)
    steady = HeldMotion(MODEL, tosses.GRIP, tool, now.body, 0.5)
    expected = toss(steady, release_of(VALUES), 0.0)
    np.testing.assert_allclose(found.toss.landing[0], expected.landing[0], atol=1e-7)
    landing, covariance = worked_out(flight, now, std)
    np.testing.assert_allclose(np.concatenate(found.toss.landing), landing, atol=1e-12)
    deviations = np.sqrt(np.diag(covariance))
    off = np.abs(found.covariance - covariance)
    # Landings, some metres away after hundreds of steps, are rounded to 1e-14 to 1e-13, in another
    # order where the compiler has inlined; pushes are about as long as deviations, some 1e-3.
    assert (off <= 1e-10 * np.outer(deviations, deviations)).all()
    rng = np.random.default_rng(3)
    landings = []
    for _ in range(400):
        start = moved_by(now.body, std * rng.standard_normal(12))
        release = release_with(
            release_of(VALUES), release_factor(VALUES) @ rng.standard_normal(8))
        held = HeldMotion(MODEL, tosses.GRIP, tool, start, 0.5)
        landings.append(toss(held, release, 0.0).landing[0][:2])
    linear = np.sqrt(np.diag(found.covariance)[:2])
    np.testing.assert_allclose(linear, np.std(landings, axis=0), rtol=0.12)  # 3.5 % each, 400


def test_uncertain_progress_on_the_plan_is_part_of_the_covariance(plan):
    """A plan that is two periods late with one standard deviation: by that landing's error."""
    held = HeldMotion(MODEL, tosses.GRIP, plan)
    now, rows = held_at(held, VALVE), tool_rows(plan)
    first = round(VALVE / (PERIOD_NS * 1e-9))

    def ahead(deviations):
        i = first + 1 - round(2 * deviations)
        return ToolRows(np.append(0, np.arange(1, len(rows) - i + 1) * PERIOD_NS),
                        np.vstack([np.concatenate(now.tool), rows[i:]]))

    def found(future):
        return Flight(VALUES, future).landing(MODEL, now, lambda _: np.zeros((12, 12)))

    sure = found(lambda now, deviations: ahead(0.0))
    late = found(lambda now, deviations: ahead(1.0))
    unsure = found(lambda now, deviations: ahead(deviations))
    error = np.concatenate(tossing.landing_error(late.toss.landing, sure.toss.landing, MODEL[2]))
    assert np.linalg.norm(error[:3]) > 1e-3
    np.testing.assert_allclose(unsure.covariance - sure.covariance, np.outer(error, error),
                               atol=1e-9)


@pytest.mark.parametrize('asked', [255, 300])
def test_says_where_it_will_be_once_the_valve_is_switched(plan, asked):
    """Before the cup has let go and after, as it comes; not once it has landed."""
    def as_planned(now, deviations):
        i = (now.stamp_ns - START_NS) // PERIOD_NS
        return ToolRows(plan.stamps_ns[i:] - plan.stamps_ns[i], tool_rows(plan)[i:])

    flight = Flight(VALUES, as_planned)
    live, found, states = played(plan, flight, asked + 1)
    now, truth = found[-1], played(plan, Flight(VALUES), 520)[1]
    assert states[-1] == ('released' if asked == 255 else 'flying')
    for later in (asked + 30, asked + 120):
        o, q, v, w = flight.later(live.model, now, (later - asked) * PERIOD_NS * 1e-9)
        np.testing.assert_allclose(o, truth[later].position, atol=1e-6)
        np.testing.assert_allclose(q, truth[later].quaternion_xyzw, atol=1e-5)
        np.testing.assert_allclose([*v, *w], [*truth[later].linear, *truth[later].angular],
                                   atol=1e-4)
    if asked == 255:
        early = flight.later(live.model, now, PERIOD_NS * 1e-9)
        np.testing.assert_allclose(early[0], truth[256].position, atol=1e-6)
    with pytest.raises(BellowsError):
        flight.later(live.model, now, 2.0)


def test_says_when_to_release_for_a_target(plan):
    """In so many seconds, where the target lies ahead; nothing without one."""
    held = HeldMotion(MODEL, tosses.GRIP, plan)
    now = held_at(held, 0.3)
    steady = HeldMotion(MODEL, tosses.GRIP, at_constant_velocity(now, None, 0.8), now.body, 0.8)
    target = toss(steady, release_of(VALUES), 0.123).landing[0][:2]
    aimed = Flight(VALUES.replaced({'landing.aim': True, 'landing.target': target}))
    assert aimed.time_to_target(MODEL, now) == pytest.approx(0.123, abs=1e-4)
    assert Flight(VALUES).time_to_target(MODEL, now) is None
    unknown = Flight(VALUES.replaced({'package.size': (0.0, 0.0, 0.0)}))
    assert unknown.landing(MODEL, now, lambda _: np.zeros((12, 12))) is None
