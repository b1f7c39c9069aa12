"""The distance of two poses counts each axis by its own tolerance."""

from bellows_ros.core.geometry.pose_distance import pose_distances
import numpy as np
from numpy.testing import assert_allclose
import pytest

TOLERANCE = 0.02, 0.2


@pytest.mark.parametrize('axis', range(6))
def test_the_same_number_of_tolerances_is_as_far_along_each_axis(axis):
    differences = np.zeros((2, 1, 3))
    differences[axis // 3, 0, axis % 3] = -3.0 * TOLERANCE[axis // 3]
    assert_allclose(pose_distances(differences, np.array([TOLERANCE]).T), 3.0, rtol=1e-14)
