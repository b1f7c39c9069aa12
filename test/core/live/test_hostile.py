"""Whatever comes, in whatever order: finite answers, counts, bounded memory, recovery."""

import math

from bellows_ros.core.live import Predictor, REFUSALS
from bellows_ros.core.live.tool_twist import MAX_QUEUE, TWIST_REFUSALS
from bellows_ros.core.model.cup_package import Cup, Package
from hypothesis import given, HealthCheck, Phase, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import PLATE
from ...cell.motion import MS, START, UPRIGHT

PERIOD = 2 * MS
HEAVY = Package(25.0, np.diag([1.0, 1.0, 1.0]), (0.02, 0.0, -0.2))
SOFT = Cup(0.1 * Cup.thesis().stiffness, 0.1 * Cup.thesis().damping, 0.0481)
STANDING, STANDING_PERIOD = 150, 25 * MS  # ten times as long as the swing takes to fade
LENGTH = 150  # of a sequence, a third of them no messages

numbers = st.floats(-2.0, 2.0) | st.floats() | st.sampled_from(
    [0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e150])
vectors = st.tuples(numbers, numbers, numbers)
calm_vectors = st.tuples(*[st.floats(-0.5, 0.5)] * 3)
quaternions = (
    st.just(UPRIGHT) | st.just((0.0, 0.0, 0.0, -1.0)) | st.just((0.0, 0.0, 0.0, 0.0))
    | st.tuples(numbers, numbers, numbers, numbers)
    | st.tuples(*[st.floats(-1.0, 1.0)] * 4).map(
        lambda q: tuple(x / (math.hypot(*q) or 1.0) for x in q)))
leaps = st.sampled_from(
    [PERIOD] * 6 + [0, 1, -1, -PERIOD, 10, 50 * MS, 400 * MS, 600 * MS, 10**10, -10**10, 10**15,
                    -10**18, 3 * 10**17, -40 * MS])
frames = st.sampled_from(['base'] * 5 + ['map', '', 'b\x00ad', 'a' * 1000])
poses = st.tuples(st.just('pose'), leaps, frames, vectors | calm_vectors, quaternions)
twists = st.tuples(st.just('twist'), leaps, frames, vectors | calm_vectors, vectors | calm_vectors)
others = st.tuples(
    st.sampled_from(['flush', 'reset', 'attach', 'detach', 'coast', 'model', 'expect', 'wait']),
    leaps)
sequences = st.lists(poses | poses | twists | others, min_size=LENGTH, max_size=LENGTH)


class Attack:
    """A predictor, a clock, and a count of what was sent."""

    def __init__(self):
        self.live = Predictor(Cup.thesis(), PLATE, 9.81)
        self.stamp, self.arrival = START, 10**12
        self.poses = self.twists = 0

    def send(self, message):
        """Send one message, and return the predictions."""
        kind, leap = message[:2]
        live = self.live
        if kind in ('pose', 'twist'):
            stamp = self.stamp + leap
            self.arrival += PERIOD
            if abs(leap) < 10**11:
                self.stamp = max(stamp, 1)
            if kind == 'twist':
                self.twists += 1
                return live.on_twist(stamp, message[3], message[4], message[2])
            self.poses += 1
            return live.on_pose(stamp, message[2], message[3], message[4], self.arrival)
        return self.control(kind, leap)

    def control(self, kind, leap):
        """Do what a user, a timer or a vacuum switch does."""
        live = self.live
        ahead_ns = abs(leap) % 10**10
        if kind == 'expect':
            live.expect_twists(leap > 0)
        elif kind == 'wait':
            self.arrival += ahead_ns
        return {
            'attach': lambda: live.set_attached(True), 'detach': lambda: live.set_attached(False),
            'coast': lambda: live.coast(self.arrival + ahead_ns),
            'flush': live.flush, 'reset': live.reset,
            'model': lambda: live.package.set_model(
                *((SOFT, HEAVY) if leap > PERIOD else (Cup.thesis(), PLATE))),
        }.get(kind, list)() or []


def check(live, predictions):
    """All numbers finite, orientations rotations, queues bounded, nothing said too far ahead."""
    for p in predictions:
        ahead_ns = p.stamp_ns - live.newest_ns
        assert not p.coasting or 0 < ahead_ns <= live.coast_limit_ns
        numbers = [x for part in (*p.body, p.force, p.moment, *p.tool) for x in part]
        assert all(map(math.isfinite, numbers))
        assert abs(math.hypot(*p.quaternion_xyzw) - 1.0) < 1e-9
    assert live.pairing.waiting <= MAX_QUEUE
    assert len(live.pairing._twists) <= 32


@pytest.mark.parametrize('count', [25, pytest.param(400, marks=pytest.mark.stress)])
def test_predictor_recovers_from_any_message(count):
    sent = []

    @given(sequences)
    @settings(max_examples=count, suppress_health_check=list(HealthCheck), database=None,
              phases=[Phase.explicit, Phase.generate])
    def attacked(sequence):
        sent.append(messages_survived(sequence))

    attacked()
    assert sum(sent) >= 100 * count, sum(sent)


def messages_survived(sequence):
    """Attack a predictor, see it come back, and return how many messages were sent to it."""
    attack = Attack()
    live, answered = attack.live, 0
    for message in sequence:
        predictions = attack.send(message)
        check(live, predictions)
        answered += sum(not p.coasting for p in predictions)
        assert set(live.refused) == {*REFUSALS, *TWIST_REFUSALS}
        refused = sum(n for name, n in live.refused.items() if not name.startswith('twist'))
        assert answered == live.predictions
        assert live.screen.poses == attack.poses
        assert live.predictions + refused + live.pairing.waiting <= attack.poses
    live.package.set_model(Cup.thesis(), PLATE)
    live.set_attached(True)
    stamp = attack.stamp + 20 * MS
    good = [live.on_pose(stamp + k * PERIOD, 'base', (1e-5 * k, 0.0, 0.0), UPRIGHT,
                         attack.arrival + (k + 1) * PERIOD) for k in range(300)]
    times = [k for k, out in enumerate(good) if out]
    words = str((dict(live.refused), live.restarts, live.frame_id[:9]))
    assert times and times[0] * PERIOD <= 200 * MS, words
    assert len(times) >= 300 - times[0] - 15  # poses may wait 20 ms for twists that stopped
    for out in good:
        check(live, out)
    if attack.poses % 8 == 0:  # for some of them, as it takes its time
        check_drift(live, stamp + 300 * PERIOD, attack.arrival + 301 * PERIOD)
    return attack.poses + attack.twists


def check_drift(live, stamp, arrival):
    """Where the tool stands, the package comes to rest where it would without the past."""
    place, tool = (1.0, 2.0, 3.0), (0.6, 0.0, 0.0, 0.8)
    for k in range(STANDING):
        now = k * STANDING_PERIOD
        out = live.on_pose(stamp + now, 'base', place, tool, arrival + now) or live.flush()
    (expected,) = Predictor(Cup.thesis(), PLATE, 9.81).on_pose(stamp, 'base', place, tool)
    assert_allclose(out[-1].position, expected.position, atol=1e-4)
    assert abs(np.dot(out[-1].quaternion_xyzw, expected.quaternion_xyzw)) > 1.0 - 1e-6
