"""What the methods of fitting make of prepared recordings."""

from contextlib import nullcontext
from dataclasses import replace

from bellows_ros.core.identification import methods
from bellows_ros.core.identification.causes import Finding
from bellows_ros.core.identification.methods import (
    are_differentiable,
    fit,
    start_cup,
)
from bellows_ros.core.identification.reduction import statistics
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import simulated

ROUND = STRUCTURES['axisymmetric']


def test_the_output_error_starts_from_a_known_damping_where_least_squares_finds_none():
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


@pytest.mark.parametrize(('rate', 'free', 'differentiable'), [
    (120.0, (), True), (60.0, (), False), (120.0, ('package_marker',), False)])
def test_slow_poses_and_a_marker_anywhere_are_not_differentiated(rate, free, differentiable):
    recording = simulated.record(simulated.shake(seed=3), rate_hz=rate)
    assert are_differentiable([recording], {'fit.free': free}) is differentiable


@pytest.mark.parametrize(('chi2', 'certain', 'ends'), [
    (1.0, False, pytest.raises(BellowsError, match='too little motion')),
    (5.0, False, nullcontext()), (3.9, True, nullcontext())])
def test_a_misfit_that_hides_the_damping_is_not_called_too_little_motion(
    chi2, certain, ends, monkeypatch
):
    recording = simulated.record(simulated.shake(seed=3))
    values = resolve({'fit.method': 'least_squares', 'cup.length': simulated.CUP.length,
                      'package.mass': simulated.HELD.mass})
    found = methods.fitted([recording], values)
    unknown = replace(found, method='output_error', robust_chi2=chi2,
                      causes=(Finding('drift', '', certain=certain),),
                      covariance=np.diag(np.full(len(found.parameters), np.inf)))
    monkeypatch.setattr(methods, 'fitted', lambda *own: unknown)
    with ends:
        assert not any(own.identifiable for own in fit([recording], values).excitation.parameters)


@pytest.mark.parametrize(('std', 'ends'), [
    (0.2, nullcontext()), (0.3, pytest.raises(BellowsError, match='too little motion'))])
def test_stiffness_that_no_weight_loads_is_enough_motion(std, ends, monkeypatch):
    """Noise may hide the damping of a stiff cup that is known otherwise."""
    recording = simulated.record(simulated.shake(seed=3))
    values = resolve({'fit.method': 'least_squares', 'cup.length': simulated.CUP.length,
                      'package.mass': simulated.HELD.mass})
    found = methods.fitted([recording], values)
    known = np.array([label == 'K rz' for label in found.labels])
    noisy = replace(found, method='output_error', robust_chi2=1.0, covariance=np.diag(
        np.where(known, (std * found.parameters) ** 2, np.inf)))
    monkeypatch.setattr(methods, 'fitted', lambda *own: noisy)
    with ends:
        assert fit([recording], values).fit is noisy
