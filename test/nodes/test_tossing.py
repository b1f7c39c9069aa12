"""The toss over DDS: where it would land, when to release, and the flight after the valve."""

from threading import Event
import time

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool, Header, String

from .conftest import PACKAGE, pose_at, stamp_ns
from .test_planning import message, Planner

TOSSED = {
    **PACKAGE, 'package.size': [0.3, 0.3, 0.02], 'landing.height': -0.5, 'release.delay': 0.02,
    'release.delay_std': 0.002, 'landing.aim': True, 'landing.target': [0.05, 0.0],
}
PERIOD_NS = 4_000_000
SPEED = 0.4  # m/s


def test_landing_agrees_with_the_prediction(make_partner, capfd):
    """Say landing and time of release; then fly on after the valve, land, and take up the next."""
    partner = make_partner(TOSSED)
    heard = {name: partner.hears(kind, topic) for name, kind, topic in (
        ('landing', PoseWithCovarianceStamped, 'package/landing'), ('at', Header, 'release/at'),
        ('lip', PoseStamped, 'cup/deflection'),
        ('odometry', Odometry, 'package/odometry'), ('later', Odometry, 'package/predicted_at'))}
    states = partner.hears(String, 'package/state', decode=lambda message: message.data)
    valve = partner.writes(Bool, 'vacuum/valve')
    asking = partner.writes(Header, 'package/predict_at')
    partner.connect()
    tossing, outputs = partner.predictor.pipeline.tossing, partner.predictor.pipeline.outputs
    partner.wait(lambda: (
        tossing._landing.subscribed and tossing._at.subscribed and outputs._deflection.subscribed))
    start_ns, sent = time.time_ns(), 0

    def go_on():
        nonlocal sent
        now_ns = start_ns + sent * PERIOD_NS
        if time.time_ns() >= now_ns:
            partner.send(
                now_ns, (SPEED * (now_ns - start_ns) * 1e-9, 0.0, 0.0), (SPEED, 0.0, 0.0))
            sent += 1

    def until(condition):
        def check():
            go_on()
            return condition()

        return bool(partner.ros.spin_until(check))

    def ask(after_ns):
        asked_ns = stamp_ns(partner.poses[-1]) + after_ns  # the node may lag behind what was sent
        asking.publish(pose_at(asked_ns).header)
        return asked_ns

    assert until(lambda: len(heard['landing']) > 3 and heard['at'])
    said = heard['landing'][-1]
    covariance = np.array(said.pose.covariance).reshape(6, 6)
    assert np.isfinite(covariance).all() and covariance[0, 0] > (0.002 * SPEED * 0.9) ** 2
    assert said.pose.pose.position.z > -0.5
    assert until(lambda: len(heard['odometry']) > 9)  # the first is of a start in motion
    assert max(heard['odometry'][-1].pose.covariance) < 1.0
    valve.publish(Bool(data=False))
    assert until(lambda: states[-1:] == ['flying'])
    asked_ns = ask(10 * PERIOD_NS)
    assert until(lambda: states[-1:] == ['landed'] and heard['later'])
    later = heard['later'][0]
    positions = {stamp_ns(each): each.pose.position for each in partner.poses}
    assert stamp_ns(later) == asked_ns
    assert later.pose.pose.position.z == pytest.approx(positions[asked_ns].z, abs=1e-6)
    assert min(heard['odometry'][-1].pose.covariance[::7]) == pytest.approx(1e6)  # not known
    log = ''
    ask(10 * PERIOD_NS)

    def refused():
        nonlocal log
        log += capfd.readouterr().err
        return 'A request on package/predict_at was refused. The package has landed' in log

    assert until(refused) and len(heard['later']) == 1
    assert partner.predictor.pipeline.held is None  # nor does the cup any longer
    assert heard['lip'] and max(abs(lip.pose.position.z) for lip in heard['lip']) < 0.02
    assert 'released' in states
    heights = [message.pose.position.z for message in partner.poses]
    # A corner, 0.21 m from the middle of the tilted plate, comes down first.
    assert heights[0] > -0.12 and -0.5 < min(heights) < -0.29
    count = len(partner.poses)
    go_on()
    valve.publish(Bool(data=True))
    assert until(lambda: states[-1:] == ['predicting'])
    assert until(lambda: len(partner.poses) > count + 3)
    assert partner.poses[-1].pose.position.z > -0.12


def test_no_plan_waits_behind_a_search(make_partner):
    """Answer a plan while the time of release is sought."""
    planner = Planner(make_partner(TOSSED))
    partner, tossing = planner.partner, planner.partner.predictor.pipeline.tossing
    partner.hears(Header, 'release/at')
    planner.wait(lambda: tossing._at.subscribed)
    begun, end = Event(), Event()

    def search(*_):
        begun.set()
        end.wait(300.0)

    tossing.flight.time_to_target = search
    partner.send(1_000_000_000)
    try:
        planner.wait(begun.is_set)
        planner.send(message())
        planner.wait(lambda: planner.plans)
    finally:
        end.set()


def test_the_vacuum_that_is_heard_counts(make_partner):
    """For a plan and for a landing, but not once the valve is switched: then the model has it."""
    planner = Planner(make_partner({
        **TOSSED, 'cup.lip_radius': 0.03, 'vacuum.signal': 'pressure', 'vacuum.holding': 90e3}))
    partner, flight = planner.partner, planner.partner.predictor.pipeline.tossing.flight
    gauge = partner.writes(FluidPressure, 'vacuum/pressure')
    partner.connect()
    factors = []
    for vacuum in (60e3, 30e3):
        gauge.publish(FluidPressure(fluid_pressure=101_325.0 - vacuum))
        planner.wait(lambda: flight.grip[0] == pytest.approx(
            vacuum * np.pi * 0.03 ** 2))  # noqa: B023
        partner.predict(1_000_000_000 + len(partner.poses) * PERIOD_NS)
        planner.plans.clear()
        partner.predictor.pipeline.planning._outcome = None
        planner.send(message())
        factors.append(float(planner.status().values['smallest_safety_factor']))
    assert factors[0] == pytest.approx(2.0 * factors[1], rel=1e-2)
    partner.predictor.pipeline.live.on_valve(False, 1_000_000_000)
    gauge.publish(FluidPressure(fluid_pressure=100_000.0))
    load = partner.predictor.pipeline.load
    planner.wait(lambda: load.pressure == 100_000.0)
    assert flight.grip[0] == pytest.approx(30e3 * np.pi * 0.03 ** 2)


def test_without_a_size_the_valve_releases(make_partner):
    """Predict no flight, and no package until the valve is on again."""
    partner = make_partner(with_twists=False)
    live, valve = partner.predictor.pipeline.live, partner.writes(Bool, 'vacuum/valve')
    partner.connect()
    partner.predict(1_000_000_000)
    valve.publish(Bool(data=False))
    partner.wait(lambda: live.state == 'released' and not live.attached)
    valve.publish(Bool(data=True))
    partner.wait(lambda: live.state == 'gripped')
    partner.predict(1_004_000_000)
