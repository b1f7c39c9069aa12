"""Time offsets that are found together with K and P."""

from dataclasses import replace

from bellows_ros.core.identification.free import refined_preparation
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from .. import simulated

NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}
SOFT = Cup(
    np.diag([2100.0, 2100.0, 3900.0, 1.6, 1.6, 0.7]),
    np.diag([14.0, 14.0, 9.0, 0.02, 0.02, 0.03]), simulated.CUP.length)


def found(recording, structure='axisymmetric'):
    """Return the offset found in a recording."""
    return refined_preparation(
        recording, simulated.CUP.length, STRUCTURES[structure], False, True).offset


@pytest.mark.parametrize('later', [-0.19, -0.095, -0.0002, 0.0, 0.005, 0.048, 0.15])
def test_an_offset_is_found_without_noise(later):
    recording = simulated.record(simulated.shake(seed=3), later=later)
    assert abs(found(recording).value - later) < 1e-5


@pytest.mark.parametrize('cup', [simulated.CUP, SOFT])
@pytest.mark.parametrize('structure', ['axisymmetric', 'full'])
def test_with_noise_the_error_is_of_the_size_that_is_said(cup, structure):
    recording = simulated.record(simulated.shake(seed=3), cup=cup, seed=5, later=0.0123, **NOISE)
    offset = found(recording, structure)
    assert offset.std < 1e-4
    assert abs(offset.value - 0.0123) < 4.0 * offset.std


def test_standstills_do_not_tell_it():
    recording = simulated.record(simulated.standstills([(0.0, 0.0, 0.0)]), **NOISE)
    assert found(recording) is None


@pytest.mark.parametrize('used', [0, 3, 240])
def test_few_samples_do_not_tell_it(used):
    recording = simulated.record(simulated.shake(seed=3))
    valid = np.arange(len(recording.package)) < used
    package = replace(recording.package, valid=recording.package.valid & valid)
    assert found(replace(recording, package=package)) is None


def test_a_larger_offset_is_refused():
    recording = simulated.record(simulated.shake(seed=3), later=0.24)
    with pytest.raises(BellowsError, match=r'\b200\b'):
        found(recording)
