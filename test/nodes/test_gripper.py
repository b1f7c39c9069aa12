"""A gripper of several cups at a live node, over DDS."""

from collections.abc import Callable
from typing import Any

from bellows_ros.core.model.cup_package import cup_of, model_tuple, package_of
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.parameters.checks import gravity_of, resolve
import numpy as np
import pytest

from .conftest import ORIGIN, PACKAGE, UPRIGHT

START = 1_700_000_000_000_000_000
GRIPPER = {
    **PACKAGE, 'cup.layout': [0.06, 0.0, 0.0, -0.06, 0.05, 0.0, -0.06, -0.05, 0.0],
    'cup.lip_radius': 0.02, 'vacuum.signal': 'pressure'}


def rest(opened: list[int]) -> Any:
    """Return the package at rest under an upright tool in the origin, without some cups."""
    values = resolve({**GRIPPER, 'cup.open': opened})
    model = model_tuple(cup_of(values), package_of(values), gravity_of(values))
    return static_equilibrium(model, (ORIGIN, UPRIGHT, ORIGIN, ORIGIN))


def test_cup_of_a_gripper_without_vacuum_is_left_out(
        make_partner: Callable[..., Any], capfd: pytest.CaptureFixture[str]) -> None:
    """By sensors of single cups: the package comes to hang from those that hold."""
    from bellows_ros.nodes.conversions import stamp_to_ns
    from sensor_msgs.msg import FluidPressure

    partner = make_partner(GRIPPER, with_twists=False)
    node, vacuum = partner.predictor, partner.node.create_publisher(
        FluidPressure, 'vacuum/pressure', 10)
    assert partner.ros.spin_until(vacuum.get_subscription_count)

    def breathe(cup: int, below: float) -> None:
        message = FluidPressure(fluid_pressure=101325.0 - below)
        message.header.frame_id = f'gripper_cup_{cup}'
        vacuum.publish(message)

    stamp_ns = START

    def hang(opened: list[int]) -> None:
        nonlocal stamp_ns
        for _ in range(400):
            stamp_ns += 10_000_000
            partner.send_pose(stamp_ns)
        assert partner.ros.spin_until(
            lambda: partner.poses and stamp_to_ns(partner.poses[-1].header.stamp) == stamp_ns)
        pose, expected = partner.poses[-1].pose, rest(opened)
        o, q = pose.position, pose.orientation
        np.testing.assert_allclose([o.x, o.y, o.z], expected[0], atol=2e-5)
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], expected[1], atol=2e-4)

    for cup in range(3):
        breathe(cup, 60e3)
    assert partner.ros.spin_until(lambda: node._attachment.held)
    hang([-1])
    assert abs(rest([2])[1][0]) > 0.01  # far from where it hung
    breathe(2, 5e3)
    assert partner.ros.spin_until(lambda: node._attachment.open_cups == (2,))
    assert 'Without vacuum: cups 2' in capfd.readouterr().err
    hang([2])
    breathe(7, 60e3)
    assert partner.ros.spin_until(lambda: node._attachment._refused['no_such_cup'] == 1)
    breathe(2, 60e3)
    assert partner.ros.spin_until(lambda: node._attachment.open_cups == ())
    hang([-1])
    for cup in range(3):
        breathe(cup, 0.0)
    assert partner.ros.spin_until(lambda: node._live.attached is False)
