"""Validation of cups on recordings, of the rig and of those that are shipped."""

import json

from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.validate import validate
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_identify import CLEAN, LAB


def cup(fit):
    """Return a fit's cup as parameters."""
    return {'cup.stiffness': tuple(fit.stiffness.ravel().tolist()),
            'cup.damping': tuple(fit.damping.ravel().tolist())}


def test_a_cup_of_one_recording_explains_another(rig):
    """Stay within 5 % on each axis that moves, noise included; z moves by less than a mm."""
    fit = identify({**LAB, 'bags': [str(rig / 'lab')]}).fit
    found = validate(rig / 'lab_validation', {**LAB, **cup(fit)}).validation
    assert found.moves.tolist() == [True, True, False, True, True, True]
    assert np.all(found.scores.nrmse[found.moves] < 0.05)
    assert np.all(found.model_error[found.moves] < 0.02)


def test_the_truth_leaves_nothing_but_noise(rig):
    """Find the error of the true cup explained by the noise, and its one-step errors white."""
    truth = np.load(rig / 'lab_validation_truth.npz')
    true_cup = {'cup.stiffness': truth['K'].ravel(), 'cup.damping': truth['P'].ravel()}
    found = validate(rig / 'lab_validation', {**LAB, **true_cup}).validation
    assert_allclose(found.scores.rms, found.noise, rtol=0.1)
    assert_allclose(found.one_step.chi2, 1.0, atol=0.05)
    assert set(found.one_step.whiteness.words) <= {'white', 'nearly white'}


def test_the_truth_without_noise_leaves_nothing(rig):
    """Meet the rig's own simulation through 20 s."""
    truth = np.load(rig / 'clean_truth.npz')
    true_cup = {'cup.stiffness': truth['K'].ravel(), 'cup.damping': truth['P'].ravel()}
    found = validate(rig / 'clean', {**CLEAN, **true_cup}).validation
    assert np.all(found.scores.nrmse < 1e-5)


@pytest.fixture(scope='module')
def shipped(root):
    """Return the shipped recording judged with the shipped cup."""
    values = read_parameters(root / 'bags/cup.yaml')
    return validate(root / 'bags/validation', values), values


def test_json_holds_every_figure(shipped):
    """Write what JSON can hold, and the recording's digests."""
    content = json.loads(format_json(shipped[0].as_json()))
    assert content['above_limit'] == []
    assert len(content['nrmse']) == len(content['free_run']['p_value']) == 6
    assert content['one_step']['chi2'] == pytest.approx(1.0, abs=0.1)
    names = [file['name'] for file in content['provenance']['recordings'][0]['files']]
    assert names == ['metadata.yaml', 'validation.mcap']


def test_lost_samples_are_not_in_the_spectra(shipped):
    """Find the noise of 0.1 mm and 0.5 mrad at 360 Hz above the motion, in all axes."""
    found = shipped[0].validation
    floor = np.repeat([1e-4, 5e-4], 3) ** 2 / 180.0
    for shown in (found.motion, found.spectrum):
        high = shown.frequency > 20.0
        assert_allclose(np.median(shown.density[high], axis=0), floor, rtol=0.2)


def test_leaving_the_envelope_is_told(shipped, root):
    """Warn where the cup's file says that the fit has seen less, else not."""
    result, values = shipped
    assert result.warnings == ()
    small = {
        **values, 'envelope.deflection_low': [-1e-3] * 3 + [-0.01] * 3,
        'envelope.deflection_high': [1e-3] * 3 + [0.01] * 3, 'envelope.rates': [10.0] * 6,
        'envelope.mass': [1.8, 1.8],
    }
    (warning,) = validate(root / 'bags/validation', small).warnings
    assert 'beyond what the fit' in warning and 'bending about x' in warning


def test_progress_ends_with_done(shipped, root):
    """Tell what is done."""
    told = []
    validate(root / 'bags/validation', shipped[1], lambda what, part: told.append((what, part)))
    assert told[-1] == ('done', 1.0)


def test_a_cup_that_carries_nothing_is_refused(shipped, root):
    """Say that there is no equilibrium."""
    soft = {**shipped[1], 'cup.stiffness': np.diag([50.0, 50, 50, 0.01, 0.01, 0.01]).ravel()}
    with pytest.raises(BellowsError, match='equilibrium'):
        validate(root / 'bags/validation', soft)
