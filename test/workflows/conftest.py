"""Given quantities of the shipped recordings, and their identification."""

from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
import pytest


@pytest.fixture(scope='session')
def known(root):
    """Return the given quantities of the shipped recordings."""
    return read_parameters(root / 'bags/package.yaml')


@pytest.fixture(scope='session')
def shipped(root, known, true_cup):
    """Return the identification of the shipped recording, and the true cup."""
    return identify({**known, 'bags': [str(root / 'bags/identification')],
                     'fit.method': 'least_squares'}), true_cup
