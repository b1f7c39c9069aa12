"""Corners of a tag by a second projection, differences in time and pose, and both solutions."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.sensors.corners import (
    CornerNoise,
    corners_of_poses,
    frames_of,
    pose_in_camera,
    sight_of,
    views,
)
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


def image(camera, tag, position, rotation, side=SIDE):
    """Return the corners (8,) of a tag on a body, by homogeneous transformations."""
    h = side / 2.0
    points = np.array([[-h, h, 0, 1], [h, h, 0, 1], [h, -h, 0, 1], [-h, -h, 0, 1]])
    places = (np.linalg.inv(camera) @ lie.transform(rotation, position) @ tag @ points.T)[:3]
    return (places[:2] / places[2]).T.ravel()


def test_residual_and_derivatives_are_those_of_a_second_projection(rng):
    """Q^T (y - image), Q^T of the acceleration, and J^T J by central differences."""
    camera, tag, _, rows, accelerations = drawn(rng)
    seen = rng.normal(0.0, 0.01, (len(rows), 8))
    out, maps, speeds = views(rows, accelerations, sight_of(camera, tag, SIDE), seen)
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


def test_corners_of_poses_are_the_corners_seen(rng):
    """Also of the second solution of a distant tag, its tilt mirrored at the line of sight."""
    camera, tag, seen, rows, _ = drawn(rng)
    T = np.array([camera @ each for each in seen])
    position, rotation = pose_in_camera(camera, T[:, :3, 3], T[:, :3, :3])
    corners = corners_of_poses(position, rotation, SIDE)
    for row, each in zip(rows, corners, strict=True):
        assert_allclose(each, image(camera, tag, row[:3], lie.quaternion_to_rotation(row[3:7])))
    sight = 40.0 * position / np.linalg.norm(position, axis=1)[:, None]
    along = sight / 40.0
    half_turn = 2.0 * along[:, :, None] * along[:, None, :] - np.eye(3)
    mirrored = half_turn @ rotation @ np.diag([-1.0, -1.0, 1.0])
    apart = np.linalg.norm(lie.log_so3(np.swapaxes(rotation, 1, 2) @ mirrored), axis=1)
    assert apart.max() > 0.3
    assert_allclose(corners_of_poses(sight, rotation, SIDE), corners_of_poses(
        sight, mirrored, SIDE), atol=1e-6)  # of corners 1.2e-3 apart


def test_noise_grows_with_the_smear_and_with_the_frames_of_a_view():
    noise = CornerNoise(1e-4, 20.0)
    assert_allclose(noise.variance(np.array([0.0, 5e-3]), np.ones(2)), [1e-8, 1e-8 + 25e-8])
    corners = np.zeros((9, 8))
    corners[:, 3] = [0.0, 1e-4, 2e-4, 1.0, 2.0, 2.0001, 3.0, 4.0, 4.0]
    assert_allclose(frames_of(corners), [3, 3, 3, 1, 2, 2, 1, 2, 2])
    assert_allclose(noise.variance(np.zeros(9), frames_of(corners))[:4] / 1e-8, [2.6] * 3 + [1.0])
