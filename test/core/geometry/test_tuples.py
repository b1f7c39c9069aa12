"""The scalar vocabulary against NumPy, on both sides of every small-angle threshold."""

import math
import zlib

from bellows_ros.core.geometry import lie, tuples
import numpy as np
from numpy.testing import assert_allclose
import pytest

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1.9e-4, 2.1e-4, 0.1, 0.4999, 0.5001, 1.0, 3.0, 3.1415]


@pytest.fixture
def rng(request):
    """Give each test numbers of its own, whichever tests ran before it in this process."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


def direction(rng):
    """Return a random unit vector."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_gives_the_rotation_about_the_vector(angle, rng):
    axis = direction(rng)
    q = tuples.exp_quaternion(tuple(angle * axis))
    assert_allclose(q[:3], math.sin(angle / 2) * axis, rtol=3e-16, atol=3e-16 * angle)
    assert_allclose(q[3], math.cos(angle / 2), rtol=0, atol=5e-16)


@pytest.mark.parametrize('angle', ANGLES)
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_log_undoes_exp_with_either_sign_of_the_quaternion(angle, sign, rng):
    phi = angle * direction(rng)
    q = tuple(sign * part for part in tuples.exp_quaternion(tuple(phi)))
    assert_allclose(tuples.log_quaternion(q), phi, rtol=1e-15, atol=1e-15 * angle)


@pytest.mark.parametrize('angle', ANGLES)
def test_rotation_matrix_is_that_of_the_arrays(angle, rng):
    phi = angle * direction(rng)
    R = np.reshape(tuples.rotation_matrix(tuples.exp_quaternion(tuple(phi))), (3, 3))
    assert_allclose(R, lie.exp_so3(phi), atol=5e-16)


@pytest.mark.parametrize('angle', ANGLES[1:])
def test_body_rate_is_the_transposed_dexp_of_the_arrays_and_its_inverse_undoes_it(angle, rng):
    phi, rate = angle * direction(rng), rng.standard_normal(3)
    omega = tuples.body_rate(tuple(phi), tuple(rate))
    assert_allclose(omega, lie.dexp(-phi) @ rate, rtol=0, atol=1e-15 * np.linalg.norm(rate))
    assert_allclose(tuples.rotation_vector_rate(tuple(phi), omega), rate, rtol=0, atol=4e-15)


def test_products_follow_the_rotations(rng):
    p, q = (lie.rotation_to_quaternion(lie.exp_so3(rng.standard_normal(3))) for _ in range(2))
    P, Q = (np.reshape(tuples.rotation_matrix(tuple(x)), (3, 3)) for x in (p, q))
    product = tuples.quaternion_product(tuple(p), tuple(q))
    assert_allclose(np.reshape(tuples.rotation_matrix(product), (3, 3)), P @ Q, atol=1e-15)
    flat = tuples.multiply_transposed(tuple(P.ravel()), tuple(Q.ravel()))
    assert_allclose(np.reshape(flat, (3, 3)), P.T @ Q, atol=1e-15)
    v = rng.standard_normal(3)
    assert_allclose(tuples.apply(tuple(P.ravel()), tuple(v)), P @ v, atol=1e-15)
    assert_allclose(tuples.apply_transposed(tuple(P.ravel()), tuple(v)), P.T @ v, atol=1e-15)
    assert_allclose(tuples.cross(tuple(v), tuple(p[:3])), np.cross(v, p[:3]), atol=1e-15)


def test_quaternions_are_normalised_and_compared(rng):
    q = rng.standard_normal(4)
    assert_allclose(tuples.normalised(tuple(q)), q / np.linalg.norm(q), rtol=1e-15)
    p, phi = tuples.normalised(tuple(rng.standard_normal(4))), rng.standard_normal(3)
    turned = tuples.quaternion_product(p, tuples.exp_quaternion(tuple(phi)))
    assert_allclose(tuples.rotation_between(p, turned), phi, atol=2e-15)


@pytest.mark.parametrize('columns', [1, 4, 6, 7, 24])
def test_products_of_arrays_are_those_of_numpy(columns, rng):
    A, B = rng.standard_normal((4, columns)), rng.standard_normal((columns, 7))
    out = rng.standard_normal((6, 7))
    expected = out.copy()
    expected[:4] += A @ B
    assert_allclose(tuples.add_product(A, B, out), expected, atol=1e-14)
    expected[:4], expected[4:] = A @ B, 0.0
    assert_allclose(tuples.product(A, B, out), expected, atol=1e-14)
    assert_allclose(tuples.transpose(A), A.T, rtol=0)
