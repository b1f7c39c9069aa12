"""
A second, slow implementation of one integration step that also takes complex numbers.

Derivatives by a complex step are exact to rounding: d f / d x = Im f(x + i h) / h, h = 1e-30.
"""

import numpy as np
from scipy.linalg import expm

STEP = 1e-30
Z = np.array([0.0, 0.0, 1.0])


def derivative(function, x):
    """Return the derivative of a function of a vector at real numbers."""
    x = np.asarray(x, dtype=complex)
    columns = [function(x + 1j * STEP * unit) for unit in np.eye(len(x))]
    return np.imag(np.array(columns)).T / STEP


def hat(v):
    """Return v^."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def vee(S):
    """Return v of v^."""
    return np.array([S[2, 1], S[0, 2], S[1, 0]])


def log(R):
    """Return the rotation vector of a rotation by less than a right angle."""
    sine = 0.5 * vee(R - R.T)
    size = np.sqrt(sine @ sine)
    return sine * (np.arcsin(size) / size if size != 0 else 1.0)


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
    """The model's 62 parameters, in the order of `jacobians.PARAMETERS`."""

    def __init__(self, p):
        """Take them."""
        self.K, self.P, self.length = symmetric(p[:21]), symmetric(p[21:42]), p[42]
        xx, yy, zz, xy, xz, yz = p[43:49]
        self.inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        self.gravity, self.mass, self.com, self.wrench = p[49:52], p[52], p[53:56], p[56:62]

    @staticmethod
    def of(cup, package, gravity):
        """Return the numbers (62,) of a model, the wrench zero."""
        upper = np.triu_indices(6)
        inertia = package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return np.concatenate([
            cup.stiffness[upper], cup.damping[upper], [cup.length], inertia, gravity,
            [package.mass], package.com, np.zeros(6)])


def acceleration(p, tool, body):
    """Return the rate of the body twist (3.5); states are (o, R, v)."""
    (o_E, R_E, v_E), (o_B, R_B, v_B) = tool, body
    n, half, eye = Numbers(p), 0.5 * p[42] * Z, np.eye(3)
    R = R_E.T @ R_B
    o_S = R_E.T @ (o_B - R_B @ n.com - o_E)
    v = adjoint(eye, n.com) @ v_B - np.linalg.inv(adjoint(R, o_S)) @ v_E
    o = half + o_S + R @ half
    J = np.block([
        [R + eye, hat(R.T @ o)], [np.zeros((3, 3)), np.trace(R) * eye - R.T]])
    h = np.concatenate([(eye + R.T) @ o, vee(R - R.T)])
    X, to_S1 = adjoint(R, o), adjoint(eye, -half)
    f = -0.25 * J.T @ n.K @ h - 0.5 * (n.P + X.T @ n.P @ X) @ to_S1 @ v
    f = adjoint(eye, n.com).T @ (to_S1.T @ f + n.wrench)
    linear, w = v_B[:3], v_B[3:]
    return np.concatenate([
        f[:3] / n.mass + R_B.T @ n.gravity - np.cross(w, linear),
        np.linalg.solve(n.inertia, f[3:] - np.cross(w, n.inertia @ w))])


def dexp(phi):
    """Return what makes body rates of rotation vector rates, by its series."""
    total, power = np.zeros((3, 3), dtype=complex), np.eye(3, dtype=complex)
    for k in range(1, 25):
        total, power = total + power, power @ hat(-phi) / (k + 1)
    return total


def tool_between(start, end, duration, s):
    """Return the tool on the Hermite curve between two samples (o, R, v)."""
    (o0, R0, v0), (o1, R1, v1) = start, end

    def hermite(x0, x1, d0, d1):
        value = ((2 * s**3 - 3 * s**2 + 1) * x0 + (s**3 - 2 * s**2 + s) * d0
                 + (3 * s**2 - 2 * s**3) * x1 + (s**3 - s**2) * d1)
        slope = ((6 * s**2 - 6 * s) * (x0 - x1) + (3 * s**2 - 4 * s + 1) * d0
                 + (3 * s**2 - 2 * s) * d1)
        return value, slope / duration

    o, velocity = hermite(o0, o1, duration * R0 @ v0[:3], duration * R1 @ v1[:3])
    phi_end = log(R0.T @ R1)
    rate_end = np.linalg.solve(dexp(phi_end), v1[3:])
    phi, rate = hermite(0 * phi_end, phi_end, duration * v0[3:], duration * rate_end)
    R = R0 @ expm(hat(phi))
    return o, R, np.concatenate([R.T @ velocity, dexp(phi) @ rate])


def advance(p, body, start, end, duration, substeps):
    """Return the state (o, R, v) after Runge-Kutta-Munthe-Kaas steps of order 4."""
    h = duration / substeps
    o, R, v = body
    for i in range(substeps):
        tools = [tool_between(start, end, duration, (i + c) / substeps) for c in (0.0, 0.5, 1.0)]
        slopes = []
        for tool, part in zip(
                (tools[0], tools[1], tools[1], tools[2]), (0, 0.5, 0.5, 1), strict=True):
            do, sigma, dv = (part * h * x for x in slopes[-1]) if slopes else (0 * Z, 0 * Z, 0)
            at = o + do, R @ expm(hat(sigma)), v + dv
            w = at[2][3:]
            rate = w + 0.5 * np.cross(sigma, w) + np.cross(sigma, np.cross(sigma, w)) / 12
            slopes.append((at[1] @ at[2][:3], rate, acceleration(p, tool, at)))
        do, sigma, dv = (
            h / 6 * (a + 2 * b + 2 * c + d) for a, b, c, d in zip(*slopes, strict=True))
        o, R, v = o + do, R @ expm(hat(sigma)), v + dv
    return o, R, v


def changed(state, x):
    """Return a state with twelve numbers added: shift, turn and twist in its own axes."""
    o, R, v = state
    return o + R @ x[:3], R @ expm(hat(x[3:6])), v + x[6:]


def change(first, second):
    """Return the twelve numbers that change one state into another nearby."""
    (o0, R0, v0), (o1, R1, v1) = first, second
    return np.concatenate([R0.T @ (o1 - o0), log(R0.T @ R1), v1 - v0])
