"""Where on its plan the tool is, however it is driven, and what is left of the plan then."""

from itertools import product

from bellows_ros.core.geometry.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import scale, ZERO
from bellows_ros.core.live import LivePredictor, Prediction
from bellows_ros.core.live.flight import at_constant_velocity, Flight
from bellows_ros.core.live.plan_tracker import PlanTracker, point_at
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.planning.points import plan_of
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


SHAPES = ('move', 'dwell', 'way back')
DRIVERS = ('on time', 'late', 'pause', 'waits', 'detour')
SLOWEST = 0.05  # m/s of the plan: above it the poses determine the progress


def plan_points(shape, rate_hz):
    """Return a plan of a shape: one move, or there and back with a dwell of 0.5 s or none."""
    dwell = 0.5 if shape == 'dwell' else 0.0
    end = 0.8 if shape == 'move' else 1.6 + dwell
    times = np.linspace(0.0, end, round(end * rate_hz) + 1)
    back = times > 0.8 + 0.5 * dwell
    o, R, v = MOVE.at(np.where(back, end - times, np.minimum(times, 0.8)))
    v = v * np.where(back, -1.0, 1.0)[:, None] * ((times <= 0.8) | (times >= end - 0.8))[:, None]
    poses = np.hstack([o, rotation_to_quaternion(R)])
    return plan_of(np.round(times * 1e9).astype(np.int64), poses, v, twist_frame='tool')


def time_on_plan(driver, speed, end):
    """Return the plan's time, and its rate, as functions of the time (s), and when it ends."""
    late = 0.4 if driver == 'late' else 0.0
    if driver in ('pause', 'waits'):  # amid the first move, or where the plan stands or turns
        begin = (0.4 if driver == 'pause' else 0.85) / speed
        at = ahead_of_time(pause=(begin, begin + 0.4), speed=speed)
    else:
        at = ahead_of_time(late, speed)
    return at, late + end / speed + (0.5 if driver in ('pause', 'waits') else 0.0)


def follow_driven(tracker, pose_hz, speed, driver, noise=0.0):
    """Yield time, true time on the plan and its speed there (m/s), after each pose of the tool."""
    plan, rng = tracker.plan, np.random.default_rng(7)
    at, arrival = time_on_plan(driver, speed, float(plan.seconds[-1]))
    for k in range(round((arrival + 0.2) * pose_hz)):
        t = k / pose_hz
        truth, rate = (float(x) for x in at(t))
        o, q, v, w = point_at(plan.rows, plan.seconds, truth)
        aside = 0.1 if driver == 'detour' and 0.3 < truth < 0.5 else 0.0
        draws = noise * rng.standard_normal((2, 3))
        tool = (tuple(o + draws[0] + [0.0, 0.0, aside]), q,
                tuple(np.multiply(rate, v) + 100.0 * draws[1]), scale(rate, w))
        tracker.follow(driven(0.0)._replace(stamp_ns=T0 + round(t * 1e9), tool=tool))
        assert (tracker.state == 'deviated') == (aside > 0.0)
        if not aside:
            yield t, truth, np.hypot(np.linalg.norm(v), 0.1 * np.linalg.norm(w))


def require_tracked(pose_hz, plan_hz, speed, shape, driver, noise=0.0):
    plan = plan_points(shape, plan_hz)
    tracker = PlanTracker(plan, T0 if driver == 'on time' else 0)
    allowed, states, end = 1e-3 * max(1.0, 500.0 / pose_hz), [], float(plan.seconds[-1])
    for t, truth, plan_speed in follow_driven(tracker, pose_hz, speed, driver, noise):
        states.append(tracker.state)
        if driver == 'waits' and plan_speed <= 2.0 * SLOWEST:
            continue  # no pose shows that a driver waits where the plan stands
        error = abs(tracker.progress.time - min(truth, end))
        std = tracker.progress.variance**0.5
        most = allowed if plan_speed > SLOWEST and not noise else allowed + 4.0 * std
        assert error <= most, (t, truth, shape, driver, tracker.progress)
    assert tracker.state == 'done'
    assert driver != 'pause' or 'paused' in states


@pytest.mark.parametrize(('pose_hz', 'plan_hz', 'speed'), [
    (62.5, 10, 0.3), (62.5, 500, 1.2), (250, 100, 0.6), (500, 10, 1.0), (500, 250, 0.6)])
def test_progress_is_the_true_time_on_the_plan(pose_hz, plan_hz, speed):
    """To 1 ms at 500 Hz where the plan moves, to four standard deviations always; then done."""
    for shape, driver in product(SHAPES, DRIVERS):
        require_tracked(pose_hz, plan_hz, speed, shape, driver)


@pytest.mark.stress
@pytest.mark.parametrize(('pose_hz', 'plan_hz', 'speed'), list(product(
    [62.5, 125, 250, 500, 1000], [10, 30, 100, 250, 500], [0.3, 0.6, 1.0, 1.2])))
def test_progress_in_the_whole_matrix(pose_hz, plan_hz, speed):
    for shape, driver, noise in product(SHAPES, DRIVERS, (0.0, 3e-5)):
        require_tracked(pose_hz, plan_hz, speed, shape, driver, noise)


def test_stated_variance_of_the_progress_covers_its_errors():
    """With noise on pose and twist: nine in ten within two deviations."""
    ratios = []
    for shape, driver in product(SHAPES, DRIVERS):
        tracker = PlanTracker(plan_points(shape, 100), 0)
        for _, truth, speed in follow_driven(tracker, 250, 1.0, driver, 3e-5):
            if speed > SLOWEST and tracker.state == 'driven':
                ratios.append((tracker.progress.time - truth) / tracker.progress.variance**0.5)
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.3
    assert np.mean(np.abs(ratios) < 2.0) > 0.9


def test_stated_deviation_of_the_future_covers_its_error():
    """0.3 s ahead of a noisy tool at an unknown rate: by progress and by rate."""
    ratios = []
    for speed in (0.6, 0.8, 1.0, 1.2):
        tracker = PlanTracker(plan_points('move', 100), 0)
        at = time_on_plan('late', speed, 0.8)[0]
        for t, truth, _ in follow_driven(tracker, 250, speed, 'late', 3e-5):
            if tracker.state == 'driven' and 0.1 < truth < 0.75 - 0.3 * speed:
                now = driven(0.0)._replace(stamp_ns=T0 + round(t * 1e9), tool=point_at(
                    tracker.plan.rows, tracker.plan.seconds, truth))
                nominal, late = (
                    at_constant_velocity(now, tracker.rest(now, deviations=d), 0.3)
                    for d in (0.0, 1.0))
                o, o_late = (np.array(point_at(tool.rows, tool.seconds, 0.3)[0])
                             for tool in (nominal, late))
                actual = MOVE.at(np.array([float(at(t + 0.3)[0])]))[0][0]
                ratios.append(np.linalg.norm(o - actual) / np.linalg.norm(o_late - o))
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_the_future_is_the_plan_and_then_standing():
    ahead, now = PlanTracker(MOVE.plan(250), T0), driven(0.4)
    ahead.follow(now)
    for duration in (0.1, 0.4, 2.0):
        tool = at_constant_velocity(now, ahead.rest(now), duration).trajectory()
        assert tool.stamps_ns[0] == 0 and tool.stamps_ns[-1] >= round(duration * 1e9)
        truth = driven(min(0.4 + tool.seconds[-1], 0.8)).tool
        assert_allclose(tool.position[-1], truth[0], atol=2e-4)
        assert_allclose(tool.rotation[-1], quaternion_to_rotation(np.array(truth[1])), atol=1e-3)


def test_a_tool_off_the_plan_returns_smoothly():
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
        return stood * speed, rate * speed
    return at


@pytest.mark.parametrize(('driven_as', 'stamped', 'every'), [
    ({}, False, 1), ({'late': 0.3}, True, 25), ({'speed': 0.5, 'late': 0.2}, False, 25),
    ({'pause': (0.35, 0.8)}, True, 1)])
def test_the_package_agrees_with_the_prediction(driven_as, stamped, every):
    """
    Say it 0.1 s before: to 0.5 mm, where the tool goes on as it did for as long.

    To 1.5 mm at poses some time after that at which the tool was found on the plan.
    """
    at, step = ahead_of_time(**driven_as), 0.002
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.expect_twists(True)
    ahead = PlanTracker(MOVE.plan(500), T0 if stamped else 0)
    flight = Flight(resolve(TOSSED), lambda now, deviations: (
        ahead.rest(now, deviations=deviations) if ahead.is_driven(now) else None))
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
        assert ahead.is_driven(now) is is_driven and ahead.progress.time == 0.0
        assert ahead.rest(now).stamps_ns[-1] <= round(6e9)  # nor is there ever a long wait


def test_a_tool_that_comes_to_the_plan_later_is_followed_from_its_start():
    """Although before it was nearest to the plan's middle."""
    ahead = PlanTracker(MOVE.plan(250), 0)
    ahead.follow(driven(0.4, off=(0.0, 0.0, 0.2)))
    assert ahead.state == 'deviated'
    for t in (0.0, 0.1, 0.2, 0.3):
        ahead.follow(driven(t)._replace(stamp_ns=T0 + 10**10 + round(t * 1e9)))
    assert abs(ahead.progress.time - 0.3) < 2e-3 and ahead.state == 'driven'
