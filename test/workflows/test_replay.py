"""Replay: the predictor's code over recordings, scored against the truth."""

import json

from bellows_ros.core.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.model import cup_of, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import write_json
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.replay import compare, replay
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from .test_identify import CLEAN, LAB


def test_clean_recording_with_the_true_cup(rig):
    result = replay(rig / 'clean', CLEAN)  # the defaults are the rig's cup
    assert result.counts['predictions'] == result.counts['poses'] == 7201
    assert result.counts['twists estimated'] == 0
    assert np.all(result.scores.largest[:3] < 0.2e-6)
    assert np.all(result.scores.largest[3:] < 3e-6)


def test_poses_alone_come_close(rig):
    result = replay(rig / 'clean', {**CLEAN, 'topics.tool_twist': ''})
    assert result.counts['twists estimated'] == 7201
    assert np.all(result.scores.largest[:3] < 0.2e-3)
    assert np.all(result.scores.largest[3:] < 2e-3)


def test_motion_capture_recording_leaves_the_noise(rig):
    result = replay(rig / 'lab_validation', LAB)
    assert result.counts['tool poses left out as outliers'] > 0
    moving = [0, 1, 3, 4, 5]  # the cup hardly lengthens
    assert np.all(result.scores.nrmse[moving] < 0.05)
    assert np.all(result.scores.rms[:3] < 0.2e-3)


@pytest.fixture(scope='module')
def shipped(root):
    """Return the replay of the shipped validation with the true cup."""
    values = {
        **read_parameters(root / 'bags/cup.yaml'), **read_parameters(root / 'bags/package.yaml')}
    return replay(root / 'bags/validation', values), values


def test_shipped_validation_with_the_true_cup(shipped):
    result, _ = shipped
    # what is left is the noise of the measured poses, 0.1 mm and 0.5 mrad, and the tool's in it
    assert np.all(result.scores.rms[:3] < 0.2e-3)
    assert np.all(result.scores.rms[3:] < 1.5e-3)


def test_predictions_are_those_of_the_predictor_message_by_message(shipped, root):
    result, values = shipped
    loaded = load(root / 'bags/validation', resolve(values, PACKAGE_PARAMETERS))
    live = LivePredictor(cup_of(values), package_of(values), 9.81)
    live.expect_twists = True
    tool, twist = loaded.tool_pose, loaded.tool_twist
    q = rotation_to_quaternion(tool.rotation).tolist()
    good = loaded.recording.report.tool.outliers.good
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
    again = compare(
        predicted, loaded.recording.measured_tool, loaded.recording.measured_package)
    assert_array_equal(result.predicted, again.predicted)
    assert_array_equal(result.stamps_ns, again.stamps_ns)


def test_tool_at_another_rate_than_the_package(shipped):
    result, _ = shipped
    assert result.counts['predictions'] > 1.3 * result.scores.samples  # 500 Hz against 360 Hz


def test_scores_are_those_of_the_coordinates(shipped):
    result, _ = shipped
    error = result.predicted - result.measured
    assert_allclose(result.scores.rms, np.sqrt((error**2).mean(axis=0)))
    assert len(result.stamps_ns) == result.scores.samples


def test_json_holds_the_scores(shipped, tmp_path):
    result, _ = shipped
    write_json(tmp_path / 'replay.json', result.as_json())
    written = json.loads((tmp_path / 'replay.json').read_text())
    assert written['axes'] == ['x', 'y', 'z', 'rx', 'ry', 'rz']
    assert_allclose(written['rms'], result.scores.rms)
    assert_allclose(written['nrmse'], result.scores.nrmse)
    assert_allclose(written['largest'], result.scores.largest)
    assert set(written['seconds']) == {'preparing', 'predicting', 'comparing'}
    recorded = 1e-9 * float(np.ptp(result.stamps_ns))
    assert written['real_time_factor'] * written['seconds']['predicting'] >= recorded


def test_a_wrong_cup_scores_worse(shipped, root):
    result, values = shipped
    soft = {**values, 'cup.stiffness': tuple(0.8 * np.array(values['cup.stiffness']))}
    worse = replay(root / 'bags/validation', soft)
    assert np.all(worse.scores.rms[[0, 1, 3, 4]] > 2 * result.scores.rms[[0, 1, 3, 4]])


def test_a_cup_that_cannot_carry_the_package_is_told(shipped, root):
    _, values = shipped
    weak = {**values, 'cup.stiffness': tuple(np.diag([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3]).ravel())}
    with pytest.raises(BellowsError, match='too few'):
        replay(root / 'bags/validation', weak)
