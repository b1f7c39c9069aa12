"""The charts of K and P: definite by construction, and linear near a point."""

from bellows_ros.core.identification.prediction.parametrisation import (
    Parametrisation,
    semidefinite,
)
from bellows_ros.core.identification.structure import STRUCTURES
from bellows_ros.core.model import Cup
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cases import random_cup


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
def test_a_neighbourhood_is_linear_in_the_parameters(name):
    cup = random_cup(np.random.default_rng(4)) if name == 'full' else Cup.thesis()
    c = chart(name, cup)
    near = c.near(c.numbers(cup.stiffness, cup.damping))
    assert_allclose(near.matrices(np.zeros(near.size))[0], cup.stiffness, rtol=1e-9, atol=1e-9)
    for j, label in enumerate(STRUCTURES[name].labels):
        K, P = near.matrices(0.5 * np.eye(near.size)[j])
        changed = K - cup.stiffness if label[0] == 'K' else P - cup.damping
        where = STRUCTURES[name].entries[j % STRUCTURES[name].size][0]
        assert_allclose(changed[where], 0.5 * near.scale[j], rtol=1e-6)
        assert_allclose(near.matrices(np.eye(near.size)[j])[0] - cup.stiffness,
                        2.0 * (K - cup.stiffness), rtol=1e-6, atol=1e-9)


def test_the_nearest_semidefinite_matrix():
    P = np.diag([60.0, 60.0, -3.0, 0.05, 0.05, 0.1])
    assert_allclose(semidefinite(P), np.diag([60.0, 60.0, 0.0, 0.05, 0.05, 0.1]), atol=1e-12)
    P[2, 2] = 3.0
    assert semidefinite(P) is P
    P[0, 2] = P[2, 0] = 20.0  # more than the root of 60 * 3
    values = np.linalg.eigvalsh(semidefinite(P))
    assert values[0] > -1e-9
    assert_allclose(semidefinite(semidefinite(P)), semidefinite(P), atol=1e-9)
