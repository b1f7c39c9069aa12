"""Measured poses of the package over DDS."""

import time

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.equilibrium import moved_by
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.files.messages import POSE_TYPES
from bellows_ros.nodes.conversions import message_class
from bellows_ros.nodes.inputs import MAX_MEASURED, MAX_WRENCHES
from bellows_ros.report.health import Level
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, PoseStamped, WrenchStamped
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation

from .conftest import ORIGIN, PACKAGE, placed, stamped, UPRIGHT
from ..core.observer.cases import truth

pytestmark = pytest.mark.usefixtures('observer_kernels')

WORLD = [1.2, -0.7, 0.3, 0.0, 0.6, 0.0, 0.8]  # of the measured package, in that of the tool
TURN = 0.1  # rad, by which the measured package begins beside its rest


def swinging():
    """Give the states of a package that swings under a tool that stands still."""
    tool = [(ORIGIN, UPRIGHT, ORIGIN, ORIGIN)] * 120
    package = package_of(Values(PACKAGE))
    rest = truth(tool[:1], package, Cup.thesis())[0]
    start = moved_by(rest, np.r_[0.0, 0.0, 0.0, 0.0, TURN, np.zeros(7)])
    return truth(tool, package, Cup.thesis(), start)


@pytest.mark.parametrize(('kind', 'apart'), [
    ('pose', False), ('pose_with_covariance', True)])
def test_measured_poses_correct_what_is_published(make_partner, kind, apart):
    """Come near where the package is seen, in a world of its own too; count what is no use."""
    partner = make_partner({
        **PACKAGE, 'measured.type': kind, 'measured.noise': [1e-4, 1e-3],
        'payload.estimate': True,
        'recording.package_world': ' '.join(map(str, WORLD)) if apart else ''})
    writer = partner.writes(message_class(POSE_TYPES[kind], kind, ''), 'package/measured')
    payloads, stds = (partner.hears(InertiaStamped, f'package/estimated{end}')
                      for end in ('', '_std'))
    reports = partner.hears(DiagnosticArray, '/diagnostics')
    partner.connect()
    pipeline = partner.predictor.pipeline
    observing = pipeline.observing
    partner.wait(lambda: observing._estimated.subscribed and observing._std.subscribed)
    live = pipeline.live
    start_ns, swing = time.time_ns(), swinging()

    def see(stamp_ns, body):
        message = stamped(message_class(POSE_TYPES[kind], kind, '')(), stamp_ns)
        position, q_xyzw = body[:2]
        if apart:
            back = Rotation.from_quat(WORLD[3:]).inv()
            position = back.apply(np.subtract(position, WORLD[:3]))
            q_xyzw = (back * Rotation.from_quat(q_xyzw)).as_quat().tolist()
        placed(message, position, q_xyzw)
        if kind != 'pose':
            message.pose.covariance = [1e-08 if i % 7 == 0 else 0.0 for i in range(36)]
        writer.publish(message)

    for k in range(1, len(swing)):
        partner.predict(start_ns + k * 4_000_000)
        if k % 8 == 0:
            see(start_ns + k * 4_000_000, swing[k])
            partner.wait(
                lambda: (observer := live.package.observer)
                and sum(observer.counts.values()) >= k // 8)  # noqa: B023
    found = [message.pose.position.x for message in partner.poses]
    true = [body[0][0] for body in swing[1:]]
    assert found[:8] == [0.0] * 8  # nothing has been measured: at rest
    assert max(map(abs, true[60:])) > 1e-3
    assert max(abs(a - b) for a, b in zip(found[60:], true[60:], strict=True)) < 1e-4
    counts = live.package.observer.counts
    assert counts['used'] >= 13
    partner.wait(lambda: len(payloads) > 10 and len(stds) == len(payloads))
    payload, std = payloads[-1], stds[-1].inertia
    assert 0.0 < std.m < 0.1 and 0.0 < std.com.x < 0.01 and std.ixx > std.ixy == 0.0
    assert payload.header.frame_id == 'cup_lip'
    assert abs(payload.inertia.m - PACKAGE['package.mass']) < 0.1
    assert abs(payload.inertia.com.x) < 1e-3 and abs(payload.inertia.com.z + 0.03) < 0.01
    see(start_ns + 119 * 4_000_000, ((float('nan'), 0.0, 0.0), swing[-1][1]))
    partner.wait(lambda: counts['nan'] == 1)
    partner.wait(lambda: any(
        'measured package' in line.name and 'refused' in line.message
        for report in reports for line in report.status))


def test_wrenches_weigh_the_package(make_partner):
    """A wrench of a sensor set to zero alone corrects the mass that is published."""
    partner = make_partner({**PACKAGE, 'package.mass_std': 0.1 * PACKAGE['package.mass'],
                            'wrench.bias_std': [0.1, 0.02]})
    writer = partner.writes(WrenchStamped, 'tool_arm/wrench')
    payloads = partner.hears(InertiaStamped, 'package/estimated')
    partner.connect()
    pipeline = partner.predictor.pipeline
    partner.wait(lambda: pipeline.observing._estimated.subscribed)
    start_ns, heavier = time.time_ns(), 1.05 * PACKAGE['package.mass']
    for k in range(1, 250):
        partner.predict(start_ns + k * 4_000_000)
        message = stamped(WrenchStamped(), start_ns + k * 4_000_000, 'tool0')
        message.wrench.force.z = -9.81 * heavier
        writer.publish(message)
    partner.wait(lambda: bool(payloads))
    partner.wait(lambda: abs(payloads[-1].inertia.m - heavier) < 0.03 * heavier)
    assert pipeline.observing.wrench_status().level <= Level.WARN


def test_a_flood_of_a_sensor_leaves_time_for_the_tool(make_partner):
    """At 10 kHz, use a bounded number of messages for each pose of the tool; count the others."""
    partner = make_partner(with_twists=False)
    predictor, observing = partner.predictor, partner.predictor.pipeline.observing
    callbacks = {each.topic_name: each.callback for each in predictor.subscriptions}
    start_ns, used = time.time_ns(), predictor.pipeline.live.package.observer.counts
    for k in range(1, 4):
        partner.predict(start_ns + k * 100_000_000)
        for j in range(1000):
            stamp_ns = start_ns + k * 100_000_000 + j * 100_000
            for kind, topic in ((WrenchStamped, '/tool_arm/wrench'),
                                (PoseStamped, '/package/measured')):
                callbacks[topic](serialize_message(stamped(kind(), stamp_ns)))
    assert observing._no_wrench['too_many'] == 3 * (1000 - MAX_WRENCHES)
    assert observing._no_view['too_many'] == 3 * (1000 - MAX_MEASURED)
    assert sum(used.values()) <= 3 * MAX_MEASURED
