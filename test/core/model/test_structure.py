"""Structures of K and P: what is free, what is tied, and what follows from it."""

from bellows_ros.core.model.structure import (
    common_structure,
    has_coupling,
    structure_named,
    STRUCTURES,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

COUPLED = STRUCTURES['axisymmetric_coupled']
SCALE = np.array([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])


def turned(degrees):
    """Return the congruence (6, 6) of a turn about z."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.kron(np.eye(2), R)


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_parameters_and_matrices_undo_each_other(name):
    structure = STRUCTURES[name]
    x = np.random.default_rng(1).standard_normal(2 * structure.size)
    K, P = structure.matrices(x)
    assert np.array_equal(K, K.T)
    assert_allclose(structure.parameters(K, P), x, rtol=1e-14)
    for number, (i, j) in enumerate(structure.leads):
        assert K[i, j] == x[number]


@pytest.mark.parametrize('name', ['axisymmetric', 'axisymmetric_coupled'])
@pytest.mark.parametrize('degrees', [30.0, 90.0])
def test_a_round_cup_may_be_turned_about_its_axis(name, degrees):
    structure, X = STRUCTURES[name], turned(degrees)
    matrix, _ = structure.matrices(np.random.default_rng(3).standard_normal(2 * structure.size))
    assert_allclose(X @ matrix @ X.T, matrix, rtol=1e-12, atol=1e-9)


def test_the_coupled_structure_is_a_centre_of_stiffness_off_the_middle():
    """Move a diagonal K along z by the adjoint (2.24): what comes out is of this structure."""
    shift = 0.004
    X = np.eye(6)
    X[:3, 3:] = [[0.0, -shift, 0.0], [shift, 0.0, 0.0], [0.0, 0.0, 0.0]]
    K = X.T @ np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35]) @ X
    assert_allclose(COUPLED.matrices(COUPLED.parameters(K, K))[0], K, rtol=1e-13)
    assert K[0, 4] == pytest.approx(-K[1, 3], rel=1e-13)
    assert COUPLED.labels[:5] == ('K x', 'K x-ry', 'K z', 'K rx', 'K rz')


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_pooled_covariances_are_those_of_pooled_vectors(name):
    """Stack the vectors of tied blocks, signs applied: their covariance stands in each block."""
    structure = STRUCTURES[name]
    vectors = np.random.default_rng(4).standard_normal((50, 6)) @ np.diag(SCALE) + SCALE
    mean = vectors.mean(axis=0)
    scatter = (vectors - mean).T @ (vectors - mean)
    Q = structure.covariance(len(vectors), mean, scatter)
    expected = np.zeros((6, 6))
    for blocks in structure.blocks:
        signed = [vectors[:, [i for i, _ in block]] * [s for _, s in block] for block in blocks]
        pooled = np.atleast_2d(np.cov(np.concatenate(signed).T))
        for block in blocks:
            for one, (i, s) in enumerate(block):
                for other, (j, t) in enumerate(block):
                    expected[i, j] = s * t * pooled[one, other]
    assert_allclose(Q, expected, rtol=1e-12, atol=1e-12)


def test_structures_contain_each_other_as_matrices_do():
    contained = {
        name: [other for other, inner in STRUCTURES.items() if structure.contains(inner)]
        for name, structure in STRUCTURES.items()}
    assert contained['axisymmetric'] == ['axisymmetric']
    assert contained['axisymmetric_coupled'] == ['axisymmetric', 'axisymmetric_coupled']
    assert contained['diagonal'] == ['axisymmetric', 'diagonal']
    assert contained['full'] == list(STRUCTURES)
    assert common_structure(COUPLED, STRUCTURES['diagonal']).name == 'full'
    assert common_structure(COUPLED, STRUCTURES['axisymmetric']) is COUPLED


def test_an_unknown_structure_is_refused():
    with pytest.raises(BellowsError, match="'round'.* axisymmetric, axisymmetric_coupled"):
        structure_named('round')


@pytest.mark.parametrize(('shift', 'expected'), [(0.0, False), (5e-5, False), (4.6e-3, True)])
def test_a_centre_of_stiffness_in_the_middle_is_no_coupling(shift, expected):
    """A shift below the uncertainty of a cup's length is none; 4.6 mm is one of a real bellows."""
    K = np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])
    K[0, 4] = K[4, 0] = 5400.0 * shift
    assert has_coupling(K) == expected
