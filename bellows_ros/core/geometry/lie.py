"""
Rotations, poses, twists and wrenches as NumPy arrays, vectorised over leading axes.

Conventions: ``R_a_b`` and ``T_a_b`` map b-coordinates to a-coordinates; twists and wrenches are
six-vectors, linear part first; quaternions are (x, y, z, w). Equation numbers refer to Peeters
(2021).

The exponential map and its derivatives are combinations of five even functions of the angle t =
|phi|::

    alpha  = sin(t) / t                    (G.75)
    beta/2 = (1 - cos(t)) / t^2            (G.76)
    gamma  = (1 - alpha) / t^2
    delta  = (alpha - beta) / t^2
    eps    = (beta/2 - 3 gamma) / t^2

The closed forms of these functions cancel catastrophically near zero, so below `SERIES_BELOW` the
Taylor series are summed.
"""

from collections.abc import Callable
from math import factorial

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

# rad. At this angle the series below reach double precision, and the closed forms have lost at
# most two digits, of terms that are 1/12 and 1/60 in size.
SERIES_BELOW = 1.0


def _even_function(
    coefficient: Callable[[int], float], closed: Callable[[Array], Array]
) -> Callable[[Array], Array]:
    """
    Return an even function of t, which takes t^2.

    Below `SERIES_BELOW` it is the sum of (-1)^k coefficient(k) t^(2 k), else the closed form.
    """
    # The first omitted term is below 1e-19 of the sum.
    series = [(-1) ** k * coefficient(k) for k in range(10)]

    def function(t2: Array) -> Array:
        small = t2 < SERIES_BELOW**2
        x = np.where(small, t2, 0.0)
        total = np.full_like(x, series[-1])
        for term in reversed(series[:-1]):
            total = total * x + term
        if np.all(small):
            return total
        return np.where(small, total, closed(np.sqrt(np.where(small, 1.0, t2))))

    return function


_alpha = _even_function(lambda k: 1.0 / factorial(2 * k + 1), lambda t: np.sin(t) / t)
_half_beta = _even_function(
    lambda k: 1.0 / factorial(2 * k + 2), lambda t: 0.5 * (np.sin(0.5 * t) / (0.5 * t)) ** 2)
_gamma = _even_function(lambda k: 1.0 / factorial(2 * k + 3), lambda t: (t - np.sin(t)) / t**3)
_delta = _even_function(
    lambda k: -2.0 * (k + 1) / factorial(2 * k + 4),
    lambda t: (t * np.sin(t) - 4.0 * np.sin(0.5 * t) ** 2) / t**4)
_eps = _even_function(
    lambda k: -2.0 * (k + 1) / factorial(2 * k + 5),
    lambda t: (2.0 * t * np.sin(0.5 * t) ** 2 - 3.0 * (t - np.sin(t))) / t**5)


def hat(v: ArrayLike) -> Array:
    """
    Return the skew-symmetric matrices of vectors, with which v x u is a product.

    Parameters
    ----------
    v : array (..., 3)
        Vectors.

    Returns
    -------
    array (..., 3, 3)

    """
    v = np.asarray(v, dtype=np.float64)
    S = np.zeros((*v.shape, 3))
    S[..., 2, 1] = v[..., 0]
    S[..., 0, 2] = v[..., 1]
    S[..., 1, 0] = v[..., 2]
    return S - np.swapaxes(S, -1, -2)


def exp_so3(phi: ArrayLike) -> Array:
    """
    Return the rotation matrices of rotation vectors (G.74).

    Parameters
    ----------
    phi : array (..., 3)
        Rotation vectors, rad; any length.

    Returns
    -------
    array (..., 3, 3)

    """
    phi = np.asarray(phi, dtype=np.float64)
    t2 = _squared(phi)
    return _rotation_polynomial(phi, _alpha(t2), _half_beta(t2))


def log_so3(R: Array) -> Array:
    """
    Return the rotation vectors of rotation matrices, the inverse of `exp_so3` for |phi| < pi.

    Computed from the quaternion by the tangent of its half angle, and thus accurate at every
    angle; (2.7), with the arc cosine of the trace, loses digits near 0 and pi. At exactly pi one
    of the two equivalent vectors is returned.

    Parameters
    ----------
    R : array (..., 3, 3)
        Rotation matrices.

    Returns
    -------
    array (..., 3)
        Rotation vectors, rad, of length at most pi.

    """
    return log_quaternion(rotation_to_quaternion(R))


def dexp(phi: Array) -> Array:
    """
    Return the right-trivialised derivative of the exponential map (G.65, with 1/|phi|^2).

    With R = exp(phi(t)) the spatial rate is ``dexp(phi) @ phi_dot`` (4.54), the body rate
    ``dexp(-phi) @ phi_dot``.

    Parameters
    ----------
    phi : array (..., 3)
        Rotation vectors, rad.

    Returns
    -------
    array (..., 3, 3)

    """
    t2 = _squared(phi)
    return _rotation_polynomial(phi, _half_beta(t2), _gamma(t2))


def dexp_inverse(phi: Array) -> Array:
    """
    Return the inverse of `dexp`, valid for |phi| < 2 pi.

    The inverse is I - phi^/2 - (delta/beta) (phi^)^2, with delta and beta of the module.

    Parameters
    ----------
    phi : array (..., 3)
        Rotation vectors, rad.

    Returns
    -------
    array (..., 3, 3)

    """
    t2 = _squared(phi)
    return _rotation_polynomial(phi, np.full(t2.shape, -0.5), -0.5 * _delta(t2) / _half_beta(t2))


def d2exp(phi: Array, a: Array) -> Array:
    """
    Return the derivative of `dexp` along a, applied to a (G.73 with both directions a).

    The result is the right-trivialised geometric Hessian of the exponential map for the (+)
    Cartan-Schouten connection: with R = exp(phi(t)) the spatial angular acceleration is
    ``d2exp(phi, phi_dot) + dexp(phi) @ phi_ddot`` (4.55). At phi = 0 it is zero.

    Parameters
    ----------
    phi, a : arrays (..., 3)
        Rotation vectors (rad) and tangent vectors; leading axes broadcast.

    Returns
    -------
    array (..., 3)

    """
    t2 = _squared(phi)[..., None]
    along = np.sum(phi * a, axis=-1, keepdims=True)
    phi_a = np.cross(phi, a)
    twice = np.cross(phi, phi_a)
    return np.asarray(
        _gamma(t2) * np.cross(a, phi_a) + along * (_delta(t2) * phi_a + _eps(t2) * twice))


def quaternion_to_rotation(quaternion_xyzw: ArrayLike) -> Array:
    """
    Return the rotation matrices of quaternions, which are divided by their norm.

    Parameters
    ----------
    quaternion_xyzw : array (..., 4)
        Quaternions of any length but zero.

    Returns
    -------
    array (..., 3, 3)

    Raises
    ------
    BellowsError
        If a quaternion is zero or not finite: it is no rotation.

    """
    norm = np.linalg.norm(quaternion_xyzw, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm) & (norm > 0.0)):
        raise BellowsError(
            'A quaternion is zero or not finite, hence not a rotation. Leave such samples out '
            'first.')
    q = quaternion_xyzw / norm
    v, w = q[..., :3], q[..., 3]
    # exp(phi) with phi^ = v^ |phi| / sin(|phi|/2): I + 2 w v^ + 2 (v^)^2.
    return _rotation_polynomial(v, 2.0 * w, np.full(w.shape, 2.0))


def rotation_to_quaternion(R: Array) -> Array:
    """
    Return the unit quaternions (x, y, z, w), w >= 0, of rotation matrices.

    Row i of the symmetric matrix 4 q q^T is linear in R; the row of the largest component is
    normalised, so no digits are lost at any angle.

    Parameters
    ----------
    R : array (..., 3, 3)
        Rotation matrices.

    Returns
    -------
    array (..., 4)

    """
    # Components are contiguous in memory, which takes a third of the time.
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, (-2, -1), (0, 1)).copy()
    xx, yy, zz, ww = diagonal = np.array(
        [1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i, 1.0 + a + e + i])
    xy, xz, yz, xw, yw, zw = b + d, c + g, f + h, h - f, c - g, d - b
    q = np.array([[xx, xy, xz, xw], [xy, yy, yz, yw], [xz, yz, zz, zw], [xw, yw, zw, ww]])
    rows = np.take_along_axis(q, np.argmax(diagonal, axis=0)[None, None], axis=0)[0]
    rows *= np.where(rows[3] < 0.0, -1.0, 1.0) / np.sqrt(np.sum(rows * rows, axis=0))
    return np.moveaxis(rows, 0, -1)


def nearest_rotation(M: Array) -> Array:
    """Return the rotation nearest to a matrix (3, 3), by least squares of the entries."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def mean_rotation(R: Array) -> Array:
    """Return the mean of rotations (N, 3, 3), by least squares of the entries."""
    return nearest_rotation(R.sum(axis=0))


def rpy_rotation(rpy: Array) -> Array:
    """Return R (3, 3) = Rz(yaw) Ry(pitch) Rx(roll) of roll, pitch and yaw, rad, as in URDF."""
    roll, pitch, yaw = exp_so3(np.diag(rpy))
    return np.asarray(yaw @ pitch @ roll)


def quaternion_product(p: Array, q: Array) -> Array:
    """
    Return the quaternions of the composed rotations R(p) R(q).

    The order of the terms makes a quaternion times its conjugate exactly real.

    Parameters
    ----------
    p, q : arrays (..., 4)
        Quaternions (x, y, z, w); leading axes broadcast.

    Returns
    -------
    array (..., 4)

    """
    px, py, pz, pw = np.moveaxis(p, -1, 0)
    qx, qy, qz, qw = np.moveaxis(q, -1, 0)
    product = np.stack([
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy + py * qw + pz * qx - px * qz,
        pw * qz + pz * qw + px * qy - py * qx,
        pw * qw - px * qx - py * qy - pz * qz])
    return np.moveaxis(product, 0, -1)


def quaternion_conjugate(quaternion_xyzw: Array) -> Array:
    """
    Return the quaternions of the inverse rotations.

    Parameters
    ----------
    quaternion_xyzw : array (..., 4)
        Unit quaternions.

    Returns
    -------
    array (..., 4)

    """
    return np.asarray(quaternion_xyzw * np.array([-1.0, -1.0, -1.0, 1.0]))


def log_quaternion(q: Array) -> Array:
    """
    Return the rotation vectors of unit quaternions of either sign.

    Parameters
    ----------
    q : array (..., 4)
        Unit quaternions.

    Returns
    -------
    array (..., 3)
        Rotation vectors, rad, of length at most pi.

    """
    v, w = q[..., :3], q[..., 3]
    s = np.sqrt(_squared(v))
    half = np.arctan2(s, np.abs(w))
    # Below the smallest squared double s underflows to 0; there the factor is 1 / w, with |w| = 1.
    factor = np.divide(half, s, out=np.ones_like(s), where=s > 0.0)
    return np.where(w < 0.0, -2.0, 2.0)[..., None] * factor[..., None] * v


def transform(R: Array, o: ArrayLike) -> Array:
    """
    Return the homogeneous transformation matrices of rotations and positions.

    Parameters
    ----------
    R : array (..., 3, 3)
        Rotation ``R_a_b``.
    o : array (..., 3)
        Origin of b in a, m; leading axes broadcast against the leading axes of R.

    Returns
    -------
    array (..., 4, 4)
        ``T_a_b``.

    """
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], np.shape(o)[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = o
    T[..., 3, 3] = 1.0
    return T


def inverse_transform(T: Array) -> Array:
    """
    Return ``T_b_a`` of ``T_a_b``.

    Parameters
    ----------
    T : array (..., 4, 4)
        ``T_a_b``.

    Returns
    -------
    array (..., 4, 4)

    """
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_inverse, -apply(R_inverse, T[..., :3, 3]))


def adjoint(T: Array) -> Array:
    """
    Return X(T) = [[R, o^ R], [0, R]], which maps a twist from b to a (2.24).

    Parameters
    ----------
    T : array (..., 4, 4)
        ``T_a_b``.

    Returns
    -------
    array (..., 6, 6)

    """
    R = T[..., :3, :3]
    X = np.zeros((*T.shape[:-2], 6, 6))
    X[..., :3, :3] = R
    X[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    X[..., 3:, 3:] = R
    return X


def log_se3(T: Array) -> Array:
    """
    Return the constant twist that reaches a pose in unit time.

    The inverse of the exponential map for angles below pi.

    Parameters
    ----------
    T : array (..., 4, 4)
        Poses.

    Returns
    -------
    array (..., 6)
        Linear part (m) first, rotation vector (rad) last.

    """
    phi = log_so3(T[..., :3, :3])
    return np.concatenate([apply(dexp_inverse(phi), T[..., :3, 3]), phi], axis=-1)


def apply(M: Array, v: Array) -> Array:
    """
    Return M v for stacks of matrices and vectors.

    Parameters
    ----------
    M : array (..., m, n)
        Matrices.
    v : array (..., n)
        Vectors; leading axes broadcast.

    Returns
    -------
    array (..., m)

    """
    return np.asarray((M @ v[..., None])[..., 0])


def _rotation_polynomial(v: Array, linear: Array, quadratic: Array) -> Array:
    """Return I + linear v^ + quadratic (v^)^2, with (v^)^2 = v v^T - |v|^2 I."""
    square = v[..., :, None] * v[..., None, :]
    np.einsum('...ii->...i', square)[...] -= _squared(v)[..., None]
    return np.asarray(
        np.eye(3) + linear[..., None, None] * hat(v) + quadratic[..., None, None] * square)


def _squared(v: Array) -> Array:
    return np.asarray(np.einsum('...i,...i->...', v, v))
