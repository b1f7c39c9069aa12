"""Lie-group functions against their definitions: series, finite differences and group laws."""

from fractions import Fraction
from math import factorial, pi

from bellows_ros.core.geometry import lie
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

NEAR_ZERO = [0.0, 1e-300, 1e-160, 1e-12, 1e-9, 1e-6, 1e-3, 0.1]
MIDDLE = [0.5, lie.SERIES_BELOW - 1e-9, lie.SERIES_BELOW, lie.SERIES_BELOW + 1e-9, 2.0, 3.0]
NEAR_PI = [pi - 1e-3, pi - 1e-6, pi - 1e-9, pi - 1e-12]
# Three roundings to each side, for those of the unit vectors.
AROUND_THRESHOLD = [lie.SERIES_BELOW * (1.0 - 4e-16), lie.SERIES_BELOW * (1.0 + 4e-16)]
ANGLES = NEAR_ZERO + MIDDLE + NEAR_PI
# A few roundings of numbers up to pi.
ROUNDING = 2e-15


def directions(count=200, seed=1):
    """Return unit vectors: the axes, both ways, and random ones."""
    random = np.random.default_rng(seed).normal(size=(count, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    return np.concatenate([np.eye(3), -np.eye(3), random])


def random_poses(count, seed=2):
    rng = np.random.default_rng(seed)
    return lie.transform(lie.exp_so3(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    for u in directions(5):
        phi = angle * u
        # SciPy's expm is itself good to some 1e-15 here.
        assert_allclose(lie.exp_so3(phi), expm(lie.hat(phi)), atol=5e-15)


@pytest.mark.parametrize('angle', ANGLES)
def test_log_inverts_exp(angle):
    phi = angle * directions()
    # Relative at small angles, absolute (a rounding of pi) at large ones.
    assert_allclose(lie.log_so3(lie.exp_so3(phi)), phi, atol=min(ROUNDING, 2e-15 * angle), rtol=0)


def test_log_at_pi_exactly():
    half_turns = [np.diag(2.0 * axis - 1.0) for axis in np.eye(3)]
    assert_array_equal(lie.log_so3(half_turns), pi * np.eye(3))
    u = directions()
    R = 2.0 * u[:, :, None] * u[:, None, :] - np.eye(3)
    phi = lie.log_so3(R)
    assert_allclose(np.linalg.norm(phi, axis=1), pi, rtol=1e-15)
    assert_allclose(np.abs(np.sum(phi * u, axis=1)), pi, rtol=1e-15)


@pytest.mark.parametrize('function', ['_alpha', '_half_beta', '_gamma', '_delta', '_eps'])
def test_series_and_closed_form_are_exact_on_both_sides_of_the_threshold(function):
    t2 = np.array([0.0, 1e-300, 1e-8, 0.1, 0.5, *AROUND_THRESHOLD, 1.5, 2.0, 3.0]) ** 2
    exact = np.array([_exact(function, x) for x in t2])
    # delta and eps (1/12 and 1/60) have lost a digit or two just above the threshold. They enter
    # matrices with entries of order 1, so there it is the absolute error that counts.
    assert_allclose(getattr(lie, function)(t2), exact, rtol=1e-15, atol=2e-16)


def _exact(function, t2):
    """Sum a function's power series in exact fractions, from the definitions of the module."""
    x, terms = Fraction(t2), range(30)
    alpha = [Fraction((-1) ** k, factorial(2 * k + 1)) for k in terms]
    half_beta = [Fraction((-1) ** k, factorial(2 * k + 2)) for k in terms]
    gamma = [-a for a in alpha[1:]]
    delta = [a - 2 * b for a, b in zip(alpha[1:], half_beta[1:], strict=True)]
    eps = [b - 3 * g for b, g in zip(half_beta[1:], gamma[1:], strict=False)]
    series = {'_alpha': alpha, '_half_beta': half_beta, '_gamma': gamma, '_delta': delta}
    return float(sum(c * x**k for k, c in enumerate(series.get(function, eps))))


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.5, 0.999, 1.001, 2.0, 3.0, 5.0, 9.0])
def test_dexp_is_the_spatial_rate_of_exp(angle):
    rng = np.random.default_rng(4)
    phi = angle * directions(20)
    rate, h = rng.normal(size=phi.shape), 1e-4
    turned = lie.exp_so3(phi + h * rate) @ np.swapaxes(lie.exp_so3(phi - h * rate), -1, -2)
    # Central differences: O(h^2) of the third derivative.
    assert_allclose(lie.apply(lie.dexp(phi), rate), lie.log_so3(turned) / (2 * h), atol=3e-7)
    body = np.swapaxes(lie.exp_so3(phi - h * rate), -1, -2) @ lie.exp_so3(phi + h * rate)
    assert_allclose(lie.apply(lie.dexp(-phi), rate), lie.log_so3(body) / (2 * h), atol=3e-7)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.5, 0.999, 1.001, 2.0, 3.0, 5.0, 9.0])
def test_d2exp_is_the_derivative_of_dexp(angle):
    rng = np.random.default_rng(5)
    phi = angle * directions(20)
    a, h = rng.normal(size=phi.shape), 1e-5
    slope = (lie.dexp(phi + h * a) - lie.dexp(phi - h * a)) / (2 * h)
    # Rounding of dexp over h dominates.
    assert_allclose(lie.d2exp(phi, a), lie.apply(slope, a), atol=1e-9)


@pytest.mark.parametrize('angle', [*ANGLES, 4.0, 6.0])
def test_dexp_inverse(angle):
    phi = angle * directions()
    # At 6 rad, close to 2 pi, dexp is nearly singular.
    product = lie.dexp_inverse(phi) @ lie.dexp(phi)
    assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-13)


def test_quaternions_and_scipy_agree():
    R = Rotation.random(300, random_state=7)
    q = R.as_quat()
    assert_allclose(lie.quaternion_to_rotation(q), R.as_matrix(), atol=1e-15)
    assert_allclose(lie.quaternion_to_rotation(-3.0 * q), R.as_matrix(), atol=1e-15)
    positive = q * np.where(q[:, 3:] < 0.0, -1.0, 1.0)
    assert_allclose(lie.rotation_to_quaternion(R.as_matrix()), positive, atol=1e-15)


@pytest.mark.parametrize('bad', [[0.0] * 4, [np.nan, 0.0, 0.0, 1.0], [np.inf, 0.0, 0.0, 1.0]])
def test_a_quaternion_that_is_no_rotation_is_refused(bad):
    with pytest.raises(BellowsError):
        lie.quaternion_to_rotation([[0.0, 0.0, 0.0, 1.0], bad])


@pytest.mark.parametrize('angle', ANGLES)
def test_log_se3_inverts_the_matrix_exponential_with_a_metre_of_translation(angle):
    xi = np.concatenate([directions(10, 9), angle * directions(10, 10)], axis=1)
    M = np.zeros((len(xi), 4, 4))
    M[:, :3, :3], M[:, :3, 3] = lie.hat(xi[:, 3:]), xi[:, :3]
    # dexp is closest to singular at pi, where its inverse is pi/2 large.
    assert_allclose(lie.log_se3(expm(M)), xi, atol=2e-14)


def test_adjoint_is_a_homomorphism():
    T_a_b, T_b_c = random_poses(50, 12), random_poses(50, 13)
    product = lie.adjoint(T_a_b) @ lie.adjoint(T_b_c)
    assert_allclose(lie.adjoint(T_a_b @ T_b_c), product, atol=1e-14)
