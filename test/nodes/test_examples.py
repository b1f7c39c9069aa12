"""Examples of the pages, run as a user runs them beside a predictor, over DDS."""

import os
import subprocess
import sys
import time

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.core.parameters.values import Values
from geometry_msgs.msg import PoseStamped
import numpy as np
import pytest

from . import tf2_interface
from .conftest import ORIGIN, PACKAGE, placed, stamped, UPRIGHT
from ..core.observer.cases import truth

pytestmark = [pytest.mark.timeout(600), pytest.mark.usefixtures('observer_kernels')]

HEAVIER = 1.15
"""Mass of the package over that of the parameters."""
GRIPPER = {'gripper_mass': 1.5, 'gripper_com': [0.0, 0.0, 0.04], 'lip_distance': 0.0981}
VALUES = {
    **PACKAGE, 'payload.estimate': True,
    'measured.camera_std': [0.0, 0.0], 'measured.marker_std': [0.0, 0.0],
    'measured.noise': [1e-4, 1e-3], 'cup.stiffness_std': [1e-3] * 36}


def shaken(t):
    """Return a tool that is shaken for 5 s, then stands."""
    def place(t):
        fade = min(1.0, max(0.0, t)) * min(1.0, max(0.0, 5.0 - t))
        return fade * np.array([0.04, 0.03, 0.03]) * np.sin(t * np.array([11.0, 8.0, 16.0]))

    velocity = (place(t + 1e-4) - place(t - 1e-4)) / 2e-4
    return tuple(place(t).tolist()), UPRIGHT, tuple(velocity.tolist()), ORIGIN


def test_a_ur_gets_the_total_payload_at_its_flange(make_partner, root, ros, tmp_path, monkeypatch):
    """At rest after a motion, as the estimate is sure: of gripper and package together."""
    if missing := tf2_interface.missing():
        pytest.skip(f'ur_msgs cannot be built: {missing}')
    built = tf2_interface.build(
        tmp_path, {'ur_msgs/srv/SetPayload.srv':
                   'float32 mass\ngeometry_msgs/Vector3 center_of_gravity\n---\nbool success'})
    monkeypatch.syspath_prepend(str(built))
    from ur_msgs.srv import SetPayload

    asked = []
    partner = make_partner(VALUES, False)
    partner.node.create_service(
        SetPayload, '/io_and_status_controller/set_payload',
        lambda request, response: asked.append(request) or response)
    writer = partner.writes(PoseStamped, 'package/measured')
    words = [word for name, value in GRIPPER.items() for word in ('-p', f'{name}:={value}')]
    example = subprocess.Popen(
        [sys.executable, root / 'docs/examples/ur_payload.py', '--ros-args', *words],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join([str(built), str(root)])})
    try:
        predictor = partner.predictor
        partner.wait(lambda: predictor.count_subscribers('package/estimated_std'))
        partner.wait(lambda: predictor.pipeline.observing._std.subscribed
                     and predictor.pipeline.observing.is_ready)
        mass = HEAVIER * PACKAGE['package.mass']
        package = package_of(Values({**PACKAGE, 'package.mass': mass}))
        tool = [shaken(0.004 * k) for k in range(2500)]
        states = truth(tool, package, Cup.thesis())
        rng = np.random.default_rng(5)
        start_ns = time.time_ns()
        for k, (body, (o, *_)) in enumerate(zip(states, tool, strict=True)):
            stamp_ns = start_ns + 4_000_000 * (k + 1)
            partner.predict(stamp_ns, o)
            if k % 8 == 0:
                writer.publish(placed(
                    stamped(PoseStamped(), stamp_ns),
                    body[0] + 1e-4 * rng.standard_normal(3), body[1]))
            if asked:
                break
        assert asked
        total = mass + 1.5
        assert asked[0].mass == pytest.approx(total, rel=0.02)
        below = 0.0981 + 0.03  # z of the flange points away from the arm
        expected = (1.5 * 0.04 + (total - 1.5) * below) / total
        assert asked[0].center_of_gravity.z == pytest.approx(expected, abs=0.005)
    finally:
        example.kill()
        example.wait()
