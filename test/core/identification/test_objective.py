"""How well a cup explains a recording: a long one is seen in stretches."""

from bellows_ros.core.identification.hypotheses import diagnose
from bellows_ros.core.identification.objective import ensemble_of, MAX_SECONDS, STRETCHES
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.variations import time_offset
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.signals.resampling import resample
import numpy as np
import pytest

from .simulated import CUP, record, shake

LATE = 0.004
AXISYMMETRIC = STRUCTURES['axisymmetric']


@pytest.fixture(scope='module')
def long():
    """Return the recording of five minutes, whose tool is late."""
    return record(shake(duration=300.0), later=LATE, tool=(1e-4, 3e-4), package=(1e-4, 3e-4))


def test_no_more_of_a_long_recording_is_seen(long):
    ensemble = ensemble_of([long], CUP.length, AXISYMMETRIC)
    (seen,) = ensemble.given
    stamps = seen.samples.tool.stamps_ns
    steps = 1e-9 * np.diff(stamps)
    assert np.count_nonzero(steps > 10.0) == STRETCHES - 1
    assert steps[steps < 1.0].sum() == pytest.approx(MAX_SECONDS, rel=0.01)
    assert steps.sum() > 270.0
    assert [len(draw[0].samples.tool) for draw in ensemble.noise_draws] == 2 * [len(stamps)]


@pytest.mark.parametrize('offset', [-0.15, 0.0, 0.2])
def test_no_pose_is_taken_from_the_time_between_stretches(long, offset):
    (seen,) = ensemble_of([long], CUP.length, AXISYMMETRIC).given
    there = time_offset(seen, np.array([offset])).samples
    used = there.tool.select(there.valid)
    poses = resample(samples_of(long).tool, used.stamps_ns + round(1e9 * offset))
    assert np.abs(used.position - poses.position).max() < 1e-5
    assert len(used) > 1000


def test_a_cause_is_found_with_its_size_in_what_is_seen(long):
    first, *_ = diagnose([long], CUP.length, AXISYMMETRIC).findings
    assert first.name == 'time_offset' and first.certain
    assert first.theta[0] == pytest.approx(LATE, abs=4.0 * first.std[0])
    assert first.std[0] < 1e-4
