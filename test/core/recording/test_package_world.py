"""The transform between the world of the tool's poses and that of the package's."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.parameters.checks import validate
from bellows_ros.core.recording import alignment
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

T_BASE_MOCAP = lie.transform(lie.exp_so3(np.array([0.3, -1.1, 2.0])), np.array([1.2, -0.7, 0.3]))
LENGTH = 0.05


def rigid():
    """Return streams of two bodies that hang together, the package as motion capture sees it."""
    t = np.arange(0.0, 6.0, 0.01)
    turn = np.stack([0.3 * np.sin(1.1 * t), 0.2 * np.sin(1.7 * t), 0.5 * np.sin(0.7 * t)], 1)
    R = lie.exp_so3(turn)
    o = np.stack([0.1 * np.sin(t), 0.1 * np.cos(0.8 * t), 0.05 * np.sin(1.3 * t)], 1)
    stamps = 1_700_000_000_000_000_100 + np.round(1e9 * t).astype(np.int64)  # in no float
    T = lie.inverse_transform(T_BASE_MOCAP) @ lie.transform(R, o - LENGTH * R[:, :, 2])
    return (PoseStream('tool', 'base', stamps, o, R),
            PoseStream('package', 'mocap', stamps, T[:, :3, 3], T[:, :3, :3]))


def test_the_closed_form_is_exact_for_a_rigid_cup():
    """Find the transform as well as poses are interpolated between others 10 ms apart."""
    tool, package = rigid()
    pose = alignment.closed_form(tool.trajectory(), package.trajectory(), LENGTH, np.zeros(3))
    assert_allclose(
        lie.transform(lie.quaternion_to_rotation(pose[3:]), pose[:3]), T_BASE_MOCAP, atol=1e-7)
    moved = alignment.in_tool_world(package, pose, 'base')
    assert moved.frame_id == 'base'
    lip = tool.position - LENGTH * tool.rotation[:, :, 2]
    assert_allclose(moved.position, lip, atol=1e-7)


def test_nothing_that_turns_tells_no_turn_between_the_worlds():
    _, package = rigid()
    with pytest.raises(BellowsError):
        alignment.rotation_of(np.tile(np.eye(3), (len(package), 1, 1)), package.rotation)


def test_a_small_motion_of_the_world_moves_what_is_seen_in_it():
    _, package = rigid()
    pose = np.concatenate([T_BASE_MOCAP[:3, 3], lie.rotation_to_quaternion(T_BASE_MOCAP[:3, :3])])
    level, middle = lie.exp_so3(np.array([np.pi / 2, 0.0, 0.0])), np.array([0.1, 0.2, 0.3])
    theta = np.array([1e-3, 2e-3, -3e-3, 0.01, -0.02, 0.03])
    before, after = (
        lie.apply(level, alignment.in_tool_world(package, p, 'base').position)
        for p in (pose, alignment.shifted_pose(pose, level, middle, theta)))
    assert_allclose(
        after, middle + theta[:3] + lie.apply(lie.exp_so3(theta[3:]), before - middle), atol=1e-12)


def test_the_parameter_takes_numbers_in_any_form_and_nothing_else():
    name, text = 'recording.package_world', '1 2 3 0 0 0 1'
    for given in (text, [1, 2, 3, 0, 0, 0, 1], '[1.0, 2, 3, 0, 0, 0, 1]', (1, 2, 3, 0, 0, 0, 1.0)):
        assert validate(name, given) == text
    assert (validate(name, 'estimate'), validate(name, '')) == ('estimate', '')
    for wrong in ('guess', [1, 2], 3, [0, 0, 0, 0, 0, 0, 2], '1 2 3 0 0 nan 1'):
        with pytest.raises(BellowsError, match=name):
            validate(name, wrong)
