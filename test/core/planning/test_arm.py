"""An arm by its URDF against products of matrices and finite differences."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.core.planning.points import (
    MAX_POINTS,
    plan_of,
    plan_of_joints,
    require_consistent,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.motion import Move

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
    for given in ((q, rate, bend), (q, rate)):
        plan, _ = plan_of_joints(ARM, ARM.moving, stamps, *given)
        assert len(plan) == 101
        assert_allclose(plan.position[::10], truth[::10], atol=1e-12)
        errors.append(np.abs(plan.position - truth).max())
    assert errors[0] < 1e-12 < errors[1] < 1e-4
    with pytest.raises(BellowsError, match=r'\b3\b'):
        broken = np.where(np.arange(11)[:, None] == 3, np.nan, q)
        plan_of_joints(ARM, ARM.moving, stamps, broken)


def test_joints_with_positions_alone_move_linearly_from_and_to_rest():
    """As ros2_control documents it: speeds change at the points, at the first and last from 0."""
    times, q = np.array([0, 300, 1000]) * 1_000_000, np.random.default_rng(4).normal(size=(3, 3))
    for given in ((q,), (q, None, np.ones((3, 3)))):  # accelerations without velocities
        plan, _ = plan_of_joints(ARM, ARM.moving, times, *given)
        assert plan.stamps_ns[0] == 0 and plan.stamps_ns[-1] == times[-1]
        position = np.column_stack([np.interp(plan.stamps_ns, times, each) for each in q.T])
        piece = np.minimum(np.searchsorted(times, plan.stamps_ns, 'right') - 1, 1)
        rate = (np.diff(q, axis=0) / np.diff(times / 1e9)[:, None])[piece]
        rate[[0, -1]] = 0.0
        T, twist = ARM.tool(position, rate)
        assert_allclose(plan.position, T[:, :3, 3], atol=1e-12)
        assert_allclose(plan.twist, twist, atol=1e-9)


@pytest.mark.parametrize(('urdf', 'link', 'named'), [
    (URDF, 'tol', "tool_link 'tol'.* tool, "), (URDF, 'camera', "'eye'.* floating"),
    ('<robot', 'tool', 'URDF'), ('<!DOCTYPE a [<!ENTITY b "c">]><robot/>', 'tool', 'URDF'),
    (URDF.replace('0 0 2', '0 0 0'), 'tool', "'turn'.* axis"),
    (URDF.replace('0 0 2', '0 0 x'), 'tool', "'turn'.* axis .*'0 0 x'"),
    (URDF, 'world', "tool_link 'world'"),
    (URDF.replace('<parent link="b"/>', ''), 'tool', 'parent.* way to the tool'),
    (URDF.replace('<parent link="world"/>', '<parent link="tool"/>'), 'tool', 'circle of joints'),
    (URDF.replace('<axis xyz="0 1 0"/>', '<mimic joint="no"/>'), 'tool',
     "'slide'.* mimics 'no', which is missing"),
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


MOVE = Move([0.5, -0.3, 0.2], [0.4, -0.6, 0.9], 0.8)
POINTS = MOVE.points(250)


def in_world(R, v):
    """Return body twists in world axes."""
    return np.hstack([np.einsum('nij,nj->ni', R, part) for part in (v[:, :3], v[:, 3:])])


def test_twists_of_a_path_are_those_of_a_spline_from_rest_to_rest():
    stamps, poses, v = MOVE.points(100)
    poses[::2, 3:] *= -1.0  # either sign
    plan = plan_of(stamps, poses).trajectory()
    assert_allclose(plan.twist, v, atol=2e-3)  # m/s, rad/s; h^3 of the spline
    two = plan_of(stamps[[0, -1]], poses[[0, -1]]).trajectory()
    middle = two.select(slice(len(two) // 2, len(two) // 2 + 1))
    assert_allclose(middle.twist[0, :3] @ middle.twist[0, :3], (1.5 / 0.8) ** 2 * 0.38, rtol=1e-6)


def changed(index, where, value):
    """Return the points with one number changed."""
    parts = [part.astype(part.dtype).copy() for part in POINTS]
    parts[index][where] = value
    return parts


@pytest.mark.parametrize(('parts', 'figures'), [
    ([part[:1] for part in POINTS], r'\b1 point\b.* 2 to 100000.* its start'),
    ([np.repeat(part[:1], MAX_POINTS + 1, axis=0) for part in POINTS],
     '100001 points.* 2 to 100000'),
    (changed(1, (7, 0), np.nan), r'point 7\b.* 1 of 201\b'),
    (changed(1, (9, slice(3, 7)), [0.0, 0.0, 0.0, 2.0]), r'point 9\b.* 1 of 201\b'),
    (changed(0, 20, 1), r'point 20\b.* 0.000000 s\b.* 0.076000 s\b'),
    (changed(0, -1, 700 * 10 ** 9), r'\b700 s\b.* 600\b'),
    (changed(1, (50, 2), 3.0), r'point 49\b.* jumps'),
    (changed(1, (50, slice(3, 7)), [1.0, 0.0, 0.0, 0.0]), r'point 49\b.* jumps'),
    (changed(2, (60, 1), 30.0), r'point 60\b.* 20 m/s'),
])
def test_what_no_arm_does_is_refused(parts, figures):
    with pytest.raises(BellowsError, match=figures):
        plan_of(*parts, twist_frame='tool')


def sampled(count, rng, stretch=0.0):
    """Return points of a random move at few, unevenly spaced times, with twists in the world."""
    move = Move(rng.normal(0.0, 0.4, 3), rng.normal(0.0, 0.1, 3), 0.8)
    t = np.linspace(0.0, 0.8, count)
    t[1:-1] += stretch * rng.uniform(-0.4, 0.4, count - 2) * 0.8 / (count - 1)
    o, R, v = move.at(t)
    return np.round(t * 1e9).astype(np.int64), np.hstack([o, rotation_to_quaternion(R)]), (
        in_world(R, v)), R


def test_plans_of_few_points_are_accepted():
    rng = np.random.default_rng(3)
    for count in range(2, 25):
        for stretch in (0.0, 1.0):
            stamps, poses, twist, _ = sampled(count, rng, stretch)
            plan_of(stamps, poses, twist)
    there = np.array([[x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for x in (0.0, 0.3, 0.3, 0.0)])
    plan_of(np.arange(4) * 10**9, there, np.zeros((4, 6)))  # stops at each, and comes back


@pytest.mark.parametrize(('count', 'factor'), [
    (3, -1.0), (19, -1.0), (25, -1.0), (25, 1e-3), (25, 180.0 / np.pi), (25, 0.0)])
@pytest.mark.parametrize('part', [0, 1])
def test_velocities_that_contradict_the_points_are_refused(count, factor, part):
    """Another sign from three points on, another unit or none from 20; in other axes, too."""
    stamps, poses, twist, _ = sampled(count, np.random.default_rng(5))
    twist[:, 3 * part:3 * part + 3] *= factor
    with pytest.raises(BellowsError):
        plan_of(stamps, poses, twist)
    stamps, poses, v = Move([0.5, 0.0, 0.0], [0.0, 0.0, 3.0], 0.8).points(250)
    with pytest.raises(BellowsError, match=r'tool_twist\.frame'):
        plan_of(stamps, poses, v, twist_frame='world')


@pytest.mark.parametrize('speed', [0.0, 0.02, 0.1])
def test_noise_of_recorded_poses_is_no_other_motion(speed):
    """Accept rates that are right, whatever the noise of the steps; refuse their negatives."""
    rng = np.random.default_rng(3)
    t = np.arange(1000) / 360.0
    rates = speed * np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t), np.sin(5.0 * t)])
    poses = np.cumsum(rates, axis=0) / 360.0 + 2e-5 * rng.standard_normal(rates.shape)
    durations, steps = np.diff(t), np.diff(poses, axis=0)
    require_consistent(durations, steps, rates, 'Rates')
    if speed:
        with pytest.raises(BellowsError, match='Rates'):
            require_consistent(durations, steps, -rates, 'Rates')
