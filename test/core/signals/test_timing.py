"""Stamps that are times of arrival: found where they are, and nowhere else."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.resampling import at_sampling
from bellows_ros.core.signals.trajectory import PoseStream
import numpy as np
from numpy.testing import assert_allclose
import pytest

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


@pytest.mark.parametrize('gaps', [False, True])
@pytest.mark.parametrize(('longest_s', 'size'), [(3e-3, 0.1), (8e-3, 1.0)])
def test_stamps_of_arrival_become_those_of_the_sampling(longest_s, size, gaps):
    sampled = START + np.rint(np.arange(2400) * 1e9 / HZ * 1.00003).astype(np.int64)
    lost = np.isin(np.arange(2400), [[700, *range(1500, 1560)]]) if gaps else np.zeros(2400, bool)
    stamps = arrived(sampled, longest_s, 1)[~lost]
    stream = PoseStream('/tool', 'world', stamps, *moving(sampled[~lost], 2, 1.0, size))
    found, arrivals = at_sampling(stream)
    off = found.stamps_ns - sampled[~lost]
    assert np.mean(np.abs(off) < 2e5) > 0.99  # beside a gap a few may be off by a period
    assert arrivals.replaced == len(stamps)
    assert_allclose(arrivals.latest_s, longest_s, rtol=0.05 if not lost.any() else 1.5)
    assert_allclose(arrivals.smoother, np.multiply(size, STD), rtol=0.1)
    assert np.prod(arrivals.rougher) > 1.1 * np.prod(arrivals.smoother)
    assert 'times of arrival' in arrivals.sentence('/tool')


@pytest.mark.parametrize(('speed', 'arrives'), [(1.0, False), (0.0, False), (0.0, True)])
def test_true_stamps_and_bodies_at_rest_are_left_alone(speed, arrives):
    sampled = START + np.rint(np.arange(2400) * 1e9 / HZ).astype(np.int64)
    stamps = arrived(sampled, 8e-3, 3)  # with a trigger that jitters they are times of sampling
    stream = PoseStream(
        '/tool', 'world', stamps, *moving(sampled if arrives else stamps, 4, speed))
    found, arrivals = at_sampling(stream)
    assert arrivals is None
    assert found is stream
