"""Strengths of relaxation found in simulated recordings, and where there are none."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import relaxation_of
from bellows_ros.core.identification.methods import fit, with_relaxation
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import UndeterminedError
from benchmarks.paths import driven
from benchmarks.rubber import CUP, GRAVITY, multisine, PLATE
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import lfilter

RUBBER = replace(CUP, stiffness=1.2 * CUP.stiffness, damping=5.0 * CUP.damping,
                 relaxation=(0.15, 0.10))
ROUND = STRUCTURES['axisymmetric']
VALUES = resolve({
    'fit.method': 'least_squares', 'cup.length': CUP.length, 'package.mass': PLATE.mass})


def record(cup, seed, seconds=20.0, hold=6.0, noise=(5e-5, 2.5e-4), kept=0.0):
    """Return the prepared recording of a cup with noise (m, rad), a part of it kept."""
    rng = np.random.default_rng(seed)
    tool = driven(multisine(seed, seconds - hold - 2.0, hold), seconds, 180.0)
    body = simulate(cup, PLATE, tool, gravity=GRAVITY)
    white = rng.standard_normal((len(tool), 6))
    e = np.sqrt(1.0 - kept**2) * lfilter([1.0], [1.0, -kept], white, axis=0)
    return prepare(
        PoseStream('tool', 'world', tool.stamps_ns, tool.position, tool.rotation),
        PoseStream('package', 'world', tool.stamps_ns, body.position + noise[0] * e[:, :3],
                   body.rotation @ exp_so3(noise[1] * e[:, 3:])),
        PrepareSettings(payload=PLATE, gravity=GRAVITY))


def found_in(recording):
    """Return the relaxation found in a recording."""
    return relaxation_of([samples_of(recording)], [recording.noise], CUP.length, ROUND)


def test_strengths_and_static_stiffness_are_found():
    recording = record(RUBBER, 1)
    found = found_in(recording)
    assert_allclose(found.strengths, RUBBER.relaxation, atol=4.0 * np.max(found.std) + 0.002)
    assert max(found.std) < 0.02
    assert not found.assumed
    for structure in ('axisymmetric', 'axisymmetric_coupled'):
        values = VALUES.replaced({'fit.structure': structure})
        (own,) = with_relaxation([recording], values)
        cup = fit([own], values).fit
        assert cup.relaxation == found.strengths
        apart = np.diag(cup.stiffness) / np.diag(RUBBER.stiffness) - 1.0
        assert np.abs(apart).max() < 0.02
    without = fit([recording], VALUES).fit
    assert without.stiffness[3, 3] > 1.05 * RUBBER.stiffness[3, 3]


@pytest.mark.parametrize(('seed', 'kept'), [(0, 0.0), (1, 0.9)])
def test_a_cup_that_does_not_relax_is_not_said_to(seed, kept):
    plain = replace(RUBBER, relaxation=(0.0, 0.0))
    recording = record(plain, seed, kept=kept)
    assert found_in(recording) is None
    assert with_relaxation([recording], VALUES)[0] is recording
    with pytest.raises(UndeterminedError, match=r'fit\.relaxation'):
        with_relaxation([recording], VALUES.replaced({'fit.relaxation': 'on'}))


def test_without_a_hold_the_slow_branch_is_assumed_and_uncertain():
    slow = replace(RUBBER, relaxation=(0.0, 0.25))
    held, shaken = (found_in(record(slow, 2, hold=hold, seconds=16.0 + hold)) for hold in (0, 6))
    assert held.std[1] > shaken.std[1]
    assert not shaken.assumed
