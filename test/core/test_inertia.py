"""Inertia against integration over the bodies."""

from contextlib import nullcontext

from bellows_ros.core.lie import exp_so3
from bellows_ros.core.model import box_inertia, composite, cylinder_inertia, Package
from bellows_ros.core.parameters import check_inertia, validate
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


def test_cylinder_is_that_of_its_points():
    radius, height, n = 0.1, 0.25, 60
    rings = (np.arange(n) + 0.5) / n * radius
    angles = np.arange(24) / 24 * 2 * np.pi
    r, a, z = (x.ravel() for x in np.meshgrid(rings, angles, midpoints(height, n)))
    points = np.stack([r * np.cos(a), r * np.sin(a), z], axis=1)
    masses = 3.0 * r / r.sum()
    assert_allclose(cylinder_inertia(3.0, radius, height), of_points(points, masses), rtol=1e-3,
                    atol=1e-12)


def test_two_half_boxes_are_the_whole_one():
    half = box_inertia(1.0, 0.1, 0.2, 0.3)
    left, right = np.eye(4), np.eye(4)
    left[:3, 3], right[:3, 3] = (-0.05, 0.0, -0.15), (0.05, 0.0, -0.15)
    mass, com, inertia = composite([(1.0, half, left), (1.0, half, right)])
    assert mass == 2.0
    assert_allclose(com, [0.0, 0.0, -0.15], atol=1e-16)
    assert_allclose(inertia, box_inertia(2.0, 0.2, 0.2, 0.3), atol=1e-16)


def test_parts_are_turned_and_moved():
    rng = np.random.default_rng(1)
    parts, points, masses = [], [], []
    for _ in range(3):
        own = rng.standard_normal((50, 3))
        weight = rng.uniform(0.1, 1.0, 50)
        own -= weight @ own / weight.sum()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = exp_so3(rng.standard_normal(3)), rng.standard_normal(3)
        parts.append((weight.sum(), of_points(own, weight), T))
        points.append(own @ T[:3, :3].T + T[:3, 3])
        masses.append(weight)
    points, masses = np.concatenate(points), np.concatenate(masses)
    mass, com, inertia = composite(parts)
    assert_allclose(mass, masses.sum())
    assert_allclose(com, masses @ points / masses.sum(), atol=1e-14)
    assert_allclose(inertia, of_points(points, masses), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize('parts', [[], [(0.0, np.eye(3), np.eye(4))]])
def test_a_composite_needs_parts_with_mass(parts):
    with pytest.raises(BellowsError, match='part'):
        composite(parts)


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
    with nullcontext() if is_taken else pytest.raises(BellowsError, match='sum of the other two'):
        Package(1.0, np.diag([1.0, 1.0, largest]), np.zeros(3))
    with nullcontext() if is_taken else pytest.raises(BellowsError, match='sum of the other two'):
        validate('package.inertia', [1.0, 1.0, largest, 0.0, 0.0, 0.0])
