"""
A bellows independent of the spring law: an energy fitted to finite elements.

The energy is a polynomial of 20 numbers in the lip's shift from nominal and rotation vector, both
in tool axes. It was fitted to the wrenches of a hyperelastic silicone bellows (1.5 folds, outer
diameter 45.5 mm, length 48 mm, wall 2.5 mm; Neo-Hooke, 20-node hexahedra, large deformations, no
vacuum) in 92 poses up to 25 degrees and 8 mm, with residuals of 2.5 % in force and moment.
"""

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.lie import exp_so3, log_so3, rotation_to_quaternion
from bellows_ros.core.model import kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.simulation import row_state, trajectory_of, write_row
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from scipy.optimize import root

LENGTH = 0.048
DAMPING = np.diag([14.0, 14.0, 18.0, 0.012, 0.012, 0.015])


def package(mass, com=-0.03):
    """Return a box of 0.2 m x 0.16 m x 0.06 m."""
    return Package(mass, mass / 1.8 * np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, com))


@kernel
def slope_of_energy(u, v, z, p, q, t):
    """Return the slopes of the energy by shift (u, v, z), N, and rotation (p, q, t), N m."""
    uu, pp, w, up = u * u + v * v, p * p + q * q, u * q - v * p, u * p + v * q
    by_uu = 926.64 - 71964.0 * z + 427240.0 * uu + 587.66 * pp + 23300.0 * w
    by_pp = 1.2485 - 115.24 * z - 556.59 * z * z - 2.0356 * pp + 587.66 * uu - 59.694 * w - (
        0.28206 * t * t)
    by_w = 51.724 - 1635.0 * z - 118170.0 * z * z + 23300.0 * uu - 59.694 * pp
    by_z = 6806.0 * z - 394650.0 * z * z - 71964.0 * uu - 115.24 * pp - 1635.0 * w - (
        5026800.0 * z ** 3) - 1113.18 * z * pp - 236340.0 * z * w - 1759.72 * z * t * t
    by_up = 15.87 * t
    by_t = 1.5006 * t + 15.87 * up - 0.56412 * t * pp - 1759.72 * z * z * t
    return (
        (2.0 * u * by_uu + q * by_w + p * by_up, 2.0 * v * by_uu - p * by_w + q * by_up, by_z),
        (2.0 * p * by_pp - v * by_w + u * by_up, 2.0 * q * by_pp + u * by_w + v * by_up, by_t))


@entry
def spring_wrench(o, R, q):
    """Return the wrench on the package at the lip in its axes, for E_o_S, E_R_S and quaternion."""
    phi = t3.rotation_between((0.0, 0.0, 0.0, 1.0), q)
    f, m = slope_of_energy(o[0], o[1], o[2] + 0.048, phi[0], phi[1], phi[2])
    back = t3.scale(-1.0, phi)
    return t3.scale(-1.0, t3.apply_transposed(R, f)), t3.scale(
        -1.0, t3.rotation_vector_rate(back, m))


@kernel
def rates(model, tool, body, w):
    """Return the rates of a state as `kernels.rates`."""
    package = model[1]
    o, R, v_lip, w_lip = kernels.lip_relative_to_tool(package[1], tool, body)
    f, m = spring_wrench(o, R, t3.quaternion_product(t3.quaternion_conjugate(tool[1]), body[1]))
    g, n = kernels.cup_wrench(model[0], o, R, v_lip, w_lip, ())
    f, m = kernels.wrench_at_com(package[1], t3.add(f, g), t3.add(m, n))
    R_A_B = t3.rotation_matrix(body[1])
    dv, dw = kernels.newton_euler(package, model[2], R_A_B, body[2], body[3], f, m)
    return t3.apply(R_A_B, body[2]), w, dv, dw


@kernel
def advance(model, body, tool, middle, end, h):
    """Return the state after h by the Runge-Kutta method of order 4."""
    half = 0.5 * h
    a = rates(model, tool, body, body[3])
    b_ = kernels.stage_state(body, half, a[0], a[1], a[2], a[3])
    b = rates(model, middle, b_, kernels.rotation_rate(t3.scale(half, a[1]), b_[3]))
    c_ = kernels.stage_state(body, half, b[0], b[1], b[2], b[3])
    c = rates(model, middle, c_, kernels.rotation_rate(t3.scale(half, b[1]), c_[3]))
    d_ = kernels.stage_state(body, h, c[0], c[1], c[2], c[3])
    d = rates(model, end, d_, kernels.rotation_rate(t3.scale(h, c[1]), d_[3]))
    end_state = kernels.stage_state(
        body, h, kernels.weighted(a[0], b[0], c[0], d[0]),
        kernels.weighted(a[1], b[1], c[1], d[1]), kernels.weighted(a[2], b[2], c[2], d[2]),
        kernels.weighted(a[3], b[3], c[3], d[3]))
    return kernels.with_rotation(end_state, t3.normalised(end_state[1]))


@entry
def run(model, body, tool, h, out):
    """Advance over two tool samples at a time."""
    write_row(out[0], body)
    for k in range(len(out) - 1):
        body = advance(model, body, row_state(tool[2 * k]), row_state(tool[2 * k + 1]),
                       row_state(tool[2 * k + 2]), h)
        write_row(out[k + 1], body)


def lip_wrench(pose):
    """Return the wrench (6,) on the package at the lip, for shift and rotation vector (6,)."""
    R = exp_so3(pose[3:])
    return np.hstack(spring_wrench(
        (pose[0], pose[1], pose[2] - LENGTH), tuple(R.ravel().tolist()),
        tuple(rotation_to_quaternion(R).tolist())))


def at_rest(R_tool, payload):
    """Return shift and rotation vector (6,) of the lip of a package that hangs at rest."""
    def unbalance(pose, part):
        f = lip_wrench(pose)
        weight = part * payload.mass * 9.81 * (R_tool @ exp_so3(pose[3:])).T @ [0.0, 0.0, -1.0]
        return f + np.hstack([weight, np.cross(payload.com, weight)])

    pose = np.zeros(6)
    for part in (0.25, 0.5, 0.75, 1.0):
        found = root(unbalance, pose, args=(part,), tol=1e-12)
        assert found.success
        pose = found.x
    return pose


def simulate(tool, payload):
    """Return the package's motion under a tool motion (Trajectory) of 2 N + 1 samples, N + 1."""
    unsprung = Cup(np.zeros((6, 6)), DAMPING, LENGTH)
    model = model_tuple(unsprung, payload, 9.81)
    rows = np.hstack([tool.position, rotation_to_quaternion(tool.rotation), tool.twist])
    pose = at_rest(tool.rotation[0], payload)
    R = tool.rotation[0] @ exp_so3(pose[3:])
    o = tool.position[0] + tool.rotation[0] @ (pose[:3] - [0, 0, LENGTH]) + R @ payload.com
    out = np.empty((len(rows) // 2 + 1, 13))
    h = float(tool.stamps_ns[2] - tool.stamps_ns[0]) * 1e-9
    start = row_state(np.hstack([o, rotation_to_quaternion(R), np.zeros(6)]))
    run(model, start, rows, h, out)
    return trajectory_of(tool.stamps_ns[::2], out)


def bending(R_tool, R):
    """Return the rotation vectors of the lip in the tool."""
    return log_so3(np.swapaxes(R_tool, -1, -2) @ R)


def measured(body, rng, every=10, position=1e-4, rotation=5e-4):
    """Return every n-th pose of a motion with white noise (m, rad), without twists."""
    some = slice(None, None, every)
    n = len(body.stamps_ns[some])
    return Trajectory(
        body.stamps_ns[some], body.position[some] + position * rng.standard_normal((n, 3)),
        body.rotation[some] @ exp_so3(rotation * rng.standard_normal((n, 3))))
