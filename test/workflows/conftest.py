"""What is known of the shipped recordings, and what is identified from them."""

from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identify import identify
import pytest


@pytest.fixture(scope='session')
def known(root):
    """Return what is known of the shipped recordings beforehand."""
    return read_parameters(root / 'bags/package.yaml')


@pytest.fixture(scope='session')
def shipped(root, known, true_cup):
    """Return the identification of the recording that is shipped, and the truth."""
    return identify({**known, 'bags': [str(root / 'bags/identification')],
                     'fit.method': 'least_squares'}), true_cup
