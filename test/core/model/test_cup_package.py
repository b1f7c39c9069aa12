"""Inertias of packages: of a box, of no body, and rounded."""

from contextlib import nullcontext

from bellows_ros.core.model import pseudo_inertia
from bellows_ros.core.model.cup_package import box_inertia, Cup, Package
from bellows_ros.core.model.modes import modes
from bellows_ros.core.model.structure import check_inertia
from bellows_ros.core.parameters.checks import implausible, resolve
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


def test_a_box_is_its_two_halves():
    """Halves along x, each moved by a quarter of the depth: only 1/12 of the squares does so."""
    half = box_inertia(1.0, 0.15, 0.2, 0.1) + np.diag([0.0, 1.0, 1.0]) * 0.075**2
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1), 2.0 * half, rtol=1e-14)
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1).diagonal()[[1, 0, 2]],
                    box_inertia(2.0, 0.2, 0.3, 0.1).diagonal(), rtol=1e-14)


@pytest.mark.parametrize(('inertia', 'figures'), [
    (np.diag([1.0, 1.0, 3.0]), '1, 1, 3 kg m'), (np.diag([1.0, 1.0, -1.0]), '-1, 1, 1 kg m'),
    (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), r'row 1, column 2\b.* 0\.1\b')])
def test_inertia_no_body_can_have_is_refused(inertia, figures):
    with pytest.raises(BellowsError, match=rf'package\.inertia.*{figures}'):
        check_inertia(inertia)


@pytest.mark.parametrize(('largest', 'std', 'is_taken'), [
    (2.003, 0.0, False), (2.1, -1.0, True), (2.15, -1.0, False),
    (2.15, 0.1, True)])
@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_an_inertia_impossible_within_its_uncertainty_becomes_the_nearest(largest, std, is_taken):
    values = resolve({
        'package.mass': 1.0, 'package.com': [0.0, 0.0, -0.03],
        'package.inertia': [1.0, 1.0, largest, 0.0, 0.0, 0.0],
        'package.inertia_std': [std] * 3 + [-1.0] * 3})
    with nullcontext() if is_taken else pytest.raises(BellowsError, match='No body'):
        found = package_of(values).inertia
        second = 0.5 * np.trace(found) - np.diag(found)
        assert_allclose(second[2], 1e-4 * second[0])
        assert_allclose(np.diag(found), values['package.inertia'][:3], rtol=0.08)
    assert any('nearest' in each for each in implausible(values))


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


PACKAGE = Package(2.0, np.diag([0.008, 0.009, 0.016]), np.array([0.0, 0.0, -0.03]))

K, P = np.array([6000.0, 6000, 11000, 4.0, 4.0, 1.2]), np.array([60.0, 60, 25, 0.06, 0.06, 0.1])

G = 9.81


def test_modes_of_bending_come_in_pairs_that_meet_a_beams_formula():
    """Find them twice where nothing tells x from y, as the 2x2 problem about the middle says."""
    plate = Package(2.0, np.diag([0.008, 0.008, 0.016]), np.array([0.0, 0.0, -0.03]))
    found = modes(Cup(np.diag(K), np.diag(P), 0.048), plate, 0.0)
    a = 0.03 + 0.024
    M = np.array([[2.0, 0.0], [0.0, 0.008]])
    stiffness = np.array([[K[0], K[0] * a], [K[0] * a, K[3] + K[0] * a**2]])
    squares = np.linalg.eigvals(np.linalg.solve(M, stiffness))
    expected = np.sort(np.sqrt(squares)) / (2 * np.pi)
    assert_allclose(sorted(m.frequency for m in found if m.direction in ('bending', 'lateral')),
                    np.repeat(expected, 2), rtol=1e-5)


def test_a_cup_that_only_bends_is_a_pendulum_with_a_spring():
    """Meet f = sqrt((k + m g a) / (I + m a^2)) / 2 pi, with a hinge in the middle of the cup."""
    stiff = Cup(np.diag([1e9, 1e9, 1e9, 4.0, 5.0, 1.2]), np.diag(P), 0.048)
    a = 0.03 + 0.024
    expected = [
        np.sqrt((k + 2.0 * G * a) / (inertia + 2.0 * a**2)) / (2 * np.pi)
        for k, inertia in ((4.0, 0.008), (5.0, 0.009))]
    found = sorted(
        mode.frequency for mode in modes(stiff, PACKAGE, G) if mode.direction == 'bending')
    assert_allclose(found, sorted(expected), rtol=1e-4)
