"""Replay: free simulation and the predictor's code over recordings, scored against the truth."""

from bellows_ros.workflows.replay import replay
import numpy as np
from numpy.testing import assert_allclose

from .test_identify import CLEAN, LAB


def test_clean_recording_with_the_true_cup(rig):
    result = replay(rig / 'clean', CLEAN)  # the defaults are the rig's cup
    assert np.all(result.validation.scores.nrmse < 1e-5)
    assert result.live.counts['predictions'] == result.live.counts['poses'] == 7201
    assert result.live.counts['twists estimated'] == 0
    assert np.all(result.live.scores.largest[:3] < 0.2e-6)
    assert np.all(result.live.scores.largest[3:] < 3e-6)


def test_residuals_at_the_truth_are_noise(rig):
    """Find the error of the true cup explained by the noise."""
    truth = np.load(rig / 'lab_validation_truth.npz')
    true_cup = {'cup.stiffness': truth['K'].ravel(), 'cup.damping': truth['P'].ravel()}
    found = replay(rig / 'lab_validation', {**LAB, **true_cup}).validation
    assert_allclose(found.scores.rms, found.noise, rtol=0.1)
