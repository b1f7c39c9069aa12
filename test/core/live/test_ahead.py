"""Where on its plan the tool is, however it is driven, and what is left of the plan then."""

from bellows_ros.core.geometry.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor, Prediction
from bellows_ros.core.live.ahead import Ahead
from bellows_ros.core.live.flight import steadily
from bellows_ros.core.live.samples import ZERO
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.planning.plan import predict
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..plans import CUP, Move, PACKAGE

MODEL = model_tuple(CUP, PACKAGE, 9.81)
T0 = 1_700_000_000_000_000_000
MOVE = Move([0.5, -0.2, 0.1], [0.2, 0.0, 0.6], 0.8)


def driven(seconds, speed=1.0, late=0.0, move=MOVE, off=(0.0, 0.0, 0.0)):
    """Return the tool at a time since T0, the plan being driven late and scaled."""
    o, R, v = move.at(np.array([max(0.0, (seconds - late) * speed)]))
    q = rotation_to_quaternion(R)[0].tolist()
    v = (v[0] * speed).tolist()
    tool = (tuple((o[0] + off).tolist()), tuple(q), tuple(v[:3]), tuple(v[3:]))
    return Prediction(T0 + round(seconds * 1e9), ZERO, (0.0, 0.0, 0.0, 1.0), ZERO, ZERO, ZERO,
                      ZERO, tool)


@pytest.mark.parametrize(('speed', 'late'), [(1.0, 0.0), (1.0, 0.4), (0.5, 0.0), (0.5, 1.3)])
@pytest.mark.parametrize('stamp_ns', [0, T0])
def test_follows_the_tool_and_not_the_clock(speed, late, stamp_ns):
    """Late and at half speed: to 2 ms of the plan, and its rest is where the tool will be."""
    ahead = Ahead(MOVE.plan(250), stamp_ns)
    for k in range(round(20 * (late + 0.8 / speed)) - 1):
        t = 0.05 * (k + 1)
        now = driven(t, speed, late)
        ahead.follow(now)
        truth = max(0.0, (t - late) * speed)
        if 0.06 < truth < 0.74:
            assert abs(ahead.progress - truth) < 2e-3
        if 0.3 < truth < 0.7:
            assert abs(ahead.rate - speed) < 0.02
            rest = ahead.rest(now).trajectory()
            for after in rest.seconds[1:-1:7]:
                later = driven(t + after, speed, late)
                place = rest.position[np.argmin(np.abs(rest.seconds - after))]
                assert np.linalg.norm(place - later.tool[0]) < 5e-3
        assert not ahead.off and not ahead.done
    for after in (0.0, 0.05, 0.1):  # at its end it creeps
        ahead.follow(driven(late + 0.8 / speed + after, speed, late))
    assert ahead.done


def test_a_plan_that_comes_back_is_followed_back():
    """The same places on the way there and back, with a stop in between."""
    there = Move([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)

    class Twice(Move):

        def at(self, t):
            t = np.asarray(t)
            return there.at(np.where(t < 0.5, t, np.where(t < 0.9, 0.5, 1.4 - t)))

    both = Twice([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 1.4)
    t = np.linspace(0.0, 1.4, 701)
    o, R, v = both.at(t)
    v[t >= 0.9] *= -1.0
    ahead = Ahead(Trajectory(np.round(t * 1e9).astype(np.int64), o, R, v), 0)
    for k in range(1, 140):
        t = 0.01 * k
        now = driven(t, move=both)
        if t >= 0.9:
            o, q, v, w = now.tool
            now = now._replace(tool=(o, q, tuple(-x for x in v), w))
        ahead.follow(now)
        if not 0.46 < t < 0.94 and t > 0.04:
            assert abs(ahead.progress - t) < 4e-3, t


def test_a_tool_elsewhere_does_not_drive_the_plan():
    ahead = Ahead(MOVE.plan(250), 0)
    ahead.follow(driven(0.4, off=(0.0, 0.0, 0.2)))
    assert ahead.off


def test_the_future_is_the_plan_and_then_standing():
    ahead, now = Ahead(MOVE.plan(250), T0), driven(0.4)
    ahead.follow(now)
    for duration in (0.1, 0.4, 2.0):
        tool = steadily(now, ahead.rest(now), duration).trajectory()
        assert tool.stamps_ns[0] == 0 and tool.stamps_ns[-1] >= round(duration * 1e9)
        truth = driven(min(0.4 + tool.seconds[-1], 0.8)).tool
        assert_allclose(tool.position[-1], truth[0], atol=2e-4)
        assert_allclose(tool.rotation[-1], quaternion_to_rotation(np.array(truth[1])), atol=1e-3)


def test_a_tool_beside_the_plan_comes_back_to_it_smoothly():
    ahead, now = Ahead(MOVE.plan(250), T0), driven(0.4, off=(0.0, 0.0, 0.004))
    ahead.follow(now)
    rest = ahead.rest(now).trajectory()
    assert_allclose(rest.position[0], now.tool[0])
    fine = resample(rest, np.arange(0, int(rest.stamps_ns[-1]), 1_000_000))
    speed = np.linalg.norm(np.diff(fine.position, axis=0), axis=1) / 1e-3
    assert speed.max() < 1.3 * np.linalg.norm(MOVE.at(np.linspace(0, 0.8, 99))[2][:, :3],
                                              axis=1).max()


def test_a_plan_replayed_as_live_poses_agrees_with_its_prediction():
    """To 0.2 um and 3 urad, of a plan at 500 Hz that the tool then drives."""
    plan = MOVE.plan(500)
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.expect_twists = True
    rows = []
    for k, stamp in enumerate((T0 + plan.stamps_ns).tolist()):
        q = rotation_to_quaternion(plan.rotation[k]).tolist()
        v = plan.twist[k].tolist()
        rows += live.on_pose(stamp, 'world', tuple(plan.position[k].tolist()), tuple(q))
        rows += live.on_twist(stamp, tuple(v[:3]), tuple(v[3:]))
    ahead = Ahead(plan, T0)
    ahead.follow(rows[0])
    found = predict(MODEL, None, ahead.rest(rows[0], 0.0), rows[0].body)
    assert len(rows) == len(found.states) == len(plan)
    assert_allclose(found.states[:, :3], [row.position for row in rows], atol=0.2e-6)
    q = np.array([row.quaternion_xyzw for row in rows])
    q *= np.sign(np.sum(q * found.states[:, 3:7], axis=1))[:, None]
    assert 2.0 * np.linalg.norm(found.states[:, 3:7] - q, axis=1).max() < 3e-6
