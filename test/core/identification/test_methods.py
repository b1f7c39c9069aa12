"""What the methods of fitting make of prepared recordings."""

from bellows_ros.core.identification.methods import start_cup
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.structure import STRUCTURES
import numpy as np
from numpy.testing import assert_allclose

from . import simulated

ROUND = STRUCTURES['axisymmetric']


def test_the_prediction_error_starts_from_a_known_damping_where_least_squares_finds_none():
    """Start positive with a tool that is stamped 8 ms late, which turns damping negative."""
    recording = simulated.record(simulated.shake(seed=3), later=0.008)
    samples = [samples_of(recording)]
    found = np.diag(simulated.least_squares(samples, simulated.CUP.length, ROUND).damping)
    parts = [statistics(own, simulated.CUP.length, ROUND) for own in samples]
    start = start_cup(parts, simulated.CUP)
    assert np.any(found < 0.0)
    assert_allclose(
        np.diag(start.damping), np.where(found < 0.0, np.diag(simulated.CUP.damping), found))
