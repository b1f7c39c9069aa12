"""A throw in closed form, a cup, a box, and a second implementation of the whole toss."""

from bellows_ros.core.geometry.lie import hat, transform
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from scipy.integrate import solve_ivp

from . import oracle
from ..cell.cup import CUP, GRAVITY_VECTOR, VALUES
from ..cell.motion import Move

PACKAGE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.004, -0.003, -0.03))
HALF = np.array([0.11, 0.09, 0.06])
GRIP = (90.0, 0.02, 0.5)
DURATION = 1.0
THROW = Move([1.2, 0.1, 0.25], [0.05, -0.5, 0.2], DURATION)


def tool_at(t):
    """Return position, rotation and body twist of a throw: 2.3 m/s, up, turning about y and z."""
    o, R, v = THROW.at(t)
    return o + [0.0, 0.0, 0.9], R, v


def plan(rate_hz=1000):
    """Return the throw sampled."""
    stamps = np.round(np.arange(int(DURATION * rate_hz) + 1) / rate_hz * 1e9).astype(np.int64)
    return Trajectory(stamps, *tool_at(stamps * 1e-9))


def values():
    """Give parameters of the case, with standard deviations as an identification leaves them."""
    K, P = np.diag(CUP.stiffness), np.diag(CUP.damping)
    return {
        **VALUES, 'package.com': tuple(PACKAGE.com),
        'cup.stiffness_std': tuple(np.diag(0.004 * K).ravel()),
        'cup.damping_std': tuple(np.diag(0.02 * P).ravel()),
        'cup.lip_radius': GRIP[1], 'cup.suction_area': 1e-3, 'vacuum.holding': GRIP[0] / 1e-3,
        'package.size': tuple(2 * HALF), 'release.delay': 0.012, 'release.fall': 0.04,
        'release.std': (5e-4, 1e-3, 0.0, 0.0, 0.0, 0.0),
    }


def corners():
    """Return the eight corners of the box in B, one per row."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return signs * HALF


def opened(T_E_S, law, late):
    """Return a cup whose axial force consists of suction, folds in contact and an open bellows."""
    delay, fall, closing, opening, damping, _ = law
    if late < delay or not opening:
        return CUP
    stretch = -(T_E_S[:3, :3].T @ T_E_S[:3, 3])[2] - CUP.length
    suction = 1.0 - (late - delay) / fall
    K = CUP.stiffness[2, 2]
    force = closing * suction - max(0.0, closing - K * stretch)
    force += closing * (max(0.0, stretch) / opening) ** 2
    P = CUP.damping.copy()
    P[2, 2] = damping or P[2, 2]
    return Cup(CUP.stiffness, P, CUP.length + stretch - force / K)


def integrate(start, switched, law, height, grip=GRIP):
    """
    Return letting go and landing (time, position, rotation, twist), by SciPy with events.

    The rotation's nine entries are integrated as they are; the flight follows Euler's equations.
    """
    package, (delay, fall, *_, sticking) = PACKAGE, law

    def cup_at(T, t):
        o_E, R_E, _ = tool_at(t)
        return opened(oracle.lip_pose(package, transform(R_E, o_E), T), law, t - switched)

    def parts(y):
        return transform(y[3:12].reshape(3, 3), y[:3]), y[12:]

    def slope(t, y):
        T, v = parts(y)
        o_E, R_E, v_E = tool_at(t)
        dv = oracle.acceleration(
            cup_at(T, t), package, GRAVITY_VECTOR, transform(R_E, o_E), v_E, T, v)
        return np.concatenate([T[:3, :3] @ v[:3], (T[:3, :3] @ hat(v[3:])).ravel(), dv])

    def margin(t, y):
        T, v = parts(y)
        o_E, R_E, v_E = tool_at(t)
        f = oracle.lip_wrench(cup_at(T, t), package, transform(R_E, o_E), v_E, T, v)
        left = grip[0] * (1.0 - max(0.0, t - switched - delay) / fall + sticking)
        return left - f[2] - 2.0 * np.hypot(f[3], f[4]) / grip[1]

    def falling(t, y):
        T, v = parts(y)
        R, w, inertia = T[:3, :3], v[3:], package.inertia
        dv = R.T @ GRAVITY_VECTOR - np.cross(w, v[:3])
        dw = np.linalg.solve(inertia, -np.cross(w, inertia @ w))
        return np.concatenate([R @ v[:3], (R @ hat(w)).ravel(), dv, dw])

    def clearance(t, y):
        T, _ = parts(y)
        return (T[2, 3] + corners() @ T[2, :3]).min() - height

    margin.terminal = clearance.terminal = True
    options = {'method': 'DOP853', 'rtol': 1e-12, 'atol': 1e-12}
    y = solve_ivp(slope, (0.0, switched), start, **options).y[:, -1]
    out = solve_ivp(slope, (switched, switched + 1.0), y, events=margin, max_step=1e-3, **options)
    t, y = out.t_events[0][0], out.y_events[0][0]
    released = (t, y[:3], y[3:12].reshape(3, 3), y[12:].copy())
    out = solve_ivp(falling, (t, t + 3.0), y, events=clearance, max_step=5e-3, **options)
    t, y = out.t_events[0][0], out.y_events[0][0]
    return released, (t, y[:3], y[3:12].reshape(3, 3), y[12:])
