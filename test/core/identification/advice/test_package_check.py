"""The centre of mass that residuals want, of packages that hang elsewhere than was said."""

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.package_check import (
    check_centre_of_mass,
    check_length,
    shifted,
)
from bellows_ros.core.identification.methods import samples_of
from bellows_ros.core.identification.structure import STRUCTURES
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import simulated

ROUND = STRUCTURES['axisymmetric']
NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}


def checked(recording, wrong, lip, structure=ROUND):
    """Return the check where the centre of mass was said to be off by so much (m)."""
    samples = samples_of(recording, simulated.HELD, simulated.GRAVITY)
    moved = shifted(samples, np.array(wrong), lip)
    return check_centre_of_mass(
        moved, simulated.CUP.length, structure, lip, FilterNoise.of(recording))


@pytest.fixture(scope='module')
def exact():
    """Return a recording without noise."""
    return simulated.record(simulated.shake(seed=3))


@pytest.fixture(scope='module')
def noisy():
    """Return one with noise."""
    return simulated.record(simulated.shake(seed=3), seed=5, **NOISE)


@pytest.mark.parametrize('lip', [True, False])
@pytest.mark.parametrize('wrong', [(0.0, 0.0, 0.005), (0.005, 0.0, 0.0), (0.0, -0.004, 0.02)])
def test_a_wrong_centre_is_found_exactly_without_noise(exact, wrong, lip):
    found = checked(exact, wrong, lip)
    assert_allclose(found.shift, -np.array(wrong), atol=1e-4)
    assert found.off and found.residual < 0.1


@pytest.mark.parametrize('lip', [True, False])
def test_with_noise_the_right_one_is_not_doubted_and_a_wrong_one_is(noisy, lip):
    assert checked(noisy, (0.0, 0.0, 0.0), lip).warning('bag') == ()
    found = checked(noisy, (0.004, 0.0, 0.0), lip)
    assert_allclose(found.shift[:2], [-0.004, 0.0], atol=2e-4)
    (sentence,) = found.warning('bag')
    assert 'mm in x from package.com' in sentence and ' in y' not in sentence
    assert 'fit.time_offset' in sentence


@pytest.mark.parametrize('error', [1e-3, -1e-3, 4e-4])
def test_a_wrong_length_of_the_cup_is_told_and_the_right_one_is_not_doubted(noisy, error):
    samples = samples_of(noisy, simulated.HELD, simulated.GRAVITY)
    noise = FilterNoise.of(noisy)
    assert check_length(samples, simulated.CUP.length, ROUND, noise).warning('bag') == ()
    found = check_length(samples, simulated.CUP.length + error, ROUND, noise)
    assert_allclose(found.shift, -error, atol=5e-5)
    (sentence,) = found.warning('bag')
    side = 'long' if error > 0.0 else 'short'
    assert f'cup.length seems {1e3 * abs(error):.1f} mm too {side}' in sentence


@pytest.mark.parametrize('size', [3e-4, 1e-3])
def test_much_noise_is_not_taken_for_a_shift_along_the_axis(size):
    """See the shift that noise makes, 4 to 34 mm, and do not tell it."""
    noise = {'tool': (size, 1e-3), 'package': (size, 1e-3)}
    recording = simulated.record(simulated.shake(seed=3), seed=5, **noise)
    for lip in (True, False):
        assert not checked(recording, (0.0, 0.0, 0.0), lip).off
        sideways = checked(recording, (0.005, 0.0, 0.0), lip)
        assert sideways.off and ' in z' not in sideways.warning('bag')[0]


def test_couplings_explain_a_shift_as_well(exact):
    assert checked(exact, (0.0, 0.0, 0.01), True, STRUCTURES['full']) is None


def test_moving_the_centre_of_a_recorded_lip_moves_what_moves_with_it(exact):
    """Compare with the motion of another point of the body, by differences of positions."""
    samples = samples_of(exact, simulated.HELD, simulated.GRAVITY)
    d = np.array([0.01, -0.02, 0.03])
    body = shifted(samples, d, True).package
    lip = body.position - np.einsum('nij,j->ni', body.rotation, simulated.HELD.com + d)
    old = samples.package
    there = old.position - np.einsum('nij,j->ni', old.rotation, simulated.HELD.com)
    assert_allclose(lip, there, atol=1e-12)
    t = body.seconds
    world = np.einsum('nij,nj->ni', body.rotation, body.twist[:, :3])
    assert_allclose(np.gradient(body.position, t, axis=0)[5:-5], world[5:-5], atol=0.01)
    rate = np.gradient(body.twist, t, axis=0)
    assert_allclose(rate[5:-5], body.acceleration[5:-5], atol=0.4)
