"""Structure selection: the right one is advised, whichever it is."""

from dataclasses import replace

from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.structure_selection import select_structure
from bellows_ros.core.model.cup_package import Cup
import numpy as np
import pytest

from . import simulated

NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}


def selection_of(recording):
    """Return the structure selection of a recording."""
    return select_structure([samples_of(recording)], simulated.CUP.length, [recording.noise])


def coupled():
    """Return a cup whose directions are coupled as no round one's are."""
    K, P = simulated.CUP.stiffness.copy(), simulated.CUP.damping.copy()
    K[0, 4] = K[4, 0] = 0.35 * np.sqrt(K[0, 0] * K[4, 4])
    K[1, 5] = K[5, 1] = 0.3 * np.sqrt(K[1, 1] * K[5, 5])
    return Cup(K, P, simulated.CUP.length)


def oval():
    """Return a cup that is softer about one lateral axis than about the other."""
    K = np.diag(np.diag(simulated.CUP.stiffness) * [1.0, 1.4, 1.0, 1.3, 1.0, 1.0])
    return Cup(K, simulated.CUP.damping, simulated.CUP.length)


def off_middle():
    """Return a round cup whose centre of stiffness is 8 mm above the middle."""
    X = np.eye(6)
    X[0, 4], X[1, 3] = -0.008, 0.008
    return Cup(X.T @ simulated.CUP.stiffness @ X, simulated.CUP.damping, simulated.CUP.length)


@pytest.mark.parametrize(('cup', 'name'), [
    (simulated.CUP, 'axisymmetric'), (off_middle(), 'axisymmetric_coupled'), (oval(), 'diagonal'),
    (coupled(), 'full')])
def test_the_structure_of_the_truth_is_advised(cup, name):
    selection = selection_of(simulated.record(
        simulated.shake(duration=12.0), cup, rate_hz=200.0, **NOISE))
    assert selection.advised == name
    assert selection.advice[0].startswith(f'Use fit.structure: {name}. ')
    assert [candidate.parameters for candidate in selection.candidates] == [8, 10, 12, 42]
    right = next(candidate for candidate in selection.candidates if candidate.structure == name)
    assert right.held_out < 0.03
    for candidate in selection.candidates[:selection.candidates.index(right)]:
        assert candidate.held_out > 2.0 * right.held_out  # too simple is far worse


def test_gaps_are_left_out():
    recording = simulated.record(simulated.shake(duration=12.0), rate_hz=120.0)
    samples = samples_of(recording)
    valid = np.ones(len(samples.tool), dtype=bool)
    valid[300:330] = False
    gappy = replace(samples, tool=replace(samples.tool, valid=valid))
    selection = select_structure([gappy], simulated.CUP.length, [recording.noise])
    assert selection.samples == len(samples.tool) - 30
    assert selection.advised == 'axisymmetric'


def test_a_poor_motion_leaves_the_structures_that_can_be_fitted():
    """Refuse what cannot be fitted, with the reason, and advise what can."""
    selection = selection_of(
        simulated.record(simulated.shake(axes=(0, 2), duration=8.0), **NOISE))
    usable = [candidate.structure for candidate in selection.candidates if candidate.usable]
    assert usable == ['axisymmetric', 'axisymmetric_coupled']
    assert selection.advised in usable
    for name in ('diagonal', 'full'):
        assert any(sentence.startswith(f'{name} ') for sentence in selection.advice)
