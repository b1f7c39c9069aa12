"""The charts of K and P: definite by construction, and their derivatives."""

from bellows_ros.core.identification.parametrisation import Parametrisation
from bellows_ros.core.identification.structure import STRUCTURES
from bellows_ros.core.model import Cup
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..cases import random_cup


def chart(name, cup):
    return Parametrisation(STRUCTURES[name], np.diag(cup.stiffness), np.diag(cup.damping))


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_numbers_and_matrices_undo_each_other(name):
    cup = random_cup(np.random.default_rng(1)) if name == 'full' else Cup.thesis()
    c = chart(name, cup)
    theta = c.numbers(cup.stiffness, cup.damping)
    assert len(theta) == c.size
    K, P = c.matrices(theta)
    assert_allclose(K, cup.stiffness, rtol=1e-12, atol=1e-9)
    assert_allclose(P, cup.damping, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_always_definite(name):
    rng = np.random.default_rng(2)
    c = chart(name, Cup.thesis())
    for _ in range(20):
        K, P = c.matrices(2.0 * rng.standard_normal(c.size))
        assert np.linalg.eigvalsh(K)[0] > 0.0
        assert np.linalg.eigvalsh(P)[0] > 0.0


def test_an_indefinite_start_is_lifted():
    c = chart('full', Cup.thesis())
    K = np.diag([6417.0, 6417.0, -11530.0, 3.868, 3.868, 1.123])
    lifted, _ = c.matrices(c.numbers(K, Cup.thesis().damping))
    assert np.linalg.eigvalsh(lifted)[0] > 0.0
    assert_allclose(lifted[[0, 3], [0, 3]], [6417.0, 3.868], rtol=1e-9)


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_slopes_are_those_of_the_entries(name):
    rng = np.random.default_rng(3)
    c = chart(name, Cup.thesis())
    theta, d = 0.3 * rng.standard_normal(c.size), 1e-6 * rng.standard_normal(c.size)
    ahead, behind = (
        np.concatenate([m.ravel() for m in c.matrices(theta + s * d)]) for s in (1, -1))
    assert_allclose(c.entry_slopes(theta) @ d, (ahead - behind) / 2, rtol=1e-5, atol=1e-10)
