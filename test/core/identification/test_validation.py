"""Free simulation of made-up recordings whose cup and noise are known."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.validation import smoothed_tool, validate
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import THESIS
from ...cell.motion import shake
from ...cell.sensors import record

RATE = 240.0
PACKAGE = Package(2.0, np.diag([0.008, 0.009, 0.016]), np.array([0.0, 0.0, -0.03]))
CUP = Cup(np.diag([6000.0, 6000, 11000, 4.0, 4.0, 1.2]),
          np.diag([60.0, 60, 25, 0.06, 0.06, 0.1]), 0.048)
POSITION, ROTATION = 1e-4, 5e-4
G = 9.81


def tool_motion(duration=8.0, at_rest=1.0):
    """Return a tool that moves in all directions after standing still, by its formula."""
    return shake(duration=duration, rest=at_rest).at_rate(RATE, 0)


def stream(name, motion, noise, rng, kept):
    """Return a motion as it is recorded: noisy, with samples missing."""
    position = motion.position + noise * POSITION * rng.normal(size=(len(motion), 3))
    R = motion.rotation @ exp_so3(noise * ROTATION * rng.normal(size=(len(motion), 3)))
    return PoseStream(name, 'world', motion.stamps_ns[kept], position[kept], R[kept], {})


def recording(noise=1.0, tool=None, first=0, kept=slice(None), seen=slice(None)):
    """Return a prepared recording of the cup."""
    tool = tool_motion() if tool is None else tool
    body = simulate(CUP, PACKAGE, tool, gravity=G)
    tool, body = tool.select(slice(first, None)), body.select(slice(first, None))
    rng = np.random.default_rng(0)
    return prepare(
        stream('tool', tool, noise, rng, kept), stream('package', body, noise, rng, seen),
        PrepareSettings(payload=PACKAGE, gravity=G))


@pytest.fixture(scope='module')
def judged():
    """Return the validation of the true cup on a noisy recording."""
    return validate(CUP, recording())


def test_the_true_cup_explains_a_noise_free_recording():
    """Leave nothing but what the smoothing takes from the tool."""
    found = validate(CUP, recording(noise=0.0))
    assert found.runs[0].start == 'equilibrium'
    assert np.all(found.scores.nrmse < 1e-4)
    assert found.findings == ()


def test_noise_explains_the_error_of_the_true_cup(judged):
    """Predict the RMS error from the noise, within what a few seconds of random motion allow."""
    assert_allclose(judged.scores.rms, judged.noise, rtol=0.2)
    assert np.all(judged.noise > 0.95 * np.repeat([POSITION, ROTATION], 3))
    assert judged.failing() == ()


@pytest.mark.parametrize('kept', [0.0, 0.75])
def test_noise_of_poses_too_slow_for_a_stride_is_known_by_a_standstill(kept):
    """Find a memory of 30 ms at 120 Hz, and none where there is none."""
    motion = shake(duration=10.0, rest=2.0)
    sizes = (5e-4, 2.5e-3)
    recorded = record(motion, tool=sizes, package=sizes, kept=kept)
    for noise in recorded.body_noise:
        assert_allclose(noise.std, np.repeat(sizes, 3), rtol=0.15)
        assert_allclose(noise.correlation, kept, atol=0.1)


@pytest.mark.parametrize('uneven', [False, True])
def test_a_slow_camera_is_simulated_at_the_rate_of_the_tool(uneven):
    """Explain poses of 30 Hz, also a third of them at random, of a tool that moves at 3.9 Hz."""
    every = np.arange(0, 12 * RATE, 8, dtype=int)
    draw = np.random.default_rng(4)
    seen = np.sort(every[draw.random(len(every)) < 0.35]) if uneven else every
    slow = recording(tool=tool_motion(duration=12.0, at_rest=3.0), seen=seen)
    found = validate(CUP, slow)
    assert_allclose(slow.body_noise[1].std, np.repeat([POSITION, ROTATION], 3), rtol=0.4)
    assert_allclose(found.scores.rms, found.noise, rtol=0.4)
    assert set(found.stamps_ns) <= set(slow.package_pose.stamps_ns)


def test_a_wrong_cup_is_rejected(judged):
    """See a cup that is too soft in bending, where it bends."""
    soft = np.diag([1.0, 1, 1, 0.8, 0.8, 1])
    found = validate(Cup(CUP.stiffness @ soft, CUP.damping, CUP.length), recording())
    assert {'rx', 'ry'} <= set(found.failing())
    assert np.all(found.model_error[3:5] > 5 * judged.model_error[3:5] + 0.05)


def test_a_recording_that_begins_in_motion_starts_as_measured():
    """Begin with the filtered pose and twist, and forget what is wrong with it."""
    found = validate(CUP, recording(noise=0.1, first=int(2.5 * RATE)))
    assert found.runs[0].start == 'measured'
    assert found.failing() == ()


def test_lost_package_poses_are_not_compared():
    """Leave an outlier's sample out of the score."""
    whole = recording()
    body = whole.tracked_package
    holes = np.ones(len(body), dtype=bool)
    holes[500:520] = False
    found = validate(CUP, replace(whole, tracked_package=Trajectory(
        body.stamps_ns, body.position, body.rotation, valid=holes)))
    at = int(np.searchsorted(found.stamps_ns, body.stamps_ns[500]))
    assert np.isnan(found.measured[at:at + 20]).all()
    assert found.scores.samples == np.count_nonzero(np.isfinite(found.measured[:, 0]))


def test_a_long_gap_of_the_tool_is_reported():
    """Begin anew after 0.3 s without tool poses, and say so; bridge a short one."""
    motion = tool_motion()
    for seconds, count in ((0.05, 0), (0.3, 1)):
        kept = np.ones(len(motion), dtype=bool)
        kept[1000:1000 + int(seconds * RATE)] = False
        found = validate(CUP, recording(kept=kept))
        assert len(found.findings) == count
        assert np.isfinite(found.predicted[np.isfinite(found.measured)]).all()


def test_smoothing_keeps_the_motion_and_bridges_gaps():
    """Give back a smooth motion and its twist; across 20 ms nearly so."""
    motion = tool_motion()
    valid = np.ones(len(motion), dtype=bool)
    valid[900:905] = False
    tool = smoothed_tool(
        Trajectory(motion.stamps_ns, motion.position, motion.rotation, valid=valid), 4)
    first = int(np.searchsorted(motion.stamps_ns, tool.stamps_ns[0]))
    same = motion.select(slice(first, first + len(tool)))
    # in the gap within the noise of motion capture, elsewhere as the filter has it
    assert_allclose(tool.position, same.position, atol=POSITION)
    outside = np.abs(tool.stamps_ns - motion.stamps_ns[902]) > 0.05e9
    assert_allclose(tool.position[outside], same.position[outside], atol=2e-6)
    assert_allclose(tool.twist[outside], same.twist[outside], atol=5e-4)


def test_a_tool_without_poses_is_refused():
    motion = tool_motion()
    lost = Trajectory(motion.stamps_ns, motion.position, motion.rotation, valid=False)
    with pytest.raises(BellowsError):
        smoothed_tool(lost, 4)


def lost(stream, *spans):
    """Return a stream without the poses of spans, s from its first stamp."""
    seconds = (stream.stamps_ns - stream.stamps_ns[0]) * 1e-9
    kept = ~np.any([(seconds > a) & (seconds < b) for a, b in spans], axis=0)
    return replace(stream, stamps_ns=stream.stamps_ns[kept], position=stream.position[kept],
                   rotation=stream.rotation[kept])


@pytest.mark.parametrize(('tool_gaps', 'package_gaps'), [
    ([(5.0, 5.3)], []), ([(4.0, 4.5), (7.0, 7.4)], [(2.0, 3.5)]), ([], [(3.0, 6.0)]),
    ([(1.4 * k, 1.4 * k + 0.25) for k in range(1, 6)], [(5.0, 6.0)]),
    ([(3.0, 7.0)], [(3.0, 7.0)])])
@pytest.mark.parametrize('kept', [0.0, 0.8])
def test_the_true_cup_is_right_behind_gaps_of_either_body(tool_gaps, package_gaps, kept):
    """Each gap of the tool that cannot be bridged begins a segment with a fitted first state."""
    sound = record(shake(duration=9.0, seed=2), tool=(2e-5, 5e-5), package=(1e-4, 5e-4),
                   rate_hz=240.0, kept=kept)
    recording = prepare(
        lost(sound.tool_pose, *tool_gaps) if tool_gaps else sound.tool_pose,
        lost(sound.package_pose, *package_gaps) if package_gaps else sound.package_pose,
        sound.settings)
    found = validate(THESIS, recording)
    assert len(found.runs) == 1 + len(tool_gaps)
    assert found.worse_than_noise == ()
    assert np.all(found.scores.rms < 1.5 * found.noise)
    assert len(found.findings) == len(tool_gaps)
    wrong = validate(Cup(0.8 * THESIS.stiffness, THESIS.damping,
                         THESIS.length), recording)
    assert wrong.worse_than_noise
