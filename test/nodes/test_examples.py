"""The example of the pages, run as a user runs it, over DDS."""

import subprocess
import sys

from geometry_msgs.msg import InertiaStamped, TwistStamped
import pytest

PACKAGE, GRIPPER = 2.5, 1.5  # kg
OPTIONS = {'gripper_mass': GRIPPER, 'gripper_com': [0.0, 0.0, 0.04], 'lip_distance': 0.0981}


def estimate(mass, x, z):
    """Return an estimated payload, or its standard deviations."""
    message = InertiaStamped()
    message.inertia.m, message.inertia.com.x, message.inertia.com.z = mass, x, z
    return message


def test_a_ur_gets_the_total_payload_at_its_flange(peer, root, user_environment):
    """As the estimate is sure: of gripper and package together, with z away from the arm."""
    SetPayload = pytest.importorskip('ur_msgs.srv', reason='no ur_msgs here').SetPayload
    asked = []
    peer.node.create_service(
        SetPayload, '/io_and_status_controller/set_payload',
        lambda request, response: asked.append(request) or response)
    twists, stds, estimates = (peer.writes(kind, f'package/{name}', 10) for kind, name in (
        (TwistStamped, 'twist'), (InertiaStamped, 'estimated_std'), (InertiaStamped, 'estimated')))
    words = [word for name, value in OPTIONS.items() for word in ('-p', f'{name}:={value}')]
    example = subprocess.Popen(
        [sys.executable, root / 'docs/examples/ur_payload.py', '--ros-args', *words],
        env=user_environment)
    try:
        peer.connect()

        def is_asked():
            for writer, message in ((twists, TwistStamped()), (stds, estimate(0.01, 1e-3, 1e-3)),
                                    (estimates, estimate(PACKAGE, 0.02, -0.03))):
                writer.publish(message)
            return asked

        peer.wait(is_asked)
    finally:
        example.kill()
        example.wait()
    total = GRIPPER + PACKAGE
    assert asked[0].mass == pytest.approx(total)
    center = asked[0].center_of_gravity
    assert center.x == pytest.approx(PACKAGE * 0.02 / total)
    assert center.z == pytest.approx((GRIPPER * 0.04 + PACKAGE * (0.0981 + 0.03)) / total)
