"""Filters of first order, against SciPy's."""

from bellows_ros.core.signals.savgol import first_order
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import lfilter


@pytest.mark.parametrize('kept', [0.0, 0.3, 0.999, -0.5])
def test_it_is_the_filter_of_scipy(kept):
    inputs = np.random.default_rng(1).standard_normal((500, 3))
    expected = lfilter([1.0], [1.0, -kept], inputs, axis=0)
    assert_allclose(first_order(inputs, kept), expected, atol=1e-9)
