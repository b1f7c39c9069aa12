"""What one recording tells, against all of its rows, and added to that of others."""

from bellows_ros.core.identification.reduction import DRAWS, information_of, SEED, with_noise
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.structure import STRUCTURES
import numpy as np
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


def weighing(structure):
    """Return a root of a weight that the structure allows."""
    root = np.random.default_rng(1).normal(size=(6, 6)) + 3.0 * np.eye(6)
    return root if structure.name == 'full' else np.diag(np.diag(root))


@pytest.mark.parametrize('name', ['axisymmetric', 'diagonal', 'full'])
def test_few_rows_stand_for_all_whatever_the_weight(recordings, name):
    structure, noise = STRUCTURES[name], recordings[0].noise
    samples = samples_of(recordings[0])
    information = information_of(samples, L0, structure, noise)
    W = weighing(structure)
    draws = np.random.default_rng(SEED).spawn(DRAWS)
    noisy = [with_noise(samples, noise, draw) for draw in draws]
    all_rows = [
        simulated.whitened_rows(s, L0, structure, W)
        for s in (samples, *noisy)]
    assert len(information.rows) == len(all_rows)
    for few, many in zip(information.rows, all_rows, strict=True):
        few = (W @ few).reshape(-1, many.shape[1])
        gram = many.T @ many
        size = np.sqrt(np.diag(gram))
        assert_allclose(few.T @ few / np.outer(size, size), gram / np.outer(size, size),
                        rtol=0, atol=1e-12)
    wanted = np.mean([np.sum((many - all_rows[0]) ** 2, axis=0) for many in all_rows[1:]], axis=0)
    energy = np.einsum('ab,pbc,ac->p', W, information.added, W)
    assert_allclose(energy, wanted[:-1], rtol=1e-9)


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
