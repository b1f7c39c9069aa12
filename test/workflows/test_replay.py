"""Replay: free simulation and the predictor's code over recordings, scored against the truth."""


from bellows_ros.core.geometry.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.live.replay import compare_recorded
from bellows_ros.core.model.cup_package import cup_of, package_of
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.replay import replay
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from .test_identify import CLEAN, LAB


def test_clean_recording_with_the_true_cup(rig):
    result = replay(rig / 'clean', CLEAN)  # the defaults are the rig's cup
    assert np.all(result.validation.scores.nrmse < 1e-5)
    assert result.live.counts['predictions'] == result.live.counts['poses'] == 7201
    assert result.live.counts['twists estimated'] == 0
    assert np.all(result.live.scores.largest[:3] < 0.2e-6)
    assert np.all(result.live.scores.largest[3:] < 3e-6)


@pytest.fixture(scope='module')
def shipped(root, known, true_cup):
    """Return the replay of the shipped validation with the true cup."""
    values = {**true_cup, **known}
    return replay(root / 'bags/validation', values), values


def test_shipped_validation_with_the_true_cup(shipped):
    result, _ = shipped
    # what is left is the noise of the measured poses, 0.1 mm and 0.5 mrad, and the tool's in it
    assert np.all(result.live.scores.rms[:3] < 0.2e-3)
    assert np.all(result.live.scores.rms[3:] < 1.5e-3)


def test_predictions_are_those_of_the_predictor_message_by_message(shipped, root):
    result, values = shipped
    loaded = load(root / 'bags/validation', resolve(values, PACKAGE_PARAMETERS))
    live = LivePredictor(cup_of(values), package_of(values), 9.81)
    live.pairing.expect = True
    tool, twist = loaded.tool_pose, loaded.tool_twist
    q = rotation_to_quaternion(tool.rotation).tolist()
    good = loaded.report.tool.outliers.good
    messages = [(int(tool.stamps_ns[k]), 0, k) for k in np.flatnonzero(good)]
    messages += [(int(stamp), 1, k) for k, stamp in enumerate(twist.stamps_ns)]
    predictions = []
    for stamp, is_twist, k in sorted(messages):
        predictions += (
            live.on_twist(stamp, tuple(twist.linear[k].tolist()), tuple(twist.angular[k].tolist()))
            if is_twist else
            live.on_pose(stamp, 'world', tuple(tool.position[k].tolist()), tuple(q[k])))
    predictions += live.flush()
    predicted = Trajectory(
        np.array([p.stamp_ns for p in predictions]), np.array([p.position for p in predictions]),
        quaternion_to_rotation(np.array([p.quaternion_xyzw for p in predictions])),
        np.array([[*p.linear, *p.angular] for p in predictions]))
    again = compare_recorded(
        predicted, loaded.measured_tool, loaded.measured_package)
    assert_array_equal(result.live.predicted, again.predicted)
    assert_array_equal(result.live.stamps_ns, again.stamps_ns)


def test_the_truth_leaves_nothing_but_noise(rig):
    """Find the error of the true cup explained by the noise, and its one-step errors white."""
    truth = np.load(rig / 'lab_validation_truth.npz')
    true_cup = {'cup.stiffness': truth['K'].ravel(), 'cup.damping': truth['P'].ravel()}
    found = replay(rig / 'lab_validation', {**LAB, **true_cup}).validation
    assert_allclose(found.scores.rms, found.noise, rtol=0.1)
    assert_allclose(found.one_step.chi2, 1.0, atol=0.05)
    assert set(found.one_step.whiteness.verdicts) <= {'white', 'nearly white'}
