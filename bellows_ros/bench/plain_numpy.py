"""
The same equations as a user would write them with NumPy: 4x4 poses, 6x6 matrices, RK4.

On purpose without this package's kernels; also the right-hand side for SciPy's `solve_ivp`.
"""

from bellows_ros.core.model import Cup, Package
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


def hat(v: Array) -> Array:
    """Return the matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def vee(S: Array) -> Array:
    """Return the vector of a skew matrix."""
    return np.array([S[2, 1], S[0, 2], S[1, 0]])


def pose(R: Array, o: Array) -> Array:
    """Return a homogeneous matrix."""
    H = np.eye(4)
    H[:3, :3], H[:3, 3] = R, o
    return H


def adjoint(H: Array) -> Array:
    """Return X(H) (2.24)."""
    R, o = H[:3, :3], H[:3, 3]
    return np.block([[R, hat(o) @ R], [np.zeros((3, 3)), R]])


class PlainModel:
    """
    Cup and package under a still tool at the origin.

    The state is a vector: position (3), rotation matrix (9), body twist (6).
    """

    def __init__(self, cup: Cup, package: Package, gravity: float) -> None:
        """Prepare the constant matrices."""
        half = 0.5 * cup.length
        self.K, self.P = cup.stiffness, cup.damping
        self.o_E_S = np.array([0.0, 0.0, -cup.length])
        self.z = np.array([0.0, 0.0, half])
        self.S_H_B = pose(np.eye(3), package.com)
        self.S_H_S1 = pose(np.eye(3), self.z)
        self.M = np.zeros((6, 6))
        self.M[:3, :3], self.M[3:, 3:] = package.mass * np.eye(3), package.inertia
        self.weight = np.array([0.0, 0.0, -package.mass * gravity])

    def rate(self, time: float, state: Array) -> Array:
        """Return the derivative of the state."""
        R, v = state[3:12].reshape(3, 3), state[12:]
        H = pose(R, state[:3])
        f = self._wrench(H, v)
        f[:3] += R.T @ self.weight
        w = hat(v[3:])
        cross = np.block([[w, hat(v[:3])], [np.zeros((3, 3)), w]])
        acceleration = np.linalg.solve(self.M, f + cross.T @ self.M @ v)
        return np.concatenate([R @ v[:3], (R @ w).ravel(), acceleration])

    def _wrench(self, H: Array, v: Array) -> Array:
        """Return the cup's wrench on the package at B (3.27), (3.33), (2.28)."""
        E_H_S = H @ np.linalg.inv(self.S_H_B)
        R = E_H_S[:3, :3]
        H12 = pose(R, self.z + R @ self.z + E_H_S[:3, 3])
        o = H12[:3, 3]
        strain = np.concatenate([(np.eye(3) + R.T) @ o, vee(R - R.T)])
        J = np.block([
            [R + np.eye(3), hat(R.T @ o)],
            [np.zeros((3, 3)), np.trace(R) * np.eye(3) - R.T],
        ])  # fmt: skip
        spring = -0.25 * J.T @ self.K @ strain
        to_S1 = np.linalg.inv(adjoint(self.S_H_S1))
        X = adjoint(H12)
        damper = -0.5 * (self.P + X.T @ self.P @ X) @ to_S1 @ adjoint(self.S_H_B) @ v
        return np.asarray(adjoint(self.S_H_B).T @ to_S1.T @ (spring + damper))

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
