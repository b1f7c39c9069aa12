"""Marker frames brought to E, S and B, and two worlds to one, against poses that are known."""

from functools import partial

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3
from bellows_ros.core.parameters.checks import validate
from bellows_ros.core.recording import alignment
from bellows_ros.core.recording.alignment import aligned_at_rest, standstill
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.motion import held, shaken, Shaking, START
from ...cell.sensors import Noise, noisy

COM = np.array([0.004, -0.002, -0.03])
TOOL_MARKERS = exp_so3([0.3, -0.2, 2.5])
PACKAGE_MARKERS = exp_so3([-1.0, 0.4, -0.6])
ASIDE = np.array([0.8e-3, -0.6e-3, 0.0])


held = partial(held, seconds=8.0, com=np.zeros(3), origin=(1.0, 2.0, 1.5))


def moved(poses, offset, turn):
    """Give poses of another frame on the same body."""
    return Trajectory(poses.stamps_ns, poses.position + apply(poses.rotation, offset),
                      poses.rotation @ turn)


def rest_of(poses, seconds=1.5):
    return standstill(poses, START, seconds, 'body')


def assert_same_poses(actual, expected, atol):
    assert_allclose(actual.position, expected.position, atol=atol)
    turn = log_so3(np.swapaxes(expected.rotation, -1, -2) @ actual.rotation)
    assert_allclose(turn, 0.0, atol=atol)


@pytest.mark.parametrize('frame', ['lip', 'com'])
def test_markers_turned_and_a_lip_aside_are_found_and_undone(frame):
    tool, lip = held(40)
    tool_markers = moved(tool, np.zeros(3), TOOL_MARKERS)
    # The plate's origin is beside the lip's centre by a constant of the plate.
    origin = ASIDE if frame == 'lip' else ASIDE + COM
    package_markers = moved(lip, origin, PACKAGE_MARKERS)
    found = aligned_at_rest(rest_of(tool_markers), rest_of(package_markers), frame, COM)
    assert_allclose(found.lateral_offset, ASIDE, atol=1e-12)
    assert_allclose(found.R_tool_markers_tool, TOOL_MARKERS.T, atol=1e-12)
    assert_allclose(found.R_package_markers_lip, PACKAGE_MARKERS.T, atol=1e-12)
    assert_same_poses(found.tool(tool_markers), tool, 1e-12)
    assert_same_poses(found.package(package_markers), moved(lip, COM, np.eye(3)), 1e-12)


def test_a_standstill_is_the_mean_of_noise_without_outliers():
    rng = np.random.default_rng(47)
    still = Trajectory(START + np.arange(720) * 2_777_778, np.tile([1.0, 2.0, 3.0], (720, 1)),
                       np.tile(TOOL_MARKERS, (720, 1, 1)))
    poses = noisy(rng, still, Noise())
    position, rotation = poses.position.copy(), poses.rotation.copy()
    position[100:104] += [0.05, 0.0, 0.0]  # an outlier that was not marked
    position[200:230] += [0.5, 0.0, 0.0]  # one that was
    valid = np.full(720, True)
    valid[200:230] = False
    poses = Trajectory(poses.stamps_ns, position, rotation, valid=valid)
    found = standstill(poses, START, 2.0, 'tool')
    # Five standard deviations of a mean of 690.
    assert_allclose(found.position, [1.0, 2.0, 3.0], atol=5 * 1e-4 / np.sqrt(690))
    assert_allclose(log_so3(TOOL_MARKERS.T @ found.rotation), 0.0, atol=5 * 5e-4 / np.sqrt(690))


@pytest.mark.parametrize('noise', [0.0, 1e-3])
def test_a_rest_ends_where_a_body_sets_off_and_is_refused_if_short(noise):
    rng = np.random.default_rng(48)
    poses = noisy(rng, shaken(rng, Shaking(360.0, 20.0)), Noise(noise, noise))
    assert alignment.rest_of(poses, poses).seconds == pytest.approx(2.0, abs=0.25)
    with pytest.raises(BellowsError, match=r'first 0\.4 s'):
        standstill(poses, START, 0.4, 'tool')


@pytest.mark.parametrize('where', [[0.0, 0.0, 0.05], [0.0, -0.05, 0.0]])
def test_a_lip_that_does_not_hang_below_the_tool_is_refused(where):
    """Exchanged topics put it above, a wrong world aside."""
    tool, lip = held(50)
    there = Trajectory(lip.stamps_ns, tool.position + where, lip.rotation)
    with pytest.raises(BellowsError):
        aligned_at_rest(rest_of(tool), rest_of(there), 'lip', np.zeros(3))


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


@pytest.mark.parametrize('to_lip', [None, np.zeros(3)])
def test_hand_eye_is_exact_for_a_rigid_cup(to_lip):
    """Find the transform as well as poses are interpolated between others 10 ms apart."""
    tool, package = rigid()
    pose, grip = alignment.hand_eye(
        tool.trajectory(), package.trajectory(), LENGTH, np.zeros(3), to_lip)
    if grip:
        assert_allclose(grip.R_package_markers_lip, np.eye(3), atol=1e-7)
    assert_allclose(
        lie.transform(lie.quaternion_to_rotation(pose[3:]), pose[:3]), T_BASE_MOCAP, atol=1e-7)
    moved = alignment.in_tool_world(package, pose, 'base')
    assert moved.frame_id == 'base'
    lip = tool.position - LENGTH * tool.rotation[:, :, 2]
    assert_allclose(moved.position, lip, atol=1e-7)


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
