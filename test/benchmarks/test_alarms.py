"""The likelihood-ratio test that alarms are measured against."""

from benchmarks.alarms import delays, least_delays, passages
import numpy as np
import pytest


def test_passage_takes_as_long_as_wald_says():
    """Pass on average after the threshold, and 0.583 std beyond it (Siegmund), by the drift."""
    for d2, threshold in ((0.3, 12.0), (1.0, 8.0)):
        taken = np.concatenate([
            1 + passages(np.full(1000, d2), threshold, seed) for seed in range(20)])
        expected = (threshold + 0.583 * np.sqrt(d2)) / (0.5 * d2)
        assert taken.mean() == pytest.approx(expected, rel=0.03)
    assert (passages(np.zeros(10), 1.0, 0) == -1).all()


def test_test_that_knows_a_slip_is_the_sooner_one():
    """Name a slip no sooner than the test that knows its time and size finds it."""
    least = least_delays('slip', 2, 'white', 2.0)
    right, named = delays('slip', 2, 'white', 2.0)
    assert right == 1.0
    assert 0.1 < least[len(least) // 2] < np.mean(named)
