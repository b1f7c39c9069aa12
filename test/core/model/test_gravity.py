"""Which way is down."""

from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.parameters.conversion import gravity_of
from bellows_ros.core.recording.alignment import levelling
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest


def test_gravity_has_size_and_direction():
    values = {'gravity.magnitude': 9.5, 'gravity.direction': (0.0, 3.0, 4.0)}
    assert_allclose(gravity_of(values), [0.0, 5.7, 7.6], rtol=1e-15)


def test_the_default_is_exact():
    values = {'gravity.magnitude': 9.81, 'gravity.direction': (0.0, 0.0, -1.0)}
    assert gravity_of(values).tolist() == [0.0, 0.0, -9.81]
    assert_array_equal(levelling((0.0, 0.0, -1.0)), np.eye(3))


@pytest.mark.parametrize('size', [1e-3, 1.0, 1e3])
def test_levelling_is_the_smallest_rotation_that_makes_a_direction_down(size):
    rng = np.random.default_rng(2)
    tilts = [*rng.normal(size=(50, 3)), *1e-9 * rng.normal(size=(20, 3))]
    for direction in [*tilts, *(np.array([0.0, 0.0, s]) + t for s in (1, -1) for t in tilts)]:
        R = levelling(size * direction)
        down = direction / np.linalg.norm(direction)
        assert_allclose(R @ down, [0.0, 0.0, -1.0], atol=1e-14)
        assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        angle = np.arctan2(np.linalg.norm(down[:2]), -down[2])
        assert_allclose(np.linalg.norm(log_so3(R)), angle, atol=1e-7)


def test_a_world_upside_down_is_turned_about_x():
    assert_array_equal(levelling((0.0, 0.0, 2.0)), np.diag([1.0, -1.0, -1.0]))
