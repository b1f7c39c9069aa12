"""
A second, slow implementation of the model: 6x6 matrices as the thesis prints them.

Poses and twists may have leading axes, one package each.
"""

from types import SimpleNamespace

from bellows_ros.core.geometry.lie import adjoint, apply, hat, inverse_transform, transform
import numpy as np
from scipy.integrate import solve_ivp

from ..cell.cup import GRAVITY_VECTOR
from ..cell.motion import Move

Z = np.array([0.0, 0.0, 1.0])


def vee(S):
    """Return v of v^, of skew-symmetric matrices (..., 3, 3)."""
    return S[..., [2, 0, 1], [1, 2, 0]]


def transposed(A):
    """Return A^T of matrices with leading axes."""
    return np.swapaxes(A, -1, -2)


def spring_frames(length, T_E_S):
    """Return S2_H_S1 as the product of poses (3.10-3.12)."""
    half = transform(np.eye(3), 0.5 * length * Z)
    return half @ T_E_S @ half


def strain(H):
    """Return h (3.18)."""
    R, R_T = H[..., :3, :3], transposed(H[..., :3, :3])
    return np.concatenate([apply(np.eye(3) + R_T, H[..., :3, 3]), vee(R - R_T)], axis=-1)


def potential(cup, H):
    """Return the elastic energy (3.17) including the energy of stretch, J."""
    h, (a, b) = strain(H), cup.stretch
    return h @ cup.stiffness @ h / 8.0 + a * h[2] ** 3 + b * h[2] * (h[3] ** 2 + h[4] ** 2)


def stretch_stress(cup, H):
    """Return 4 times the gradient of the energy of stretch by the strain."""
    h, (a, b) = strain(H), cup.stretch
    s = np.zeros(h.shape)
    s[..., 2] = 3.0 * a * h[..., 2] ** 2 + b * (h[..., 3] ** 2 + h[..., 4] ** 2)
    s[..., 3:5] = 2.0 * b * h[..., 2:3] * h[..., 3:5]
    return 4.0 * s


def effective_strain(cup, H, strains=()):
    """Return h + sum_b r_b (h - z_b) for internal strains z_b (12,), h without them."""
    h = strain(H)
    return h + sum((r * (h - z) for r, z in zip(
        cup.relaxation, np.reshape(strains, (-1, 6)), strict=False)), np.zeros(6))


def wrench_at_S1(cup, H, v1, strains=()):
    """Return the wrench of spring and damper on the package at S1 (3.24, 3.32, 3.33)."""
    R, R_T = H[..., :3, :3], transposed(H[..., :3, :3])
    J, X = np.zeros((*H.shape[:-2], 6, 6)), adjoint(H)
    J[..., :3, :3], J[..., :3, 3:] = R + np.eye(3), hat(apply(R_T, H[..., :3, 3]))
    J[..., 3:, 3:] = np.multiply.outer(np.trace(R, axis1=-2, axis2=-1), np.eye(3)) - R_T
    D = 0.5 * (cup.damping + transposed(X) @ cup.damping @ X)
    stress = effective_strain(cup, H, strains) @ cup.stiffness + stretch_stress(cup, H)
    return -0.25 * apply(transposed(J), stress) - apply(D, v1)


def wrench_at_lip(cup, T_E_S, v_ES, strains=()):
    """Return the cup's wrench on the package at S (3.27, 3.35)."""
    T_S_S1 = transform(np.eye(3), 0.5 * cup.length * Z)
    X = adjoint(inverse_transform(T_S_S1))
    return wrench_at_S1(cup, spring_frames(cup.length, T_E_S), v_ES @ X.T, strains) @ X


def lip_wrench(cup, package, T_A_E, v_E, T_A_B, v_B, strains=()):
    """Return the cup's wrench on the package at S for poses and twists of tool and package."""
    T_E_S = lip_pose(package, T_A_E, T_A_B)
    v_ES = apply(adjoint(transform(np.eye(3), package.com)), v_B) - apply(
        adjoint(inverse_transform(T_E_S)), v_E)
    return wrench_at_lip(cup, T_E_S, v_ES, strains)


def lip_pose(package, T_A_E, T_A_B):
    """Return the pose of the lip in the tool."""
    return inverse_transform(T_A_E) @ T_A_B @ transform(np.eye(3), -package.com)


def acceleration(cup, package, gravity, T_A_E, v_E, T_A_B, v_B, strains=()):
    """Return the rate of the package's body twist (3.5) with the generalized inertia (A.1)."""
    X = adjoint(transform(np.eye(3), package.com))
    f = apply(transposed(X), lip_wrench(cup, package, T_A_E, v_E, T_A_B, v_B, strains))
    weight = np.multiply.outer(package.mass, gravity)
    f[..., :3] += apply(transposed(T_A_B[..., :3, :3]), weight)
    M, dual_cross = np.zeros((2, *T_A_B.shape[:-2], 6, 6))
    M[..., :3, :3], M[..., 3:, 3:] = np.multiply.outer(package.mass, np.eye(3)), package.inertia
    dual_cross[..., :3, :3] = dual_cross[..., 3:, 3:] = hat(v_B[..., 3:])  # (2.32)
    dual_cross[..., 3:, :3] = hat(v_B[..., :3])
    return np.linalg.solve(M, (f - apply(dual_cross @ M, v_B))[..., None])[..., 0]


def energies(cup, package, gravity, T_A_E, T_A_B, v_B):
    """Return kinetic (3.43), elastic (3.17) and gravity's (3.44) energy (J) of one state."""
    H = spring_frames(cup.length, lip_pose(package, T_A_E, T_A_B))
    kinetic = package.mass * v_B[:3] @ v_B[:3] + v_B[3:] @ package.inertia @ v_B[3:]
    return np.array([0.5 * kinetic, potential(cup, H),
                     -package.mass * gravity @ T_A_B[:3, 3]])


def solve(cup, package, gravity, tool_at, T_start, v_start, times, strains=()):
    """
    Integrate the plain equations, R's nine entries as they are, with SciPy's DOP853.

    Internal strains (12,) are those at the start of a cup that relaxes.
    """
    tau = np.repeat(cup.relaxation_times, 6)

    def slope(t, y):
        T, v, z = np.eye(4), y[12:18], y[18:]
        T[:3, :3], T[:3, 3] = y[3:12].reshape(3, 3), y[:3]
        o_E, R_E, v_E = tool_at(t)
        T_E = transform(R_E, o_E)
        dv = acceleration(cup, package, gravity, T_E, v_E, T, v, z)
        h = strain(spring_frames(cup.length, lip_pose(package, T_E, T)))
        dz = (np.tile(h, 2) - z) / tau if len(z) else z
        return np.concatenate([T[:3, :3] @ v[:3], (T[:3, :3] @ hat(v[3:])).ravel(), dv, dz])

    y0 = np.concatenate([T_start[:3, 3], T_start[:3, :3].ravel(), v_start, strains])
    out = solve_ivp(slope, (times[0], times[-1]), y0, 'DOP853', times, rtol=3e-13, atol=1e-13)
    assert out.success, out.message
    return out.y[:3].T, out.y[3:12].T.reshape(-1, 3, 3), out.y[12:18].T


class Batch:
    """Many packages on one cup, each under its own move: the printed formulas, broadcast."""

    def __init__(self, cup, moves, packages):
        self.cup, self.packages = cup, SimpleNamespace(**{
            name: np.array([getattr(package, name) for package in packages])
            for name in ('mass', 'com', 'inertia')})
        self.moves = Move(*(np.array([getattr(move, name) for move in moves])
                            for name in ('way', 'turn', 'duration')))

    def tools(self, t):
        """Return poses (N, 4, 4) and body twists (N, 6) of the tools at a time (s)."""
        o, R, v = self.moves.at(t)
        return transform(R, o), v

    def run(self, T, v, duration, steps):
        """Yield time, tools, poses, twists and wrenches of all after every step of plain RK4."""
        h, tools = duration / steps, self.tools(0.0)
        for k in range(steps + 1):
            wrench = lip_wrench(self.cup, self.packages, *tools, T, v)
            yield k * h, tools, T, v, wrench
            middle, end = self.tools((k + 0.5) * h), self.tools((k + 1) * h)
            a1 = self.rates(tools, T, v)
            a2 = self.rates(middle, T + 0.5 * h * a1[0], v + 0.5 * h * a1[1])
            a3 = self.rates(middle, T + 0.5 * h * a2[0], v + 0.5 * h * a2[1])
            a4 = self.rates(end, T + h * a3[0], v + h * a3[1])
            T, v = (x + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                    for x, b1, b2, b3, b4 in zip((T, v), a1, a2, a3, a4, strict=True))
            tools = end

    def rates(self, tools, T, v):
        """Return the rates of poses (N, 4, 4), entry by entry, and of twists."""
        twist = np.zeros((len(v), 4, 4))
        twist[:, :3, :3], twist[:, :3, 3] = hat(v[:, 3:]), v[:, :3]
        return T @ twist, acceleration(self.cup, self.packages, GRAVITY_VECTOR, *tools, T, v)
