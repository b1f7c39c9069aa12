"""Streams and trajectories: their checks, and what is derived from them."""

from bellows_ros.core.signals.trajectory import Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from ...cell.motion import motion, stamps


def test_uniform_rate():
    assert_allclose(uniform_rate_hz(stamps(7201, 360.0)), 360.0, rtol=1e-9)
    jumpy = stamps(100, 360.0)
    jumpy[50] += 40_000
    for uneven, figure in ((jumpy, 50), (jumpy[:1], 2), (np.delete(stamps(100, 360.0), 40), 40)):
        with pytest.raises(BellowsError, match=rf'\b{figure}\b'):
            uniform_rate_hz(uneven)


def test_seconds_and_select():
    trajectory = motion(11, 10.0)
    assert_allclose(trajectory.seconds, np.arange(11) / 10, atol=1e-15)
    part = trajectory.select(trajectory.seconds > 0.45)
    assert len(part) == 6
    assert_array_equal(part.twist, trajectory.twist[5:])
    assert_array_equal(part.valid, True)


GOOD = {
    'stamps_ns': stamps(3, 10.0),
    'position': np.zeros((3, 3)),
    'rotation': np.tile(np.eye(3), (3, 1, 1)),
}
BAD = [
    ({'stamps_ns': stamps(3, 10.0) / 1e9}, 'stamps .*float64'),
    *(({'stamps_ns': stamps(3, 10.0)[[0, *order]]}, 'stamps .*sample 2') for order in (
        (2, 1), (1, 1))),
    ({'position': np.zeros((2, 3))}, r'position .*\(3, 3\).*\(2, 3\)'),
    ({'position': np.array([[0.0] * 3, [np.nan] * 3, [0.0] * 3])}, 'position of sample 1'),
    ({'rotation': np.full((3, 3, 3), np.inf)}, 'rotation of sample 0'),
    ({'rotation': np.stack([np.eye(3), np.eye(3), np.diag([1, 1, 1.0001])])}, 'sample 2'),
    ({'rotation': np.tile(np.diag([1.0, 1.0, -1.0]), (3, 1, 1))}, 'rotation of sample 0'),
    ({'twist': np.zeros((3, 3))}, r'twist .*\(3, 6\).*\(3, 3\)'),
    ({'acceleration': np.full((3, 6), np.nan)}, 'acceleration of sample 0'),
    ({'valid': np.ones(3)}, 'valid .*float64'), ({'valid': np.array([True])}, r'valid .*\(1,\)')]


@pytest.mark.parametrize('changed, named', BAD)
def test_a_bad_trajectory_is_refused(changed, named):
    with pytest.raises(BellowsError, match=named):
        Trajectory(**{**GOOD, **changed})
