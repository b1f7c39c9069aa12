"""An arm by its URDF against products of matrices and finite differences."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.core.planning.points import plan_of_joints
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="world"/><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
  <link name="tool"/><link name="camera"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
    <origin xyz="0.1 0 0.5" rpy="0 0 1.2"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0.3 -0.2 0.1"/><axis xyz="0 0 2"/></joint>
  <joint name="slide" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0.2 0 0"/><axis xyz="0 1 0"/></joint>
  <joint name="spin" type="continuous"><parent link="b"/><child link="c"/>
    <axis xyz="1 1 0"/></joint>
  <joint name="tip" type="fixed"><parent link="c"/><child link="tool"/>
    <origin rpy="3.14159265 0 0" xyz="0 0 -0.1"/></joint>
  <joint name="eye" type="floating"><parent link="a"/><child link="camera"/></joint>
</robot>"""
ARM = read_arm(URDF, 'tool')


def by_hand(q):
    """Return the pose of the tool as the specification of URDF has it."""
    def pose(xyz, rpy=(0, 0, 0)):
        return lie.transform(lie.rpy_rotation(np.array(rpy, dtype=float)), xyz)

    turn, slide, spin = q
    return (
        pose([0.1, 0, 0.5], (0, 0, 1.2)) @ pose([0, 0, 0.3], (0.3, -0.2, 0.1))
        @ lie.transform(lie.exp_so3([0, 0, turn]), np.zeros(3)) @ pose([0.2, slide, 0])
        @ lie.transform(lie.exp_so3(np.array([1, 1, 0]) / np.sqrt(2) * spin), np.zeros(3))
        @ pose([0, 0, -0.1], (3.14159265, 0, 0)))


def test_pose_is_the_product_of_its_joints():
    assert (ARM.root, ARM.moving) == ('world', ('turn', 'slide', 'spin'))
    q = np.random.default_rng(0).normal(size=(5, 3))
    T, twist = ARM.tool(q)
    assert_allclose(T, [by_hand(each) for each in q], atol=1e-14)
    assert not twist.any()


def test_twist_is_the_slope_of_the_pose():
    rng = np.random.default_rng(1)
    q, rate, h = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), 1e-5
    T, twist = ARM.tool(q, rate)
    before, after = (ARM.tool(q + side * h * rate)[0] for side in (-1, 1))
    R_T = np.swapaxes(T[:, :3, :3], -1, -2)
    v = np.einsum('nij,nj->ni', R_T, after[:, :3, 3] - before[:, :3, 3]) / (2 * h)
    w = lie.log_so3(np.swapaxes(before[:, :3, :3], -1, -2) @ after[:, :3, :3]) / (2 * h)
    assert_allclose(twist, np.hstack([v, w]), atol=1e-8)


def test_columns_are_found_by_name():
    assert ARM.columns(['spin', 'other', 'turn', 'slide'], 'It') == [2, 3, 0]
    with pytest.raises(BellowsError, match="It .*'slide'.* turn, spin"):
        ARM.columns(['turn', 'spin'], 'It')


def test_a_plan_of_joints_goes_through_its_points():
    t = np.linspace(0, 1, 11)
    q = np.outer(t**3 * (10 - 15 * t + 6 * t**2), [0.8, 0.2, -0.5])
    rate = np.outer(30 * t**2 * (1 - t)**2, [0.8, 0.2, -0.5])
    bend = np.outer(60 * t * (1 - t) * (1 - 2 * t), [0.8, 0.2, -0.5])
    stamps = np.round(t * 1e9).astype(np.int64)
    fine_t = np.linspace(0, 1, 101)
    fine = np.outer(fine_t**3 * (10 - 15 * fine_t + 6 * fine_t**2), [0.8, 0.2, -0.5])
    truth = ARM.tool(fine)[0][:, :3, 3]
    errors = []
    for given in ((q, rate, bend), (q, rate), (q,)):
        plan, _ = plan_of_joints(ARM, ARM.moving, stamps, *given)
        assert len(plan) == 101
        assert_allclose(plan.position[::10], truth[::10], atol=1e-12)
        errors.append(np.abs(plan.position - truth).max())
    assert errors[0] < 1e-12 < errors[1] < 1e-4 and errors[2] < 1e-3
    with pytest.raises(BellowsError, match=r'\b3\b'):
        broken = np.where(np.arange(11)[:, None] == 3, np.nan, q)
        plan_of_joints(ARM, ARM.moving, stamps, broken)


@pytest.mark.parametrize(('urdf', 'link', 'named'), [
    (URDF, 'tol', "tool_link 'tol'.* tool, "), (URDF, 'camera', "'eye'.* floating"),
    ('<robot', 'tool', 'URDF'), ('<!DOCTYPE a [<!ENTITY b "c">]><robot/>', 'tool', 'URDF'),
    (URDF.replace('0 0 2', '0 0 0'), 'tool', "'turn'.* axis"),
    (URDF.replace('0 0 2', '0 0 x'), 'tool', "'turn'.* axis .*'0 0 x'"),
    (URDF, 'world', "tool_link 'world'"),
    (URDF.replace('<parent link="b"/>', ''), 'tool', 'parent.* way to the tool'),
    (URDF.replace('<parent link="world"/>', '<parent link="tool"/>'), 'tool', 'circle of joints'),
    (URDF.replace('<axis xyz="0 1 0"/>', '<mimic joint="no"/>'), 'tool', "'slide'.* mimics 'no'"),
])
def test_what_cannot_be_followed_is_refused(urdf, link, named):
    with pytest.raises(BellowsError, match=named):
        read_arm(urdf, link)


LIMITED = URDF.replace('<axis xyz="0 0 2"/>', '<axis xyz="0 0 2"/>'
                       '<limit lower="-1.5" upper="2" velocity="3" effort="1"/>')


def test_ranges_and_speeds_of_joints_are_read():
    _, turn, slide, spin, _ = read_arm(LIMITED, 'tool').joints
    assert (turn.lower, turn.upper, turn.speed) == (-1.5, 2.0, 3.0)
    assert (slide.upper, spin.lower) == (np.inf, -np.inf)
    with pytest.raises(BellowsError, match="'fast'"):
        read_arm(LIMITED.replace('"3"', '"fast"'), 'tool')


def test_joint_positions_are_found_again():
    near = np.array([0.3, -0.2, 0.5])
    q = near + 0.2 * np.random.default_rng(3).standard_normal((7, 3))
    assert_allclose(ARM.positions(ARM.tool(q)[0], near), q, atol=1e-8)
    J = ARM.jacobian(q)
    rate = np.array([0.3, -0.4, 0.5])
    assert_allclose(J @ rate, ARM.tool(q, np.tile(rate, (7, 1)))[1], atol=1e-12)
    far = ARM.tool(q[:1])[0] + np.eye(4)[3] * 0.0
    far[0, :3, 3] += 2.0
    with pytest.raises(BellowsError):
        ARM.positions(far, near)


PALLETISER = """<robot name="p"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
<link name="tool"/>
<joint name="base_turn" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2"/></joint>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<origin xyz="0.1 0 0.4"/><limit lower="-1" upper="1" velocity="2"/></joint>
<joint name="level" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
<origin xyz="0.6 0 0"/><mimic joint="lift" multiplier="-1" offset="0.1"/></joint>
<joint name="spin" type="continuous"><parent link="c"/><child link="tool"/><axis xyz="0 0 1"/>
<origin xyz="0.1 0 -0.1"/></joint></robot>"""


def test_a_joint_that_mimics_another_moves_with_it():
    """Pose and Jacobian of a parallel palletiser: the tool keeps its tilt as the arm is lifted."""
    arm = read_arm(PALLETISER, 'tool')
    assert arm.moving == ('base_turn', 'lift', 'spin')
    q = np.array([[0.3, -0.4, 0.2], [0.3, 0.5, 0.2]])
    T, _ = arm.tool(q)
    assert_allclose(T[0, :3, :3], T[1, :3, :3], atol=1e-12)
    height = 0.4 - 0.6 * np.sin(q[:, 1])
    tilt = np.cos(0.1) * -0.1 - np.sin(0.1) * 0.1
    assert_allclose(T[:, 2, 3], height + tilt, atol=1e-12)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        moved = lie.log_se3(lie.inverse_transform(arm.tool(q - step)[0]) @ arm.tool(q + step)[0])
        assert_allclose(moved / 2e-6, arm.jacobian(q)[:, :, k], atol=1e-7)
    with pytest.raises(BellowsError, match="mimics 'none'"):
        read_arm(PALLETISER.replace('joint="lift" multi', 'joint="none" multi'), 'tool')
