"""Errors of measured poses, against geometry written with arrays."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.recording.measurement_model import MeasurementModel, pose_noise
from bellows_ros.core.signals.trajectory import PoseStream
import numpy as np
import pytest

CAMERA = (0.3, -0.2, 1.1)
MODEL = MeasurementModel(
    'tag', (1e-3, 5e-3, 1e-2, 3e-3), (2e-3, 2e-2, 1e-1, 4e-2), CAMERA, scale=1.02)


@pytest.fixture
def rng():
    """Give random numbers of a seed."""
    return np.random.default_rng(3)


def test_covariance_is_diagonal_in_axes_of_the_line_of_sight(rng):
    """State lateral and depth errors apart, by distance and by speed across the line of sight."""
    for _ in range(5):
        place, velocity = rng.normal(size=(2, 3))
        sight = place - CAMERA
        distance = np.linalg.norm(sight)
        z = sight / distance
        x = np.cross(z, rng.normal(size=3))
        x /= np.linalg.norm(x)
        axes = np.kron(np.eye(2), np.column_stack([x, np.cross(z, x), z]))
        v2 = velocity @ velocity - (velocity @ z) ** 2
        factors = np.array([distance, distance**2, distance, distance])
        blurred = np.array([1.0, distance, 1.0, 1.0]) * MODEL.in_motion * v2
        lateral, depth, across, along = np.hypot(factors * MODEL.at_rest, blurred)
        covariance = pose_noise(MODEL.sensor, tuple(place), tuple(velocity))
        np.testing.assert_allclose(
            axes.T @ covariance @ axes,
            np.diag([lateral, lateral, depth, across, across, along]) ** 2, atol=1e-12)


def test_second_solution_has_the_same_image_from_afar(rng):
    """Mirror the tilt: corners keep their lateral places, and their depths change sign."""
    place = np.array(CAMERA) + [0.1, 0.2, 3.0]
    sight = (place - CAMERA) / np.linalg.norm(place - CAMERA)
    rotation = exp_so3(rng.normal(size=3))
    (other,) = MODEL.second_solution(place[None], rotation[None])
    assert np.linalg.det(other) == pytest.approx(1.0)
    for corner in ([1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]):
        first, second = rotation @ corner, other @ corner
        assert second @ sight == pytest.approx(-first @ sight)
        np.testing.assert_allclose(
            second - (second @ sight) * sight, first - (first @ sight) * sight, atol=1e-12)
    (again,) = MODEL.second_solution(place[None], other[None])
    np.testing.assert_allclose(again, rotation, atol=1e-12)


def test_errors_of_recorded_poses_are_those_of_the_observer(rng):
    """Agree with the covariance at the middle of three poses in uniform motion."""
    velocity = np.array([0.3, -0.2, 0.1])
    stamps, rotation = np.arange(3) * 33_000_000, exp_so3(rng.normal(size=(3, 3)))
    position = [0.4, 0.1, 0.5] + velocity * stamps[:, None] * 1e-9
    errors = MODEL.errors(PoseStream('tag', 'camera', stamps, position, rotation))
    covariance = pose_noise(MODEL.sensor, tuple(position[1]), tuple(velocity))
    axes = np.kron(np.eye(2), errors.axes[1])
    np.testing.assert_allclose(
        axes.T @ covariance @ axes, np.diag(errors.std[1]) ** 2, atol=1e-12)
    np.testing.assert_allclose(errors.at(stamps[1:2] + 9).std[0], errors.std[1])
    body = errors.at(stamps[1:2]).body_std(rotation[1:2])
    R = np.kron(np.eye(2), rotation[1])
    np.testing.assert_allclose(body, np.sqrt(np.diag(R.T @ covariance @ R)))


def test_body_errs_alike_from_everywhere():
    """Depend neither on place nor on speed without a line of sight."""
    covariance = pose_noise(MeasurementModel().sensor, (1.0,) * 3, (1.0,) * 3)
    np.testing.assert_allclose(covariance, np.diag([2e-3] * 3 + [1e-2] * 3) ** 2)


def test_scale_and_frame_apply_about_the_camera():
    """Correct the size of the tag along the line of sight, in a frame that has moved."""
    turn = (0.0, 0.0, 1.0, 0.0)
    there = MODEL.moved((1.0, 0.0, 0.0), turn)
    assert there.camera == pytest.approx((0.7, 0.2, 1.1))
    assert there.scaled((1.7, 0.2, 1.1)) == pytest.approx((1.72, 0.2, 1.1))
