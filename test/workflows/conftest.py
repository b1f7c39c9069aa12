"""Parameters of the shipped recordings, and standstills of several masses."""

from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.simulate import simulate_recording
import pytest

RESTING = {
    'kind': 'static', 'rest_duration': 1.5,
    'static': {'move': 0.5, 'hold': 3.0, 'poses': [
        {'rpy': [0.3, 0.0, 0.0]}, {'rpy': [0.0, 0.3, 0.0]}]},
    'tool': {'rate_hz': 100.0, 'noise': {'position': 5e-5, 'rotation': 1e-4},
             'twist': {'publish': False}},
    'package': {'rate_hz': 100.0, 'noise': {'position': 1e-4, 'rotation': 5e-4}},
}


@pytest.fixture(scope='session')
def known(root):
    """Return what is known of the shipped recordings beforehand."""
    return read_parameters(root / 'bags/package.yaml')


@pytest.fixture(scope='session')
def true_cup(root):
    """Return the cup of the shipped recordings, with what they were simulated with."""
    return read_parameters(root / 'bags/cup.yaml')


@pytest.fixture(scope='session')
def shipped(root, known, true_cup):
    """Return the identification of the recording that is shipped, and the truth."""
    return identify({**known, 'bags': [str(root / 'bags/identification')],
                     'fit.method': 'least_squares'}), true_cup


@pytest.fixture(scope='session')
def weights(tmp_path_factory, true_cup):
    """Return recordings of three standstills, one upright and two tilted, with their masses."""
    folder, found = tmp_path_factory.mktemp('weights'), {}
    for number, mass in enumerate((0.6, 1.2, 2.0)):
        found[str(folder / f'm{number}')] = mass
        simulate_recording({**true_cup, 'package.mass': mass}, {**RESTING, 'seed': number},
                           folder / f'm{number}')
    return found
