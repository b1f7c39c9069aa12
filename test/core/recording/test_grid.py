"""Rates, gaps and jitter of stamps, and poses brought to a uniform rate."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.resampling import on_grid, timing
from bellows_ros.core.signals.savgol import savgol
from bellows_ros.core.signals.trajectory import Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from .tracking import START


def rounded_stamps(rate_hz, count):
    """Give stamps as a driver rounds them: to whole nanoseconds, downwards."""
    return START + (np.arange(count) * 1_000_000_000) // rate_hz


def moving(stamps_ns):
    """Give a smooth motion at any stamps."""
    t = (stamps_ns - START) / 1e9
    position = np.stack([np.sin(6.0 * t), np.cos(5.0 * t), 0.2 * t], axis=1)
    return Trajectory(stamps_ns, position, exp_so3(0.5 * np.sin(4.0 * t)[:, None] * [1, 2, 0.5]))


@pytest.mark.parametrize('rate_hz', [100, 125, 360, 500, 1000])
def test_rounded_stamps_are_uniform_and_copied(rate_hz):
    poses = moving(rounded_stamps(rate_hz, 2000))
    found = timing(poses.stamps_ns)
    assert found.uniform
    assert found.gaps == ()
    assert_allclose(found.rate_hz, rate_hz, rtol=1e-7)
    grid = on_grid(poses, found)
    assert_array_equal(grid.stamps_ns, poses.stamps_ns)
    assert_array_equal(grid.position, poses.position)
    assert_array_equal(grid.rotation, poses.rotation)
    assert grid.valid.all()


@pytest.mark.parametrize('drift', [-0.05, -0.01, 0.003, 0.05])
def test_a_clock_that_runs_wrong_changes_the_rate_and_nothing_else(drift):
    stamps = START + np.rint(np.arange(5000) * (1e9 / 360 * (1 + drift))).astype(np.int64)
    found = timing(np.delete(stamps, slice(1000, 1030)))
    assert_allclose(found.rate_hz, 360 / (1 + drift), rtol=1e-6)
    assert found.uniform
    assert [gap.start_ns for gap in found.gaps] == [stamps[999]]
    assert_array_equal(on_grid(moving(stamps), timing(stamps)).stamps_ns, stamps)


@pytest.mark.parametrize('together', [2, 3, 5])
@pytest.mark.parametrize('count', [400, 401])
def test_poses_in_bursts_have_the_rate_of_their_mean_and_no_gaps(together, count):
    """As a driver sends them that collects a few, each stamped when it is sent."""
    k = np.arange(count)
    stamps = START + (k // together) * 10_000_000 * together + (k % together) * 100_000
    found = timing(stamps)
    assert_allclose(found.rate_hz, 100.0, rtol=0.01)
    assert found.gaps == ()
    assert on_grid(moving(stamps), found).valid.all()


@pytest.mark.parametrize('lost', [1, 2, 12, 39, 400])
def test_gaps_are_filled_on_the_grid_and_invalid(lost):
    poses = moving(rounded_stamps(360, 2000))
    missing = slice(700, 700 + lost)
    kept = poses.select(np.delete(np.arange(2000), missing))
    found = timing(kept.stamps_ns)
    (gap,) = found.gaps
    assert gap.start_ns == poses.stamps_ns[699]
    assert_allclose(gap.duration_s, (lost + 1) / 360, rtol=1e-6)
    grid = on_grid(kept, found)
    # The stamps put in divide the gap evenly: they are those lost, but for the rounding.
    assert np.max(np.abs(grid.stamps_ns - poses.stamps_ns)) <= 1
    assert_array_equal(np.flatnonzero(~grid.valid), np.arange(2000)[missing])
    assert np.isfinite(grid.position).all()
    assert_array_equal(grid.position[grid.valid], kept.position)


def test_jittering_stamps_are_interpolated_at_the_uniform_rate():
    rng = np.random.default_rng(4)
    even = rounded_stamps(360, 4000)
    stamps = even + np.rint(rng.uniform(-0.3, 0.3, 4000) * 1e9 / 360).astype(np.int64)
    found = timing(stamps)
    assert not found.uniform
    assert_allclose(found.rate_hz, 360, rtol=1e-2)
    grid = on_grid(moving(stamps), found)
    assert uniform_rate_hz(grid.stamps_ns) == pytest.approx(found.rate_hz, rel=1e-6)
    assert np.mean(grid.valid) > 0.99
    expected = moving(grid.stamps_ns)
    # A chord misses by at most acceleration h^2 / 8, with h up to 1.6 periods: here 0.09 mm.
    assert_allclose(grid.position, expected.position, atol=1e-4)
    assert savgol(grid, 10, 4).valid.any()


def test_stamps_far_apart_are_refused_and_not_filled():
    stamps = rounded_stamps(360, 1000)
    stamps[999] += 86_400_000_000_000
    poses = moving(stamps)
    with pytest.raises(BellowsError):
        on_grid(poses, timing(stamps))
