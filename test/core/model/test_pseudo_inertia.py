"""Stretched bodies are possible, and their moments are those of point masses."""

from bellows_ros.core.model import pseudo_inertia
from bellows_ros.core.model.structure import check_inertia
import numpy as np
from numpy.testing import assert_allclose
import pytest


def inertia_of(points):
    """Return the inertia of unit masses about their mean: the integral of r^2 I - r r^T."""
    second = (points - points.mean(axis=0)).T @ (points - points.mean(axis=0))
    return np.trace(second) * np.eye(3) - second


@pytest.fixture(params=range(5))
def points(request):
    """Return points of a body: three axes of different lengths, the last one thin."""
    draw = np.random.default_rng(request.param)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    return draw.normal(size=(8, 3)) @ np.diag([0.2, 0.1, 0.02]) @ turn


def test_a_stretched_body_is_that_of_stretched_points(points):
    d = np.array([0.3, -0.2, 1.5])
    inertia = inertia_of(points)
    expected = inertia_of(points * np.exp(d))
    found = np.reshape(pseudo_inertia.stretched(tuple(inertia.ravel()), tuple(d)), (3, 3))
    assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    factors = np.log(np.diag(expected) / np.diag(inertia))
    assert_allclose(pseudo_inertia.with_moments(inertia, factors), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('factors', [(0.0, 0.0, 0.3), (-1.0, 1.0, 0.0), (2.0, 0.0, -2.0)])
def test_no_factors_of_the_moments_leave_the_possible_bodies(points, factors):
    check_inertia(pseudo_inertia.with_moments(inertia_of(points), factors))


def test_a_possible_body_is_its_nearest_and_another_one_is_close(points):
    inertia = inertia_of(points)
    assert pseudo_inertia.nearest(inertia) is inertia
    impossible = np.diag([1.0, 1.0, 2.05])
    assert_allclose(pseudo_inertia.nearest(impossible), np.diag([1.025, 1.025, 2.05]), rtol=2e-4)
