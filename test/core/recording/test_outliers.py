"""Tracking faults found in motions whose faults are known, and none found in honest motions."""

from dataclasses import replace
import functools

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.recording.outliers import find_outliers
from bellows_ros.core.recording.pose_faults import noise_of
from bellows_ros.core.signals.resampling import timing
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from ...cell.motion import shaken, Shaking
from ...cell.sensors import displaced, Noise, noisy, with_excursions

NONE = Noise(0.0, 0.0)
LAB = Noise(1e-4, 5e-4)
COARSE = Noise(1e-3, 1e-3)
CALM, LIVELY, WILD = (0.5, 2.0), (2.0, 3.0), (10.0, 5.0)  # g, Hz
LARGE, SMALL = ((0.03, 2.0), (0.05, 2.0)), ((0.003, 0.01), (0.005, 0.02))  # m, rad: from, to


def found_in(poses):
    """Give the outliers of poses whose only gaps are those of their stamps."""
    return find_outliers(poses, timing(poses.stamps_ns).longest_step_ns)


@functools.cache
def recorded(seed, noise=LAB):
    """Give the poses of a motion at 360 Hz."""
    rng = np.random.default_rng(seed)
    return noisy(rng, shaken(rng, Shaking(360.0)), noise)


def without(poses, *missing):
    """Give poses with slices of them missing."""
    return poses.select(np.delete(np.arange(len(poses)), np.r_[missing]))


def score(rng, shake, noise, metres, radians, samples, recordings=3, count=8):
    """Give recall and precision of samples marked, over several recordings."""
    hit = off_in_all = marked = 0
    for _ in range(recordings):
        poses = noisy(rng, shaken(rng, shake), noise)
        poses, off = with_excursions(rng, poses, count, metres, radians, samples)
        bad = ~found_in(poses).good
        hit += np.count_nonzero(bad & off)
        off_in_all += np.count_nonzero(off)
        marked += np.count_nonzero(bad)
    return hit / off_in_all, hit / marked


@pytest.mark.parametrize(('rate_hz', 'motion', 'noise'), [
    (100.0, WILD, NONE), (100.0, LIVELY, COARSE), (360.0, CALM, Noise(1e-5, 1e-5)),
    (360.0, WILD, LAB), (1000.0, LIVELY, LAB), (1000.0, WILD, COARSE)])
def test_true_motion_is_not_omitted(rate_hz, motion, noise):
    """Up to 10 g at 5 Hz, even at 100 Hz, where neighbours differ by more than a jump would."""
    rng = np.random.default_rng(10)
    for _ in range(3):
        duration = min(12.0, 4500.0 / rate_hz)
        poses = noisy(rng, shaken(rng, Shaking(rate_hz, duration, *motion)), noise)
        found = found_in(poses)
        assert found.good.all()
        assert found.steps == ()


@pytest.mark.parametrize('motion', [CALM, LIVELY])
@pytest.mark.parametrize('rate_hz', [100.0, 360.0, 1000.0])
def test_a_motion_that_begins_at_once_is_no_jump(rate_hz, motion):
    """Its velocity jumps, its pose does not."""
    rng = np.random.default_rng(11)
    for _ in range(5):
        found = found_in(shaken(rng, Shaking(rate_hz, 6.0, *motion), at_once=True))
        assert found.good.all()


@pytest.mark.parametrize(('seed', 'rate_hz', 'motion', 'noise', 'excursion'), [
    *((13, *of, (*LARGE, (1, 200))) for of in (
        (100.0, LIVELY, COARSE), (360.0, CALM, NONE), (360.0, LIVELY, LAB),
        (1000.0, WILD, COARSE))),
    (14, 100.0, CALM, LAB, (*SMALL, (2, 7))), (14, 360.0, LIVELY, LAB, (*SMALL, (2, 7))),
    (14, 360.0, CALM, NONE, (*SMALL, (8, 200))), (14, 1000.0, LIVELY, LAB, (*SMALL, (8, 200)))])
def test_excursions_are_marked_to_the_sample(seed, rate_hz, motion, noise, excursion):
    """Large ones with noise of 1 mm or 10 g too, small ones with noise of 0.1 mm, 0.5 mrad."""
    recall, precision = score(
        np.random.default_rng(seed), Shaking(rate_hz, 20.0, *motion), noise, *excursion)
    is_large = excursion[:2] == LARGE
    assert recall > (0.99 if is_large else 0.95)
    assert precision > (0.97 if is_large else 0.9)


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('lengths', [(7, 3, 6), (12, 4, 20), (3, 9, 5)])
def test_excursions_that_overlap_are_marked_to_the_end_of_the_later_one(lengths, seed):
    """Of two errors of tracking, the second begins in the first."""
    rng, poses = np.random.default_rng(seed), recorded(3)
    first, begin, second = lengths
    begins = (700, 700 + begin)
    R, position = poses.rotation.copy(), poses.position.copy()
    bad = np.zeros(len(poses), dtype=bool)
    for start, length in zip(begins, (first, second), strict=True):
        off = slice(start, start + length)
        position[off] += rng.uniform(0.02, 0.05) * rng.choice([-1.0, 1.0], 3)
        R[off] = R[off] @ exp_so3(rng.uniform(0.1, 0.4) * rng.choice([-1.0, 1.0], 3))
        bad[off] = True
    good = found_in(Trajectory(poses.stamps_ns, position, R)).good
    assert not good[bad].any()
    assert np.count_nonzero(~good & ~bad) <= 2


@pytest.mark.parametrize('samples', [1, 2, 3, 6])
@pytest.mark.parametrize('degrees', [90.0, 175.0, 180.0])
def test_flips_of_a_symmetric_box_return(samples, degrees):
    """Noise decides between the two rotation vectors of half a turn."""
    poses, starts = recorded(17), np.arange(400, 4000, 400)
    for k, start in enumerate(starts):
        turn = np.zeros(3)
        turn[k % 3] = np.radians(degrees)
        poses = displaced(poses, slice(start, start + samples), np.zeros(3), turn, True)
    found = found_in(poses)
    assert found.steps == ()
    assert_array_equal(np.flatnonzero(~found.good),
                       (starts[:, None] + np.arange(samples)).ravel())


@pytest.mark.parametrize('on_body', [False, True])
def test_a_permanent_step_is_reported_and_only_its_sides_are_marked(on_body):
    found = found_in(displaced(recorded(16), slice(3000, None), np.array([0.03, 0, 0]),
                               np.array([0, 0.2, 0]), on_body))
    (step,) = found.steps
    assert step.before == 2999
    # The size of a jump is known to a few times the noise of one sample.
    assert_allclose([step.position, step.rotation], [0.03, 0.2], atol=4e-3)
    assert_array_equal(np.flatnonzero(~found.good), [2999, 3000])


@pytest.mark.parametrize('noise', [NONE, LAB])
@pytest.mark.parametrize('length', [1, 2, 30, 150])
@pytest.mark.parametrize('where', ['start', 'end'])
def test_excursions_at_the_ends_are_marked(where, length, noise):
    poses = recorded(19, noise)
    run = slice(0, length) if where == 'start' else slice(len(poses) - length, len(poses))
    poses = displaced(poses, run, np.array([0.03, 0, 0]), np.array([0, 0.2, 0]), True)
    found = found_in(poses)
    assert_array_equal(np.flatnonzero(~found.good), np.arange(len(poses))[run])
    assert found.steps == ()


@pytest.mark.parametrize('length', [1, 3, 20, 60])
@pytest.mark.parametrize('side', ['before', 'after'])
@pytest.mark.parametrize('lost', [1, 5, 20])
def test_excursions_that_end_in_a_gap_are_marked(lost, side, length):
    """Only one of their two jumps can be seen; the other one shows as a jump over the gap."""
    poses = recorded(20)
    gap = slice(4000, 4000 + lost)
    run = slice(4000 - length, 4000) if side == 'before' else slice(gap.stop, gap.stop + length)
    poses = displaced(poses, run, np.array([0.1, 0, 0]), np.array([0, 0.5, 0]), True)
    off = np.full(len(poses), False)
    off[run] = True
    kept, off = without(poses, gap), np.delete(off, gap)
    found = found_in(kept)
    assert_array_equal(np.flatnonzero(~found.good), np.flatnonzero(off))
    assert found.steps == ()


@pytest.mark.parametrize('seed', [4, 5])
def test_a_lasting_step_does_not_end_in_a_lost_pose(seed):
    """Of a camera, whose lost poses each leave time for a jump: most of what follows is kept."""
    rng = np.random.default_rng(seed)
    poses = noisy(rng, shaken(rng, Shaking(30.0, 20.0, *CALM)), Noise(1e-3, 5e-3))
    poses = displaced(
        poses, slice(len(poses) // 3, None), np.array([0.02, 0, 0]), np.zeros(3), True)
    kept = poses.select(rng.random(len(poses)) > 0.05)
    assert np.count_nonzero(~found_in(kept).good) < 0.05 * len(kept)


def test_a_rest_recorded_without_noise_is_not_frozen_even_with_an_outlier_in_it():
    rng = np.random.default_rng(25)
    poses = shaken(rng, Shaking(360.0))
    poses = displaced(poses, slice(300, 304), np.array([0.3, 0, 0]), np.zeros(3), False)
    assert_array_equal(np.flatnonzero(~found_in(poses).good), np.arange(300, 304))


def test_rounded_coordinates_are_neither_jumps_nor_frozen():
    """A driver that sends four decimals repeats poses at rest and moves in steps of 0.1 mm."""
    rng = np.random.default_rng(26)
    poses = shaken(rng, Shaking(360.0, 20.0, 0.5, 1.0))
    rounded = Trajectory(poses.stamps_ns, np.round(poses.position, 4), poses.rotation)
    assert found_in(rounded).good.all()


def test_noise_is_estimated_along_each_axis():
    rng = np.random.default_rng(31)
    sound = shaken(rng, Shaking(360.0, 20.0, 0.5, 1.0))
    size = np.array([[0.5, 1.0, 2.0]])
    shift, turn = (x * size * rng.normal(size=(len(sound), 3)) for x in (1e-4, 5e-4))
    found = noise_of(replace(
        sound, position=sound.position + shift, rotation=sound.rotation @ exp_so3(turn)))
    assert_allclose(found, np.ravel([1e-4 * size, 5e-4 * size]), rtol=0.1)
