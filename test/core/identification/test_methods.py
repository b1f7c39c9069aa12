"""What the methods of fitting make of prepared recordings."""

from bellows_ros.core.identification.methods import fit, given_std, start_cup, with_method
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import resolve
import numpy as np
from numpy.testing import assert_allclose
import pytest

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


@pytest.mark.parametrize('kept', [0.0, 0.9])
def test_least_squares_says_where_the_noise_is_not_white(kept):
    noise = (1e-4, 5e-4)
    recording = simulated.record(
        simulated.shake(seed=3), tool=noise, package=noise, rate_hz=360.0, kept=kept)
    values = resolve({
        'fit.method': 'least_squares', 'cup.length': simulated.CUP.length,
        'package.mass': simulated.HELD.mass})
    said = [text for text in fit([recording], values).fit.warnings if 'correlated' in text]
    assert len(said) == (kept > 0.0)


def test_what_is_given_of_half_a_package_is_nothing():
    """Know no standard deviation of a package whose inertia is not given."""
    assert given_std({'package.mass': 1.0, 'package.mass_std': 0.01}) == {}


@pytest.mark.parametrize(('rate', 'free', 'method'), [
    (120.0, (), 'prediction_error'), (60.0, (), 'output_error'),
    (120.0, ('package_marker',), 'output_error')])
def test_the_method_follows_from_the_recordings(rate, free, method):
    """Take what slow poses, or a marker anywhere, need; what is set by name stays."""
    recording = simulated.record(simulated.shake(seed=3), rate_hz=rate)
    values = {'fit.method': 'auto', 'fit.free': free}
    assert with_method(values, [recording])['fit.method'] == method
    named = {**values, 'fit.method': 'least_squares'}
    assert with_method(named, [recording]) == named
