"""A gripper of several cups at a live node, over DDS."""

from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import cup_of, gravity_of, package_of
from bellows_ros.nodes.conversions import quaternion_xyzw, vector
from geometry_msgs.msg import PoseStamped
import numpy as np
import pytest
from sensor_msgs.msg import FluidPressure
from std_srvs.srv import Trigger

from .conftest import ORIGIN, PACKAGE, pose_at, stamp_ns, START, UPRIGHT
from ..core.observer.cases import truth

pytestmark = pytest.mark.usefixtures('observer_kernels')

GRIPPER = {
    **PACKAGE, 'cup.layout': [0.06, 0.0, 0.0, -0.06, 0.05, 0.0, -0.06, -0.05, 0.0],
    'cup.lip_radius': 0.02, 'vacuum.signal': 'pressure'}


STILL = (ORIGIN, UPRIGHT, ORIGIN, ORIGIN)


def model_without(opened):
    """Return the model without some cups."""
    values = resolve({**GRIPPER, 'cup.open': opened})
    return model_tuple(cup_of(values), package_of(values), gravity_of(values))


def rest(opened):
    """Return the package at rest under an upright tool in the origin, without some cups."""
    return static_equilibrium(model_without(opened), STILL)


def test_cup_of_a_gripper_without_vacuum_is_left_out(make_partner, capfd):
    """By sensors of single cups: the package comes to hang from those that hold."""
    partner = make_partner(GRIPPER, with_twists=False)
    node, vacuum = partner.predictor, partner.writes(FluidPressure, 'vacuum/pressure')
    partner.connect()

    def breathe(cup, below):
        message = FluidPressure(fluid_pressure=101325.0 - below)
        message.header.frame_id = f'gripper_cup_{cup}'
        vacuum.publish(message)

    now_ns = START

    def hang(opened):
        nonlocal now_ns
        for _ in range(400):
            now_ns += 10_000_000
            partner.send_pose(now_ns)
        partner.wait(lambda: partner.poses and stamp_ns(partner.poses[-1]) == now_ns)
        pose, expected = partner.poses[-1].pose, rest(opened)
        np.testing.assert_allclose(vector(pose.position), expected[0], atol=2e-5)
        np.testing.assert_allclose(quaternion_xyzw(pose.orientation), expected[1], atol=2e-4)

    for cup in range(3):
        breathe(cup, 60e3)
    partner.wait(lambda: node.pipeline.live.attached)
    hang([-1])
    assert abs(rest([2])[1][0]) > 0.01  # far from where it hung
    breathe(2, 5e3)
    partner.wait(lambda: node.pipeline.live.vacuum.open_cups == (2,))
    assert 'Without vacuum: cups 2' in capfd.readouterr().err
    hang([2])
    breathe(7, 60e3)
    partner.wait(lambda: node.pipeline.attachment._refused['no_such_cup'] == 1)
    breathe(2, 60e3)
    partner.wait(lambda: node.pipeline.live.vacuum.open_cups == ())
    hang([-1])
    for cup in range(3):
        breathe(cup, 0.0)
    partner.wait(lambda: node.pipeline.live.attached is False)


def test_cup_that_a_camera_finds_lost_is_left_out(make_partner, capfd):
    """Name it by its index and place, and let the package hang from the others until the next."""
    partner = make_partner(
        {**GRIPPER, 'vacuum.signal': 'none', 'measured.noise': [1e-3, 5e-3]})
    node = partner.predictor
    camera = partner.writes(PoseStamped, 'package/measured')
    partner.connect()
    partner.wait(lambda: node.pipeline.observing.is_ready)
    all_cups, others = model_without([-1]), model_without([2])
    swing = truth([STILL] * 260, start=rest([-1]), period_ns=8_000_000, change=lambda k, body, _: (
        body, all_cups if k < 160 else others))
    for k, (position, q, *_) in enumerate(swing[1:], 1):
        partner.send_pose(START + k * 8_000_000)
        if k % 4 == 0:
            camera.publish(pose_at(START + k * 8_000_000, position, q))
        partner.wait_for_poses(k)
        assert k > 160 or not node.pipeline.live.lost_cups
        if node.pipeline.live.lost_cups:
            break
    assert node.pipeline.live.lost_cups == {2}
    assert (k - 160) * 8e-3 < 0.5
    assert 'Alarm, cup 2: Cup 2 of cup.layout, at x -60 mm, y -50 mm' in capfd.readouterr().err
    assert node.pipeline.live.alarm.cause == 'cup 2'
    assert 'alarm: cup 2' in node.pipeline.observing.status('measured package').values
    np.testing.assert_allclose(node.pipeline.live.model[0][2][0], others[0][2][0], rtol=1e-9)
    assert node.pipeline.attachment._answer(True, '', None, Trigger.Response()).success
    assert node.pipeline.live.lost_cups == set()
    np.testing.assert_allclose(node.pipeline.live.model[0][2][0], all_cups[0][2][0], rtol=1e-9)
