"""Where on its plan the tool is, however it is driven, and what is left of the plan then."""

from types import SimpleNamespace

from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import LivePredictor, Prediction
from bellows_ros.core.live.flight import at_constant_velocity, Flight
from bellows_ros.core.live.plan_tracker import PlanTracker
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..cases import messages, state_of
from ..plans import CUP, Move, PACKAGE, VALUES

MODEL = model_tuple(CUP, PACKAGE, 9.81)
T0 = 1_700_000_000_000_000_000
TOSSED = VALUES.replaced({'package.size': [0.1, 0.1, 0.1], 'landing.height': -9.0})
MOVE = Move([0.5, -0.2, 0.1], [0.2, 0.0, 0.6], 0.8)


def driven(seconds, speed=1.0, late=0.0, move=MOVE, off=(0.0, 0.0, 0.0)):
    """Return the tool at a time since T0, the plan being driven late and scaled."""
    o, R, v = move.at(np.array([max(0.0, (seconds - late) * speed)]))
    tool = state_of(o[0] + off, R[0], v[0] * speed)
    return Prediction(T0 + round(seconds * 1e9), ZERO, (0.0, 0.0, 0.0, 1.0), ZERO, ZERO, ZERO,
                      ZERO, tool)


@pytest.mark.parametrize(('speed', 'late'), [(1.0, 0.0), (1.0, 0.4), (0.5, 0.0), (0.5, 1.3)])
@pytest.mark.parametrize('stamp_ns', [0, T0])
def test_follows_the_tool_and_not_the_clock(speed, late, stamp_ns):
    """Late and at half speed: to 2 ms of the plan, and its rest is where the tool will be."""
    ahead = PlanTracker(MOVE.plan(250), stamp_ns)
    for k in range(round(20 * (late + 0.8 / speed)) - 1):
        t = 0.05 * (k + 1)
        now = driven(t, speed, late)
        ahead.follow(now)
        truth = max(0.0, (t - late) * speed)
        if 0.06 < truth < 0.74:
            assert abs(ahead.progress - truth) < 2e-3
        if 0.3 < truth < 0.7:
            assert abs(ahead._anchor[2] - speed) < 0.02
            rest = ahead.rest(now).trajectory()
            for after in rest.seconds[1:-1:7]:
                later = driven(t + after, speed, late)
                place = rest.position[np.argmin(np.abs(rest.seconds - after))]
                assert np.linalg.norm(place - later.tool[0]) < 5e-3
        assert not ahead.deviated and not ahead.done
    for after in (0.0, 0.05, 0.1):  # at its end it creeps
        ahead.follow(driven(late + 0.8 / speed + after, speed, late))
    assert ahead.done


def test_a_plan_that_comes_back_is_followed_back():
    """The same places on the way there and back, with a stop in between."""
    there = Move([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)

    def at(t):
        o, R, v = there.at(np.where(t < 0.5, t, np.where(t < 0.9, 0.5, 1.4 - t)))
        return o, R, np.where(t < 0.9, 1.0, -1.0)[:, None] * v

    t = np.linspace(0.0, 1.4, 701)
    ahead = PlanTracker(Trajectory(np.round(t * 1e9).astype(np.int64), *at(t)), 0)
    for k in range(1, 140):
        t = 0.01 * k
        ahead.follow(driven(t, move=SimpleNamespace(at=at)))
        if not 0.46 < t < 0.94 and t > 0.04:
            assert abs(ahead.progress - t) < 4e-3, t


def test_the_future_is_the_plan_and_then_standing():
    ahead, now = PlanTracker(MOVE.plan(250), T0), driven(0.4)
    ahead.follow(now)
    for duration in (0.1, 0.4, 2.0):
        tool = at_constant_velocity(now, ahead.rest(now), duration).trajectory()
        assert tool.stamps_ns[0] == 0 and tool.stamps_ns[-1] >= round(duration * 1e9)
        truth = driven(min(0.4 + tool.seconds[-1], 0.8)).tool
        assert_allclose(tool.position[-1], truth[0], atol=2e-4)
        assert_allclose(tool.rotation[-1], quaternion_to_rotation(np.array(truth[1])), atol=1e-3)


def test_a_tool_beside_the_plan_comes_back_to_it_smoothly():
    ahead, now = PlanTracker(MOVE.plan(250), T0), driven(0.4, off=(0.0, 0.0, 0.004))
    ahead.follow(now)
    rest = ahead.rest(now).trajectory()
    assert_allclose(rest.position[0], now.tool[0])
    fine = resample(rest, np.arange(0, int(rest.stamps_ns[-1]), 1_000_000))
    speed = np.linalg.norm(np.diff(fine.position, axis=0), axis=1) / 1e-3
    assert speed.max() < 1.3 * np.linalg.norm(MOVE.at(np.linspace(0, 0.8, 99))[2][:, :3],
                                              axis=1).max()


def ahead_of_time(late=0.0, speed=1.0, pause=None):
    """Return time in the plan, and its rate, of a tool that starts late, is slow, or pauses."""
    def at(t):
        t = np.maximum(0.0, np.asarray(t) - late)
        if pause is None:
            return t * speed, np.where(t > 0.0, speed, 0.0)
        brake, begin, end = 0.05, pause[0], pause[1]  # from full speed to none, and back
        x = np.clip((t - begin) / brake, 0.0, 1.0)
        y = np.clip((t - end) / brake, 0.0, 1.0)
        rate = 1.0 - (3.0 * x * x - 2.0 * x**3) + (3.0 * y * y - 2.0 * y**3)
        stood = np.minimum(t, begin) + brake * (x - x**3 + 0.5 * x**4) + (
            brake * (y**3 - 0.5 * y**4) + np.maximum(t - end - brake, 0.0))
        return stood, rate
    return at


@pytest.mark.parametrize(('driven_as', 'stamped', 'every'), [
    ({}, False, 1), ({'late': 0.3}, True, 25), ({'speed': 0.5, 'late': 0.2}, False, 25),
    ({'pause': (0.35, 0.8)}, True, 1)])
def test_the_package_is_where_it_was_said_to_be(driven_as, stamped, every):
    """
    Say it 0.1 s before: to 0.5 mm, where the tool goes on as it did for as long.

    To 1.5 mm at poses some time after that at which the tool was found on the plan.
    """
    at, step = ahead_of_time(**driven_as), 0.002
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.expect_twists(True)
    ahead = PlanTracker(MOVE.plan(500), T0 if stamped else 0)
    flight = Flight(resolve(TOSSED), lambda now: ahead.rest(now) if ahead.is_driven(now) else None)
    times = step * np.arange(round(1.8 / step))
    seconds, rates = at(times)
    o, R, v = MOVE.at(np.minimum(seconds, 0.8))
    v = v * (rates * (seconds < 0.8))[:, None]
    tool, seen, said = Trajectory(np.round(times * 1e9).astype(np.int64), o, R, v), [], {}
    for k, (stamp, place, q, linear, angular) in enumerate(zip(*messages(tool, T0), strict=True)):
        live.on_pose(stamp, 'world', place, q)
        seen += live.on_twist(stamp, linear, angular)
        if k % every == 0:
            ahead.follow(seen[-1])
        if k % 25 == 12 and k + 50 < len(times) and np.ptp(rates[k - 12:k + 51]) < 1e-9 and (
                seconds[k] > 0.1 or (seconds[k] == 0.0 and times[k] > 0.14)):
            said[k] = flight.later(MODEL, seen[-1], 0.1)
    errors = {k: np.linalg.norm(np.subtract(body[0], seen[k + 50].position))
              for k, body in said.items()}
    assert len(errors) > 15 and max(errors.values()) < (5e-4 if every == 1 else 1.5e-3), errors


def test_a_tool_that_waits_for_a_plan_without_a_stamp_stands():
    """Take the plan as driven once the tool moves, or is about to by the plan's stamp."""
    for stamp_ns, is_driven in ((0, False), (T0 + 5 * 10**9, True), (T0 + 10**17, False)):
        ahead = PlanTracker(MOVE.plan(250), stamp_ns)
        for t in (0.0, 0.1, 0.2):
            ahead.follow(driven(0.0)._replace(stamp_ns=T0 + round(t * 1e9)))
        now = driven(0.0)._replace(stamp_ns=T0 + 200_000_000)
        assert ahead.is_driven(now) is is_driven and ahead.progress == 0.0
        assert ahead.rest(now).stamps_ns[-1] <= round(6e9)  # nor is there ever a long wait


def test_a_tool_that_comes_to_the_plan_later_is_followed_from_its_start():
    """Although before it was nearest to the plan's middle."""
    ahead = PlanTracker(MOVE.plan(250), 0)
    ahead.follow(driven(0.4, off=(0.0, 0.0, 0.2)))
    assert ahead.deviated
    for t in (0.0, 0.1, 0.2, 0.3):
        ahead.follow(driven(t)._replace(stamp_ns=T0 + 10**10 + round(t * 1e9)))
    assert abs(ahead.progress - 0.3) < 2e-3 and not ahead.deviated
