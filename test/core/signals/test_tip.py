"""Poses, twists and plans of another frame of the tool than E: recorded, live, and of joints."""

from bellows_ros.core.geometry.lie import exp_so3, transform
from bellows_ros.core.parameters.checks import validate
from bellows_ros.core.parameters.conversion import tip_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.arm import Arm, Joint
from bellows_ros.core.signals import trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..cases import ShakenTool

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
