"""The sizes of a tag's errors from the squares of its errors."""

from bellows_ros.core.observer.calibration import squared_sizes
import numpy as np
import pytest


@pytest.mark.parametrize('rest', [0.0, 2.0])
def test_sizes_at_rest_and_in_motion_are_found_also_without_noise_at_rest(rest):
    rng = np.random.default_rng(0)
    true, speed = np.tile([rest, 3.0], (4, 1)), np.repeat([0.0, 1.0], 5000)
    units = np.repeat(np.stack([np.ones(10000), speed], axis=1)[:, :, None], 4, axis=2)
    squares = np.einsum('nka,ak->na', units, true) * rng.chisquare(1.0, (10000, 4))
    np.testing.assert_allclose(squared_sizes(squares, units), true, rtol=0.25, atol=1e-3)
