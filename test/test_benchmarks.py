"""Every measurement runs in its short form, and fits of simulated sensors are right."""

from bellows_ros.core.geometry.jit import COMPILED
from benchmarks import __main__ as command
from benchmarks.sensors import CELLS, JUDGED, trial
import numpy as np
import pytest

pytestmark = pytest.mark.lane


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: this takes minutes')
@pytest.mark.parametrize('section', [
    pytest.param('node', marks=pytest.mark.stress),
    pytest.param('start', marks=pytest.mark.stress), 'camera'])
def test_short_form_measures(section):
    if section != 'camera':
        pytest.importorskip('rclpy')
    assert all(min(times) > 0.0 for times in command.SECTIONS[section](True).values())


def test_all_estimates_are_printed_with_their_errors():
    """From a start twice too large."""
    found = trial(CELLS['robot, 30 Hz camera, 1 mm, apart'], 2, 30.0, 'axisymmetric')
    judged = found.bound < JUDGED
    judged[1] = False  # K z: the world's height is free, and its damping is not known
    assert found.converged and np.isfinite(found.std[judged]).all()
    assert np.all(np.abs(found.error[judged]) < 3.5 * found.std[judged])
    assert np.all(found.std[judged] < 2.0 * found.bound[judged])
