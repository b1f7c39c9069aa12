"""Resampling against motions in closed form."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.resampling import at_sampling, resample, timing
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from ...cell.motion import EPOCH_NS, motion, poses_at, stamps


def errors(trajectory):
    """Return the largest errors of position, rotation and twist of a trajectory on the motion."""
    o, R, twist = poses_at(trajectory.stamps_ns)
    turn = lie.log_so3(np.swapaxes(R, -1, -2) @ trajectory.rotation)
    twist_error = 0.0 if trajectory.twist is None else np.abs(trajectory.twist - twist).max()
    return np.array([np.abs(trajectory.position - o).max(), np.abs(turn).max(), twist_error])


def test_hermite_is_of_fourth_order():
    wanted = EPOCH_NS + np.arange(10_000_000, 1_900_000_000, 1_234_567)
    coarse, fine = (errors(resample(motion(2 * f + 1, f), wanted)) for f in (50, 100))
    order = np.log2(coarse / fine)
    assert np.all(order[:2] > 3.9)
    # The twist is the derivative of a fourth-order interpolant.
    assert order[2] > 2.9
    assert np.all(fine[:2] < 1e-6)


@pytest.mark.parametrize('with_twist', [True, False])
def test_constant_twist_is_interpolated_exactly(with_twist):
    twist = np.array([0.0, 0.0, 0.4, 0.0, 0.0, 2.0])  # a screw: both interpolants hold it
    coarse, fine = stamps(11, 10.0), stamps(101, 100.0)
    way = np.multiply.outer((fine - EPOCH_NS) / 1e9, twist)
    T = lie.transform(lie.exp_so3(way[:, 3:]), way[:, :3])  # along its axis
    twists = np.tile(twist, (11, 1)) if with_twist else None
    result = resample(Trajectory(coarse, T[::10, :3, 3], T[::10, :3, :3], twists), fine)
    assert_allclose(result.position, T[:, :3, 3], atol=1e-15)
    assert_allclose(result.rotation, T[:, :3, :3], atol=2e-15)
    if with_twist:
        assert_allclose(result.twist, np.tile(twist, (101, 1)), atol=1e-13)


def test_twist_is_the_derivative_of_the_interpolated_pose():
    trajectory, h = motion(11, 10.0), 10_000
    at = trajectory.stamps_ns[:-1] + 37_000_000
    here, before, after = (resample(trajectory, at + s * h) for s in (0, -1, 1))
    R_inverse = np.swapaxes(here.rotation, -1, -2)
    v = lie.apply(R_inverse, after.position - before.position) / (2 * h * 1e-9)
    turn = lie.log_so3(np.swapaxes(before.rotation, -1, -2) @ after.rotation) / (2 * h * 1e-9)
    # Rounding of poses over 20 us, and h^2 times third derivatives of some 1e3.
    assert_allclose(here.twist, np.concatenate([v, turn], axis=1), atol=2e-7)


@pytest.mark.parametrize('offset_ns', [-1, 1])
def test_never_extrapolates(offset_ns):
    trajectory = motion(11, 10.0)
    with pytest.raises(BellowsError):
        resample(trajectory, trajectory.stamps_ns + offset_ns)
    with pytest.raises(BellowsError):
        resample(trajectory.select(slice(0, 0)), trajectory.stamps_ns)


def test_validity_of_resampled_samples():
    trajectory = motion(6, 10.0)
    valid = np.array([True, True, False, True, True, True])
    trajectory = Trajectory(
        trajectory.stamps_ns, trajectory.position, trajectory.rotation, valid=valid
    )
    wanted = EPOCH_NS + np.array([100, 150, 200, 250, 300, 350]) * 1_000_000
    result = resample(trajectory, wanted)
    assert_array_equal(result.valid, [True, False, False, False, True, True])


def test_long_gaps_are_not_valid():
    trajectory = motion(11, 10.0).select(np.array([0, 1, 2, 6, 7, 8]))
    wanted = EPOCH_NS + np.array([150, 200, 300, 500, 600, 650]) * 1_000_000
    result = resample(trajectory, wanted, longest_gap_ns=100_000_000)
    assert_array_equal(result.valid, [True, True, False, False, True, True])
    assert resample(trajectory, wanted).valid.all()


START, HZ, STD = 10**18, 120.0, (3e-4, 1e-3)


def moving(stamps, seed, speed=1.0, size=1.0):
    """Return poses of a smooth motion with noise."""
    rng, t = np.random.default_rng(seed), (stamps - START) / 1e9
    way = 0.02 * np.sin(np.outer(t, 2.0 * np.pi * speed * np.array([0.7, 1.3, 2.1])))
    turn = 4.0 * way[:, ::-1] + size * STD[1] * rng.standard_normal((len(t), 3))
    return way + size * STD[0] * rng.standard_normal((len(t), 3)), exp_so3(turn)


def arrived(sampled, longest_s, seed):
    """Return when samples arrive: each late by up to some time, in order."""
    late = np.random.default_rng(seed).integers(0, int(longest_s * 1e9), len(sampled))
    return np.maximum.accumulate(sampled + late) + np.arange(len(sampled))


def test_jitter_is_the_standard_deviation_of_the_steps():
    rng = np.random.default_rng(4)
    stamps_ns = EPOCH_NS + 4_000_000 * np.arange(20_000) + np.round(
        1e5 * rng.standard_normal(20_000)).astype(np.int64)
    result = timing(stamps_ns)
    assert_allclose(result.jitter_s, np.sqrt(2.0) * 1e-4, rtol=0.05)
    assert_allclose(result.rate_hz, 250.0, rtol=1e-3)
    assert not result.uniform


@pytest.mark.parametrize('gaps', [False, True])
@pytest.mark.parametrize(('longest_s', 'size'), [(3e-3, 0.1), (8e-3, 1.0)])
def test_stamps_of_arrival_become_those_of_the_sampling(longest_s, size, gaps):
    sampled = START + np.rint(np.arange(2400) * 1e9 / HZ * 1.00003).astype(np.int64)
    lost = np.isin(np.arange(2400), [[700, *range(1500, 1560)]]) if gaps else np.zeros(2400, bool)
    stamps = arrived(sampled, longest_s, 1)[~lost]
    stream = PoseStream('/tool', 'world', stamps, *moving(sampled[~lost], 2, 1.0, size))
    found, jitter_s = at_sampling(stream)
    off = found.stamps_ns - sampled[~lost]
    assert np.mean(np.abs(off) < 2e5) > 0.99  # beside a gap a few may be off by a period
    assert 0.2 < jitter_s / longest_s < 0.5


@pytest.mark.parametrize(('speed', 'arrives'), [(1.0, False), (0.0, False), (0.0, True)])
def test_true_stamps_and_bodies_at_rest_are_left_alone(speed, arrives):
    sampled = START + np.rint(np.arange(2400) * 1e9 / HZ).astype(np.int64)
    stamps = arrived(sampled, 8e-3, 3)  # with a trigger that jitters they are times of sampling
    stream = PoseStream(
        '/tool', 'world', stamps, *moving(sampled if arrives else stamps, 4, speed))
    found, jitter_s = at_sampling(stream)
    assert jitter_s == 0.0
    assert found is stream
