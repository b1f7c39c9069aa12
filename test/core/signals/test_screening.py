"""Poses that a driver repeats with new stamps: left out in motion, kept at rest."""

import functools

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.resampling import timing
from bellows_ros.core.signals.screening import pose_steps, repeated
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from ...cell.motion import shaken, Shaking
from ...cell.sensors import displaced, Noise, noisy

NONE, ROBOT, LAB = Noise(0.0, 0.0), Noise(2e-5, 1e-4), Noise(1e-4, 5e-4)


@functools.cache
def motion(seed, rate_hz):
    """Give the poses of a body at rest, then in motion."""
    return shaken(np.random.default_rng(seed), Shaking(rate_hz))


def recorded(seed, rate_hz=500.0, noise=ROBOT):
    """Give the measured poses of a motion."""
    return noisy(np.random.default_rng(seed), motion(seed, rate_hz), noise)


def left_out(poses, shown=None):
    """Give the mask of repeats in messages that show some of the poses."""
    shown = np.arange(len(poses)) if shown is None else shown
    return repeated(pose_steps(poses.position[shown], poses.rotation[shown]))


@pytest.mark.parametrize('noise', [NONE, ROBOT, LAB])
@pytest.mark.parametrize('ratio', [1.0, 1.5, 2.0, 2.5, 4.0, 10.0])
def test_each_sample_of_a_slower_sensor_counts_once(ratio, noise):
    poses = recorded(1, noise=noise)
    number = np.floor(np.arange(len(poses)) / ratio)
    shown = np.ceil(number * ratio).astype(int)
    out = left_out(poses, shown)
    moves = np.arange(len(poses)) > 1500  # after the rest
    again = np.append(False, np.diff(number) == 0)
    assert_array_equal(out[moves], again[moves])
    assert np.mean(~out) == pytest.approx(1.0 / ratio, rel=0.02)  # also at rest
    kept = poses.stamps_ns[np.flatnonzero(~out)]
    for begin in (0, 1):  # with a long or a short step first
        assert timing(kept[begin:]).rate_hz == pytest.approx(500.0 / ratio, rel=1e-3)


@pytest.mark.parametrize('part', [0.05, 0.3])
def test_poses_repeated_at_random_are_left_out_in_motion(part):
    poses, rng = recorded(2), np.random.default_rng(3)
    again = rng.random(len(poses)) < part
    again[0] = False
    shown = np.maximum.accumulate(np.where(again, 0, np.arange(len(poses))))
    out = left_out(poses, shown)
    speed = 500.0 * np.linalg.norm(np.gradient(recorded(2, noise=NONE).position, axis=0), axis=1)
    fast = speed > 0.25 * np.max(speed)
    assert not np.any(out & ~again)
    assert np.mean(out[again & fast]) > 0.9


@pytest.mark.parametrize('noise', [NONE, LAB])
@pytest.mark.parametrize('length', [5, 12, 60, 100])
def test_poses_of_a_frozen_tracker_are_left_out(length, noise):
    """In the motion, and till the end."""
    for start in (2500, 4000, 7200 - length):
        poses = recorded(23, 360.0, noise)
        shown = np.arange(len(poses))
        shown[start:start + length] = start - 1
        assert_array_equal(np.flatnonzero(left_out(poses, shown)),
                           np.arange(start, start + length))


def test_a_rest_recorded_without_noise_is_kept_even_with_an_outlier_in_it():
    poses = recorded(25, 360.0, NONE)
    assert not left_out(poses).any()
    poses = displaced(poses, slice(300, 304), np.array([0.3, 0, 0]), np.zeros(3), False)
    assert set(np.flatnonzero(left_out(poses))) <= {301, 302, 303}


def test_rounded_coordinates_are_no_repeats():
    """A driver that sends four decimals repeats poses at rest and moves in steps of 0.1 mm."""
    rng = np.random.default_rng(26)
    poses = shaken(rng, Shaking(360.0, 20.0, 0.5, 1.0))
    assert not repeated(pose_steps(np.round(poses.position, 4), poses.rotation)).any()
    seconds = np.arange(5000) / 500.0  # 5 mm/s, with a resolution of 0.1 mm
    position = np.round(np.outer(5e-3 * seconds, [1.0, 0.3, 0.0]), 4)
    turned = exp_so3(np.outer(np.zeros(5000), [0.0, 0.0, 1.0]))
    assert np.mean(repeated(pose_steps(position, turned))) < 0.01
