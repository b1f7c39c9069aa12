"""Inertia against integration over the bodies."""

from contextlib import nullcontext

from bellows_ros.core.model.cup_package import box_inertia, Package
from bellows_ros.core.model.structure import check_inertia
from bellows_ros.core.parameters.checks import validate
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


def of_points(points, masses):
    """Return the inertia of point masses about their centre of mass."""
    r = points - masses @ points / masses.sum()
    return np.einsum('n,nij->ij', masses, (
        np.einsum('ni,ni->n', r, r)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None, :]))


def midpoints(length, count):
    """Return the centres of equal slices of a length around zero."""
    return (np.arange(count) + 0.5) / count * length - length / 2


def test_box_is_that_of_its_points():
    d, w, h, n = 0.3, 0.2, 0.1, 40
    points = np.stack(np.meshgrid(*(midpoints(s, n) for s in (d, w, h))), -1).reshape(-1, 3)
    masses = np.full(len(points), 2.0 / len(points))
    # midpoint sums fall short of the integral of x^2 by 1 / n^2
    assert_allclose(box_inertia(2.0, d, w, h), of_points(points, masses) / (1 - 1 / n**2),
                    atol=1e-12)


@pytest.mark.parametrize(('inertia', 'word'), [
    (np.diag([1.0, 1.0, 3.0]), 'sum of the other two'),
    (np.diag([1.0, 1.0, -1.0]), 'above zero'),
    (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), 'symmetric'),
])
def test_inertia_no_body_can_have_is_refused(inertia, word):
    with pytest.raises(BellowsError, match=word):
        check_inertia(inertia)


@pytest.mark.parametrize(('largest', 'is_taken'), [(2.001999, True), (2.002001, False)])
def test_packages_and_parameters_take_the_same_rounded_inertia(largest, is_taken):
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        Package(1.0, np.diag([1.0, 1.0, largest]), np.zeros(3))
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        validate('package.inertia', [1.0, 1.0, largest, 0.0, 0.0, 0.0])
