"""What a predictor says about bad company: diagnostics, coasting, floods, clocks; real DDS."""

from contextlib import contextmanager
from threading import Event, Thread
import time

from bellows_ros.nodes.conversions import vector
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from nav_msgs.msg import Odometry
import numpy as np
from numpy.testing import assert_allclose
from std_msgs.msg import Bool
from visualization_msgs.msg import MarkerArray

from .conftest import (
    ERROR,
    LATCHED,
    MS,
    OK,
    PACKAGE,
    Peer,
    stamped,
    START,
    topics_of,
    WARN,
)


@contextmanager
def sending(partner, period=0.002, shift=0, **options):
    """Send poses from a thread, as a driver does, until the block is left."""
    stop = Event()

    def work():
        while not stop.wait(period):
            partner.send_pose(time.time_ns() + shift, **options)

    thread = Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_nobody_silent_and_good(listener, partner):
    """Name an absent and a silent driver in words, then the rate of a good one."""
    assert listener.sees('tool pose', ERROR, 'No message on /tool_arm/pose so far')
    assert listener.sees('prediction', OK, 'Waiting')
    with sending(partner):
        assert listener.sees('tool pose', OK, 'Hz')
        ages = [float(listener.value('tool pose', f'age {name} (s)'))
                for name in ('p50', 'p99', 'max')]
        assert 0.0 < ages[0] <= ages[1] <= ages[2] and ages[0] < 1.0
        assert listener.sees('prediction', OK, 'Predicting')
        assert float(listener.value('prediction', 'compute time p99 (us)')) > 0.0
    assert listener.sees('prediction', ERROR, 'Interrupted')
    assert listener.sees('load', OK, 'safety factor of the grip is unknown')
    partner.node.destroy_publisher(partner.pose_writer)
    assert listener.sees('tool pose', ERROR, 'of 0 publishers')


def test_two_publishers_of_a_topic_are_named(ros, listener, make_partner):
    """Two arms, or a sensor and its filter, of which none is taken in silence."""
    partner, other = make_partner(), Peer(ros, 'other')
    other.writes(PoseStamped, 'tool_arm/pose')
    wrenches = [each.writes(WrenchStamped, 'tool_arm/wrench') for each in (partner, other)]
    with sending(partner):
        assert listener.sees('tool pose', WARN, 'several publishers: other, partner')
        for writer in wrenches:
            writer.publish(stamped(WrenchStamped(), time.time_ns()))
        assert listener.sees('wrench', ERROR, 'several publishers: other, partner')


def test_all_outputs_agree(make_partner):
    """Find the same package in odometry, deflection and markers as in the pose."""
    partner = make_partner({
        **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 5e4,
    }, with_twists=False)
    got = {name: partner.hears(kind, topic) for name, kind, topic in (
        ('odometry', Odometry, 'package/odometry'), ('deflection', PoseStamped, 'cup/deflection'),
        ('markers', MarkerArray, 'package/markers'),
        ('safety', Vector3Stamped, 'cup/safety_factor'))}
    partner.connect()
    partner.wait(lambda: all(topic.subscribed for topic in topics_of(partner.predictor)))
    for k in range(5):
        partner.send_pose(START + k * 50 * MS)
    partner.wait(lambda: len(got['odometry']) == len(got['deflection']) == 5 and got['markers'])

    pose, odometry = partner.poses[-1].pose, got['odometry'][-1]
    assert odometry.pose.pose == pose
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('world', 'package')
    covariance = np.reshape(odometry.pose.covariance, (6, 6))
    assert (np.diag(covariance) > 0.0).all()
    suction, weight = 5e4 * np.pi * 0.02 ** 2, 2.17 * 9.81
    assert np.isclose(got['safety'][-1].vector.z, suction / weight, rtol=1e-6)
    shift = vector(got['deflection'][-1].pose.position)
    assert_allclose(shift, (0.0, 0.0, -weight / 11530.0), atol=1e-9)
    assert got['deflection'][-1].header.frame_id == 'cup_lip_nominal'
    box = got['markers'][-1].markers[0]
    assert box.pose == pose and box.header.frame_id == 'world'


def test_ok_is_true_only_while_the_package_is_held_within_limits(make_partner):
    """False before the first pose and with stamps of another clock, true at rest."""
    partner = make_partner({
        **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 5e4,
        'safety.least': 1.0})
    heard = partner.hears(
        Bool, 'package/ok', LATCHED, decode=lambda message: message.data)
    partner.wait(lambda: heard == [False])
    live = partner.predictor.pipeline.live
    for shift in (-100 * 10**9, 5 * 10**9):  # far behind the clock, and ahead of it
        with sending(partner, shift=shift):
            before = live.predictions
            partner.wait(lambda least=before + 400: live.predictions > least)
        assert heard == [False]
    with sending(partner):
        partner.wait(lambda: True in heard)
