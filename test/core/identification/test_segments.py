"""What the prediction error is given of a recording with gaps."""

from bellows_ros.core.identification.segments import in_motion, measured_segments
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.recording.recording import noise_of
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .recordings import GRAVITY, noisy, PLATE, Shake

RATE_HZ = 200.0
MOTION = Shake(31).trajectory(6.0, RATE_HZ)
BODY = simulate(Cup.thesis(), PLATE, MOTION, gravity=GRAVITY)


def lost(poses, *gaps):
    """Return poses without twists, those in gaps (first, last sample) lost and nonsense."""
    position, valid = poses.position.copy(), np.ones(len(poses), dtype=bool)
    for first, last in gaps:
        position[first:last + 1] += 1.0
        valid[first:last + 1] = False
    return Trajectory(poses.stamps_ns, position, poses.rotation, valid=valid)


def test_a_short_gap_of_the_tool_is_bridged():
    smooth = in_motion(lost(MOTION, (600, 609)))
    true = MOTION.select(np.isin(MOTION.stamps_ns, smooth.stamps_ns))
    assert smooth.valid.all()
    # cubics over 70 ms of a motion of 4 mm and up to 3.5 Hz: (w h)^4 / 384 of it
    assert_allclose(smooth.position, true.position, atol=6e-5)
    far = np.abs(np.arange(len(smooth)) - 600) > 30
    assert_allclose(smooth.position[far], true.position[far], atol=1e-8)
    assert_allclose(smooth.twist[far], true.twist[far], atol=1e-5)


def test_poses_in_a_gap_are_bridged_and_do_not_count():
    (part,) = measured_segments(
        lost(MOTION, (600, 609)), lost(BODY, (900, 919)), PLATE, GRAVITY)
    stamps = MOTION.stamps_ns
    at = np.searchsorted(part.package.stamps_ns, stamps)
    valid = np.append(part.package.valid, False)[at]
    assert not valid[600:610].any() and not valid[900:920].any()
    assert valid[610] and valid[920] and valid[100:600].all()
    assert np.ptp(np.diff(part.package.stamps_ns)) == 0
    # cubics over 100 ms of vibrations of a few mm at 11.6 Hz
    assert_allclose(part.package.position[at[900:920]], BODY.position[900:920], atol=1e-3)


def test_a_long_gap_of_the_package_cuts_the_recording():
    parts = measured_segments(lost(MOTION), lost(BODY, (600, 640)), PLATE, GRAVITY)
    assert len(parts) == 2
    assert parts[0].package.stamps_ns[-1] == BODY.stamps_ns[599]
    assert parts[1].package.stamps_ns[0] == BODY.stamps_ns[641]


def test_a_long_gap_of_the_tool_cuts_the_recording():
    parts = measured_segments(
        lost(MOTION, (600, 640)), lost(BODY), PLATE, GRAVITY)
    assert len(parts) == 2
    assert parts[0].package.stamps_ns[-1] < MOTION.stamps_ns[600]
    assert parts[1].package.stamps_ns[0] > MOTION.stamps_ns[640]


def test_nothing_but_gaps_is_an_error():
    often = [(k, k + 40) for k in range(0, 1160, 60)]
    with pytest.raises(BellowsError, match=r'\b1\b'):
        measured_segments(lost(MOTION, *often), lost(BODY), PLATE, GRAVITY)


@pytest.mark.parametrize(('position', 'rotation'), [(1e-4, 5e-4), (1e-3, 1e-3), (0.0, 0.0)])
def test_noise_is_found_in_spite_of_motion_and_outliers(position, rotation):
    poses = noisy(Shake(1).trajectory(10.0, 360.0), position, rotation, np.random.default_rng(0))
    jumps = poses.position.copy()
    jumps[100:1000:97] += 0.03
    found = noise_of(type(poses)(poses.stamps_ns, jumps, poses.rotation))
    assert_allclose(found.position, position, rtol=0.05, atol=1e-8)
    assert_allclose(found.rotation, rotation, rtol=0.05, atol=1e-7)
