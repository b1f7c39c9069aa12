"""Corners of a tag by a second projection, differences in time and pose, and both solutions."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.sensors.corners import (
    CornerNoise,
    corners_of_poses,
    equivalent_pose,
    frames_of,
    Tag,
    TagViews,
    views,
)
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

SIDE = 0.05


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def drawn(rng, count=6):
    """Return camera, tag, bodies (N, 13) with accelerations, and tags in front of the camera."""
    camera = lie.transform(lie.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    tag = lie.transform(lie.exp_so3(rng.normal(0.0, 0.3, 3)), [0.1, 0.02, -0.01])
    seen = [lie.transform(lie.exp_so3([np.pi + rng.normal(0.0, 0.4), *rng.normal(0.0, 0.4, 2)]), [
        *rng.normal(0.0, 0.2, 2), rng.uniform(0.6, 1.5)]) for _ in range(count)]
    bodies = np.array([camera @ T @ np.linalg.inv(tag) for T in seen])
    rows = np.column_stack([
        bodies[:, :3, 3], lie.rotation_to_quaternion(bodies[:, :3, :3]),
        rng.normal(0.0, 0.5, (count, 3)), rng.normal(0.0, 2.0, (count, 3))])
    return camera, tag, np.array(seen), rows, rng.normal(0.0, 20.0, (count, 6))


def seen_by(camera, tag, position, rotation):
    """Return the views of tags at poses in the world."""
    stamps = 33_000_000 * (1 + np.arange(len(position)))
    return TagViews.of(Tag(SIDE, CornerNoise(1e-5, 0.0), T_world_camera=camera), PoseStream(
        'tag', 'world', stamps, position, rotation), tag)


def image(camera, tag, position, rotation, side=SIDE):
    """Return the corners (8,) of a tag on a body, by homogeneous transformations."""
    h = side / 2.0
    points = np.array([[-h, h, 0, 1], [h, h, 0, 1], [h, -h, 0, 1], [-h, -h, 0, 1]])
    places = (np.linalg.inv(camera) @ lie.transform(rotation, position) @ tag @ points.T)[:3]
    return (places[:2] / places[2]).T.ravel()


def test_residual_and_derivatives_are_those_of_a_second_projection(rng):
    """Q^T (y - image), Q^T of the acceleration, and J^T J by central differences."""
    camera, tag, poses, rows, accelerations = drawn(rng)
    seen = rng.normal(0.0, 0.01, (len(rows), 8))
    sight = seen_by(camera, tag, poses[:, :3, 3], poses[:, :3, :3]).sight
    out, maps, speeds = views(rows, accelerations, sight, seen)
    for n, row in enumerate(rows):
        o, R = row[:3], lie.quaternion_to_rotation(row[3:7])

        def moved(shift, turn, o=o, R=R):
            return image(camera, tag, o + R @ shift, R @ lie.exp_so3(turn))

        step = 1e-6
        J = np.transpose([(moved(e[:3], e[3:]) - moved(-e[:3], -e[3:])) / (2.0 * step)
                          for e in step * np.eye(6)])
        assert_allclose(maps[n].T @ maps[n], J.T @ J, rtol=1e-6, atol=1e-6)
        assert_allclose(np.tril(maps[n], -1), 0.0)
        r = seen[n] - moved(np.zeros(3), np.zeros(3))
        assert_allclose(maps[n].T @ out[n, :6, 0], J.T @ r, atol=1e-8)
        assert np.linalg.norm(out[n, :, 0]) == pytest.approx(np.linalg.norm(r))

        def at(t, row=row, a=accelerations[n]):
            return moved(row[7:10] * t + a[:3] * t * t / 2, row[10:] * t + a[3:] * t * t / 2)

        h = 1e-4
        acceleration = (at(h) - 2.0 * at(0.0) + at(-h)) / h**2
        assert_allclose(maps[n].T @ out[n, :6, 1], J.T @ acceleration, rtol=1e-3, atol=1e-2)
        velocity = (at(h) - at(-h)) / (2.0 * h)
        assert speeds[n] == pytest.approx(
            np.sqrt(np.mean(np.sum(velocity.reshape(4, 2) ** 2, axis=1))), rel=1e-3)


def mirrored(position, rotation):
    """Return the second solutions of distant tags, their tilt mirrored at the line of sight."""
    along = position / np.linalg.norm(position, axis=1)[:, None]
    half_turn = 2.0 * along[:, :, None] * along[:, None, :] - np.eye(3)
    return half_turn @ rotation @ np.diag([-1.0, -1.0, 1.0])


def test_corners_of_poses_are_the_corners_seen_with_either_solution(rng):
    camera, tag, seen, rows, _ = drawn(rng)
    position, rotation = seen[:, :3, 3], seen[:, :3, :3]
    T = camera @ seen
    found = seen_by(camera, tag, T[:, :3, 3], T[:, :3, :3])
    for row, each in zip(rows, found.corners, strict=True):
        assert_allclose(each, image(camera, tag, row[:3], lie.quaternion_to_rotation(row[3:7])))
    far, other = 40.0 * position, mirrored(position, rotation)
    apart = np.linalg.norm(lie.log_so3(np.swapaxes(rotation, 1, 2) @ other), axis=1)
    assert apart.max() > 0.3
    size = np.ptp(corners_of_poses(far, rotation, SIDE).reshape(-1, 4, 2), axis=1).max()
    assert np.abs(corners_of_poses(far, rotation, SIDE) - corners_of_poses(
        far, other, SIDE)).max() < 2e-3 * size


def test_poses_near_a_prediction_show_the_corners(rng):
    """From predictions that are off by some 10 mm and 3 degrees."""
    camera, tag, _, rows, _ = drawn(rng, 20)
    rotation = lie.quaternion_to_rotation(rows[:, 3:7])
    found = TagViews(
        Tag(SIDE, CornerNoise(1e-5, 0.0), T_world_camera=camera), np.arange(20) * 33_000_000,
        np.array([image(camera, tag, row[:3], R) for row, R in zip(rows, rotation, strict=True)]),
        np.ones(20), tag)
    poses, std = found.poses_near(Trajectory(
        found.stamps_ns, rows[:, :3] + rng.normal(0.0, 5e-3, (20, 3)),
        rotation @ lie.exp_so3(rng.normal(0.0, 0.03, (20, 3)))))
    error = np.hstack([poses.position - rows[:, :3], lie.log_so3(
        np.swapaxes(rotation, 1, 2) @ poses.rotation)])
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < std)


def test_noise_grows_with_the_smear_and_with_the_frames_of_a_view():
    noise = CornerNoise(1e-4, 20.0)
    assert_allclose(noise.variance(np.array([0.0, 5e-3]), np.ones(2)), [1e-8, 1e-8 + 25e-8])
    corners = np.zeros((9, 8))
    corners[:, 3] = [0.0, 1e-4, 2e-4, 1.0, 2.0, 2.0001, 3.0, 4.0, 4.0]
    assert_allclose(frames_of(corners), [3, 3, 3, 1, 2, 2, 1, 2, 2])
    assert_allclose(noise.variance(np.zeros(9), frames_of(corners))[:4] / 1e-8, [2.6] * 3 + [1.0])


def test_pose_of_a_view_errs_across_the_line_of_sight_and_with_the_square_of_the_speed():
    """
    Add the common error of corners to a quarter each by their mean and by the tilt.

    A tilt shifts all corners as much, which the other axis tells; the smear is v T / Z.
    """
    sigma, growth, exposure, depth, half = 3e-4, 30.0, 0.01, 1.5, 0.04
    identity, still = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), ((0.0,) * 3, (0.0,) * 3)
    sight = (0.0, 0.0, 0.0), identity, (0.0, 0.0, 0.0), identity, half
    variances = []
    for speed in (0.0, 0.5, 1.0):
        body = (0.0, 0.0, depth), (0.0, 0.0, 0.0, 1.0), (speed, 0.0, 0.0), (0.0, 0.0, 0.0)
        noise = equivalent_pose(
            body, still, sight, (True, sigma, growth, (0.0,) * 3, identity, half, exposure),
            np.zeros((1, 8)))[1]
        variances.append(noise[0, 0])
    assert variances[0] == pytest.approx((sigma * depth) ** 2 * (1.0 + 0.5), rel=0.01)
    smear = np.array([0.5, 1.0]) * exposure / depth
    assert_allclose(
        variances[1:] / variances[0], 1.0 + (growth * smear**2 / sigma) ** 2, rtol=0.02)
