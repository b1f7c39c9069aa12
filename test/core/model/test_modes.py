"""Modes of a cup, against textbook formulas."""

from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.modes import modes
import numpy as np
from numpy.testing import assert_allclose

PACKAGE = Package(2.0, np.diag([0.008, 0.009, 0.016]), np.array([0.0, 0.0, -0.03]))

K, P = np.array([6000.0, 6000, 11000, 4.0, 4.0, 1.2]), np.array([60.0, 60, 25, 0.06, 0.06, 0.1])

G = 9.81


def test_modes_of_axial_and_torsion_are_those_of_one_mass():
    """Meet f = sqrt(k/m) / 2 pi and zeta = p / (2 sqrt(k m)), exact for these two."""
    found = {mode.direction: (mode.frequency, mode.damping) for mode in modes(
        Cup(np.diag(K), np.diag(P), 0.048), PACKAGE, G)}
    for name, k, p, m in (('axial', K[2], P[2], 2.0), ('torsion', K[5], P[5], 0.016)):
        assert_allclose(found[name][0], np.sqrt(k / m) / (2 * np.pi), rtol=1e-6)
        assert_allclose(found[name][1], p / (2 * np.sqrt(k * m)), rtol=1e-6)


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
