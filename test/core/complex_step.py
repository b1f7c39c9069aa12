"""
A second, slow implementation of the package's acceleration that also takes complex numbers.

Derivatives by a complex step are exact to rounding: d f / d x = Im f(x + i h) / h, h = 1e-30.
"""

import numpy as np
from scipy.linalg import expm

from .oracle import vee, Z

STEP = 1e-30


def derivative(function, x):
    """Return the derivative of a function of a vector at real numbers."""
    x = np.asarray(x, dtype=complex)
    columns = [function(x + 1j * STEP * unit) for unit in np.eye(len(x))]
    return np.imag(np.array(columns)).T / STEP


def hat(v):
    """Return v^."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def adjoint(R, o):
    """Return X (2.24)."""
    return np.block([[R, hat(o) @ R], [np.zeros((3, 3)), R]])


def symmetric(entries):
    """Return the symmetric matrix of an upper triangle."""
    n = 6 if len(entries) == 21 else 3
    M = np.zeros((n, n), dtype=complex)
    M[np.triu_indices(n)] = entries
    return M + np.triu(M, 1).T


class Numbers:
    """The model's 64 parameters, in the order of `jacobians.PARAMETER_COLUMNS`."""

    def __init__(self, p):
        """Store the numbers."""
        self.K, self.P, self.length = symmetric(p[:21]), symmetric(p[21:42]), p[42]
        xx, yy, zz, xy, xz, yz = p[43:49]
        self.inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        self.gravity, self.mass, self.com, self.wrench = p[49:52], p[52], p[53:56], p[56:62]
        self.stretch = p[62:64]

    @staticmethod
    def of(cup, package, gravity):
        """Return the numbers (64,) of a model without an additional wrench."""
        upper = np.triu_indices(6)
        inertia = package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return np.concatenate([
            cup.stiffness[upper], cup.damping[upper], [cup.length], inertia, gravity,
            [package.mass], package.com, np.zeros(6), cup.stretch])


def acceleration(p, tool, body, r=(), z=()):
    """Return the rate of the body twist (3.5); states are (o, R, v), internal strains r and z."""
    (o_E, R_E, v_E), (o_B, R_B, v_B) = tool, body
    n, half, eye = Numbers(p), 0.5 * p[42] * Z, np.eye(3)
    R = R_E.T @ R_B
    o_S = R_E.T @ (o_B - R_B @ n.com - o_E)
    v = adjoint(eye, n.com) @ v_B - np.linalg.inv(adjoint(R, o_S)) @ v_E
    o = half + o_S + R @ half
    J = np.block([
        [R + eye, hat(R.T @ o)], [np.zeros((3, 3)), np.trace(R) * eye - R.T]])
    h = np.concatenate([(eye + R.T) @ o, vee(R - R.T)])
    e = h + sum((a * (h - b) for a, b in zip(r, z, strict=True)), np.zeros(6))
    s = n.K @ e + 4.0 * stretch_gradient(n.stretch, h)
    X, to_S1 = adjoint(R, o), adjoint(eye, -half)
    f = -0.25 * J.T @ s - 0.5 * (n.P + X.T @ n.P @ X) @ to_S1 @ v
    f = adjoint(eye, n.com).T @ (to_S1.T @ f + n.wrench)
    linear, w = v_B[:3], v_B[3:]
    return np.concatenate([
        f[:3] / n.mass + R_B.T @ n.gravity - np.cross(w, linear),
        np.linalg.solve(n.inertia, f[3:] - np.cross(w, n.inertia @ w))])


def stretch_gradient(stretch, h):
    """Return the gradient of a h_z^3 + b h_z (h_rx^2 + h_ry^2) by the strain."""
    a, b = stretch
    return np.array([
        0, 0, 3 * a * h[2] ** 2 + b * (h[3] ** 2 + h[4] ** 2), 2 * b * h[2] * h[3],
        2 * b * h[2] * h[4], 0])


def changed(state, x):
    """Return a state with twelve numbers added: shift, turn and twist in its own axes."""
    o, R, v = state
    return o + R @ x[:3], R @ expm(hat(x[3:6])), v + x[6:]
