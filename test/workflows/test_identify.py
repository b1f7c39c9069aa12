"""Identification from recordings of known cups, and what it writes."""

import json

from bellows_ros.core.jit import COMPILED
from bellows_ros.core.parameters import resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.files.results import read_result
from bellows_ros.workflows.identify import identify, save
import numpy as np
from numpy.testing import assert_allclose
import pytest
import yaml

CLEAN = {
    'topics.tool_pose': '/tool_arm/pose', 'topics.tool_twist': '/tool_arm/twist',
    'topics.package_pose': '/package/pose',
    'package.mass': 2.17, 'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03], 'cup.length': 0.0481,
}
LAB = {
    **CLEAN, 'topics.tool_pose': '/mocap/tool_arm/pose', 'topics.tool_twist': '',
    'topics.package_pose': '/mocap/plate/pose', 'recording.world': 'motive_y_up',
    'recording.package_frame': 'lip', 'recording.align_at_rest': True,
    'recording.rest_duration': 1.8,
}


def ratios(fit, truth):
    """Return found over true diagonal entries of K and P."""
    return (
        np.diag(fit.stiffness) / np.diag(truth['K']), np.diag(fit.damping) / np.diag(truth['P']))


@pytest.mark.parametrize('name', ['lab', 'lab_validation'])
def test_motion_capture_recordings_of_the_rig(rig, name):
    result = identify({**LAB, 'bags': [str(rig / name)]})
    stiffness, damping = ratios(result.fit, np.load(rig / f'{name}_truth.npz'))
    assert_allclose(stiffness, 1.0, atol=0.04)
    assert_allclose(damping[[0, 1, 3, 4, 5]], 1.0, atol=0.15)
    assert result.fit.samples_rejected > 0
    assert result.fit.usable


def test_clean_recording_of_the_rig(rig):
    result = identify({**CLEAN, 'bags': [str(rig / 'clean')]})
    stiffness, damping = ratios(result.fit, np.load(rig / 'clean_truth.npz'))
    assert_allclose(stiffness, 1.0, atol=0.01)
    assert_allclose(damping[[0, 1, 3, 4, 5]], 1.0, atol=0.02)
    assert_allclose(damping[2], 1.0, atol=0.12)
    assert result.fit.samples_rejected == 0
    assert result.warnings == ()


@pytest.fixture(scope='module')
def shipped(root):
    """Return the identification of the recording that is shipped, and the truth."""
    known = read_parameters(root / 'bags/package.yaml')
    truth = read_parameters(root / 'bags/cup.yaml')
    return identify({**known, 'bags': [str(root / 'bags/identification')]}), truth


def test_shipped_recording(shipped):
    result, truth = shipped
    K, P = (np.reshape(truth[f'cup.{name}'], (6, 6)) for name in ('stiffness', 'damping'))
    assert_allclose(np.diag(result.fit.stiffness), np.diag(K), rtol=0.03)
    assert_allclose(np.diag(result.fit.damping)[[0, 1, 3, 4, 5]], np.diag(P)[[0, 1, 3, 4, 5]],
                    rtol=0.1)


def test_files_hold_the_result_and_the_cup_file_serves_both_nodes(shipped, tmp_path):
    result, _ = shipped
    save(result, tmp_path / 'cup.yaml', tmp_path / 'fit.json')
    written = read_result(tmp_path / 'fit.json')
    fit = result.fit
    for name in ('stiffness', 'damping', 'stiffness_std', 'damping_std'):
        assert_allclose(written[name], getattr(fit, name), rtol=0, atol=0)
    for name in ('method', 'structure', 'samples_used', 'samples_rejected', 'condition_number'):
        assert written[name] == getattr(fit, name)
    (recording,) = written['recordings']
    assert recording['package_pose']['outliers'] > 0
    assert len(recording['package_pose']['gaps']) == 3
    values = resolve(read_parameters(tmp_path / 'cup.yaml'))
    assert_allclose(values['cup.stiffness'], fit.stiffness.ravel(), rtol=0, atol=0)
    assert_allclose(values['cup.damping'], fit.damping.ravel(), rtol=0, atol=0)
    assert values['package.mass'] == 1.8
    assert values['topics.tool_pose'] == '/tool_arm/pose'
    assert 'bags' not in read_parameters(tmp_path / 'cup.yaml')


def test_same_recording_and_settings_give_the_same_bits(shipped, root):
    result, _ = shipped
    again = identify(result.values)
    assert json.dumps(again.fit.stiffness.tolist()) == json.dumps(result.fit.stiffness.tolist())
    assert json.dumps(again.fit.covariance.tolist()) == json.dumps(result.fit.covariance.tolist())


def test_two_recordings_are_one_fit(shipped, root):
    result, truth = shipped
    both = identify({**result.values, 'bags': [
        str(root / 'bags/identification'), str(root / 'bags/validation')]})
    assert both.fit.samples_used > result.fit.samples_used
    assert len(both.reports) == 2
    K = np.reshape(truth['cup.stiffness'], (6, 6))
    assert_allclose(np.diag(both.fit.stiffness), np.diag(K), rtol=0.03)


def test_progress_goes_from_reading_to_done(shipped):
    told = []
    identify(shipped[0].values, lambda what, part: told.append((what, part)))
    assert told[0][0].startswith('reading')
    assert told[-1] == ('done', 1.0)
    parts = [part for _, part in told]
    assert parts == sorted(parts)


def test_a_cup_that_is_not_definite_is_not_written(shipped, tmp_path, root):
    known = {**shipped[0].values, 'fit.structure': 'full', 'bags': [str(root / 'bags/static')]}
    try:
        result = identify(known)
    except BellowsError as error:  # standing still tells too little: that is said as well
        assert 'excite' in str(error).lower() or 'tells nothing' in str(error)
        return
    assert not result.fit.usable
    with pytest.raises(BellowsError, match='definite'):
        save(result, tmp_path / 'cup.yaml', tmp_path / 'fit.json')
    assert (tmp_path / 'fit.json').exists()
    assert not (tmp_path / 'cup.yaml').exists()


@pytest.mark.parametrize(('change', 'word'), [
    ({'bags': []}, 'bags is empty'),
    ({'package.mass': None}, 'package.mass'),
    ({'fit.structur': 'full'}, 'fit.structure'),
    ({'bags': ['nowhere']}, 'nowhere'),
    ({'topics.tool_pose': '/tool'}, '/tool_arm/pose'),
])
def test_mistakes_are_named(shipped, change, word):
    values = {**shipped[0].values, **change}
    values = {name: value for name, value in values.items() if value is not None}
    with pytest.raises(BellowsError, match=word):
        identify(values)


@pytest.fixture(scope='module')
def two_packages(tmp_path_factory, root):
    """Return recordings of one cup with two packages, and a parameter file of each package."""
    from bellows_ros.workflows.simulate import simulate_recording
    folder = tmp_path_factory.mktemp('packages')
    cup = read_parameters(root / 'bags/cup.yaml')
    motion = yaml.safe_load((root / 'bags/identification.yaml').read_text())
    motion['duration'] = 12.0
    bags, files = [], []
    for number, (mass, inertia) in enumerate((
            (1.8, [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0]),
            (1.2, [0.003, 0.0045, 0.0068, 0.0, 0.0, 0.0]))):
        held = {'package.mass': mass, 'package.inertia': inertia, 'package.com': [0, 0, -0.03]}
        bags.append(str(folder / f'bag{number}'))
        simulate_recording({**cup, **held}, {**motion, 'seed': number}, folder / f'bag{number}')
        files.append(str(folder / f'package{number}.yaml'))
        write_parameters(files[-1], resolve(held), [])
    return bags, files


@pytest.mark.parametrize('method', ['least_squares', pytest.param(
    'prediction_error', marks=pytest.mark.skipif(
        not COMPILED, reason='numba is not installed: the fit takes minutes interpreted'))])
def test_each_recording_may_have_its_own_package(two_packages, root, method):
    bags, files = two_packages
    truth = read_parameters(root / 'bags/cup.yaml')
    result = identify({
        'bags': bags, 'package.files': files, 'cup.length': truth['cup.length'],
        'topics.tool_pose': '/tool_arm/pose', 'topics.package_pose': '/package/pose',
        'fit.method': method, 'fit.compare_recordings': True})
    K = np.diag(np.reshape(truth['cup.stiffness'], (6, 6)))
    assert_allclose(np.diag(result.fit.stiffness), K, rtol=0.03)
    assert [package.mass for package in result.held] == [1.8, 1.2]
    assert result.consistency is not None
    assert result.consistency.verdict in result.warnings
    if method == 'prediction_error':
        assert result.consistency.probability > 1e-3
        assert 0.9 < result.fit.chi2 < 1.1


def test_package_files_must_be_one_for_each_recording(two_packages):
    bags, files = two_packages
    with pytest.raises(BellowsError, match='1 files for 2 recordings'):
        identify({'bags': bags, 'package.files': files[:1]})
