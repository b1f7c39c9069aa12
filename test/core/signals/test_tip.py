"""Poses, twists and plans of another frame of the tool than E: recorded, live, and of joints."""

from bellows_ros.core.geometry.lie import exp_so3, transform
from bellows_ros.core.parameters.checks import validate
from bellows_ros.core.parameters.conversion import tip_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.arm import Arm, Joint
from bellows_ros.core.signals import trajectory
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.transforms import Chain, MAX_FRAMES, QUEUE_LENGTH
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation, Slerp

from ...cell.motion import ShakenTool

TIP = tip_of(Values({'tool_pose.offset': '0.02 -0.01 0.15 1 0 0 0'}))


@pytest.fixture(scope='module')
def motion():
    """Give a motion of E, and that of the flange of which E is the tip."""
    tool = ShakenTool(np.random.default_rng(3), 1.3, 0.05, 0.3).trajectory(1.5, 250.0)
    return tool, trajectory.from_tip(tool, TIP)


def test_the_flange_moves_as_its_poses_say(motion):
    """Its body twist is the slope of its poses; the tip of it is E again."""
    tool, flange = motion
    assert_allclose(flange.position + flange.rotation @ TIP[:3, 3], tool.position, atol=1e-12)
    slope = (flange.position[2:] - flange.position[:-2]) / 0.008
    velocity = np.einsum('nij,nj->ni', flange.rotation, flange.twist[:, :3])
    assert_allclose(velocity[1:-1], slope, atol=5e-3)
    again = trajectory.at_tip(flange, TIP)
    assert_allclose(again.position, tool.position, atol=1e-12)
    assert_allclose(again.twist, tool.twist, atol=1e-10)


def twists_of(flange, in_world):
    """Return linear and angular parts in world axes or in those of the flange."""
    v, w = flange.twist[:, :3], flange.twist[:, 3:]
    return tuple(np.einsum('nij,nj->ni', flange.rotation, part) for part in (v, w)) \
        if in_world else (v, w)


@pytest.mark.parametrize('in_world', [True, False])
def test_recorded_streams_become_those_of_the_tip(motion, in_world):
    """The same as with streams of E, in the same kind of axes."""
    tool, flange = motion
    linear, angular = twists_of(flange, in_world)
    poses, twists = trajectory.streams_at_tip(
        trajectory.PoseStream('p', 'world', flange.stamps_ns, flange.position, flange.rotation),
        trajectory.TwistStream('t', 'world', flange.stamps_ns, linear, angular), TIP, in_world)
    expected = twists_of(tool, in_world)
    assert_allclose(poses.position, tool.position, atol=1e-12)
    assert_allclose(poses.rotation, tool.rotation, atol=1e-12)
    assert_allclose(twists.linear, expected[0], atol=1e-10)
    assert_allclose(twists.angular, expected[1], atol=1e-10)


def test_an_arm_ends_at_the_tip():
    """Poses of its joints are those of E."""
    joint = Joint('j', 'revolute', transform(np.eye(3), (0.1, 0.0, 0.2)), np.array([0.0, 0, 1]))
    arm = Arm('base', 'tool0', (joint,))
    pose, twist = arm.tool(np.array([[0.3]]), np.array([[1.0]]))
    tip, tip_twist = arm.with_tip(TIP).tool(np.array([[0.3]]), np.array([[1.0]]))
    assert_allclose(tip, pose @ TIP, atol=1e-12)
    assert_allclose(tip[0, :3, :3], exp_so3(np.array([0.0, 0.0, 0.3])) @ TIP[:3, :3], atol=1e-12)
    assert_allclose(tip_twist[0, 3:], TIP[:3, :3].T @ twist[0, 3:], atol=1e-12)
    assert arm.with_tip(None) is arm and arm.with_tip(TIP).moving == ('j',)


def test_refuses_what_is_no_pose():
    """Nor can it be estimated."""
    for wrong in ('estimate', '0 0 0', '0 0 0 2 0 0 0'):
        with pytest.raises(BellowsError, match=r'tool_pose\.offset'):
            validate('tool_pose.offset', wrong)
    assert tip_of(Values({'tool_pose.offset': ''})) is None


MS = 1_000_000
ONE = (0.0, 0.0, 0.0, 1.0)


def random_pose(rng, stamp_ns=0):
    """Return a pose anywhere."""
    return PoseSample(
        stamp_ns, tuple(rng.normal(size=3).tolist()),
        tuple(Rotation.random(random_state=rng).as_quat().tolist()))


def four(pose):
    """Turn a pose into four rows."""
    return transform(Rotation.from_quat(pose.quaternion_xyzw).as_matrix(), pose.position)


def along_x(stamp_ns, x):
    """Return a pose that is only shifted."""
    return PoseSample(stamp_ns, (x, 0.0, 0.0), ONE)


def test_a_chain_of_links_whose_world_is_in_another_branch():
    rng = np.random.default_rng(1)
    base, camera, wrist, tip = (random_pose(rng) for _ in range(4))
    chain = Chain('camera', 'tip')
    chain.add('root', 'base', base, static=True)
    chain.add('root', 'camera', camera, static=True)
    chain.add('wrist', 'tip', tip, static=True)
    for k in range(1, 4):
        moved = random_pose(rng, k * MS)
        chain.add('base', 'wrist', moved)
        (pose,) = chain.due()
        assert pose.stamp_ns == k * MS
        expected = np.linalg.inv(four(camera)) @ four(base) @ four(moved) @ four(tip)
        assert_allclose(four(pose), expected, atol=1e-12)
    assert not chain.missing and not chain.dropped


def test_a_slower_link_is_interpolated_between_its_stamps():
    rng = np.random.default_rng(2)
    chain = Chain('world', 'tool')
    ends = [PoseSample(k * 10 * MS, (0.1 * k, 0.0, 0.0), tuple(
        Rotation.from_euler('z', 0.02 * k).as_quat().tolist())) for k in range(3)]
    turns = Slerp([0, 10, 20], Rotation.from_quat([end.quaternion_xyzw for end in ends]))
    poses, fast = [], {}
    chain.add('rail', 'tool', along_x(-MS, 0.0))  # with which the way is known
    for k in range(21):
        if k % 10 == 0:
            chain.add('world', 'rail', ends[k // 10])
        fast[k * MS] = random_pose(rng, k * MS)
        chain.add('rail', 'tool', fast[k * MS])
        poses += chain.due()
    assert [pose.stamp_ns for pose in poses] == [k * MS for k in range(21)]
    for k, pose in enumerate(poses):
        rail = PoseSample(0, (0.01 * k, 0.0, 0.0), turns(k).as_quat())
        # Along the chord the turn is off by up to the cube of its angle over 125.
        assert_allclose(four(pose), four(rail) @ four(fast[k * MS]), atol=0.02**3 / 100)


def test_missing_parts_are_reported():
    chain = Chain('world', 'tool')
    assert "no transforms connect 'world' and 'tool'" in chain.missing
    chain.add('arm', 'tool', along_x(5 * MS, 0.0))
    assert "lead up to 'world' and 'arm'" in chain.missing
    assert not list(chain.due())
    chain.add('world', 'arm', along_x(0, 1.0), static=True)
    assert chain.missing == "no transform of 'tool' has come" and not list(chain.due())
    chain.add('world', 'arm', along_x(7 * MS, 1.0))
    chain.add('arm', 'tool', along_x(2007 * MS, 0.0))
    assert not list(chain.due())  # where the other end is at that time is not known
    assert chain.missing == "the transforms of 'arm' are 2 s behind those of 'tool'"
    still = Chain('world', 'tool')
    still.add('world', 'tool', along_x(0, 0.0), static=True)
    assert 'all transforms are static' in still.missing


def test_two_parents_in_turn_and_loops_yield_no_pose():
    chain = Chain('world', 'tool')
    chain.add('world', 'left', along_x(0, 1.0), static=True)
    chain.add('world', 'right', along_x(0, -1.0), static=True)
    chain.add('rail', 'tool', along_x(0, 0.0))
    for stamp in range(1, 6):
        chain.add(('left', 'right')[stamp % 2], 'rail', along_x(2 * stamp * MS, 0.0))
        chain.add('rail', 'tool', along_x((2 * stamp - 1) * MS, 0.0))
        assert not list(chain.due())  # between a rail on the left and one on the right is none
    for parent, child in (('a', 'tool'), ('b', 'a'), ('tool', 'b'), ('world', 'world')):
        chain.add(parent, child, along_x(MS, 0.0))
        assert not list(chain.due())
    assert "'world' and 'b'" in chain.missing


def test_a_clock_set_back_is_followed_and_a_repetition_left_out():
    chain, got = Chain('world', 'tool'), []
    for stamp in (5, 6, 6, 7, 3, 4):
        chain.add('world', 'tool', along_x(stamp * MS, 0.1 * stamp))
        got += [(pose.stamp_ns // MS, round(pose.position[0], 9)) for pose in chain.due()]
    assert got == [(5, 0.5), (6, 0.6), (7, 0.7), (3, 0.3), (4, 0.4)]


def test_memory_is_bounded_and_what_is_dropped_counted():
    chain = Chain('world', 'tool')
    chain.add('world', 'rail', along_x(MS, 0.0))
    for k in range(2, QUEUE_LENGTH + 52):
        chain.add('rail', 'tool', along_x(k * MS, 0.0))
        assert not list(chain.due())
    assert chain.dropped == 50
    for k in range(MAX_FRAMES + 10):
        chain.add('world', f'frame {k}', along_x(MS, 0.0))
    assert len(chain._parents) == MAX_FRAMES
