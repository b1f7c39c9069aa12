"""A gripper of three cups as a user identifies one of its cups: files in, a cup file out."""

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import cup_of
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.safe_yaml import load
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from numpy.testing import assert_allclose
import pytest

LAYOUT = (0.06, 0.05, 0.0, -0.06, 0.03, 0.0, 0.01, -0.07, 0.0)


@pytest.fixture(scope='module')
def gripper(root, known, true_cup, tmp_path_factory):
    """Return the true parameters, and those that are known of a recording of the gripper."""
    motion = load(root / 'bags/validation.yaml')
    motion['package'] = {
        'rate_hz': 360.0, 'frame': 'com', 'noise': {'position': 2e-5, 'rotation': 1e-4}}
    truth = {**true_cup, 'cup.layout': LAYOUT}
    bag = tmp_path_factory.mktemp('gripper') / 'bag'
    simulate_recording(truth, motion, bag)
    return resolve(truth), {
        **known, 'bags': [str(bag)], 'cup.layout': LAYOUT, 'fit.structure': 'layout',
        'recording.end': 8.0}


def test_the_cup_file_holds_one_cup_and_the_layout(gripper, tmp_path):
    truth, known = gripper
    result = identify({**known, 'fit.method': 'least_squares'})
    assert not result.refusals
    save(result, tmp_path / 'cup.yaml', None)
    written = read_parameters(tmp_path / 'cup.yaml')
    assert tuple(written['cup.layout']) == LAYOUT
    assert_allclose(np.diag(cup_of(resolve(written)).stiffness), np.diag(cup_of(truth).stiffness),
                    rtol=0.03)
    found = replay(known['bags'][0], {**known, **written}).validation.scores
    assert np.all(found.rms < 1.5 * np.repeat([2e-5, 1e-4], 3))
