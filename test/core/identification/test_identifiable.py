"""Covariances with unknown directions: inversion forth and back, and what is identifiable."""

from bellows_ros.core.identification.equations import covariance_of, information_of, without
import numpy as np
from numpy.testing import assert_allclose
import pytest


def definite(seed, size=5):
    """Return a positive definite matrix of numbers of very different sizes."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3 * size, size))
    scale = 10.0 ** rng.uniform(-4, 4, size)
    return scale[:, None] * (A.T @ A) * scale


@pytest.mark.parametrize('seed', range(5))
def test_a_covariance_is_the_inverse_where_all_is_known(seed):
    information = definite(seed)
    covariance = covariance_of(information)
    assert np.isfinite(covariance).all()
    size = np.sqrt(np.diag(information))
    assert_allclose(covariance * np.outer(size, size), np.linalg.inv(
        information / np.outer(size, size)), rtol=1e-8, atol=1e-10)
    assert_allclose(
        information_of(covariance) / np.outer(size, size), information / np.outer(size, size),
        rtol=1e-6, atol=1e-9)


def test_nothing_about_one_is_an_infinite_variance():
    information = definite(1)
    information[2] = information[:, 2] = 0.0
    covariance = covariance_of(information)
    assert covariance[2, 2] == np.inf
    assert np.all(covariance[2, [0, 1, 3, 4]] == 0.0)
    others = [0, 1, 3, 4]
    assert_allclose(
        covariance[np.ix_(others, others)],
        np.linalg.inv(information[np.ix_(others, others)]), rtol=1e-6)
    assert_allclose(information_of(covariance), information, rtol=1e-6, atol=1e-20)


def test_a_sum_that_is_known_does_not_tell_its_terms():
    """Know a + b and c: neither a nor b is identifiable."""
    rows = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    covariance = covariance_of(rows.T @ rows)
    assert np.isinf(np.diag(covariance)).tolist() == [True, True, False]
    assert_allclose(covariance[2, 2], 0.25)


def test_nothing_known_at_all():
    assert np.all(np.isinf(np.diag(covariance_of(np.zeros((3, 3))))))
    assert not np.any(information_of(np.diag([np.inf, np.inf])))


def test_what_is_made_unknown():
    covariance = np.linalg.inv(definite(2))
    found = without(covariance, np.array([False, True, False, False, True]))
    assert np.isinf(np.diag(found)).tolist() == [False, True, False, False, True]
    assert np.all(found[1, [0, 2, 3, 4]] == 0.0)
    assert_allclose(found[0, 2], covariance[0, 2])
