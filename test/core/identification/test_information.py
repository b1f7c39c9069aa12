"""What recordings tell together."""

from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.structure import STRUCTURES
from numpy.testing import assert_allclose
import pytest

from . import simulated

L0 = simulated.CUP.length
NOISE = (1e-4, 5e-4)


@pytest.fixture(scope='module')
def recordings():
    """Return two prepared recordings of different motions and lengths, with noise."""
    return [
        simulated.record(simulated.shake(axes, duration), tool=NOISE, package=NOISE, seed=seed)
        for seed, (axes, duration) in enumerate([((0, 1, 2), 6.0), ((0, 2, 3, 4, 5), 9.0)])
    ]


@pytest.mark.parametrize('name', ['axisymmetric', 'full'])
def test_what_recordings_tell_does_not_depend_on_their_order(recordings, name):
    def found(chosen):
        samples = [samples_of(r) for r in chosen]
        noises = [r.noise for r in chosen]
        return simulated.excitation(samples, L0, STRUCTURES[name], noises)

    one, other = found(recordings), found(recordings[::-1])
    for here, there in zip(one.parameters, other.parameters, strict=True):
        assert_allclose(there.noise_share, here.noise_share, rtol=1e-8)
        assert_allclose(there.bias, here.bias, rtol=1e-6, atol=1e-9)
    for here, there in zip(one.axes, other.axes, strict=True):
        assert_allclose(there.strain_noise, here.strain_noise, rtol=1e-12)
        assert_allclose(there.motion, here.motion, rtol=1e-12)
