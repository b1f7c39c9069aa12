"""
The same equations as a user would write them with NumPy: 6x6 matrices, RK4.

What does not change is worked out once, and the tool stands still, which costs less than one that
moves. On purpose without this package's kernels; also the right-hand side for SciPy's `solve_ivp`.
"""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import Cup, Package
import numpy as np
from scipy.integrate import solve_ivp

EYE = np.eye(3)


def hat(v: Array) -> Array:
    """Return the matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def vee(S: Array) -> Array:
    """Return the vector of a skew matrix."""
    return np.array([S[2, 1], S[0, 2], S[1, 0]])


def upper(diagonal: Array, corner: Array, below: Array) -> Array:
    """Return a 6x6 matrix of 3x3 blocks, zero at the lower left."""
    X = np.zeros((6, 6))
    X[:3, :3], X[:3, 3:], X[3:, 3:] = diagonal, corner, below
    return X


def adjoint(R: Array, o: Array) -> Array:
    """Return X(H) (2.24) of the pose H with rotation R and origin o."""
    return upper(R, hat(o) @ R, R)


class PlainModel:
    """
    Cup and package under a still tool at the origin.

    The state is a vector: position (3), rotation matrix (9), body twist (6).
    """

    def __init__(self, cup: Cup, package: Package, gravity: float) -> None:
        """Prepare the constant matrices."""
        self.K, self.P = cup.stiffness, cup.damping
        self.z = np.array([0.0, 0.0, 0.5 * cup.length])
        self.B_o_S = -np.asarray(package.com)
        self.to_S1 = adjoint(EYE, -self.z) @ adjoint(EYE, package.com)
        self.M = upper(package.mass * EYE, np.zeros((3, 3)), package.inertia)
        self.M_inverse = np.linalg.inv(self.M)
        self.weight = np.array([0.0, 0.0, -package.mass * gravity])

    def rate(self, time: float, state: Array) -> Array:
        """Return the derivative of the state."""
        R, v = state[3:12].reshape(3, 3), state[12:]
        f = self._wrench(R, state[:3] + R @ self.B_o_S, v)
        f[:3] += R.T @ self.weight
        w = hat(v[3:])
        f += upper(w, hat(v[:3]), w).T @ (self.M @ v)
        return np.concatenate([R @ v[:3], (R @ w).ravel(), self.M_inverse @ f])

    def _wrench(self, R: Array, E_o_S: Array, v: Array) -> Array:
        """Return the cup's wrench on the package at B (3.27), (3.33), (2.28)."""
        o = self.z + R @ self.z + E_o_S
        strain = np.concatenate([o + R.T @ o, vee(R - R.T)])
        J = upper(R + EYE, hat(R.T @ o), np.trace(R) * EYE - R.T)
        spring = -0.25 * J.T @ (self.K @ strain)
        X, v_S1 = adjoint(R, o), self.to_S1 @ v
        damper = -0.5 * (self.P @ v_S1 + X.T @ (self.P @ (X @ v_S1)))
        return np.asarray(self.to_S1.T @ (spring + damper))

    def rk4(self, state: Array, h: float, count: int) -> Array:
        """Return the state after some steps of the classical Runge-Kutta method."""
        for _ in range(count):
            k1 = self.rate(0.0, state)
            k2 = self.rate(0.0, state + 0.5 * h * k1)
            k3 = self.rate(0.0, state + 0.5 * h * k2)
            k4 = self.rate(0.0, state + h * k3)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return state

    def solve(self, state: Array, seconds: float, method: str, rtol: float) -> tuple[Array, int]:
        """Return the state at the end, and the number of steps, of SciPy's solve_ivp."""
        done = solve_ivp(
            self.rate, (0.0, seconds), state, method=method, rtol=rtol, atol=1e-3 * rtol
        )
        return np.asarray(done.y[:, -1]), len(done.t) - 1
